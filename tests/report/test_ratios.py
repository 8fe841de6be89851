"""What tables say beside the averages: ratios and aims, floors, oracles, settings that differ, two trainings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.config import parse, plain
from neuspring.config.settings import Aim, Config
from neuspring.core.run_record import RunRecord
from neuspring.report import study as tables_study
from neuspring.report import summary
from neuspring.scores.numbers import Numbers
from neuspring.scores.paper import Study, read_studies
from neuspring.scores.runs import Collected, collect, read_scores
from neuspring.scores.settings import differing as differing_table
from neuspring.scores.study import ORACLE_LINE, Verdict, cells, restricted
from tests.support.runs import run_record
from tests.support.study_runs import collected, rows_of, study_text, write_run
from tests.support.study_runs import summary as summary_of

STUDIES = read_studies(Path(__file__).resolve().parents[2] / "config" / "studies.yaml")
NAMES = [f"cable_{index}" for index in range(6)]
BOTH = {("future", "track_error"): 0.02, ("future", "track_error_bound"): 0.01, ("future", "chamfer"): 0.03}


def with_oracle(values: dict[tuple[str, str, int], float], oracle: str = "oracle") -> Collected:
    found = collected(values)
    return Collected(found.scores, found.runs.assign(oracle=found.runs["method"] == oracle))


def test_an_oracle_stands_outside_every_comparison(tmp_path):
    """It finished fewer runs than the others, and is better: neither must be seen in their numbers."""
    values = {(s, m, 0): v * (1 + 0.1 * i) for i, s in enumerate("abcd") for m, v in (("x", 0.01), ("y", 0.008))}
    without = summary_of(collected(values))
    oracle = {("a", "oracle", 0): 0.001, ("b", "oracle", 0): 0.003}
    lines = summary_of(with_oracle(values | oracle)).splitlines()
    place = next(index for index, line in enumerate(lines) if ORACLE_LINE in line)
    assert lines[place + 1].startswith("| oracle") and "2.00" in lines[place + 1]
    assert [line for line in lines if "oracle" not in line] == without.splitlines()
    numbers = Numbers(everything=with_oracle(values | oracle), baseline="x")
    summary.write(numbers, tmp_path)
    for table in (numbers.ratios, numbers.seeds):
        assert "oracle" not in set(table["method"])
    assert read_scores(tmp_path / "scores.csv").oracles == ("oracle",)


def test_an_oracle_in_a_study_is_never_marked():
    study = parse(Study, {"title": "T", "reference": None, "baseline": "x", "rows": {"x": "x", "y": "y", "O": "oracle"}}, "here")
    values = {(s, m, 0): v for s in NAMES for m, v in (("x", 0.01), ("y", 0.008), ("oracle", 0.001))}
    runs = with_oracle(values)
    runs = Collected(runs.scores, runs.runs.assign(source="mocap", run_key="", images="null"))
    found = cells(study, restricted(study, runs)).set_index(["label", "metric"])
    assert found.loc[("O", "track_error"), ["verdict", "direction"]].tolist() == [Verdict.ORACLE] * 2
    table = tables_study.main_table(study, cells(study, restricted(study, runs)))
    assert ORACLE_LINE in rows_of(table)
    assert [row[0].text for row in table.rows if any(cell.mark for cell in row)] == ["y"]


def test_records_say_which_method_is_an_oracle_and_what_the_floor_is(tmp_path):
    for method, oracle in (("x", False), ("o", True)):
        path = write_run(tmp_path, "a", method, 0, BOTH)
        record = RunRecord.load(path)
        changed = {"variant": {"oracle": True} if oracle else {}, "floors": {"chamfer": 0.007, "track_error": 0.0035}}
        RunRecord(**({name: getattr(record, name) for name in record.__dataclass_fields__} | changed)).save(path)
    found = collect(tmp_path, ["a", "b"], ["x", "o"], [0])
    assert found.oracles == ("o",)
    assert set(found.comparison.runs["method"]) == {"x"}
    assert "Floor in frame 0: CD 7.00 mm, TE 3.50 mm; TE bound 0 by construction." in summary_of(found)
    floors = Numbers(everything=found, baseline="x").floors.set_index("metric")["value"]
    assert floors.to_dict() == {"chamfer": 0.007, "track_error": 0.0035}


def test_the_new_metric_is_left_out_where_no_run_has_it():
    old = collected({(s, m, 0): 0.01 for s in "abc" for m in "xy"})
    assert "TE bound" not in summary_of(old)
    new = Collected(pd.concat([old.scores, old.scores.assign(metric="track_error_bound", value=0.004)]), old.runs)
    text = summary_of(new)
    header = next(line for line in text.splitlines() if "Future TE" in line)
    assert "Future TE bound" in header and "Recon. TE bound" not in header
    assert "4.00" in text


def test_a_study_shows_it_beside_the_papers_columns(tmp_path):
    for name in NAMES:
        for method, factor in (("baseline", 1.0), ("model_a", 0.7)):
            write_run(tmp_path, name, method, 0, {key: factor * value for key, value in BOTH.items()}, source="mocap")
    methods = ["baseline", "model_a"]
    text = study_text("table2", STUDIES["table2"], tmp_path, NAMES, [0], methods, tmp_path / "out")
    found = pd.read_csv(tmp_path / "out" / "table2.csv").set_index(["label", "metric", "task"])
    row = found.loc[("Model-A (PT)", "track_error_bound", "future")]
    assert (row["direction"], row["verdict"]) == (Verdict.BETTER, Verdict.NO_VALUE)
    assert row[["relative", "relative_low", "relative_high"]].astype(float).tolist() == pytest.approx([-0.3] * 3)
    assert "Future TE bound" in text and "0 for every rigid motion" in text


def test_two_trainings_stand_under_one_heading(tmp_path):
    ours = STUDIES["table2_ours"]
    assert ours.beside == "table2"
    beside = STUDIES["table2"]
    factors = {"baseline": 1.0, "neuspring_one_frame": 0.9, "baseline_ten_frames": 0.8, "neuspring": 0.4}
    for name in NAMES:
        for method, factor in factors.items():
            write_run(tmp_path, name, method, 0, {key: factor * value for key, value in BOTH.items()}, source="mocap")
    text = study_text("table2_ours", ours, tmp_path, NAMES, [0], factors, tmp_path / "out", beside=beside)
    change = text.split("## Both trainings: change")[1].split("##")[0].splitlines()
    rows = [line for line in change if line.startswith("| NeuSpring") or line.startswith("|  ")]
    # Each against the baseline of its own training.
    assert "one frame per step" in rows[2] and "-10.0 %" in rows[2]
    assert "ten frames per step" in rows[3] and "-50.0 %" in rows[3]
    assert set(beside.rows) == set(ours.rows)


def record(method: str, scenario: str = "a", variant: dict | None = None, **settings: dict) -> RunRecord:
    return run_record(scenario=scenario, method=method, settings=settings, variant=variant or {})


def differing(records, labels) -> dict[str, str]:
    return dict(differing_table(records, labels).itertuples(index=False))


def test_settings_that_differ_are_those_of_the_records():
    same = {"search": {"rollouts": 88}}
    records = [
        record("x", fit={"fit": {"horizon": 1, "epochs": 20}, "seed": 0}, **same),
        record("y", fit={"fit": {"horizon": 10, "epochs": 20}, "seed": 1}, **same),
        record("z", fit={"fit": {"horizon": 10, "epochs": 20}, "seed": 2}, **same),
        record("alone", variant={"search": "uniform"}, **same),
    ]
    found = differing(records, {"x": "X", "y": "Y", "z": "Z", "alone": "Search"})
    assert found.pop("method.search") == "–: X, Y, Z; uniform: Search"
    assert found == {"stages": "search + fit: X, Y, Z; search: Search", "fit.horizon": "1: X; 10: Y, Z"}


def test_settings_of_scenarios_are_no_difference_between_methods():
    records = [record(m, s, search={"ground": s == "a"}) for m in "xy" for s in "ab"]
    assert differing(records, {"x": "X", "y": "Y"}) == {}
    found = differing([*records, record("y", "c", search={"ground": "other"})], {"x": "X", "y": "Y"})
    assert list(found) == ["search.ground"]


def test_the_footnote_is_in_markdown_and_latex(tmp_path):
    for method, horizon in (("baseline", 1), ("model_a", 10)):
        write_run(tmp_path, "cable_0", method, 0, BOTH, source="mocap", settings={"fit": {"horizon": horizon}})
    out = tmp_path / "out"
    text = study_text("table2", STUDIES["table2"], tmp_path, NAMES[:1], [0], ["baseline", "model_a"], out)
    assert "## Settings that differ" in text
    assert "| fit.horizon | 1: Baseline; 10: Model-A (PT) |" in text
    assert "fit.horizon & 1: Baseline; 10: Model-A (PT)" in (out / "table2.tex").read_text()


def test_aims_reach_the_summary_and_its_file(tmp_path):
    values = {(s, m, 0): v * (1 + 0.02 * i * (m == "y")) for i, s in enumerate("abcd") for m, v in (("x", 0.01), ("y", 0.007))}
    config = parse(Config, {"aims": [{"method": "y", "baseline": "x", "ratio": r} for r in (0.85, 0.5)]}, "here")
    assert json.loads(json.dumps(plain(config)["aims"]))[0]["below"] == 1.0
    aims = tuple(parse(Aim, row, "here") for row in plain(config)["aims"])
    text = summary.write(Numbers(everything=collected(values), baseline="x", aims=aims), tmp_path)
    aimed = Numbers.load(tmp_path).aimed
    assert aimed["aim_verdict"].tolist() == ["reached", "missed"]
    assert [row[-1].plain for row in summary.aim_table(aimed)[0].rows] == ["reached", "missed"]
    assert "## Aims" in text
    table = Numbers.load(tmp_path).ratios
    assert table["verdict"].tolist() == ["below 1"]
    np.testing.assert_allclose(table["ratio"], 0.7 * np.exp(np.log1p(0.02 * np.arange(4)).mean()))
