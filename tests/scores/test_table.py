"""The long table: values read from runs, compared scores, averages without and with failures."""

import json
import math

import pandas as pd
import pytest

from neuspring.core.errors import InputError
from neuspring.core.records import Recorder
from neuspring.core.run_record import RunRecord
from neuspring.scores import queries, statistics
from neuspring.scores.metrics import SCORE_COLUMNS
from neuspring.scores.table import DAMAGED, as_asked, collect, comparable, differing, mixed_settings, read_scores
from tests.support.study_runs import all_scores, collected, write_run

FUTURE = ("future", "track_error")
HELD = ("future_held", "track_error")
VALUES = {("a", "x", 0): 0.010, ("b", "x", 0): 0.020, ("a", "y", 0): 0.004}


@pytest.fixture
def results(tmp_path):
    """Two methods on two scenarios; y failed on b, and its last frame was held."""
    for scenario, method, value in (("a", "x", 0.01), ("b", "x", 0.02), ("a", "y", 0.004)):
        write_run(tmp_path, scenario, method, 0, {FUTURE: value}, settings={"fit": {"horizon": 1 + (method == "y")}})
    write_run(
        tmp_path,
        "b",
        "y",
        0,
        {("reconstruction", "track_error"): 7.0},
        status="failed",
        reason="diverged",
        frozen={FUTURE: 0.1},
        settings={"fit": {"horizon": 2}},
    )
    return tmp_path


def test_a_table_is_read_from_records_and_from_its_files(results, tmp_path):
    table = collect(results, ["a", "b", "c"], ["x", "y"], [0])
    status = table.runs.set_index("run")["status"].to_dict()
    assert status == {"a/x/0": "ok", "a/y/0": "ok", "b/x/0": "ok", "b/y/0": "failed", "c/x/0": "missing", "c/y/0": "missing"}
    assert set(table.rows["task"]) == {"future", "reconstruction", "future_held"}
    table.save(tmp_path / "tables")
    again = read_scores(tmp_path / "tables" / "scores.csv")
    pd.testing.assert_frame_equal(again.rows, table.rows, check_dtype=False)
    pd.testing.assert_frame_equal(queries.means(again), queries.means(table))
    assert differing(again.runs) == differing(table.runs) == {"fit.horizon": {"x": "1", "y": "2"}}
    some = again.named(scenario=["a"], method=["x"], seed=[])
    assert set(some.rows["run"]) == {"a/x/0"}
    with pytest.raises(InputError, match="--scenarios: must be in the file of --scores"):
        again.named(scenario=["z"])


def test_older_files_are_read_and_others_refused(results, tmp_path):
    table = collect(results, ["a", "b"], ["x"], [0])
    old = tmp_path / "scores.csv"
    table.finished[list(SCORE_COLUMNS)].to_csv(old, index=False)
    assert set(read_scores(old).runs["status"]) == {"ok"}
    table.runs.drop(columns="run").to_csv(old.with_name("runs.csv"), index=False)
    assert set(read_scores(old).runs["status"]) == {"ok"}
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"must be a scores.csv with the columns scenario"):
        read_scores(tmp_path / "other.csv")


def test_damaged_records_and_held_files_are_failed_runs(results):
    (results / "b" / "y" / "0" / "held.parquet").write_bytes(b"half")
    (results / "a" / "x" / "0" / "run.json").write_text("{")
    runs = collect(results, ["a", "b"], ["x", "y"], [0]).runs.set_index("run")
    for name in ("b/y/0", "a/x/0"):
        assert runs.loc[name, "status"] == "failed" and runs.loc[name, "reason"].startswith(DAMAGED)


def test_methods_that_do_not_apply_have_no_run(results):
    table = collect(results, ["a", "b"], ["x", "y"], [0], {"y": {"b": "needs images", "z": "other"}, "w": {"a": "no"}})
    assert "b/y/0" not in set(table.runs["run"]) and table.left_out == {"y": {"b": "needs images"}}


def test_an_oracle_is_known_by_its_records_and_takes_no_part(results):
    path = results / "a" / "y" / "0" / "run.json"
    record = RunRecord.load(path)
    RunRecord(**{name: getattr(record, name) for name in record.__dataclass_fields__} | {"variant": {"oracle": True}}).save(path)
    table = collect(results, ["a", "b"], ["x", "y"], [0])
    assert table.oracles == ["y"] and table.comparison.methods == ["x"]
    assert set(comparable(table.comparison.finished)["scenario"]) == {"a", "b"}
    means = queries.means(table).set_index("method")["equal"]
    assert means.to_dict() == pytest.approx({"x": 0.015, "y": 0.004})
    assert set(queries.duels(table, "x")["method"]) == {"x"}


