"""The tables beside the paper's: its conventions, honest verdicts, nothing hidden."""

import itertools
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.cli.main import main
from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.core.table import tex
from neuspring.intake.phystwin import released_cases
from neuspring.report import study as tables_paper
from neuspring.report import summary as tables
from neuspring.scores import paper
from neuspring.scores import study as tables_cells
from neuspring.scores.metrics import SCORE_COLUMNS, averages
from neuspring.scores.numbers import Numbers
from neuspring.scores.paper import Study, read_studies
from neuspring.scores.runs import RUN_COLUMNS, Collected, collect, read_scores
from neuspring.scores.statistics import paired_differences
from neuspring.scores.study import Verdict
from tests.support.study_runs import all_scores, study_text, write_benchmark, write_run

STUDY_TABLE = Path(__file__).resolve().parents[2] / "config" / "studies.yaml"
STUDIES = read_studies(STUDY_TABLE)
RELEASED = sorted(paper.scenarios())
METHODS = ["neuspring", "search_only", "baseline"]
CD, TE, IOU, PSNR = (("future", name) for name in ("chamfer", "track_error", "iou", "psnr"))
Values = Mapping[tuple[str, str, int], Mapping[tuple[str, str], float]]


def collected(values: Values, frames: Mapping[str, int] | None = None, failed: tuple = (), source: str = "phystwin") -> Collected:
    """Runs with scores by (scenario, method, seed), and failed ones; without files."""
    rows, runs = [], []
    for (scenario, method, seed), scores in values.items():
        counts = (frames or {}).get(scenario, 10)
        rows += [(scenario, "rope", method, seed, *key, value, "", counts) for key, value in scores.items()]
        runs.append((scenario, method, seed, "ok", "", "", None, source, "k", False, "{}"))
    runs += [(*run, "failed", "it diverged", "", None, source, "k", False, "{}") for run in failed]
    return Collected(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)), pd.DataFrame(runs, columns=list(RUN_COLUMNS)))


def cells_of(name: str, runs: Collected) -> pd.DataFrame:
    """The cells of a study, by label, task and metric."""
    study = STUDIES[name]
    return tables_cells.cells(study, tables_cells.restricted(study, runs)).set_index(["label", "task", "metric"])


def everywhere(method: str, scores: Mapping[tuple[str, str], float], scenarios=RELEASED) -> dict:
    """The same scores in every scenario."""
    return {(scenario, method, 0): scores for scenario in scenarios}


def varied(changes: Mapping[str, float], scenarios=RELEASED, metric=CD, noise: float = 0.0) -> dict:
    """Errors that differ between scenarios; every method changes them by its factor, and noise of its own."""
    rng = np.random.default_rng(0)
    sizes = dict(zip(scenarios, rng.uniform(0.005, 0.02, len(scenarios)), strict=True))
    draw = {(s, m): 1 + noise * rng.normal() for s in scenarios for m in changes}
    return {
        (s, m, seed): {metric: sizes[s] * factor * draw[s, m] * (1 + 0.01 * seed)}
        for s in scenarios
        for m, factor in changes.items()
        for seed in (0, 1)
    }


def test_the_papers_values_keep_their_digits_in_mm():
    values = paper.table("table1_comparison")
    assert [len(paper.table(name)) for name in paper.tables()] == [48, 48, 24]
    assert values["Spring-Gaus", "reconstruction", "track_error"] == paper.Printed(text="50", value=50.0, slack=0.5)
    assert values["NeuSpring", "future", "iou"].slack == pytest.approx(0.05)
    assert set(released_cases()) == paper.scenarios()
    assert paper.released().groupby(["task", "metric"]).size().to_dict() == {
        ("future", "chamfer"): 22,
        ("future", "track_error"): 22,
        ("reconstruction", "chamfer"): 11,
        ("reconstruction", "track_error"): 11,
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": "Nobody"}, "baseline: must be a label"),
        ({"reference": "table9"}, "reference: must be null or one of table1_comparison"),
        ({"rows": {"a": "x", "b": "x"}, "baseline": "a", "reference": None}, "methods must differ"),
        ({"rows": {"w/o TP": "x", "NeuSprint": "y"}, "baseline": "w/o TP"}, "also has"),
        ({"color": "red"}, "color: unknown key"),
    ],
)
def test_a_wrong_study_is_refused(change, message):
    good = {"title": "T", "reference": "table3_network", "baseline": "NeuSpring", "rows": dict(STUDIES["table3"].rows)}
    parse(Study, good, "here")
    with pytest.raises(InputError, match=re.escape(message)):
        parse(Study, good | change, "here")


