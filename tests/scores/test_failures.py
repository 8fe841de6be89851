"""Failures and scenarios that a method leaves out change what averages mean, and tables say how."""

import json
import math
import re
from pathlib import Path

import pandas as pd
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.report import summary as tables
from neuspring.report.explain import explain
from neuspring.report.explain import text as explained
from neuspring.report.grid import columns
from neuspring.scores import failures
from neuspring.scores.metrics import SCORE_COLUMNS
from neuspring.scores.numbers import Numbers
from neuspring.scores.paper import Study
from neuspring.scores.runs import DAMAGED, Collected, collect, comparable, read_scores
from tests.support.study_runs import collected, study_text, write_run

FUTURE = ("future", "track_error")
IMAGES = {"cable": "it needs images"}
STUDY = Study(title="Systems", reference=None, baseline="Ours", rows={"Spring-Gaus": "spring_gaus", "Ours": "ours"})


def frozen(values: dict[tuple[str, str, int], float], metric: str = "track_error") -> pd.DataFrame:
    rows = [(s, "rope", m, seed, "future", metric, value, "m", 10) for (s, m, seed), value in values.items()]
    return pd.DataFrame(rows, columns=list(SCORE_COLUMNS))


def with_frozen(found: Collected, values: dict[tuple[str, str, int], float], **options) -> Collected:
    return Collected(found.scores, found.runs, frozen(values), **options)


def means(found: Collected) -> dict[str, pd.Series]:
    table = failures.both_averages(found.scores, found.runs, found.frozen)
    return {str(row["method"]): row for _, row in table.iterrows()}


VALUES = {("a", "x", 0): 0.010, ("b", "x", 0): 0.020, ("a", "y", 0): 0.004}
LOST = (("b", "y", 0),)


def test_both_averages_weigh_scenarios_equally():
    values = VALUES | {("a", "y", 1): 0.006}
    # Held scores of runs that succeeded are passed over.
    both = means(with_frozen(collected(values, failed=LOST), {("b", "y", 0): 0.100, ("a", "y", 0): 9.0}))
    row = both["y"]
    assert (row["succeeded"], row["attempted"], row["unknown"]) == (2, 3, 0)
    assert row["own"] == pytest.approx(0.005)
    assert row["all"] == pytest.approx((0.005 + 0.100) / 2)
    assert both["x"]["own"] == both["x"]["all"] == pytest.approx(0.015), "without failures there is one average"


def test_what_a_failed_run_scored_before_it_failed_is_in_no_average():
    found = collected(VALUES | {("b", "y", 0): 7.0}, failed=())
    found.runs.loc[(found.runs["scenario"] == "b") & (found.runs["method"] == "y"), "status"] = "failed"
    row = means(with_frozen(found, {("b", "y", 0): 0.100}))["y"]
    assert row["own"] == pytest.approx(0.004)
    assert row["all"] == pytest.approx(0.052)


def test_missing_runs_are_no_attempts():
    found = collected(VALUES, failed=LOST)
    found.runs.loc[found.runs["status"] == "failed", "status"] = "missing"
    assert not len(failures.both_averages(found.scores, found.runs, found.frozen))


def test_failures_without_held_scores_are_told_and_not_averaged():
    found = collected(VALUES, failed=LOST)
    row = means(found)["y"]
    assert row["unknown"] == 1 and math.isnan(row["all"]) and row["own"] == pytest.approx(0.004)
    held = failures.both_averages(found.scores, found.runs, found.frozen)
    assert failures.unknown_lines(held)[0].startswith("y: 1 of 1 failed runs have no scores of a held prediction")
    table = tables.failure_table("", held, {"x": "x", "y": "y"}, columns(held))
    (row,) = [row for row in table.rows if row[2].text == "all, failures held"]
    assert {cell.text for cell in row[3:]} == {"–"}


def test_a_metric_that_a_failed_run_has_no_held_score_of_has_no_mean_over_all():
    """Pictures, for example, that could not be drawn."""
    found = collected(VALUES, failed=LOST)
    pictures = found.scores.assign(metric="psnr", value=30.0)
    found = Collected(pd.concat([found.scores, pictures], ignore_index=True), found.runs, frozen({("b", "y", 0): 0.1}))
    table = failures.both_averages(found.scores, found.runs, found.frozen).set_index(["method", "metric"])
    assert math.isnan(table.loc[("y", "psnr"), "all"]) and table.loc[("y", "psnr"), "own"] == 30.0
    assert table.loc[("y", "track_error"), "all"] == pytest.approx(0.052)
    assert table.loc[("x", "psnr"), "all"] == 30.0


