"""Stages without the workflow: records name their files, failures propagate, the run record is complete."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from neuspring import config
from neuspring.baselines import REFERENCES
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.core.files import read_npz
from neuspring.core.records import Recorder, StageRecord
from neuspring.core.run_record import RunRecord
from neuspring.experiments.tracking import log as tracking
from neuspring.physics import stability
from neuspring.physics.topology import node_spacing
from neuspring.scores import metrics
from neuspring.stages.average import average
from neuspring.stages.fit import fit
from neuspring.stages.observe import observe
from neuspring.stages.rollout import rollout
from neuspring.stages.score import _notes, score
from neuspring.stages.search import search
from neuspring.stages.transfer import transfer
from tests.support import small

SETTINGS = config.Config(search=config.Search(rollouts=11), fit=config.Fit(epochs=2), toy=config.Toy(frames=8), device="cpu")


METHODS = {"phystwin": (1, "springs"), "search_only": (1, None), "neuspring": (3, "field")}
"""Regions and what the second stage trains."""


def run_all(folder, name="small", *, method="phystwin", settings=SETTINGS):
    """Observe, search, fit, roll out and score one toy scene; returns the path of run.json."""
    clusters, kind = METHODS[method]
    searched = "search-uniform" if clusters == 1 else f"search-piecewise_{clusters}"
    seen, found = folder / name / "observations.npz", folder / name / searched / "0" / "search.json"
    out = folder / name / method / "0"
    if not seen.exists():
        observe(scenario=small.row(name=name), settings=settings, output=seen)
    if not found.exists():
        search(observations=seen, settings=settings, clusters=clusters, seed=0, device="cpu", output=found)
    records = {"search": found}
    if kind:
        fit(observations=seen, search=found, settings=settings, kind=kind, device="cpu", output=out / "fit.json")
        records["fit"] = out / "fit.json"
    rollout(observations=seen, learned=list(records.values())[-1], device="cpu", output=out / "rollout.json")
    score(
        observations=seen,
        **(records | {"rollout": out / "rollout.json"}),
        method=out.parent.name,
        variant={"search": "uniform"},
        seed=0,
        output=out / "run.json",
    )
    return out / "run.json"


def searched(seen, output, settings=SETTINGS, **how):
    """The record of a search for one region."""
    search(observations=seen, settings=settings, clusters=1, seed=0, device="cpu", output=output, **how)
    return StageRecord.load(output)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Results of one scene, with and without the second stage."""
    folder = tmp_path_factory.mktemp("results")
    return folder, run_all(folder), run_all(folder, method="search_only")


def test_every_step_leaves_what_its_record_names(finished):
    folder, run, _ = finished
    record = StageRecord.load(run.with_name("fit.json"))
    assert record.status == "ok"
    twin = Twin.load(record.file("twin", run.with_name("fit.json")))
    observations = Observations.load(folder / "small" / "observations.npz")
    assert len(twin.topology.nodes) == len(observations.nodes)
    found = StageRecord.load(folder / "small" / "search-uniform" / "0" / "search.json").facts
    assert found["spacing"] == node_spacing(observations.nodes)
    assert 0 < found["controller_reach"] < found["controller_radius"]
    assert Twin.load(folder / "small" / "truth.npz").topology.nodes.shape == twin.topology.nodes.shape
    assert not list(folder.rglob("*partial*"))
    assert not list(folder.rglob("*.part"))
    plots = sorted(path.name for path in run.parent.glob("plots/*.png"))
    assert plots == ["errors.png", "losses.png", "motion.png", "stiffness.png", "topology.png"]


def test_scores_are_the_metrics_of_the_trajectory(finished):
    folder, run, _ = finished
    observations = Observations.load(folder / "small" / "observations.npz")
    expected = metrics.score(Trajectory.load(run.with_name("trajectory.npz")), observations, "phystwin", 0)
    pd.testing.assert_frame_equal(pd.read_parquet(run.with_name("scores.parquet")), expected)
    assert metrics.present(expected) >= {(task, metric) for task in metrics.TASKS for metric in ("chamfer", "track_error")}


def test_stages_that_simulate_count_their_spring_updates(finished):
    folder, run, _ = finished
    found, fitted = folder / "small/search-uniform/0/search.json", run.with_name("fit.json")
    records = {name: StageRecord.load(path) for name, path in (("search", found), ("fit", fitted))}
    seen = Observations.load(folder / "small" / "observations.npz")
    train = seen.scenario.train_end - 1
    trace = pd.read_parquet(found.with_name("trace.parquet"))
    facts = {name: record.facts for name, record in records.items()}
    assert facts["search"]["spring_updates"] == train * sum(trace["springs"] * trace["substeps"]) > 0
    per_frame = facts["fit"]["springs"] * facts["fit"]["substeps"]
    assert facts["fit"]["spring_updates"] == 2 * train * per_frame
    frames = seen.scenario.frame_count - 1
    assert StageRecord.load(run.with_name("rollout.json")).facts["spring_updates"] == frames * per_frame


