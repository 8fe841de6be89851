"""The distance between neighboring nodes, on bodies whose spacing is known."""

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.twin.topology import controller_reach, node_spacing

ROUNDING = 1e-12
"""Relative, in float64."""


def lattice(*counts: int) -> np.ndarray:
    return np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, len(counts)).astype(float)


def rings(count: int, of: int, apart: float, radius: float) -> np.ndarray:
    """A straight cable along x."""
    angle = 2 * np.pi * np.arange(of) / of
    ring = np.stack([0 * angle, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return (ring[None] + apart * np.array([1.0, 0, 0]) * np.arange(count)[:, None, None]).reshape(-1, 3)


@pytest.mark.parametrize("counts", [(40, 1, 1), (15, 15, 1), (9, 8, 7)])
def test_a_grid_has_the_spacing_of_its_nodes(counts):
    assert node_spacing(0.018 * lattice(*counts)) == pytest.approx(0.018, rel=ROUNDING)


@pytest.mark.parametrize("of", [3, 4, 8])
def test_rings_of_near_nodes_have_the_distance_of_the_rings(of):
    cable = rings(40, of, apart=0.025, radius=0.006)
    nearest = np.linalg.norm(cable[1:of] - cable[0], axis=1).min()
    assert nearest < 0.025 / 2
    assert node_spacing(cable) == pytest.approx(0.025, rel=ROUNDING)


def test_it_scales_with_the_body_and_forgets_the_order_of_its_nodes():
    rng = np.random.default_rng(0)
    nodes = lattice(12, 12, 1) + 0.3 * rng.random((144, 3))
    expected = node_spacing(nodes)
    assert node_spacing(1000 * nodes) == pytest.approx(1000 * expected, rel=ROUNDING)
    assert node_spacing(nodes[rng.permutation(144)]) == pytest.approx(expected, rel=ROUNDING)


def test_holes_and_nodes_at_the_same_place_do_not_count():
    rope = lattice(60, 1, 1)
    holes = np.delete(rope, [10, 11, 30], axis=0)
    assert node_spacing(holes) == pytest.approx(1.0, rel=ROUNDING)
    assert node_spacing(np.concatenate([rope, rope[::3]])) == pytest.approx(1.0, rel=ROUNDING)


def test_parts_that_lie_farther_than_any_neighbor_are_a_forest():
    body = lattice(8, 8, 1)
    assert node_spacing(np.concatenate([body, body + 1000])) == pytest.approx(1.0, rel=ROUNDING)


def test_one_place_has_no_spacing():
    with pytest.raises(InputError, match="two nodes at different places"):
        node_spacing(np.ones((3, 3)))


def test_the_reach_is_that_of_the_nearest_controller():
    hands = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 0.5], [0.0, 0.0, 9.0]])
    assert controller_reach(lattice(5, 5, 1), hands) == 0.5