def test_a_method_that_failed_everywhere_has_the_mean_of_held_predictions():
    found = with_frozen(collected({("a", "x", 0): 0.01}, failed=(("a", "y", 0),)), {("a", "y", 0): 0.2})
    row = means(found)["y"]
    assert (row["succeeded"], row["attempted"]) == (0, 1)
    assert math.isnan(row["own"]) and row["all"] == pytest.approx(0.2)
    assert means(collected({}, failed=(("a", "y", 0),)))["y"]["attempted"] == 1


def test_summary_and_csv_have_both_averages(tmp_path):
    found = with_frozen(collected(VALUES, failed=LOST), {("b", "y", 0): 0.100})
    text = tables.write(Numbers(everything=found, baseline="x"), tmp_path)
    assert text.count("## Failures") == 1 and "published numbers of Spring-Gaus cover successful cases only" in text
    assert "## Failures" in (tmp_path / "summary.md").read_text()
    section = text.partition("## Failures")[2]
    assert "| y      | 1/2       | its successes" in section and "| 4.00 (4.00)" in section and "52.00 (52.00)" in section
    assert "| x      | 2/2       | all " in section
    assert Numbers.load(tmp_path).held.set_index("method").loc["y", "all"] == pytest.approx(0.052)
    assert "Failures" not in tables.write(Numbers(everything=collected(VALUES), baseline="x"), tmp_path)
    assert not len(Numbers.load(tmp_path).held), "nothing is left over from the earlier run"


def test_it_is_said_whose_failures_removed_how_many_pairs():
    values = {(s, m, 0): 0.01 for s in "abcd" for m in "xyz"}
    for lost in (("b", "y", 0), ("c", "y", 0), ("c", "z", 0)):
        del values[lost]
    found = collected(values, failed=(("b", "y", 0), ("c", "y", 0), ("c", "z", 0)))
    (line,) = failures.removed_lines(found.runs)
    assert line.endswith(": y 2 (1 by its failures alone), z 1 (0 by its failures alone).")
    text = tables.summary_text(Numbers(everything=found, baseline="x"))
    assert f"Averages take 2 of 4 pairs of scenario and seed, those that every method finished. {line}" in text
    assert failures.removed_lines(collected({("a", "x", 0): 0.01}).runs) == []


def test_it_is_said_if_failures_leave_no_pair():
    found = collected({("a", "x", 0): 0.01, ("b", "y", 0): 0.01}, failed=(("b", "x", 0), ("a", "y", 0)))
    assert not len(comparable(found))
    text = tables.summary_text(Numbers(everything=found, baseline="x"))
    assert "No pair of scenario and seed was finished by every method" in text
    assert ": x 1 (1 by its failures alone), y 1 (1 by its failures alone)." in text


def test_a_method_that_finished_nothing_removes_nothing():
    found = collected({("a", "x", 0): 0.01}, failed=(("a", "y", 0),))
    assert failures.removed_lines(found.runs) == []
    assert len(comparable(found)) == 1


@pytest.fixture
def results(tmp_path) -> Path:
    """Two scenarios with both methods, of which one failed and is held; a third that spring_gaus leaves out."""
    folder = tmp_path / "results"
    for scenario in ("a", "b", "cable"):
        write_run(folder, scenario, "ours", 0, {FUTURE: 0.01, ("future", "chamfer"): 0.002}, source="mocap")
    write_run(folder, "a", "spring_gaus", 0, {FUTURE: 0.03, ("future", "chamfer"): 0.004}, source="mocap")
    kept = {FUTURE: 0.5, ("future", "chamfer"): 0.1}
    write_run(folder, "b", "spring_gaus", 0, {}, status="failed", reason="rollout: it diverged", frozen=kept)
    return folder


def of(results: Path) -> Collected:
    return collect(results, ["a", "b", "cable"], ["spring_gaus", "ours"], [0], {"spring_gaus": IMAGES, "z": IMAGES})


def test_runs_left_out_are_neither_missing_nor_failed(results):
    found = of(results)
    assert len(found.runs) == 5
    assert set(found.runs["status"]) == {"ok", "failed"}
    assert found.left_out == {"spring_gaus": IMAGES}
    assert found.frozen["value"].tolist() == [0.5, 0.1]
    text = tables.summary_text(Numbers(everything=found, baseline="ours"))
    assert "Left out: spring_gaus on cable: it needs images." in text
    assert "spring_gaus does not apply to cable, so that averages of all methods are over the other 2." in text
    assert "missing" not in text
    assert set(comparable(found)["scenario"]) == {"a"}


def test_a_method_left_out_everywhere_takes_nothing_from_the_others(results):
    found = collect(results, ["cable"], ["spring_gaus", "ours"], [0], {"spring_gaus": IMAGES})
    assert set(found.runs["method"]) == {"ours"}
    text = tables.summary_text(Numbers(everything=found, baseline="ours"))
    assert "Left out: spring_gaus on cable" in text and "does not apply" not in text
    assert "10.00" in text