def test_a_transfer_keeps_positions_and_the_course_of_errors(finished, tmp_path):
    folder, run, _ = finished
    seen = Observations.load(folder / "small" / "observations.npz")
    replace(seen, scenario=replace(seen.scenario, name="other")).save(tmp_path / "other.npz")
    found = {"learned": run.with_name("fit.json"), "method": "phystwin", "settings": SETTINGS, "device": "cpu"}
    transfer(targets=[tmp_path / "other.npz", folder / "small/observations.npz"], **found, output=tmp_path / "transfer.json")
    record = StageRecord.load(tmp_path / "transfer.json")
    course, scores = (pd.read_parquet(record.file(role, tmp_path / "transfer.json")) for role in ("frames", "scores"))
    frames = seen.scenario.frame_count
    assert course.groupby(["scenario", "metric"])["frame"].apply(list).map(lambda each: each == list(range(frames))).all()
    means = course[course["frame"] > 0].groupby(["scenario", "metric"])["value"].mean()
    pd.testing.assert_series_equal(means, scores.set_index(["scenario", "metric"])["value"], check_like=True)
    positions, _ = read_npz(record.file("positions", tmp_path / "transfer.json"))
    trajectory = Trajectory.load(run.with_name("trajectory.npz"))
    assert list(positions) == ["other", seen.scenario.name]
    for moved in positions.values():
        np.testing.assert_allclose(moved, trajectory.positions, atol=1e-5)
    assert course["seconds"].max() == (frames - 1) / seen.scenario.frame_rate


@pytest.mark.parametrize("model", REFERENCES)
def test_what_learns_nothing_is_the_floor_of_transfers(finished, tmp_path, model):
    seen = finished[0] / "small/observations.npz"
    transfer(targets=[seen], method=model, model=model, settings=SETTINGS, device="cpu", output=tmp_path / "transfer.json")
    scores = pd.read_parquet(tmp_path / "transfer.parquet")
    assert set(scores["task"]) == {"transfer"} and (scores["value"] > 0).any()


def test_a_method_without_second_stage_shares_the_search(finished):
    _, run, coarse = finished
    first, second = (json.loads(path.read_text()) for path in (run, coarse))
    assert first["histories"]["search"] == second["histories"]["search"] == "../../search-uniform/0/history.parquet"
    assert second["artifacts"]["twin"] == ["../../search-uniform/0/twin.npz"]
    assert first["run_key"] != second["run_key"]


def test_regions_and_a_field_pass_through_every_stage(tmp_path):
    fit = config.Fit(epochs=2, selection="tail", field=config.SpringFieldSettings())
    run = run_all(tmp_path, method="neuspring", settings=replace(SETTINGS, fit=fit))
    record = tracking.RunRecord.load(run)
    assert record.status == "ok"
    assert set(record.timings) == {"search", "fit", "rollout", "score"} and set(record.histories) == {"search", "fit"}
    assert record.params["search.result.springs"] > 0
    assert (record.params["search.clusters"], record.params["fit.kind"]) == (3, "field")
    assert {f"search.result.object_radius.{region}" for region in range(3)} <= record.params.keys()
    found = tmp_path / "small" / "search-piecewise_3" / "0" / "search.json"
    assert StageRecord.load(found).settings["clusters"] == 3
    coarse = Twin.load(found.with_name("twin.npz"))
    fitted = Twin.load(run.with_name("twin.npz"))
    assert np.unique(fitted.topology.labels).tolist() == [0, 1, 2]
    np.testing.assert_array_equal(fitted.topology.springs, coarse.topology.springs)
    counts = pd.read_parquet(run.with_name("history.parquet"))["metric"].value_counts().to_dict()
    assert counts == {"loss": 2, "rollout_loss": 2, "gradient_norm": 2, "learning_rate": 2}


def test_a_fit_that_its_settings_held_says_so_in_the_notes():
    facts = {"at_bound": 0.25, "texels_moved": 0.0125, "frames_left_out": 0.2}
    settings = {"fit": {"epochs": 2}}
    held = StageRecord(stage="fit", status="ok", facts=facts, settings=settings)
    notes = _notes({"rollout": StageRecord(stage="rollout", status="ok"), "fit": held})
    assert notes == [
        "fit: 25% of the springs lie at the bound of their stiffness (fit.output_bound)",
        "fit: 20% of the frames left out of gradients",
        "fit: only 1.2% of the texels moved by a tenth of their first scale",
    ]
    facts = {"at_bound": 0.05, "texels_moved": 0.05, "frames_left_out": 0.05}
    free = StageRecord(stage="fit", status="ok", facts=facts, settings=settings)
    assert _notes({"rollout": StageRecord(stage="rollout", status="ok"), "fit": free}) == []


