"""A small scenario's results folder with runs that have real twins, as the workflow leaves it: for tests of the playground."""

from dataclasses import replace

import numpy as np

from neuspring.core.files import write_text
from neuspring.core.records import Recorder
from neuspring.splats.model import Splats
from neuspring.twin.rollout import roll_out
from tests.support import small


def results(folder, methods=("baseline", "neuspring")):
    """results/<scenario> of a toy rope whose twins differ in stiffness; returns the scenario's folder."""
    problem = small.scene()
    seen, scenario = problem.observations, folder / "small"
    seen.save(scenario / "observations.npz")
    for index, method in enumerate(methods):
        place = scenario / method / "0"
        twin = softer(problem.truth, 0.7**index)
        twin.save(place / "twin.npz")
        roll_out(twin, seen.controller_points).save(place / "trajectory.npz")
        record(place)
    return scenario


def record(run):
    """Write the records of a run's twin and trajectory as they lie there."""
    Recorder("fit", run / "fit.json").save({"twin": run / "twin.npz"})
    rollout = Recorder("rollout", run / "rollout.json", inputs={"learned": run / "fit.json"})
    rollout.save({"trajectory": run / "trajectory.npz"})


def softer(twin, factor):
    """The twin with its stiffness times a factor."""
    return replace(twin, material=replace(twin.material, stiffness=twin.material.stiffness * np.float32(factor)))


def spoil(path, old, new):
    """Replace text in a file that has it."""
    text = path.read_text()
    assert old in text
    write_text(path, text.replace(old, new))


def dressed(scenario, degree=0, count=300):
    """Give a scenario of `results` splats of seed 0, around the nodes of frame 0; returns them."""
    nodes = small.observations().nodes
    rng = np.random.default_rng(1)
    splats = Splats(
        means=nodes[rng.integers(0, len(nodes), count)] + rng.normal(0, 0.004, (count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        log_scales=np.log(rng.uniform(0.003, 0.009, (count, 3))),
        opacity_logits=np.full(count, 3.0),
        harmonics=np.concatenate([rng.uniform(0.2, 1.2, (count, 1, 3)), np.zeros((count, (degree + 1) ** 2 - 1, 3))], axis=1),
    )
    record = Recorder("appearance", scenario / "appearance" / "0" / "appearance.json")
    files = record.beside(splats="splats.ply")
    splats.save(files["splats"])
    record.save(files)
    return splats