def test_a_study_does_not_take_the_name_of_another_table(tmp_path):
    path = tmp_path / "studies.yaml"
    path.write_text("summary: {title: T, reference: null, baseline: a, rows: {a: x}}\n")
    with pytest.raises(InputError, match=r"summary.*are taken"):
        read_studies(path)


NEAR = ("reconstruction", "chamfer")


@pytest.mark.parametrize(
    ("key", "ours", "verdict"),
    [
        *((NEAR, 0.00549, "within"), (NEAR, 0.00451, "within"), (NEAR, 0.00551, "worse"), (NEAR, 0.00449, "better")),
        *((IOU, 0.7252, "within"), (IOU, 0.8, "better")),
    ],
)
def test_rounding_makes_no_difference_to_the_paper_which_prints_mm_and_per_cent(key, ours, verdict):
    """PhysTwin's Chamfer distance is printed as 0.005 m, its overlap of silhouettes as 72.5 %."""
    found = cells_of("table1", collected(everywhere("baseline", {key: ours}))).loc[("PhysTwin", *key)]
    scale, printed = (1e3, 5) if key == NEAR else (1e2, 72.5)
    assert found["verdict"] == verdict
    assert (found["ours"], found["difference"]) == pytest.approx((scale * ours, scale * ours - printed))


def test_absolute_values_are_compared_on_the_papers_scenarios_alone():
    some = everywhere("baseline", {CD: 0.012}, RELEASED[:8])
    found = cells_of("table1", collected(some)).loc[("PhysTwin", *CD)]
    assert (found["verdict"], found["partial"], found["scenarios"]) == (Verdict.WITHIN, True, 8)
    assert tables_cells.verdict_text(found) == "partial (8 of 22): within"
    one = everywhere("baseline", {CD: 0.1}, RELEASED[:1])
    found = cells_of("table1", collected(one)).loc[("PhysTwin", *CD)]
    assert (found["verdict"], found["partial"]) == (Verdict.NO_INTERVAL, True)
    for others in (collected(some | everywhere("baseline", {CD: 0.012}, ["toy"])), collected(some, source="phystwin_raw")):
        found = cells_of("table1", others).loc[("PhysTwin", *CD)]
        assert found["verdict"] == "other data"
        assert np.isnan(found["difference"])
        assert found["ours"] == pytest.approx(12.0)


def test_what_is_not_there_is_said():
    runs = collected(everywhere("baseline", {CD: 0.012}), failed=tuple((s, "neuspring", 0) for s in RELEASED))
    found = cells_of("table1", runs)["verdict"]
    assert found[("Spring-Gaus", *CD)] == "not run"
    assert found[("NeuSpring", *CD)] == "not run"
    assert tables_cells.verdict_text(cells_of("table1", runs).loc[("NeuSpring", *CD)]) == "not run (22 failed)"
    assert found[("PhysTwin", *PSNR)] == "not computed"
    apart = everywhere("baseline", {CD: 0.012}, RELEASED[:2]) | everywhere("neuspring", {CD: 0.012}, RELEASED[2:4])
    assert cells_of("table1", collected(apart)).loc[("NeuSpring", *CD), "verdict"] == "nothing to compare"


def test_errors_weigh_scenarios_and_pictures_weigh_frames():
    values = {("a", "baseline", 0): {CD: 0.01, PSNR: 20.0}, ("b", "baseline", 0): {CD: 0.03, PSNR: 40.0}}
    found = cells_of("table1", collected(values, {"a": 30, "b": 10})).loc["PhysTwin"]
    assert found.loc[CD, ["ours", "other_average"]].tolist() == pytest.approx([20.0, 15.0])
    assert found.loc[PSNR, ["ours", "other_average"]].tolist() == pytest.approx([25.0, 30.0])


def test_the_spread_is_that_of_the_averages():
    runs = collected(varied({"baseline": 1.0, "neuspring_one_frame": 0.8}, noise=0.1))
    expected = averages(runs.scores).set_index("method")["seed_std"]
    assert cells_of("table2", runs)["spread"][("Baseline", *CD)] == pytest.approx(1e3 * expected["baseline"])
    # A seed that lacks a scenario has another mean for that reason alone.
    less = Collected(runs.scores.drop(index=3), runs.runs)
    assert np.isnan(cells_of("table2", less)["spread"][("Baseline", *CD)])


