"""Masses from volume on clouds whose cells are known."""

from __future__ import annotations

import numpy as np
import pytest

from neuspring import config
from neuspring.twin.masses import volume_masses
from neuspring.twin.search import candidate
from tests.support import small


def test_a_chain_has_half_of_both_gaps() -> None:
    """Whatever its gaps and direction, and the order of its nodes."""
    rng = np.random.default_rng(0)
    gaps = rng.uniform(0.5, 1.5, 49)
    place = np.concatenate([[0], np.cumsum(gaps)])
    cells = (np.concatenate([[0], gaps]) + np.concatenate([gaps, [0]])) / 2
    order = rng.permutation(50)
    masses = volume_masses((place[:, None] * [0.1, -0.2, 0.2])[order])
    np.testing.assert_allclose(masses, (cells / cells.mean())[order], rtol=1e-12)


@pytest.mark.parametrize("axes", [2, 3])
def test_a_lattice_has_its_cells_at_its_border_too(axes: int) -> None:
    """Inside 1, and less where there are fewer neighbors: (3 of 4 and 2 of 4 in a sheet, 5, 4 and 3 of 6 in a block)."""
    steps = np.arange(9) * 0.01
    grid = np.stack(np.meshgrid(*[steps] * axes, indexing="ij"), axis=-1).reshape(-1, axes)
    border = ((grid < 1e-9) | (grid > 0.08 - 1e-9)).sum(axis=1)
    masses = volume_masses(np.pad(grid, ((0, 0), (0, 3 - axes))))
    wanted = (2 * axes - border) / (2 * axes)
    np.testing.assert_allclose(masses, wanted / wanted.mean(), rtol=1e-9)


def test_a_dense_patch_is_lighter_per_node() -> None:
    """A sheet sampled four times as densely on its left half weighs as much there as on its right."""
    rng = np.random.default_rng(1)
    left, right = rng.uniform([0, 0], [1, 1], (1600, 2)), rng.uniform([1, 0], [2, 1], (400, 2))
    masses = volume_masses(np.pad(np.concatenate([left, right]), ((0, 0), (0, 1))))
    assert masses.mean() == pytest.approx(1.0)
    assert 0.9 < masses[:1600].sum() / masses[1600:].sum() < 1.1


def test_what_has_no_volume_has_unit_masses() -> None:
    np.testing.assert_array_equal(volume_masses(np.zeros((0, 3))), [])
    np.testing.assert_array_equal(volume_masses(np.eye(3)[:2]), [1, 1])
    np.testing.assert_array_equal(volume_masses(np.zeros((5, 3))), np.ones(5))


def test_candidates_have_masses_where_asked() -> None:
    problem = small.search_problem(simulation=config.Simulation(mass="volume"))
    made = candidate(problem, small.start_values())
    nodes = problem.observations.canonical[: len(problem.observations.nodes)]
    np.testing.assert_array_equal(made.material.mass, volume_masses(nodes).astype(np.float32))
    assert candidate(small.search_problem(), small.start_values()).material.mass.size == 0
