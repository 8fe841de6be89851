"""Recordings of one cable in a pool."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from neuspring import config
from neuspring.core.errors import InputError
from neuspring.extensions.rods import mocap
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
    return mocap.read(row, path, Mocap(rings=12, stride=1, **settings))


def test_all_recordings_of_a_pool_that_are_others_are_named_at_once(tmp_path):
    here, there = cable(tmp_path, 0.3), cable(tmp_path, 0.33)
    pool = [there, cable(tmp_path, 0.31), cable(tmp_path, 0.32)]
    require_pool(here, pool)
    with pytest.raises(InputError, match=r"equal numbers of nodes and controllers.*in cable_0\.33, .* in cable_0\.31"):
        require_pool(here, [replace(each, interior_points=np.zeros((2, 3)), rest_shape=np.zeros((0, 3))) for each in pool[:2]])
    # Nodes around the line are the lattice's affair: a rod follows the markers alone.
    settings = config.Config()
    fit = {"fit": settings.fit, "simulation": settings.simulation, "losses": settings.losses, "quirks": settings.released_quirks}
    twin = rod_twin(here, settings, (0.0, 1.0, 0.0))
    FitProblem(observations=here, pool=[there], twin=twin, kind="rod", **fit)
    with pytest.raises(InputError, match="equal numbers of tracked points, controllers and vertices"):
        FitProblem(observations=here, pool=[replace(there, line=there.line[1:])], twin=twin, kind="rod", **fit)