def test_intervals_agree_with_those_of_the_summary():
    """The same bootstrap with other draws: the ends of 10,000 resamples agree within some per cent of the width."""
    runs = collected(varied({"baseline": 1.0, "neuspring_one_frame": 0.8}, noise=0.3))
    found = cells_of("table2", runs).loc[("NeuSpring (PT+NSF)", *CD)]
    row = paired_differences(runs.scores, "baseline").iloc[0]
    width = row["high"] - row["low"]
    assert found["change"] == pytest.approx(1e3 * row["difference"])
    assert found["relative"] == pytest.approx(row["difference"] / averages(runs.scores).set_index("method")["equal"]["baseline"])
    assert found["change_low"] == pytest.approx(1e3 * row["low"], abs=50 * width)
    assert found["change_high"] == pytest.approx(1e3 * row["high"], abs=50 * width)
    assert found["low"] < found["ours"] < found["high"]


@pytest.mark.parametrize("metric", [CD, IOU])
def test_changes_are_paired(metric):
    """Scenarios of very different errors and lengths, the same change in all: the change is known exactly."""
    frames = {name: 10 + 7 * index for index, name in enumerate(RELEASED)}
    found = cells_of("table2", collected(varied({"baseline": 1.0, "neuspring_one_frame": 0.8}, metric=metric), frames))
    row = found.loc[("NeuSpring (PT+NSF)", *metric)]
    assert row[["relative", "relative_low", "relative_high"]].tolist() == pytest.approx([-0.2] * 3)
    assert row["low"] < 0.95 * row["ours"]


def test_intervals_and_spreads_of_pictures_are_weighted_too():
    """A short recording counts for little, also in a resample that holds it twice."""
    values = {(name, "baseline", seed): {PSNR: 20.0 + seed} for name in RELEASED[:9] for seed in (0, 1)}
    values |= {("short", "baseline", seed): {PSNR: 40.0 - seed} for seed in (0, 1)}
    found = cells_of("table1", collected(values, dict.fromkeys(RELEASED, 1000) | {"short": 1})).loc[("PhysTwin", *PSNR)]
    assert found["ours"] == pytest.approx(20.5, abs=0.01)
    assert found["spread"] == pytest.approx(np.sqrt(0.5), abs=0.001)
    assert 20.0 < found["low"] < 20.5 < found["high"] < 21.1


@pytest.mark.parametrize(
    ("factor", "noise", "scenarios", "direction"),
    [
        (0.8, 0.05, 22, "same direction, confirmed"),
        (1.2, 0.05, 22, "opposite"),
        (0.99, 0.3, 22, "not resolved"),
        (0.8, 0.05, 5, "too few scenarios"),
    ],
)
def test_a_change_is_judged_by_its_interval(factor, noise, scenarios, direction):
    names = [f"toy_{index}" for index in range(scenarios)]
    found = cells_of("table2", collected(varied({"baseline": 1.0, "model_b_one_frame": factor}, names, noise=noise), source="toy"))
    assert found.loc[("Model-B (NSF)", *CD), "direction"] == direction
    assert found.loc[("Model-B (NSF)", *CD), "verdict"] == "other data"
    assert found.loc[("Baseline", *CD), "direction"] == "baseline"


def test_a_change_that_the_paper_does_not_show_is_not_confirmed():
    """SSIM of both models in Table 2: 0.945 for reconstruction; their study's baseline stands at 0.944."""
    study = parse(
        Study,
        {"title": "T", "reference": "table2_ablation", "baseline": "Model-A (PT)", "rows": dict(STUDIES["table2"].rows)},
        "here",
    )
    key = ("reconstruction", "ssim")
    runs = collected(varied({"model_a": 1.0, "model_b_one_frame": 0.8}, metric=key))
    found = tables_cells.cells(study, tables_cells.restricted(study, runs)).set_index(["label", "task", "metric"])
    assert found.loc[("Model-B (NSF)", *key), "direction"] == "no change in the paper"


