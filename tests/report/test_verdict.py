"""The answer in words says what was measured, whether chance explains it, and what the records say of the cause."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.core.findings import finding
from neuspring.core.job_records import keep_asked
from neuspring.report.blocks import Code, Text
from neuspring.report.grid import ratio_text
from neuspring.report.summary import detail_blocks
from neuspring.report.verdict import again, headline, verdict
from neuspring.scores import statistics
from neuspring.scores.numbers import Numbers
from neuspring.scores.runs import Collected, as_asked, collect
from tests.support import report_tree
from tests.support.runs import run_record
from tests.support.study_runs import collected, rows_of, summary, tables_in

TWO = {("a", "ours", 0): 0.010, ("a", "base", 0): 0.020, ("b", "ours", 0): 0.030, ("b", "base", 0): 0.028}


def said(found: Collected, **options) -> dict[str, str]:
    """Label to text, without commands."""
    blocks = verdict(Numbers(**({"everything": found, "baseline": "base"} | options)))
    return {one.label: one.text for one in blocks if isinstance(one, Text)}


def test_a_lead_that_is_not_resolved_is_no_lead_and_where_the_best_is_weakest_is_said():
    texts = said(collected(TWO | {("a", "still", 0): 0.1, ("b", "still", 0): 0.1}))
    assert texts["Who wins"] == (
        "No method is ahead (2 scenes, 1 seed). The track error on future frames of ours is 0.732 times that of base "
        "(geometric mean over 2 scenarios)."
    )
    assert texts["What went wrong"] == (
        "ours is weakest in b (30.00 mm). base is better in b (28.00 against 30.00 mm); it is worse in a (20.00 against 10.00 mm)."
    )


@pytest.mark.parametrize(
    ("values", "start"),
    [
        ({("a", "ours", 0): 0.01}, "ours is alone: its track error on future frames is 10.00 mm."),
        ({("a", "ours", 0): 0.01, ("a", "base", 0): 0.01}, "No method is ahead (1 scene, 1 seed). The track error"),
        ({("a", "ours", 0): 0.02, ("a", "base", 0): 0.01}, "No method is ahead (1 scene, 1 seed). The track error"),
    ],
)
def test_nobody_wins_alone_or_by_nothing(values, start):
    assert said(collected(values))["Who wins"].startswith(start)


@pytest.mark.parametrize(
    ("factors", "answer", "words"),
    [
        ([0.5], "No.", "1 scenario cannot tell a lead from chance; 3 give an interval. Seeds 0, 1 and 2 would tell"),
        ([0.80, 0.82, 0.78], "Not yet.", "interval, but fewer than 6 scenarios are too few. Seeds"),
        ([0.8, 0.9, 0.7] * 2, "Yes.", "1 lies outside the interval. Seeds"),
        ([0.5, 0.9, 0.8], "No.", "1 lies in the interval. 6 scenarios that scatter alike would resolve it."),
        ([0.5, 1.9, 1.0], "No.", "1 lies in the interval. The lead is too small to be resolved."),
    ],
)
def test_chance_is_judged_and_what_would_resolve_it_is_counted(factors, answer, words):
    values = {(f"s{i}", m, 0): 0.02 * f for i, factor in enumerate(factors) for m, f in (("ours", factor), ("base", 1.0))}
    texts = said(collected(values))
    assert texts["Is it resolved"].startswith(answer) and words in texts["Is it resolved"]
    ahead = "ours is ahead of base" if answer in ("Yes.", "Not yet.") else "No method is ahead"
    assert texts["Who wins"].startswith(f"{ahead} (")
    if len(factors) > 1:
        ends = np.exp(statistics.t_interval(np.log(factors)))
        assert f" times that of base (geometric mean and 95 % interval over {len(factors)} scenarios)" in texts["Who wins"]
        assert f"of ours is {np.exp(np.log(factors).mean()):.3f} [{ends[0]:.3f}, {ends[1]:.3f}] times" in texts["Who wins"]


def test_one_large_error_does_not_make_a_leader():
    values = {(f"s{i}", m, 0): error for i in range(5) for m, error in (("ours", 0.013), ("base", 0.010))}
    texts = said(collected(values | {("s5", "ours", 0): 0.98, ("s5", "base", 0): 1.1}))
    assert texts["Who wins"].startswith(
        "base is ahead of ours (6 scenes, 1 seed). The track error on future frames of ours is 1.22"
    )
    assert "First by other measures: ours in mean TE (" in texts["What went wrong"]


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_pair_has_one_number_in_the_verdict_and_in_the_table(factor):
    values = {
        (f"s{i}", m, 0): 0.01 * f * (1 + 0.1 * i * (m == "ours")) for i in range(4) for m, f in (("ours", factor), ("base", 1))
    }
    numbers = Numbers(everything=collected(values), baseline="base", names={"base": "The base (`base`)"})
    cell = rows_of(tables_in(detail_blocks(numbers))["Ratio of the error to that of The base (`base`)"])["ours"]["Future TE"]
    assert cell.text == ratio_text(numbers.ratios.iloc[0]) and cell.text.count(".") == 3
    assert f" of ours is {cell.text} times that of The base (`base`) (" in verdict(numbers)[0].text


def test_the_best_track_error_with_the_worst_overlap_is_explained():
    found = collected(TWO)
    overlap = found.scores.assign(metric="iou", unit="1", value=[0.6, 0.7, 0.7, 0.8])
    text = said(Collected(pd.concat([found.scores, overlap]), found.runs))["What went wrong"]
    assert "The best track error goes with the worst IoU: ours in a (TE 10.00 mm and IoU 60.0 %). The two measure" in text
    other = overlap.assign(value=[0.8, 0.7, 0.7, 0.7])
    assert "worst IoU" not in said(Collected(pd.concat([found.scores, other]), found.runs))["What went wrong"]


def test_next_moves_are_commands_for_the_folder_in_use(tmp_path):
    results = report_tree.make(tmp_path / "results", ["rope"], ["baseline", "neuspring"], [0], pictures=False)
    keep_asked(results, {"command": ["snakemake", "--config", f"results={results}", "seeds=[0]", "--cores", "2"], "only": ""})
    found = collect(results, ["rope"], ["baseline", "neuspring"], [0, 1])
    blocks = verdict(Numbers(everything=found, baseline="baseline", results=results))
    commands = [shlex.split(one.text) for one in blocks if isinstance(one, Code)]
    assert commands[0] == ["snakemake", "--config", f"results={results}", "seeds=[0]", "--cores", "2"]
    # One scene: other seeds say little, and come last.
    assert commands[2] == ["snakemake", "--config", "seeds=[0,1,2]", f"results={results}", "--cores", "2"]
    assert Path(commands[1][0]).name == "neuspring" and commands[1][1] == "play"
    assert all((Path(place) / "run.json").is_file() for place in commands[1][2:]) and len(commands[1]) == 4
    assert again({"command": ["snakemake", "report"]}, "seeds", "[0,1,2]") == "snakemake report --config 'seeds=[0,1,2]'"
    assert again({}, "seeds", "[0,1,2]") == ""


def test_runs_that_only_left_out_are_not_missing(tmp_path):
    results = report_tree.make(tmp_path / "results", ["rope"], ["baseline"], [0], pictures=False)
    whole = collect(results, ["rope", "cloth"], ["baseline", "neuspring"], [0])
    about = {"only": "method=baseline scenario=rope", "scenarios": ["rope"], "methods": ["baseline"], "seeds": [0]}
    found, part = as_asked(whole, about)
    texts = said(found, asked=part)
    assert "As asked: only=method=baseline scenario=rope;" in texts["What went wrong"] and "not finished" not in str(texts)
    more, part = as_asked(whole, about | {"methods": ["baseline", "neuspring"]})
    assert "1 of 2 runs have not finished." in said(more, asked=part)["What went wrong"]
    assert as_asked(whole, {}) == (whole, "") and as_asked(found, about)[1] == ""


def test_as_many_scenarios_as_it_asks_for_do_resolve_it():
    logs = np.random.default_rng(3).normal(-0.2, 0.3, 5)
    low, high = np.exp(statistics.t_interval(logs))
    count = statistics.needed(low, high, 5)
    shape = np.linspace(-1, 1, count)
    more, fewer = (
        logs.mean() + logs.std(ddof=1) * part / part.std(ddof=1) for part in (shape - shape.mean(), np.linspace(-1, 1, count - 1))
    )
    assert low < 1 < high and statistics.t_interval(more)[1] < 0 < statistics.t_interval(fewer)[1]
    assert statistics.needed(0.5, 2.001, 5) is None


def test_failures_missing_runs_and_other_measures_are_named():
    found = collected(TWO, failed=(("c", "ours", 0),))
    missing = pd.DataFrame([{"scenario": "c", "method": "base", "seed": 0, "status": "missing", "reason": "", "notes": ""}])
    other = found.scores.assign(metric="chamfer", value=found.scores["value"].where(found.scores["method"] == "base", 0.05))
    text = said(Collected(pd.concat([found.scores, other]), pd.concat([found.runs, missing])))["What went wrong"]
    assert text.startswith("1 of 6 runs have not finished. 1 of 6 runs failed, first ours on c: diverged. ")
    assert text.endswith("First by other measures: base in CD (24.00 against 50.00).")


def test_nothing_finished_is_no_verdict():
    assert said(collected({}, failed=(("a", "ours", 0),))) == {
        "Who wins": "Nothing can be compared yet: 0 of 1 runs have finished.",
        "What went wrong": "1 of 1 runs failed, first ours on a: diverged.",
    }


def test_the_cause_is_what_the_records_of_the_weakest_scenario_say_with_the_next_move():
    params = {"search.result.at_ends": "drag", "fit.result.at_bound": 0.38}
    records = {(s, "ours", 0): run_record(scenario=s, method="ours", params=params if s == "b" else {}) for s in "ab"}
    warned = finding("two objects", "warning", "camera 0", "2 pieces", "one is expected", "Look at masks.png; mark it.")
    texts = said(replace(collected(TWO), records=records), warnings=(("b", warned), ("a", replace(warned, name="other"))))
    assert texts["Probable cause"] == (
        "b: two objects (camera 0). Look at masks.png; mark it. ours on b: fraction of the springs at the bound of "
        "their stiffness (fit.output_bound): 38 %, at most 5 % expected; a wider bound may predict better. Raise fit.output_bound "
        "of this method, and compare. ours on b: the search ended at an end of its range in drag. Widen search.variables for drag."
    )


@pytest.mark.parametrize(
    ("trained", "word"), [(0.004, "drifts after it (4.00 mm"), (0.020, "on training frames already (20.00 mm")]
)
def test_without_a_record_of_a_cause_the_course_of_the_error_is_told(trained, word):
    found = collected(TWO)
    more = found.scores.assign(task="reconstruction", value=trained)
    texts = said(Collected(pd.concat([found.scores, more]), found.runs))
    assert word in texts["Probable cause"]


def test_a_terminal_shows_the_verdict_then_the_first_table():
    text = headline(summary(collected(TWO), "base"))
    assert text.startswith("Who wins: No method is ahead") and text.count("\n| ") == 3
    assert text.index("Next move" if "Next move" in text else "What went wrong") < text.index("In mm, lower is better")
    assert headline("# Scores\n\nNo run has finished.\n") == "No run has finished."
