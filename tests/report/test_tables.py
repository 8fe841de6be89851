"""Tables show which method is better and whether this is resolved, compare equal sets, and show gaps."""

import json
from dataclasses import replace

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.config import parse
from neuspring.config.settings import Aim
from neuspring.core.table import Cell, Table, lay_out, tex
from neuspring.report.blocks import markdown
from neuspring.report.notes import of_runs
from neuspring.report.tables import (
    Compared,
    behind,
    failure_blocks,
    shown_names,
    summary_blocks,
    verdict,
    write,
)
from neuspring.scores import statistics
from neuspring.scores.metrics import METRICS
from neuspring.scores.statistics import paired_differences, resampled_means
from neuspring.scores.table import ScoreTable, collect, read_scores
from tests.support.runs import run_record
from tests.support.study_runs import collected, rows_of, tables_in, write_run

FUTURE = ("future", "track_error")


def benchmark(values, failed=(), baseline: str = "base", **facts) -> Compared:
    return Compared(table=collected(values, failed, **facts), baseline=baseline)


@pytest.mark.parametrize(
    ("factors", "resolved", "ahead"),
    [
        ([0.5], statistics.TOO_FEW, "No method"),
        ([0.80, 0.82, 0.78], statistics.BELOW, "ours"),
        ([1.2, 1.25, 1.3], statistics.ABOVE, "base"),
        ([0.5, 1.9, 1.0], statistics.NOT_RESOLVED, "No method"),
    ],
)
def test_the_verdict_says_who_is_ahead_by_how_much_and_whether_it_is_resolved(factors, resolved, ahead):
    values = {(f"s{i}", m, 0): 0.02 * f for i, factor in enumerate(factors) for m, f in (("ours", factor), ("base", 1.0))}
    lead, table = verdict(benchmark(values))[:2]
    mean = np.exp(np.log(factors).mean())
    assert lead.text.startswith(f"{ahead} is ahead") and f"{mean:.3f}" in lead.text and ". " not in lead.text
    assert (f"({resolved})" in lead.text) == (ahead == "No method")
    row = rows_of(table)["ours"]
    assert row["Verdict"].text == resolved and row["Ratio [95 %]"].text in lead.text
    assert (row["Error"].text, row["Rival's error"].text) == (f"{20 * np.mean(factors):.2f}", "20.00")
    assert [rows_of(table)["base"][name].text for name in ("Rival", "Rival's error", "Better in")] == ["", "–", ""]
    assert row["Better in"].text == f"{sum(f < 1 for f in factors)} of {len(factors)}"
    assert row["Worst scenario (error)"].text.startswith(f"s{int(np.argmax(factors))} (")


def test_nobody_wins_alone_or_before_anything_has_finished():
    assert "Only ours has results" in verdict(benchmark({("a", "ours", 0): 0.01}))[0].text
    (only,) = verdict(benchmark({}, failed=[("a", "ours", 0)]))
    assert only.text == "No comparison is possible yet: 0 of 1 runs have finished."


def test_averages_mark_the_best_count_runs_and_keep_oracles_apart():
    values = {("a", "x", 0): 0.010, ("a", "y", 0): 0.008, ("b", "x", 0): 0.5, ("a", "o", 0): 0.001}
    table = collected(values, failed=[("b", "y", 0), ("a", "z", 0)])
    table = ScoreTable(table.rows, table.runs.assign(oracle=table.runs["method"] == "o"))
    numbers = Compared(table=table, baseline="x", names={"x": "The x (`x`)"})
    rows = rows_of(tables_in(summary_blocks(numbers))["Errors, mm"])
    assert {name: (row["Future TE ↓"].text, row["Future TE ↓"].mark, row["Runs"].text) for name, row in rows.items()} == {
        "The x (`x`)": ("10.00", "", "2/2"),
        "y": ("8.00", "best", "1/2 (1 failed)"),
        "o (oracle)": ("1.00", "", "1/1"),
    }
    assert "Averages use the 1 of 2 pairs" in markdown(summary_blocks(numbers))
    assert {row["Method"].text for row in rows_of(failure_blocks(numbers)[-1]).values()} == {"y", "z"}