def test_a_pair_that_one_method_failed_is_left_out_for_all_and_listed():
    values = everywhere("baseline", {CD: 0.01}, ["a", "b"]) | everywhere("neuspring_one_frame", {CD: 0.02}, ["a"])
    values["b", "baseline", 0] = {CD: 0.5}
    runs = collected(values, failed=(("b", "neuspring_one_frame", 0),))
    own = tables_cells.restricted(STUDIES["table2"], runs)
    found = cells_of("table2", runs)
    assert found.loc[("Baseline", *CD), "ours"] == pytest.approx(10.0)
    assert found.loc[("NeuSpring (PT+NSF)", *CD), ["ok", "failed", "missing"]].tolist() == [1, 1, 0]
    why = tables_cells.accounted(STUDIES["table2"], own).set_index(["label", "scenario"])["why"]
    assert why["NeuSpring (PT+NSF)", "b"] == "failed: it diverged"
    assert why["Baseline", "b"] == "not comparable, since without this scenario and seed: NeuSpring (PT+NSF) (failed)"
    assert why["Baseline", "a"] == ""


def test_a_score_that_one_method_lacks_is_left_out_for_all():
    values = everywhere("baseline", {CD: 0.01, PSNR: 30.0}, ["a", "b"])
    values |= everywhere("neuspring_one_frame", {CD: 0.02, PSNR: 20.0}, ["a"])
    values |= everywhere("neuspring_one_frame", {CD: 0.04}, ["b"])
    values["b", "baseline", 0] = {CD: 0.01, PSNR: 90.0}
    found = cells_of("table2", collected(values))
    assert found.loc[("Baseline", *PSNR), ["ours", "scenarios"]].tolist() == [30.0, 1]
    assert found.loc[("NeuSpring (PT+NSF)", *CD), ["ours", "scenarios"]].tolist() == [pytest.approx(30.0), 2]


def test_a_table_of_nothing_holds_the_papers_values(tmp_path):
    text = study_text("table1", STUDIES["table1"], tmp_path, RELEASED, [0], [], tmp_path / "out")
    assert "Nothing has finished." in text
    assert "| **9**" in text
    assert "- Spring-Gaus: spring_gaus is not among the methods of this benchmark" in text
    table = pd.read_csv(tmp_path / "out" / "table1.csv", dtype={"paper": str})
    assert set(table["verdict"]) == {"not run"}
    assert len(table) == 48
    assert table["ours"].isna().all()
    missing = study_text("table1", STUDIES["table1"], tmp_path, RELEASED, [0], ["baseline"], tmp_path / "out")
    assert "0/22 (22 missing)" in missing
    assert "and 16 more: missing: no run.json" in missing


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Tables of a benchmark of two seeds on eight of the paper's scenarios, in which a run failed and a record is damaged."""
    folder = tmp_path_factory.mktemp("results")
    names = RELEASED[:8]
    write_benchmark(folder, names, {"baseline": 1.0, "neuspring": 0.8})
    write_run(folder, names[0], "neuspring", 1, {}, status="failed", reason="rollout: node 3 left | the scene")
    (folder / names[1] / "baseline" / "0" / "scores.parquet").write_bytes(b"half a fi")
    out = folder / "tables" / "studies"
    text = study_text("table1", STUDIES["table1"], folder, names, [0, 1], ["baseline", "neuspring"], out)
    return folder, out, text


def test_every_failure_is_counted_and_named(written):
    _, out, text = written
    assert "| 15/16 (1 failed) * | ours" in text
    assert "| NeuSpring | 15/16 " in text.partition("## Failures")[2]
    assert "NeuSpring: 1 of 1 failed runs have no scores of a held prediction" in text
    assert f"- NeuSpring, {RELEASED[0]} / seed 1: failed: rollout: node 3 left | the scene" in text
    assert f"- PhysTwin, {RELEASED[1]} / seed 0: failed: damaged record: " in text
    assert "Averages take the 14 of 16 pairs of scenario and seed" in text
    runs = Numbers.load(out.parent).by_study["table1"].runs
    assert runs["counted"].sum() == 28
    assert len(runs) == 32


def test_best_and_second_best_are_marked_where_the_paper_marks_them(written):
    _, out, text = written
    ours = {line.split("|")[3].strip() + str(i): line for i, line in enumerate(text.splitlines()) if "| ours " in line}
    rows = [line.split("|")[4].strip() for line in ours.values()][:4]
    assert rows[2].startswith("<ins>")
    assert rows[3].startswith("**")
    latex = (out / "table1.tex").read_text()
    assert r"\underline{5}" in latex
    assert r"\textbf{4}" in latex
    of_two = tables_paper.main_table(STUDIES["table2"], cells_of("table2", collected({})).reset_index())
    assert "second" not in {cell.mark for row in of_two.rows for cell in row}


