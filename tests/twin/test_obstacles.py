"""Obstacles of a scenario reach every simulation: of a search, a fit, a rollout, a transfer; files without any are as before."""

from dataclasses import replace

import numpy as np

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.core.geometry import Obstacle
from neuspring.twin.fit import fit
from neuspring.twin.rollout import roll_out
from neuspring.twin.search import search
from neuspring.twin.transfer import move
from tests.support import small

SHELF = Obstacle(shape="box", center=(0.0, 0.0, -0.5), half_sizes=(2.0, 2.0, 0.55))
"""A board of 5 cm on the table: its top is above the lower nodes of the rope, which it throws up."""


def on_shelf() -> Observations:
    seen = small.observations()
    return replace(seen, scenario=replace(seen.scenario, obstacles=(SHELF,)))


def test_search_fit_rollout_and_transfer_carry_the_obstacles_of_a_scenario(tmp_path):
    on_shelf().save(tmp_path / "seen.npz")
    seen = Observations.load(tmp_path / "seen.npz")
    assert seen.scenario.obstacles == (SHELF,)
    found = search(small.search_problem(seen), 0)
    assert found.twin.simulation.obstacles == (SHELF,)
    assert found.cost != search(small.search_problem(), 0).cost
    trained = fit(small.fit_problem(seen, fit=config.Fit(epochs=2, learning_rate=5e-2))).twin
    assert trained.simulation.obstacles == (SHELF,)
    positions = roll_out(trained, seen.controller_points).positions
    free = replace(trained, simulation=replace(trained.simulation, obstacles=()))
    assert np.abs(positions - roll_out(free, seen.controller_points).positions).max() > 1e-3
    assert move(free, seen)[0].simulation.obstacles == (SHELF,)