@pytest.mark.parametrize(("better", "heading", "marked"), [("higher", "Future TE ↑", ["x"]), ("neither", "Future TE", [])])
def test_the_direction_of_a_metric_decides_what_is_best_and_only_errors_have_ratios(better, heading, marked, monkeypatch):
    monkeypatch.setitem(METRICS._loaded, "track_error", replace(METRICS["track_error"], better=better))
    values = {(scenario, m, 0): error for scenario in "abc" for m, error in (("x", 0.010), ("y", 0.008))}
    found = tables_in(summary_blocks(benchmark(values, baseline="x")))
    for caption in ("Errors, mm", "Per scenario"):
        assert {name for name, row in rows_of(found[caption]).items() if row[heading].mark} <= {*marked, *"abc"}
    assert [name for name, row in rows_of(found["Errors, mm"]).items() if row[heading].mark] == marked
    (change,) = rows_of(found["Compared with x"]).values()
    assert change[heading].text.startswith("-2.00 [") and not change[heading].tone


def test_changes_breakdowns_and_pictures_have_tables():
    facts = {"views": ["0"], "masks": "given", "lpips": "no AlexNet weights"}
    values = {
        (s, m, seed): {FUTURE: 0.01 * f * (1 + seed), ("future", "psnr"): 30.0 + f}
        for s in "abcdef" for m, f in (("x", 1.0), ("y", 0.9)) for seed in (0, 1)
    }  # fmt: skip
    numbers = benchmark(values, baseline="x", images=json.dumps(facts))
    found = tables_in(summary_blocks(numbers))
    assert rows_of(found["Errors, mm"])["y"]["Future TE ↓"].text == "13.50 ± 6.36"
    changes = rows_of(found["Compared with x"])["y"]
    assert changes["Future TE ↓"].text == "0.900 [0.900, 0.900]: below 1"
    assert changes["Future PSNR ↑"].text == "-0.100 [-0.100, -0.100]"
    assert "lpips: no AlexNet weights" in found["Image scores"].note
    assert len(found["Per scenario"].rows) == 12 and found["Per scenario"].rows[1][2].mark == "best"


def test_aims_are_judged():
    values = {(s, m, 0): v * (1 + 0.02 * i * (m == "y")) for i, s in enumerate("abcd") for m, v in (("x", 0.01), ("y", 0.007))}
    aims = tuple(parse(Aim, {"method": "y", "baseline": "x", "ratio": ratio}, "here") for ratio in (0.85, 0.5))
    numbers = Compared(table=collected(values), baseline="x", aims=aims)
    rows = tables_in(summary_blocks(numbers))["Aims of the configuration"].rows
    assert [row[-1].text for row in rows] == ["reached", "missed"]


def test_failures_and_settings_are_listed(tmp_path):
    write_run(tmp_path, "a", "x", 0, {FUTURE: 0.01}, settings={"fit": {"horizon": 1}})
    write_run(tmp_path, "a", "y", 0, {FUTURE: 0.02}, settings={"fit": {"horizon": 9}})
    write_run(
        tmp_path,
        "b",
        "y",
        0,
        {},
        status="failed",
        reason="rollout: node 3 | left",
        frozen={FUTURE: 0.1},
        settings={"fit": {"horizon": 9}},
    )
    table = collect(tmp_path, ["a", "b"], ["x", "y"], [0], {"x": {"b": "needs images"}})
    text = write(Compared(table=table, baseline="x"), tmp_path / "tables")
    assert "| y      | successful and failed runs | 60.00" in text
    assert "rollout: node 3 \\| left" in text and "| x      | does not apply | b " in text
    assert "| fit.horizon | 1: x; 9: y" in text
    assert (tmp_path / "tables" / "summary.md").read_text().startswith("# Scores\n")
    table = behind(read_scores(tmp_path / "tables" / "scores.csv"), ["y", "future", "TE"], tmp_path)
    (row,) = (dict(zip(table.header, (cell.text for cell in row), strict=True)) for row in table.rows)
    assert row["value"] == "0.02" and (tmp_path / "a/y/0/run.json").samefile(row["run"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tables", "--left-out", '{"x": "a"}'], "--left-out"),
        (["tables", "--left-out", "{"], "--left-out"),
        (["tables"], "must contain runs"),
        (["explain", "nobody"], "scores.csv"),
        (["study", "--study", "nothing"], "must be an entry of"),
    ],
)
def test_what_cannot_be_laid_out_is_refused(tmp_path, arguments, words, capsys):
    output = [] if arguments[0] == "explain" else ["--output", str(tmp_path / "out")]
    assert main([*arguments, "--results", str(tmp_path), *output]) == 2
    assert words in capsys.readouterr().err


