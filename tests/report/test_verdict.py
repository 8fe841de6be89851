"""The answer in words says what was measured, whether chance explains it, and what the records say of the cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from neuspring.core.findings import finding
from neuspring.report.verdict import headline, verdict
from neuspring.scores import statistics
from neuspring.scores.numbers import Numbers
from neuspring.scores.runs import Collected
from tests.support.runs import run_record
from tests.support.study_runs import collected, summary

TWO = {("a", "ours", 0): 0.010, ("a", "base", 0): 0.020, ("b", "ours", 0): 0.030, ("b", "base", 0): 0.028}


def said(found: Collected, **options) -> dict[str, str]:
    """Label to text."""
    return {one.label: one.text for one in verdict(Numbers(**({"everything": found, "baseline": "base"} | options)))}


def test_the_winner_comes_with_its_error_its_lead_and_where_it_is_weakest():
    texts = said(collected(TWO | {("a", "still", 0): 0.1, ("b", "still", 0): 0.1}))
    assert texts["Who wins"] == (
        "ours, by track error on future frames: 20.00 mm, mean over 2 scenarios. "
        "That is 17 % below base (24.00 mm) and 80 % below still (100.00 mm)."
    )
    assert texts["What went wrong"] == "ours is weakest in b (30.00 mm). base is better in b."


@pytest.mark.parametrize(
    ("values", "start"),
    [
        ({("a", "ours", 0): 0.01}, "ours is alone: its track error on future frames is 10.00 mm."),
        ({("a", "ours", 0): 0.01, ("a", "base", 0): 0.01}, "Nobody: ours and base have the same track error"),
        ({("a", "ours", 0): 0.02, ("a", "base", 0): 0.01}, "base, by track error on future frames: 10.00 mm in a. That is 50 %"),
    ],
)
def test_nobody_wins_alone_or_by_nothing(values, start):
    assert said(collected(values))["Who wins"].startswith(start)


@pytest.mark.parametrize(
    ("factors", "answer", "words"),
    [
        ([0.5], "No.", "1 scenario cannot tell a lead from chance; 3 give an interval. Seeds 0, 1 and 2 would tell"),
        ([0.80, 0.82, 0.78], "Not yet.", "below 1, but fewer than 6 are too few. Seeds"),
        ([0.8, 0.9, 0.7] * 2, "Yes.", "Over 6 scenarios the ratio of its error to that of base is 0.796, interval"),
        ([0.5, 0.9, 0.8], "No.", "1 lies in it. 6 scenarios that scatter alike would resolve it."),
        ([0.5, 1.9, 1.0], "No.", "1 lies in it. The lead is too small to be resolved."),
    ],
)
def test_chance_is_judged_and_what_would_resolve_it_is_counted(factors, answer, words):
    values = {(f"s{i}", m, 0): 0.02 * f for i, factor in enumerate(factors) for m, f in (("ours", factor), ("base", 1.0))}
    # So that `ours` has the least mean although its ratio is large there.
    values |= {("s1", "base", 0): 0.005, ("s1", "ours", 0): 0.005 * factors[1]} if len(factors) > 1 else {}
    text = said(collected(values))["Is it resolved"]
    assert text.startswith(answer) and words in text
    if len(factors) > 1:
        ends = np.exp(statistics.t_interval(np.log(factors)))
        assert f"interval {ends[0]:.3f} to {ends[1]:.3f}: " in text


def test_a_lead_that_one_large_error_makes_is_none():
    values = {(f"s{i}", m, 0): error for i in range(5) for m, error in (("ours", 0.013), ("base", 0.010))}
    texts = said(collected(values | {("s5", "ours", 0): 0.98, ("s5", "base", 0): 1.0}))
    assert texts["Who wins"].startswith("ours, ")
    assert texts["Is it resolved"].startswith("No. ") and ": above 1. A few large errors of base" in texts["Is it resolved"]


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
    assert text.endswith("By other measures base is first: CD (24.00 against 50.00).")


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
        "b: two objects (camera 0). ours on b: up to 38% of the springs lie at the bound of their stiffness (fit.output_bound). "
        "ours on b: the search ended at an end of its range in drag."
    )
    assert "Look at masks.png; mark it." in texts["Next move"]
    move = "Raise output_bound in the settings of the row ours of the method table. Widen search.variables for drag."
    assert texts["Next move"].endswith(move)


@pytest.mark.parametrize(
    ("trained", "word"), [(0.004, "drifts after it (4.00 mm"), (0.020, "on training frames already (20.00 mm")]
)
def test_without_a_record_of_a_cause_the_course_of_the_error_is_told(trained, word):
    found = collected(TWO)
    more = found.scores.assign(task="reconstruction", value=trained)
    texts = said(Collected(pd.concat([found.scores, more]), found.runs))
    assert word in texts["Probable cause"] and " b" in texts["Next move"]


def test_a_terminal_shows_the_verdict_then_the_first_table():
    text = headline(summary(collected(TWO), "base"))
    assert text.startswith("Who wins: ours, by") and text.count("\n| ") == 3
    assert text.index("Next move" if "Next move" in text else "What went wrong") < text.index("In mm, lower is better")
    assert headline("# Scores\n\nNo run has finished.\n") == "No run has finished."
