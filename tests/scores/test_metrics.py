"""Reported metrics against golden values (tests/golden/m04, m06), and the rules for rows and averages."""

from __future__ import annotations

import dataclasses
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.config.settings import Aim
from neuspring.core.artifacts import Trajectory
from neuspring.core.errors import InputError
from neuspring.report.tables import Compared, write
from neuspring.scores import metrics, paper
from neuspring.scores.metrics import require_metrics
from neuspring.scores.statistics import ratios
from neuspring.scores.study import cells, restricted
from tests.support.scenarios import observations
from tests.support.study_runs import collected

GOLDEN = 1e-5
"""Relative; the golden README's tolerance (we compute in float64 and agree to rounding). Traps differ by 14 % or more."""
TRAP = 0.1


def load(name: str) -> dict[str, np.ndarray]:
    with np.load(Path(__file__).parents[1] / "golden" / f"{name}.npz", allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


def rollout(positions: np.ndarray, **fields: object) -> Trajectory:
    return Trajectory(positions=positions, **({"frame_count": len(positions)} | fields))


# Golden ---------------------------------------------------------------------------------------------------------------


def test_golden_chamfer():
    d = load("m04_chamfer_eval")
    surface, frames = int(d["num_surface_points"]), range(int(d["start"]), int(d["end"]))
    inputs = d["vertices"], d["object_points"], d["object_visibilities"]
    got = np.array([metrics.visible_to_surface(*(values[t] for values in inputs), surface) for t in frames])
    np.testing.assert_allclose(got, d["exp_frame"], rtol=GOLDEN)
    assert got.mean() == pytest.approx(float(d["exp_mean"]), rel=GOLDEN)
    assert got[0] == pytest.approx(d["exp_first_frame_dist"].mean(), rel=GOLDEN)
    for trap in ("trap_euclid_mean", "trap_sq_mean"):
        assert abs(got.mean() / d[trap] - 1) > TRAP


def test_golden_track_error():
    d = load("m06_track_eval")
    end = int(d["train_frame"])
    got = metrics.track_errors(d["vertices"], d["gt_track_3d"])
    np.testing.assert_allclose(got[1:end], d["exp_train_frame"], rtol=GOLDEN)
    np.testing.assert_allclose(got[end:], d["exp_test_frame"], rtol=GOLDEN)
    for part, name in ((got[1:end], "train"), (got[end:], "test")):
        assert part.mean() == pytest.approx(float(d[f"exp_{name}"]), rel=GOLDEN)
        assert abs(part.mean() / d[f"trap_skip_empty_{name}"] - 1) > TRAP


# Rules ----------------------------------------------------------------------------------------------------------------


def test_chamfer_is_the_l1_distance_of_visible_points_to_surface_nodes():
    seen = np.ones((5, 3), bool)
    seen[2] = [True, False, True]
    given = observations(object_visibility=seen)
    positions = np.tile(given.nodes, (5, 1, 1))
    positions[:, 0] += [0.1, 0.2, -0.3]
    positions[2, 1] += 10
    # The interior node sits on an observed point; it does not count as surface.
    positions[:, 4] = [0, 0, 0]
    np.testing.assert_allclose(metrics.chamfer_per_frame(positions, given), [0.2, 0.2, 0.3, 0.2, 0.2], rtol=1e-6)


def test_a_frame_in_which_nothing_is_visible_is_left_out():
    """NaN per frame; the mean and its frame count are over the others; a task without any such frame gives no row."""
    seen = np.ones((5, 3), bool)
    seen[[1, 3, 4]] = False
    given = observations(object_visibility=seen)
    positions = np.tile(given.nodes, (5, 1, 1))
    positions[:, :, 0] += 0.1
    assert np.isnan(metrics.chamfer_per_frame(positions, given)).tolist() == [False, True, False, True, True]
    rows = metrics.score(rollout(positions), given, "ours", 0)
    rows = rows[rows["metric"] == "chamfer"]
    assert rows[["task", "metric", "frames"]].to_numpy().tolist() == [["reconstruction", "chamfer", 1]]
    assert rows["value"].item() == pytest.approx(0.1, rel=1e-5)


def test_tracks_are_matched_once_to_all_nodes():
    """The first track is nearest to the interior node at frame 0 and stays with it; the second appears late: never used."""
    tracks = np.full((5, 2, 3), np.nan)
    tracks[[0, 1, 3], 0] = [0.0, 0, 6.5]
    tracks[1:, 1] = [1.0, 0, 0]
    given = observations(tracks=tracks)
    positions = np.tile(given.nodes, (5, 1, 1))
    positions[1:, 3:] += [0.3, 0.4, 0.0]
    found = metrics.track_errors(positions, given.tracks)
    wanted = np.sqrt(0.3**2 + 0.4**2 + 0.5**2)
    # Frames 2 and 4 are without annotation: they score 0 and are averaged in, as published.
    np.testing.assert_allclose(found, [0.5, wanted, 0, wanted, 0], rtol=1e-6)
    rows = metrics.score(rollout(positions), given, "ours", 0).query("metric == 'track_error'")
    np.testing.assert_allclose(rows["value"], [wanted / 2, wanted / 2], rtol=1e-6)
    assert rows["frames"].tolist() == [2, 2]


def test_without_tracks_there_is_no_track_row():
    late = np.full((5, 1, 3), np.nan)
    late[1:] = 0.0
    for own in ({}, {"tracks": late}):
        given = observations(**own)
        assert np.isnan(metrics.track_errors(np.tile(given.nodes, (5, 1, 1)), given.tracks)).all()
        rows = metrics.score(rollout(np.tile(given.nodes, (5, 1, 1))), given, "ours", 0)
        assert "chamfer" in set(rows["metric"]) and not {"track_error", "track_error_bound"} & set(rows["metric"])


def test_a_row_says_what_it_is():
    given = observations(tracks=np.zeros((5, 1, 3)))
    rows = metrics.score(rollout(np.tile(given.nodes, (5, 1, 1))), given, "ours", 7)
    assert tuple(rows.columns) == metrics.SCORE_COLUMNS
    applying = [name for name in metrics.METRICS if name in metrics.errors_per_frame(given.nodes[None], given)]
    assert rows[["task", "metric"]].to_numpy().tolist() == [[t, m] for t in metrics.TASKS for m in applying]
    first = rows.iloc[0]
    assert (first["scenario"], first["category"], first["method"], first["seed"]) == ("scene", "toy", "ours", 7)
    assert rows["unit"].tolist() == [metrics.METRICS[name].unit for name in rows["metric"]]
    assert set(rows["frames"]) == {2}


@pytest.mark.parametrize(("end", "tasks"), [(1, []), (2, []), (3, ["reconstruction"]), (4, ["reconstruction"])])
def test_a_diverged_rollout_gives_no_row_for_the_tasks_it_missed(end, tasks):
    """Five frames, three of them training: diverging in frame `end` leaves only complete tasks, and never a NaN."""
    given = observations(tracks=np.zeros((5, 1, 3)))
    broken = rollout(np.tile(given.nodes, (end, 1, 1)), frame_count=5, diverged_frame=end, reason="node 0 left the scene")
    rows = metrics.score(broken, given, "ours", 0)
    assert rows["task"].unique().tolist() == tasks
    assert tuple(rows.columns) == metrics.SCORE_COLUMNS
    assert not rows["value"].isna().any()


# Averages -------------------------------------------------------------------------------------------------------------


def table(*rows: tuple[str, str, int, float, int]) -> pd.DataFrame:
    """Rows of (method, scenario, seed, value, frames)."""
    found = pd.DataFrame(rows, columns=["method", "scenario", "seed", "value", "frames"])
    return found.assign(task="future", metric="chamfer", category="toy", unit="m")


def test_both_averages():
    """Equal weights scenarios equally, frames weighs them by length; seeds are averaged within a scenario first."""
    long = ("ours", "long", 0, 1.0, 30), ("ours", "long", 1, 3.0, 30)
    row = metrics.averages(table(*long, ("ours", "short", 0, 5.0, 10), ("ours", "short", 1, 7.0, 10))).iloc[0]
    assert (row["method"], row["task"], row["metric"]) == ("ours", "future", "chamfer")
    assert row["equal"] == pytest.approx((2 + 6) / 2)
    assert row["frames"] == pytest.approx((2 * 30 + 6 * 10) / 40)
    assert row["scenarios"] == 2
    assert row["seed_std"] == pytest.approx(np.std([3.0, 5.0], ddof=1))


def test_scenarios_with_different_numbers_of_seeds():
    """Seeds are averaged first, so that a scenario with more of them weighs no more; no spread from scenarios that seeds lack."""
    scores = table(("ours", "a", 0, 9.0, 10), *(("ours", "b", seed, 1.0, 10) for seed in range(3)))
    row = metrics.averages(scores).iloc[0]
    assert (row["equal"], row["frames"]) == (5.0, 5.0)
    assert np.isnan(row["seed_std"])
    more = metrics.averages(pd.concat([scores, table(("ours", "a", 1, 8.0, 10))])).iloc[0]
    assert more["seed_std"] == pytest.approx(np.std([5.0, 4.5], ddof=1))


# Declarations -----


def test_every_metric_of_the_papers_tables_is_declared_once():
    assert {metric for name in paper.tables() for _, _, metric in paper.table(name)} == set(paper.metrics())
    assert list(paper.metrics()) == ["chamfer", "track_error", "iou", "psnr", "ssim", "lpips"]
    others = [name for name, metric in metrics.METRICS.items() if metric.in_studies and not metric.paper_name]
    assert list(paper.in_studies()) == [*paper.metrics(), *others] and "track_error_bound" in others
    assert len({metric.column for metric in metrics.METRICS.values()}) == len(metrics.METRICS)


def test_values_are_printed_in_the_unit_of_the_table():
    assert metrics.METRICS["chamfer"].text(0.00512) == "5.12"
    assert metrics.METRICS["psnr"].text(1.234, "+") == "+1.234"
    assert metrics.METRICS["iou"].shown(84.06) == metrics.METRICS["iou"].text(0.8406) == "84.1"
    assert metrics.METRICS["iou"].shown(float("nan")) == "–"
    assert metrics.METRICS["iou"].column == "IoU %"


def test_a_packages_metric_is_one_entry_that_is_scored_shown_and_may_be_aimed_at(monkeypatch, tmp_path):
    """As the registry gives it where an installed package names it in its entry points."""
    extent = metrics.Metric(
        name="extent", title="extent", heading="Extent", unit="m", shown_unit="cm", factor=100.0, digits=1, in_studies=True,
        function=lambda positions, _: np.ptp(positions[..., 2], axis=1),
    )  # fmt: skip
    point = EntryPoint("extent", "package.metrics:EXTENT", "neuspring.metrics")
    monkeypatch.setattr(EntryPoint, "load", lambda _: extent)
    monkeypatch.setitem(vars(metrics.METRICS), "_foreign", {"extent": point})
    monkeypatch.setitem(vars(metrics.METRICS), "_loaded", {})
    given = observations()
    positions = np.repeat(given.nodes[None], given.scenario.frame_count, axis=0)
    values = {}
    for method, factor in (("x", 1.0), ("y", 2.0)):
        rows = metrics.score(rollout(factor * positions), given, method, 0)
        own = {(row.task, row.metric): row.value for row in rows.itertuples()}
        values |= {(scenario, method, 0): own for scenario in "abcdef"}
    table = collected(values)
    aim = Aim(method="y", baseline="x", metric="extent", ratio=2.5, below=3.0)
    require_metrics([aim])
    assert ratios(table.rows, "x").set_index(["metric", "task"]).loc[("extent", "future"), "ratio"] == pytest.approx(2.0)
    assert "Future Extent" in write(Compared(table=table, baseline="x", aims=(aim,)), tmp_path)
    study = paper.Study(title="T", reference=None, baseline="x", rows={"x": "x", "y": "y"})
    found = cells(study, restricted(study, table)).set_index(["metric", "task", "label"])
    assert found.loc[("extent", "future", "y"), "change"] == pytest.approx(2.0)
    with pytest.raises(InputError, match=r"aims, metric: .*Known: .*extent"):
        require_metrics([dataclasses.replace(aim, metric="psnr")])
