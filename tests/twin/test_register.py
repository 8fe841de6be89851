"""Shapes laid onto each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.scenes.synthetic import toy
from neuspring.twin.register import register, residual, spacing

EXACT = 1e-9
"""Rounding of float64 over a meter."""


def body(name: str) -> np.ndarray:
    """Nodes of a toy body without symmetry: a corner is cut off."""
    shape = toy.SHAPES[name]()
    nodes = np.concatenate([shape.tracked, shape.surface, shape.interior])
    middle = nodes - nodes.mean(axis=0)
    return nodes[middle @ [1.0, 0.7, 0.4] < 0.75 * (middle @ [1.0, 0.7, 0.4]).max()]


@pytest.mark.parametrize("name", ["cloth", "blob"])
def test_a_rigid_motion_is_found_exactly(name):
    nodes, turn = body(name), Rotation.from_euler("xyz", [0.4, -1.1, 2.5]).as_matrix()
    order = np.random.default_rng(0).permutation(len(nodes))
    target, hand = nodes[order] @ turn.T + [0.3, -0.2, 0.5], nodes[:2] + np.array([0.0, 0.0, 0.05])
    found = register(nodes, target, hand @ turn.T + [0.3, -0.2, 0.5])
    np.testing.assert_allclose(found.points, nodes[order], atol=EXACT)
    np.testing.assert_allclose(found.others, hand, atol=EXACT)
    assert found.stretch == 0.0
    assert found.rigid_residual == found.residual < EXACT


def test_a_symmetric_body_that_has_not_moved_does_not_turn():
    nodes = np.stack([np.linspace(-0.3, 0.3, 31), np.zeros(31), np.zeros(31)], axis=1)
    np.testing.assert_allclose(register(nodes, nodes + np.array([0.0, 0.1, 0.0]), nodes[:1]).points, nodes, atol=EXACT)


def test_a_bent_body_is_straightened_and_hands_follow():
    x = np.linspace(-0.3, 0.3, 61)
    # A cloth of 0.6 x 0.2 m, and the same rolled around a cylinder of radius 0.4 m: lengths stay.
    flat = np.stack([a.ravel() for a in np.meshgrid(x, np.linspace(0, 0.2, 9), [0.0], indexing="ij")], axis=1)
    rolled = np.stack([0.4 * np.sin(flat[:, 0] / 0.4), flat[:, 1], 0.4 * (1 - np.cos(flat[:, 0] / 0.4))], axis=1)
    found = register(flat, rolled, rolled[:1])
    assert found.residual < 0.5 * found.rigid_residual
    assert found.stretch < 0.15
    np.testing.assert_allclose(found.others, found.points[:1], atol=EXACT)
    # Bending moves every node nearer to its place, on average by much.
    order = np.argsort(found.points[:, 0])
    assert abs(np.corrcoef(flat[order, 0], np.arange(len(order)))[0, 1]) > 0.98


def test_limbs_that_lie_otherwise_are_told_apart_by_the_ways_through_the_body():
    """A head and four limbs, which swing by up to half a radian: without ways another limb comes to lie on the head."""

    def animal(*swings: float) -> np.ndarray:
        parts = []
        for length, angle, swing in zip((0.12, 0.2, 0.2, 0.2, 0.2), (0, 1.1, 2.3, -2.3, -1.1), swings, strict=True):
            axes = np.arange(0, length, 0.015), (-0.015, 0.0, 0.015), (0.0, 0.015)
            part = np.stack([a.ravel() for a in np.meshgrid(*axes)], axis=1)
            parts.append(part @ Rotation.from_euler("z", angle + swing).as_matrix().T)
        return np.concatenate(parts)

    here, there = animal(0, 0, 0, 0, 0), animal(0, 0.2, 0.5, -0.1, 0.5)
    found = register(here, there, there[:1])
    assert np.median(np.linalg.norm(found.points - here, axis=1)) < 0.015, "node i is node i within a spacing"


def test_residual_and_spacing_of_a_grid():
    grid = np.stack([a.ravel() for a in np.meshgrid(*[np.arange(5) * 0.1] * 3, indexing="ij")], axis=1)
    assert spacing(grid) == pytest.approx(0.1)
    # All points move by half a spacing along x: every nearest point is half a spacing away.
    assert residual(grid, grid + np.array([0.05, 0.0, 0.0])) == pytest.approx(0.05)