def test_latex_can_be_input(written):
    latex = (written[1] / "table1.tex").read_text()
    plain = re.sub(r"\\[{}]", "", latex)
    assert plain.count("{") == plain.count("}")
    assert latex.count(r"\begin{") == latex.count(r"\end{")
    assert latex.count("$") % 2 == 0
    assert latex.isascii()
    for body in re.findall(r"\\begin\{tabular\}(.*?)\\end\{tabular\}", latex, re.S):
        columns = sum(character in "lr" for character in body.partition("\n")[0])
        rows = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert len(rows) > 3
        for row in rows:
            spans = [int(count) - 1 for count in re.findall(r"\\multicolumn\{(\d+)\}", row)]
            assert len(re.findall(r"(?<!\\)&", row)) + sum(spans) == columns - 1
    assert tex("50 % of a_b & #1 [-0.3, +2] {x} 0.1 ± 0.2 –") == (r"50 \% of a\_b \& \#1 {[}$-$0.3, +2] \{x\} 0.1 $\pm$ 0.2 --")


def test_breakdowns_hold_every_finished_run(written):
    _, out, text = written
    numbers = Numbers.load(out.parent).by_study["table1"]
    rows = numbers.scenarios.set_index(["scenario", "label", "task", "metric"])
    assert rows.loc[(RELEASED[0], "PhysTwin", *CD), ["seeds", "counted"]].tolist() == [2, 1]
    assert rows.loc[(RELEASED[0], "NeuSpring", *CD), ["seeds", "counted"]].tolist() == [1, 1]
    table = pd.read_csv(out / "table1.csv").set_index(["label", "task", "metric"])
    category = numbers.categories.set_index(["label", "task", "metric"])
    assert category.loc[("NeuSpring", *IOU), "value"] == pytest.approx(table.loc[("NeuSpring", *IOU), "ours"])
    assert "## Per category" in text
    assert "## Per scenario" in text


def test_ours_stands_beside_the_released_values(written):
    folder, out, text = written
    name = RELEASED[2]
    row = Numbers.load(out.parent).by_study["table1"].released.set_index(["scenario", "task", "metric"]).loc[(name, *CD)]
    known = paper.released().set_index(["scenario", "task", "metric"])["value"]
    scores = [pd.read_parquet(folder / name / "baseline" / str(seed) / "scores.parquet") for seed in (0, 1)]
    ours = np.mean([table.set_index(["task", "metric"]).loc[CD, "value"] for table in scores])
    assert row["released"] == pytest.approx(1e3 * known[(name, *CD)])
    assert row["ours"] == pytest.approx(1e3 * ours)
    assert row["ratio"] == pytest.approx(ours / known[(name, *CD)])
    assert "## Beside the released PhysTwin" in text


def test_other_data_of_the_same_name_does_not_stand_beside_the_released_values():
    runs = collected(everywhere("baseline", {CD: 0.012}), source="phystwin_raw")
    own = tables_cells.restricted(STUDIES["table1"], runs)
    assert tables_cells.released_comparison(own, "baseline")["ours"].isna().all()


def test_tables_are_the_same_every_time_and_from_a_file_of_numbers(written, tmp_path):
    folder, out, _ = written
    tables_paper.write_study(Numbers.load(out.parent).by_study["table1"], tmp_path / "read")
    study_text("table1", STUDIES["table1"], folder, RELEASED[:8], [0, 1], METHODS, tmp_path / "new")
    for name in ("table1.csv", "table1.tex", "table1.md"):
        assert (tmp_path / "read" / name).read_bytes() == (out / name).read_bytes()
        assert name == "table1.md" or (tmp_path / "new" / name).read_bytes() == (out / name).read_bytes()


