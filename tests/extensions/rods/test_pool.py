"""Recordings of one cable in a pool."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.extensions.rods import mocap
from neuspring.extensions.rods.fit import along
from neuspring.extensions.rods.made import rod_twin
from neuspring.extensions.rods.settings import Mocap
from neuspring.twin.fit import FitProblem
from neuspring.twin.transfer import require_pool


def cable(folder, sag, **settings):
    """A cable that hangs between two grippers, about in the plane of x and z, as recorded."""
    # Markers are never quite evenly spaced.
    u = np.linspace(-1, 1, 12)
    x = 0.3 * u + 0.02 * (u**2 - 1)
    line = np.stack([x, 0.05 * np.sin(5 * x), sag * (x / 0.3) ** 2 + 0.5], axis=1)
    path = folder / f"{sag}.pkl"
    path.write_bytes(pickle.dumps(np.repeat(line.T[None], 5, axis=0), protocol=4))
    row = config.ScenarioRow(
        scenario=f"cable_{sag}", source="mocap", category="cable", path="x", self_collision=False, ground=False
    )
    return mocap.read(row, path, Mocap(ring=4, rings=12, grip="clamp", stride=1, **settings))


def from_the_other_end(seen: Observations, name: str) -> Observations:
    """The recording as if its markers were numbered from the other end."""
    held = [3, 2, 1, 0, *range(4, seen.controller_points.shape[1])]
    scenario = replace(seen.scenario, name=name)
    return replace(
        seen, object_points=seen.object_points[:, ::-1], controller_points=seen.controller_points[:, held], scenario=scenario
    )


def test_all_recordings_of_a_pool_that_are_others_are_named_at_once(tmp_path):
    here, there = cable(tmp_path, 0.3), cable(tmp_path, 0.33)
    pool = [there, cable(tmp_path, 0.31), cable(tmp_path, 0.32)]
    require_pool(here, pool)
    other = [from_the_other_end(pool[0], "one"), from_the_other_end(pool[2], "two")]
    with pytest.raises(InputError, match=r"as many nodes and controllers.*in cable_0\.33, .* in cable_0\.31"):
        require_pool(here, [replace(each, interior_points=np.zeros((2, 3))) for each in pool[:2]])
    # Nodes around the line are the lattice's affair: a rod follows the markers alone.
    settings = config.Config()
    fit = {"fit": settings.fit, "simulation": settings.simulation, "losses": settings.losses, "quirks": settings.released_quirks}
    twin = rod_twin(here, settings, (0.0, 1.0, 0.0))
    FitProblem(observations=here, pool=[*other, there], twin=twin, kind="rod", **fit)
    with pytest.raises(InputError, match="as many tracked points, controllers and vertices"):
        FitProblem(observations=here, pool=[replace(there, line=there.line[1:])], twin=twin, kind="rod", **fit)


def test_the_order_along_a_cable_is_told_by_the_distances_between_its_markers(tmp_path):
    pool = [cable(tmp_path, sag) for sag in (0.3, 0.31, 0.32, 0.33)]
    exchanged = replace(pool[3], controller_points=pool[3].controller_points[:, [0, 1, 3, 2, *range(4, 20)]])
    pool[1:] = [from_the_other_end(pool[1], "other"), pool[2], exchanged]
    for each, order in zip(pool, along(pool), strict=True):
        points = np.concatenate([each.nodes, each.controller_points[0]])
        assert (np.diff(points[each.line[order], 0]) > 0).all()