def test_transfers_are_rows_of_their_own(results):
    for method, value, diverged in (("x", 0.03, []), ("y", 0.05, ["a"])):
        path = results / "a" / method / "0" / "transfer.parquet"
        rows = [(f"t{k}", "rope", method, 0, "transfer", "track_error", value + 0.02 * k, "m", 9) for k in range(2)]
        pd.DataFrame(rows, columns=list(SCORE_COLUMNS)).to_parquet(path)
        Recorder("transfer", path.with_suffix(".json")).save({"scores": path}, facts={"diverged": diverged})
    table = collect(results, ["a"], ["x", "y"], [0], transfers=["a"])
    moved = table.task("transfer")
    assert moved[["run", "value", "frames"]].to_numpy().tolist() == [["a/x/0", pytest.approx(0.04), 18]]
    assert table.runs.set_index("run").loc["a/y/0", "notes"] == "transfer: diverged on a"
    assert set(comparable(table.finished)["task"]) == {"future", "transfer"}, "each compared on its own"


def test_only_pairs_that_every_method_has_of_a_metric_are_compared():
    scores = all_scores()
    table = collected(
        {("a", "x", 0): scores, ("a", "y", 0): scores, ("b", "x", 0): scores, ("b", "y", 0): {FUTURE: 0.1}, ("c", "x", 0): scores}
    )
    kept = comparable(table.finished)
    assert set(kept["scenario"]) == {"a", "b"}
    assert set(kept.loc[kept["metric"] == "psnr", "scenario"]) == {"a"}


def test_failed_runs_count_with_their_last_frame_held():
    held = {("b", "y", 0): {HELD: 0.1, FUTURE: 7.0}, ("a", "y", 1): 0.006}
    table = collected(VALUES | held)
    table.runs.loc[table.runs["run"] == "b/y/0", "status"] = "failed"
    row = queries.with_failures(table).set_index("method").loc["y"]
    assert (row["own"], row["all"]) == pytest.approx((0.005, (0.005 + 0.1) / 2))
    assert len(queries.with_failures(collected(VALUES))) == 0
    lost = collected(VALUES, failed=[("b", "y", 0)])
    assert math.isnan(queries.with_failures(lost).set_index("method").loc["y", "all"]), "no held score"
    lost.runs.loc[lost.runs["status"] == "failed", "status"] = "missing"
    assert len(queries.with_failures(lost)) == 0, "a missing run is no attempt"


def test_settings_differ_between_methods_and_must_not_within_one():
    table = collected({(s, m, 0): 0.01 for s in "ab" for m in "xyz"})
    own = {"x": {"stages": "search", "fit.horizon": 1}, "y": {"fit.horizon": 2, "render.views": 1}, "z": {"fit.horizon": 2}}
    runs = table.runs.assign(settings=[json.dumps(own[method]) for method in table.runs["method"]])
    assert differing(runs) == {"fit.horizon": {"x": "1", "y": "2", "z": "2"}}
    assert mixed_settings(runs) == []
    runs.loc[0, "settings"] = json.dumps({"fit.horizon": 3})
    assert mixed_settings(runs) == ["fit of x"] and differing(runs)["fit.horizon"]["x"] == "1 or 3"


def test_runs_that_a_part_left_out_are_not_missing(results):
    whole = collect(results, ["a", "c"], ["x"], [0])
    about = {"only": "scenario=a", "scenarios": ["a"], "methods": ["x"], "seeds": [0]}
    found = as_asked(whole, about)
    assert set(found.runs["scenario"]) == {"a"} and as_asked(whole, {}) is whole


def test_a_duel_has_the_ratio_of_the_table_of_ratios_and_names_the_worst_scenario():
    values = {
        (f"s{i}", m, 0): 0.01 * f * (1 + 0.1 * i * (m == "ours"))
        for i in range(5)
        for m, f in (("ours", 0.8), ("base", 1), ("still", 9))
    }
    table = collected(values)
    ours, base, still = queries.duels(table, "base").to_dict("records")
    ratio = statistics.ratios(table.finished, "base").set_index("method").loc["ours"]
    assert (ours["ratio"], ours["ratio_low"], ours["verdict"]) == (ratio["ratio"], ratio["ratio_low"], ratio["verdict"])
    assert (ours["better"], ours["of"], ours["worst"]) == (3, 5, "s4") and ours["worst_error"] == pytest.approx(0.0112)
    assert (base["rival"], still["better"], still["verdict"]) == ("", 0, "above 1")
    assert queries.duels(table.of(["ours", "still"]), "base")["rival"].tolist() == ["", "ours"]
    assert not len(queries.duels(collected({}, failed=[("a", "x", 0)]), "x"))
