"""Study tables with the paper's values and ours: the paper's conventions, honest verdicts, nothing hidden."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.report.study import blocks_of, write_study
from neuspring.scores import paper
from neuspring.scores.metrics import averages
from neuspring.scores.paper import Study, read_studies
from neuspring.scores.study import cells, restricted
from neuspring.scores.table import ScoreTable, collect
from tests.support.study_runs import all_scores, collected, rows_of, tables_in, write_run

STUDIES = read_studies(Path(__file__).resolve().parents[2] / "config" / "studies.yaml")
RELEASED = sorted(paper.scenarios())
CD, TE, IOU, PSNR = (("future", name) for name in ("chamfer", "track_error", "iou", "psnr"))
NEAR = ("reconstruction", "chamfer")


def made(values, failed=(), source: str = "phystwin", frames: Mapping[str, int] | None = None) -> ScoreTable:
    table = collected(values, failed, source=source)
    counts = table.rows["scenario"].map(frames or {}).fillna(10).astype(int)
    return ScoreTable(table.rows.assign(frames=counts), table.runs)


def cells_of(name: str, table: ScoreTable) -> pd.DataFrame:
    """The cells of a study, by label, task and metric."""
    return cells(STUDIES[name], restricted(STUDIES[name], table)).set_index(["label", "task", "metric"])


def everywhere(method: str, scores: Mapping[tuple[str, str], float], scenarios=RELEASED) -> dict:
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
    assert paper.released().groupby("task").size().to_dict() == {"future": 44, "reconstruction": 22}


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"baseline": "Nobody"}, "baseline: must be a label"),
        ({"reference": "table9"}, "reference: must be null or one of table1_comparison"),
        ({"rows": {"a": "x", "b": "x"}, "baseline": "a", "reference": None}, "methods must differ"),
        ({"rows": {"w/o TP": "x", "NeuSprint": "y"}, "baseline": "w/o TP"}, "must contain every label"),
        ({"beside": "table2"}, "beside: unknown key"),
    ],
)
def test_a_wrong_study_is_refused(change, field, tmp_path):
    good = {"title": "T", "reference": "table3_network", "baseline": "NeuSpring", "rows": dict(STUDIES["table3"].rows)}
    parse(Study, good, "here")
    with pytest.raises(InputError, match=re.escape(field)):
        parse(Study, good | change, "here")
    (tmp_path / "s.yaml").write_text("summary: {title: T, reference: null, baseline: a, rows: {a: x}}\n")
    with pytest.raises(InputError, match=r"study summary.*must not be"):
        read_studies(tmp_path / "s.yaml")


@pytest.mark.parametrize(
    ("key", "ours", "verdict"),
    [
        *((NEAR, 0.00549, "within"), (NEAR, 0.00451, "within"), (NEAR, 0.00551, "worse"), (NEAR, 0.00449, "better")),
        *((IOU, 0.7252, "within"), (IOU, 0.8, "better")),
    ],
)
def test_rounding_makes_no_difference_to_the_paper_which_prints_mm_and_per_cent(key, ours, verdict):
    """PhysTwin's Chamfer distance is printed as 0.005 m, its overlap of silhouettes as 72.5 %."""
    found = cells_of("table1", made(everywhere("baseline", {key: ours}))).loc[("PhysTwin", *key)]
    scale, printed = (1e3, 5) if key == NEAR else (1e2, 72.5)
    assert found["verdict"] == verdict
    assert (found["ours"], found["difference"]) == pytest.approx((scale * ours, scale * ours - printed))


def test_absolute_values_are_compared_on_the_papers_scenarios_alone():
    some = everywhere("baseline", {CD: 0.012}, RELEASED[:8])
    assert cells_of("table1", made(some)).loc[("PhysTwin", *CD), "verdict"] == "partial (8 of 22): within"
    one = everywhere("baseline", {CD: 0.1}, RELEASED[:1])
    assert cells_of("table1", made(one)).loc[("PhysTwin", *CD), "verdict"] == "partial (1 of 22): worse"
    for others in (made(some | everywhere("baseline", {CD: 0.012}, ["toy"])), made(some, source="phystwin_raw")):
        found = cells_of("table1", others).loc[("PhysTwin", *CD)]
        assert found["verdict"] == "other data" and np.isnan(found["difference"]) and found["ours"] == pytest.approx(12.0)


def test_what_is_not_there_is_said():
    runs = made(everywhere("baseline", {CD: 0.012}), failed=[(s, "neuspring", 0) for s in RELEASED])
    found = cells_of("table1", runs)
    verdicts = found["verdict"]
    assert (
        verdicts[("Spring-Gaus", *CD)] == verdicts[("NeuSpring", *CD)] == "not run"
        and found.loc[("NeuSpring", *CD), "failed"] == 22
    )


def test_errors_weigh_scenarios_and_pictures_weigh_frames_in_mean_spread_and_interval():
    values = {(name, "baseline", seed): {CD: 0.01, PSNR: 20.0 + seed} for name in RELEASED[:9] for seed in (0, 1)}
    values |= {("short", "baseline", seed): {CD: 0.03, PSNR: 40.0 - seed} for seed in (0, 1)}
    found = cells_of("table1", made(values, frames=dict.fromkeys(RELEASED, 1000) | {"short": 1})).loc["PhysTwin"]
    assert found.loc[CD, "ours"] == pytest.approx(12.0)
    row = found.loc[PSNR]
    assert row["ours"] == pytest.approx(20.5, abs=0.01) and row["spread"] == pytest.approx(np.sqrt(0.5), abs=0.001)
    assert 20.0 < row["low"] < 20.5 < row["high"] < 21.1