def test_a_damaged_held_file_is_a_damaged_run(results):
    (results / "b" / "spring_gaus" / "0" / "held.parquet").write_bytes(b"half")
    runs = of(results).runs.set_index(["scenario", "method"])
    assert runs.loc[("b", "spring_gaus"), "reason"].startswith(DAMAGED)


def test_a_study_has_the_success_count_and_both_averages(results, tmp_path):
    left = {"spring_gaus": IMAGES}
    out = tmp_path / "studies"
    text = study_text("systems", STUDY, results, ["a", "b", "cable"], [0], ["spring_gaus", "ours"], out, left)
    assert "| 1/2 (1 failed) *" in text and "| 3/3 " in text
    assert "* Some runs failed; the table of failures has both averages" in text
    section = text.partition("## Failures")[2].partition("\n## ")[0]
    own, kept = ([cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if ".00" in line)
    assert own == ["Spring-Gaus", "1/2", "its successes", "4.00 (4.00)", "30.00 (30.00)"]
    assert kept == ["", "", "all, failures held", "52.00 (52.00)", "265.00 (265.00)"]
    assert "Spring-Gaus 1 (1 by its failures alone)" in text
    assert "- Left out: Spring-Gaus on cable: it needs images." in text
    assert "- Ours, cable / seed 0: not comparable, since without this scenario and seed: Spring-Gaus (does not apply)" in text
    assert r"1/2 (1 failed) *" in (out / "systems.tex").read_text()
    assert Numbers.load(tmp_path).everything.left_out == left
    table = pd.read_csv(out / "systems.csv").set_index(["label", "task", "metric"])
    assert table.loc[("Spring-Gaus", *FUTURE), ["ok", "failed", "missing"]].tolist() == [1, 1, 0]


def test_an_explanation_names_what_was_left_out(results, tmp_path):
    out, left = tmp_path / "studies", {"spring_gaus": IMAGES}
    study_text("systems", STUDY, results, ["a", "b", "cable"], [0], ["spring_gaus", "ours"], out, left)
    found = explain("systems/Spring-Gaus/future/track_error", results, tmp_path)
    assert [run.scenario for run in found.runs] == ["a"]
    assert [run.scenario for run in found.left_out] == ["b"], "no run is missing on cable"
    assert found.problems == []
    assert "Left out: spring_gaus on cable: it needs images." in explained(found)


@pytest.mark.parametrize("text", ['{"x": "a"}', '["x"]', '{"x": {"a": 1}}', "{"])
def test_what_is_left_out_must_be_scenarios_with_reasons(text, capsys, tmp_path):
    arguments = ["tables", "--results", str(tmp_path), "--output", str(tmp_path / "tables")]
    assert main([*arguments, "--scenarios", "a", "--methods", "x", "--seeds", "0", "--left-out", text]) == 2
    assert "--left-out" in capsys.readouterr().err


def test_every_command_of_tables_takes_what_is_left_out(results, tmp_path, capsys):
    studies = tmp_path / "studies.yaml"
    studies.write_text("systems: {title: T, reference: null, baseline: Ours, rows: {Ours: ours, SG: spring_gaus}}\n")
    runs = ["--scenarios", "a", "b", "cable", "--methods", "ours", "spring_gaus", "--seeds", "0"]
    common = ["--results", str(results), *runs, "--left-out", json.dumps({"spring_gaus": IMAGES})]
    kept = ["--studies", "systems", "--table", str(studies)]
    assert main(["tables", *common, *kept, "--output", str(results / "tables")]) == 0
    assert main(["tables", *common, *kept, "--output", str(tmp_path / "out")]) == 0
    made = str(results / "tables" / "studies")
    assert main(["study", "--study", "systems", "--results", str(results), "--output", made]) == 0
    assert main(["report", *common, "--table", str(studies), "--output", str(tmp_path / "out" / "report.html")]) == 0
    told = capsys.readouterr().out
    assert "Left out: Spring-Gaus (`spring_gaus`) on cable" in told and "Left out: SG on cable" in told
    page = (tmp_path / "out" / "report.html").read_text()
    assert re.search(r"Left out: Spring-Gaus \(.{,20}spring_gaus.{,20}\) on cable: it needs images\.", page)
    assert page.count("all, failures held") >= 2, "in the scores and in the study"


def test_old_scores_say_nothing_of_held_predictions(results, tmp_path):
    tables.write(Numbers(everything=of(results), baseline="ours"), tmp_path)
    again = read_scores(tmp_path / "scores.csv")
    assert not len(again.frozen) and not again.left_out
    with pytest.raises(InputError):
        read_scores(tmp_path / "runs.csv")
