"""The sample twin of the package: a complete, small run of the workflow that names its commit."""

import re

import numpy as np
import pytest

import neuspring as ns
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.report.shown import find


@pytest.fixture(scope="module")
def run():
    return ns.load_run()


def test_it_is_the_demos_sloth_rolled_out_and_scored_as_the_workflow_did(run):
    assert run.folder == ns.sample_twin() and run.folder.parts[-3:] == ("synthetic_single_lift_sloth", "neuspring", "0")
    predicted = ns.roll_out(run.twin, run.observations, "cpu")
    assert predicted.positions.shape == (45, run.twin.counts["nodes"], 3)
    assert np.allclose(predicted.positions, run.trajectory.positions, atol=1e-3)
    kept = run.scores.set_index(["task", "metric"])["value"]
    found = ns.score(run.trajectory, run.observations).set_index(["task", "metric"])["value"]
    assert np.allclose(found, kept[found.index], rtol=1e-6) and {"chamfer", "track_error"} <= set(found.index.levels[1])
    rest = np.linalg.norm(run.observations.tracks[15:] - run.observations.tracks[0], axis=-1)
    assert kept["future", "track_error"] < 0.5 * np.nanmean(rest), "it learned to move"


def test_the_playground_has_all_that_it_shows():
    found = find([ns.sample_twin()])
    [one] = found.runs
    assert not one.notes and not found.notes and set(one.paths) == {"twin", "trajectory", "splats"}
    assert one.splats is not None and len(one.splats.means) > 1000


def test_it_is_smaller_than_a_megabyte_and_says_what_made_it(run):
    files = [path for path in ns.sample_twin().parents[1].rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 900_000
    record = RunRecord.load(run.folder / RUN_RECORD)
    assert re.fullmatch("[0-9a-f]{40}", record.commit) and record.ok, "made of a commit, without changes"
    records = [StageRecord.load(path) for path in files if path.suffix == ".json" and path.name != RUN_RECORD]
    assert {one.stage for one in records} == {"search", "fit", "rollout", "appearance"}
    texts = [path.read_text() for path in files if path.suffix == ".json"]
    assert not [text for text in texts if re.search(r'"/\w', text)], "no places of the machine that made it"