def test_the_spread_is_that_of_the_averages():
    runs = made(varied({"baseline": 1.0, "neuspring_one_frame": 0.8}, noise=0.1))
    expected = averages(runs.rows).set_index("method")["seed_std"]
    assert cells_of("table2", runs)["spread"][("Baseline", *CD)] == pytest.approx(1e3 * expected["baseline"])
    # A seed that lacks a scenario has another mean for that reason alone.
    assert np.isnan(cells_of("table2", ScoreTable(runs.rows.drop(index=3), runs.runs))["spread"][("Baseline", *CD)])


@pytest.mark.parametrize("metric", [CD, IOU])
def test_a_change_is_paired_and_stands_beside_the_papers(metric):
    names = [f"toy_{index}" for index in range(6)]
    values = varied({"baseline": 1.0, "model_b_one_frame": 0.8}, names, metric)
    row = cells_of("table2", made(values, source="toy")).loc[("Model-B (NSF)", *metric)]
    change = 0.8 if metric == CD else -0.2 * 100 * np.mean([value[metric] for key, value in values.items() if key[1] == "baseline"])
    assert row["verdict"] == "other data" and row["change"] == pytest.approx(change) and row["n"] == 6
    assert row["change_low"] <= row["change"] * (1 + 1e-9) and np.isfinite(row["paper_change"])


def test_an_oracle_in_a_study_is_never_marked():
    study = parse(Study, {"title": "T", "reference": None, "baseline": "x", "rows": {"x": "x", "y": "y", "O": "oracle"}}, "here")
    values = {(f"s{k}", m, 0): v for k in range(6) for m, v in (("x", 0.01), ("y", 0.008), ("oracle", 0.001))}
    table = made(values)
    table = ScoreTable(table.rows, table.runs.assign(oracle=table.runs["method"] == "oracle"))
    rows = tables_in(blocks_of("s", study, table, Path()))["Our values"].rows
    assert [row[0].text for row in rows if any(cell.mark for cell in row)] == ["y"] and len(rows) == 3


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Table 1 of two seeds on eight of the paper's scenarios, in which a run failed and a record is damaged."""
    folder = tmp_path_factory.mktemp("results")
    names = RELEASED[:8]
    for number, name in enumerate(names):
        for seed in (0, 1):
            for method, factor in (("baseline", 1.0), ("neuspring", 0.8)):
                settings = {"fit": {"horizon": 1 if method == "baseline" else 10}}
                write_run(folder, name, method, seed, all_scores(factor * (1 + 0.1 * number + 0.01 * seed)), settings=settings)
    write_run(
        folder, names[0], "neuspring", 1, {}, status="failed", reason="node 3 left | the scene", settings={"fit": {"horizon": 10}}
    )
    (folder / names[1] / "baseline" / "0" / "scores.parquet").write_bytes(b"half a fi")
    table = collect(folder, names, ["baseline", "neuspring"], [0, 1], {"neuspring": {names[7]: "it needs images"}})
    return folder, table, write_study("table1", STUDIES["table1"], table, folder, folder / "studies")


def test_failures_absent_methods_and_settings_are_named(written):
    _, _, text = written
    assert "| 13/14 (1 failed) | ours" in text
    assert "the 12 of 16 pairs of scenario and seed" in text and "Without runs: Spring-Gaus (spring_gaus)" in text
    assert f"| NeuSpring | failed         | {RELEASED[0]}/1" in text and "node 3 left \\| the scene" in text
    assert f"| PhysTwin  | failed         | {RELEASED[1]}/0" in text and "damaged record: " in text
    assert f"| NeuSpring | does not apply | {RELEASED[7]}" in text
    assert "| fit.horizon | 1: PhysTwin; 10: NeuSpring |" in text


def test_the_best_is_marked(written):
    folder, table, _ = written
    main = tables_in(blocks_of("table1", STUDIES["table1"], table, folder))["The paper's values and ours"]
    ours = {row[0].text: row[3].mark for row in main.rows if row[2].text == "ours"}
    assert ours == {"Spring-Gaus": "", "GS-Dynamics": "", "PhysTwin": "", "NeuSpring": "best"}
    latex = (folder / "studies" / "table1.tex").read_text()
    assert r"\textbf{4}" in latex
    for body in re.findall(r"\\begin\{tabular\}(.*?)\\end\{tabular\}", latex, re.S):
        spec = re.sub(r"p\{.*?\}", "p", body.partition("\n")[0])
        columns = sum(character in "lrp" for character in spec)
        rows = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert len(rows) > 1 and {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {columns - 1}


def test_a_metric_of_ours_is_shown_beside_the_papers_columns():
    factors, bound = {"baseline": 1.0, "model_a": 0.7}, ("future", "track_error_bound")
    values = {(f"s{k}", m, 0): {TE: 0.02 * f, bound: 0.01 * f} for k in range(6) for m, f in factors.items()}
    blocks = tables_in(blocks_of("table2", STUDIES["table2"], made(values, source="mocap"), Path()))
    changes = blocks["Compared with Baseline"]
    rows = [dict(zip(changes.header, row, strict=True)) for row in changes.rows if row[0].text == "Model-A (PT)"]
    assert [row["Future TE bound ↓"].text for row in rows] == ["–", "0.700 [0.700, 0.700]"]
    assert "Future TE bound ↓" in rows_of(blocks["The paper's values and ours"])["Baseline"]