def test_commands_make_tables_studies_and_explanations(tmp_path, capsys):
    for number in range(6):
        for method, factor in (("baseline", 1.0), ("neuspring", 0.8)):
            write_run(tmp_path, f"cable_{number}", method, 0, {FUTURE: 0.01 * factor * (1 + number)}, source="mocap")
    tables = tmp_path / "tables"
    assert main(["tables", "--results", str(tmp_path), "--output", str(tables), "--baseline", "baseline", "--brief"]) == 0
    assert (
        "NeuSpring (`neuspring`) is ahead: the track error on future frames of NeuSpring (`neuspring`) is 0.800 ["
        in capsys.readouterr().out
    )
    assert main(["study", "--study", "table1", "--results", str(tmp_path), "--output", str(tables / "studies")]) == 0
    assert main(["study", "--study", "table1", "--scores", str(tables / "scores.csv"), "--output", str(tmp_path / "other")]) == 0
    assert (tables / "studies" / "table1.csv").read_text() == (tmp_path / "other" / "table1.csv").read_text()
    assert main(["explain", "neuspring/future/TE", "--results", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "Rows of scores.csv: 6 match neuspring/future/TE" in out and f"{tmp_path}/cable_5/neuspring/0/run.json" in out
    assert main(["explain", "neuspring/pst", "--results", str(tmp_path)]) == 2
    assert "method: neuspring |" in capsys.readouterr().err


def test_findings_of_runs_name_the_next_move():
    params = {"search.result.at_ends": "drag", "fit.result.best_epoch": -1, "fit.result.springs": 9, "fit.result.object_springs": 9}
    found = of_runs([run_record(scenario="b", method="ours", params=params), run_record(scenario="c", method="ours")])
    assert {finding.name: finding.remedy for _, finding in found} == {
        "search at an end of its range": "Widen search.variables for drag.",
        "training improved nothing": "Lower fit.learning_rate.",
        "no spring joins a controller to the object": "Look at the controllers in lifted.png.",
    }


def test_methods_have_names_for_people(tmp_path):
    from pathlib import Path

    names = shown_names(Path(__file__).resolve().parents[2] / "config" / "methods.yaml")
    assert names["search_only"] == "CMA-ES alone (`search_only`)"
    assert shown_names(tmp_path / "absent.yaml") == {}


def test_a_table_is_laid_out_as_text_markdown_latex_and_html():
    cell = Cell(text="1.5 ± 0.1: worse", mark="second", tone="bad", value=1.5)
    table = Table(
        caption="T & U",
        header=["Method", "CD ↓"],
        rows=[[Cell(text="a|`b`"), cell], [Cell(text="<3"), Cell(text="x")]],
        note="50 %",
    )
    head, rule, first, _ = table.markdown()
    assert first == "| a\\|`b` | <ins>1.5 ± 0.1: worse</ins> |" and len(head) == len(rule) == len(first)
    latex = lay_out(table, "latex", "label")
    assert r"a$|$`b` & \underline{1.5 $\pm$ 0.1: worse} \\" in latex and r"\caption{\textbf{T \& U.} 50 \%}" in latex
    assert latex.count(r"\begin{") == latex.count(r"\end{") and latex.isascii()
    page = lay_out(table, "html")
    assert '<td class="bad" data-value="1.5"><u>1.5 ± 0.1: worse</u></td>' in page and "<code>b</code>" in page and "&lt;3" in page
    assert lay_out(table, "text").splitlines()[2] == "a|`b`   1.5 ± 0.1: worse"
    assert tex("50 % of a_b & #1 [-0.3, +2] {x} 0.1 ± 0.2 –") == r"50 \% of a\_b \& \#1 {[}$-$0.3, +2] \{x\} 0.1 $\pm$ 0.2 --"


def test_paired_differences_weigh_scenarios_equally_on_the_same_seeds():
    values = {("a", "x", 0): 0.1, ("a", "y", 0): 0.09}
    values |= {("b", m, seed): v for m, v in (("x", 0.01), ("y", 0.009)) for seed in range(3)}
    row = paired_differences(collected(values).rows, "x").iloc[0]
    assert row["difference"] == pytest.approx(-0.0055) and row["low"] <= row["difference"] <= row["high"]
    one = paired_differences(collected({key: value for key, value in values.items() if key[0] == "b"}).rows, "x").iloc[0]
    assert one["scenarios"] == 1 and np.isnan(one["low"])


def test_the_bootstrap_has_the_variance_of_both_levels():
    """Twelve equal scenarios with independent noise of three seeds."""
    rng = np.random.default_rng(1)
    runs = [rng.normal(size=3) for _ in range(12)]
    within = np.mean([part.var() / 3 for part in runs]) / 12
    between = np.var([part.mean() for part in runs]) / 12
    means = resampled_means([part[None] for part in runs], np.random.default_rng(0))
    assert means.var() == pytest.approx(within + between, rel=0.05)