def test_a_table_can_be_made_from_scores_alone(tmp_path, capsys):
    methods = {"baseline": 1.0, "neuspring_one_frame": 0.8}
    for number, (method, factor) in itertools.product(range(7), methods.items()):
        write_run(tmp_path, f"cable_{number}", method, 0, {CD: 0.01 * factor * (1 + number)}, source="mocap")
    names = [f"cable_{number}" for number in range(7)]
    kept = ["tables", "--results", str(tmp_path), "--output", str(tmp_path / "tables"), "--seeds", "0", "--studies", "table2"]
    assert main([*kept, "--table", str(STUDY_TABLE), "--scenarios", *names, "--methods", *methods]) == 0
    assert main(["study", "--study", "table2", "--results", str(tmp_path), "--output", str(tmp_path / "records")]) == 0
    assert main(["study", "--study", "table3", "--results", str(tmp_path), "--output", str(tmp_path / "records")]) == 2
    assert "There: table2. Make it: tables --studies table3." in capsys.readouterr().err
    command = ["study", "--study", "table2", "--table", str(STUDY_TABLE), "--output", str(tmp_path / "scores")]
    assert main([*command, "--scores", str(tmp_path / "tables" / "scores.csv")]) == 0
    assert "same direction, confirmed" in capsys.readouterr().out
    for name in ("table2.csv", "table2.md"):
        assert (tmp_path / "scores" / name).read_text() == (tmp_path / "records" / name).read_text()
    assert "released PhysTwin" not in (tmp_path / "scores" / "table2.md").read_text(), "none of these is a released scenario"
    # Of a run that diverged the errors of one task remain, with or without the file that says so.
    one = {("reconstruction", "chamfer"): 9.0}
    write_run(tmp_path, "cable_6", "neuspring_one_frame", 0, one, status="failed", reason="diverged")
    tables.write(Numbers(everything=collect(tmp_path, names, methods, [0]), baseline="baseline"), tmp_path / "tables")
    scores = pd.read_csv(tmp_path / "tables" / "scores.csv")
    other = scores[scores["task"] == "future"].assign(task="reconstruction")
    pd.concat([scores, other]).to_csv(tmp_path / "tables" / "scores.csv", index=False)
    for _ in range(2):
        runs = read_scores(tmp_path / "tables" / "scores.csv").runs.set_index(["scenario", "method"])["status"]
        assert (runs["cable_6", "neuspring_one_frame"], runs["cable_6", "baseline"]) == ("failed", "ok")
        (tmp_path / "tables" / "runs.csv").unlink(missing_ok=True)
    alone = ["tables", "--scores", str(tmp_path / "tables" / "scores.csv"), "--output", str(tmp_path / "some"), "--scenarios"]
    assert main([*alone, *names[:3], "--methods", "baseline"]) == 0
    kept = pd.read_csv(tmp_path / "some" / "scores.csv")
    # A scores.csv is read in part as runs are.
    assert (set(kept["scenario"]), set(kept["method"])) == (set(names[:3]), {"baseline"})
    assert main([*alone, "cable_9"]) == 2
    assert "--scenarios: must be in the file of --scores" in capsys.readouterr().err
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    assert main([*command, "--scores", str(tmp_path / "other.csv")]) == 2
    assert "other.csv: must be a scores.csv with the columns scenario, category" in capsys.readouterr().err


def test_how_pictures_were_scored_is_said(tmp_path):
    facts = {"lpips": "no weights"}
    write_run(tmp_path, RELEASED[0], "baseline", 0, all_scores(), images=facts)
    text = study_text("table1", STUDIES["table1"], tmp_path, RELEASED[:1], [0], ["baseline"], tmp_path / "out")
    assert "LPIPS not computed in some runs: no weights." in text


def test_the_number_of_regions_is_a_curve_without_the_papers_numbers(tmp_path):
    methods = {"model_b": 1.0, "clusters_5": 0.7, "clusters_10": 1.2}
    names = [f"rope_{index}" for index in range(6)]
    write_benchmark(tmp_path, names, methods, source="toy")
    text = study_text("clusters", STUDIES["clusters"], tmp_path, names, [0, 1], methods, tmp_path)
    assert "![Chamfer distance against the number of regions K](clusters_curve.png)" in text
    assert (tmp_path / "clusters_curve.png").stat().st_size > 1000
    drawn = Numbers.load(tmp_path.parent).by_study["clusters"].chamfer["value"]
    assert 0.001 < drawn.min() < drawn.max() < 0.1, "m, of which the picture makes mm"
    assert paper.CLUSTER_CLAIM in text
    assert "| paper " not in text
    table = pd.read_csv(tmp_path / "clusters.csv", dtype={"label": str}).set_index(["label", "task", "metric"])
    assert table.loc[("5", *CD), "direction"] == "better"
    assert table.loc[("10", *CD), "direction"] == "worse"
    assert table.loc[("10", *PSNR), "direction"] == "worse"
    assert table.loc[("2", *CD), "direction"] == "not run"
    study_text("clusters", STUDIES["clusters"], tmp_path, names, [0, 1], [], tmp_path)
    assert not (tmp_path / "clusters_curve.png").exists()
