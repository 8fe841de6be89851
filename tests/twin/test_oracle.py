"""The oracle reads the future, and its records state it."""

from pathlib import Path

import numpy as np
import pytest

from neuspring import config
from neuspring.core.artifacts import Twin
from neuspring.core.records import StageRecord
from neuspring.physics.parameters import twin_tensors
from neuspring.stages.fit import fit as fit_stage
from neuspring.stages.fit import prepared
from neuspring.stages.rollout import rollout
from neuspring.stages.search import search as search_stage
from neuspring.twin.fit import fit
from tests.support import small

SETTINGS = config.Config(
    search=small.released(rollouts=11, start={"object_radius": 0.045, "stiffness": 1e4}),
    fit=config.Fit(epochs=2, learning_rate=5e-2),
    device="cpu",
)


def parameters(twin: Twin) -> np.ndarray:
    return np.concatenate([values.numpy().ravel() for values in twin_tensors(twin, "cpu").values()])


def test_an_oracle_reads_what_comes_after_the_split():
    results = [fit(small.fit_problem(seen, oracle=True)).twin for seen in (small.observations(), small.spoiled_future())]
    assert not np.array_equal(*map(parameters, results))


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    folder = tmp_path_factory.mktemp("oracle")
    small.observations().save(folder / "observations.npz")
    seen, output = folder / "observations.npz", folder / "search.json"
    search_stage(observations=seen, settings=SETTINGS, clusters=1, seed=0, device="cpu", output=output)
    return folder


def fitted(started: Path, output: Path, oracle: bool):
    before = {"observations": started / "observations.npz", "search": started / "search.json"}
    fit_stage(**before, settings=SETTINGS, kind="springs", device="cpu", output=output, oracle=oracle)


def test_records_of_fit_and_rollout_say_oracle_and_digests_differ(started, tmp_path):
    seen, found = started / "observations.npz", started / "search.json"
    keys = {}
    for oracle in (False, True):
        output = tmp_path / f"{oracle}" / "fit.json"
        job = fit_stage.job(observations=seen, search=found, settings=SETTINGS, device="cpu", output=output, oracle=oracle)
        arguments = {name: value for name, value in job.arguments.items() if name != "threads"}
        keys[oracle] = prepared(**arguments)[2]
        fitted(started, output, oracle)
        rollout(observations=seen, learned=output, device="cpu", output=output.with_name("rollout.json"))
    assert keys[False] != keys[True]
    for name in ("fit", "rollout"):
        normal, seeing = (StageRecord.load(tmp_path / f"{oracle}" / f"{name}.json") for oracle in (False, True))
        assert not normal.settings.get("oracle")
        assert seeing.settings["oracle"] is True
    frames = [StageRecord.load(tmp_path / f"{oracle}" / "fit.json").facts["spring_updates"] for oracle in (False, True)]
    scenario = small.observations().scenario
    assert frames[1] * (scenario.train_end - 1) == frames[0] * (scenario.frame_count - 1)