def test_a_larger_budget_costs_only_the_difference(finished, tmp_path):
    seen = finished[0] / "small" / "observations.npz"
    larger = replace(SETTINGS, search=replace(SETTINGS.search, rollouts=14))
    searched(seen, tmp_path / "search.json")
    before = pd.read_parquet(tmp_path / "trace.parquet")
    record, after = searched(seen, tmp_path / "search.json", larger), pd.read_parquet(tmp_path / "trace.parquet")
    assert (record.attempts, record.facts["rollouts"], len(after)) == (2, 14, 14)
    # Candidates that were there are not evaluated again: not even their times change.
    pd.testing.assert_frame_equal(after[: len(before)], before, check_exact=True)
    assert record.file("trace", tmp_path / "search.json").exists()
    # Everything else does start a search afresh.
    other = replace(larger, losses=config.Losses(track=2.0))
    assert searched(seen, tmp_path / "search.json", other).attempts == 1


def test_the_same_results_have_the_same_key(finished, tmp_path):
    _, run, _ = finished
    again = run_all(tmp_path)
    first, second = (json.loads(path.read_text()) for path in (run, again))
    assert first["run_key"] == second["run_key"]


def test_a_missing_or_changed_artifact_is_an_error_that_says_what_to_do(finished, tmp_path):
    twin = tmp_path / "twin.npz"
    _, run, _ = finished
    record = tmp_path / "fit.json"
    record.write_bytes(run.with_name("fit.json").read_bytes())
    with pytest.raises(InputError, match=r"twin.npz: this file of .*no such file.*Delete .*fit.json and rerun the command"):
        StageRecord.load(record).file("twin", record)
    twin.write_bytes(b"other")
    with pytest.raises(InputError, match="other content"):
        StageRecord.load(record).file("twin", record)


def test_the_mean_of_seeds_is_scored_as_any_prediction_and_a_seed_that_failed_fails_it(tmp_path, finished):
    folder = finished[1].parent
    seen, one = folder.parents[1] / "observations.npz", Trajectory.load(folder / "trajectory.npz")

    def saved(name, shift, failure=""):
        record = Recorder("rollout", tmp_path / name / "rollout.json", inputs={"observations": seen})
        files = record.beside(trajectory="trajectory.npz")
        replace(one, positions=one.positions + np.array([shift, 0, 0])).save(files["trajectory"])
        record.save(files, {}, failure=failure)
        return record.output

    rollouts, out = [saved(str(k), 0.001 * k) for k in range(3)], tmp_path / "mean" / "0"
    average(observations=seen, rollout=rollouts, output=out / "rollout.json")
    record = StageRecord.load(out / "rollout.json")
    assert [record.facts[f"spread_{task}"] for task in metrics.TASKS] == pytest.approx([0.001, 0.001], rel=1e-3)
    np.testing.assert_allclose(
        Trajectory.load(out / "trajectory.npz").positions, one.positions + np.array([0.001, 0, 0]), atol=1e-7
    )
    score(observations=seen, rollout=out / "rollout.json", method="mean", variant={"mean_of": "x"}, output=out / "run.json")
    assert RunRecord.load(out / "run.json").ok
    average(observations=seen, rollout=[*rollouts[:2], saved("lost", 0.0, "it left the scene")], output=out / "failed.json")
    assert StageRecord.load(out / "failed.json").status == "failed"


def test_only_a_body_that_can_meet_itself_is_predicted_with_more_substeps(tmp_path, finished):
    folder, _, _ = finished
    twin = Twin.load((folder / "small" / "search-uniform" / "0" / "search.json").with_name("twin.npz"))
    counts = {}
    for meets in (False, True):
        for released in (True, False):
            learned = tmp_path / f"{meets}{released}" / "search.json"
            frame_time = stability.RELEASED_FRAME_TIME if released else twin.simulation.frame_time
            one = replace(twin, simulation=replace(twin.simulation, self_collision=meets, frame_time=frame_time))
            one.save(learned.with_name("twin.npz"))
            Recorder("search", learned).save({"twin": learned.with_name("twin.npz")})
            output = learned.with_name("rollout.json")
            rollout(observations=folder / "small" / "observations.npz", learned=learned, device="cpu", output=output)
            counts[meets, released] = StageRecord.load(output).facts["substeps"]
    searched = twin.simulation.substeps
    assert counts == {
        (False, False): searched,
        (False, True): searched,
        (True, False): stability.for_prediction(one).simulation.substeps,
        (True, True): searched,
    }
    assert counts[True, False] > searched


def test_a_diverging_rollout_is_a_result(tmp_path, finished, monkeypatch):
    folder, _, _ = finished
    monkeypatch.setattr("neuspring.twin.rollout.FAR_AWAY", 0.5)  # the rope's far end lies at 0.6 m
    found = folder / "small" / "search-uniform" / "0" / "search.json"
    rollout(observations=folder / "small" / "observations.npz", learned=found, device="cpu", output=tmp_path / "rollout.json")
    record = StageRecord.load(tmp_path / "rollout.json")
    assert record.status == "failed"
    assert "left the scene in frame" in record.reason
    records = {"search": found, "rollout": tmp_path / "rollout.json"}
    score(
        observations=folder / "small" / "observations.npz",
        **records,
        method="search_only",
        variant={},
        seed=0,
        output=tmp_path / "run.json",
    )
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "failed"
    assert len(pd.read_parquet(tmp_path / "scores.parquet")) < 4
