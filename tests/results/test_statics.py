"""Equilibria of lattices, and their stiffness in pascals."""

from __future__ import annotations

import numpy as np
import pytest

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.physics.topology import object_springs
from neuspring.twin.rollout import roll_out
from results.published.beam.statics import at_rest, elasticity, young
from tests.support.scenes import scene, twin_of

DENSITY, SIDE, LENGTH, STIFFNESS = 1000.0, 0.03, 0.1, 2.0
"""kg/m^3, m, m, N: a block that a layer of controllers holds."""


def held_node(mass: float = 1.0, **options) -> Twin:
    """A node below a controller, held by a spring of 0.5 m and 80 N."""
    return twin_of(scene(1, [(1, 0)], [0.5], stiffness=80.0, mass=[mass], gravity=9.8, **options), np.array([[0.1, 0, 0]]), HAND)


HAND = np.array([[0.0, 0.0, 0.5]])


def block(across: int, direction: tuple[int, int, int], gravity: float) -> Twin:
    """A block along x (0, 1, 2) or hanging along z (1, 2, 0), whose nodes stand for cells; the last layer for half of one."""
    spacing = SIDE / across
    along = np.linspace(0, LENGTH, round(LENGTH / spacing) + 1)
    side = (np.arange(across) + 0.5) * spacing
    grid = np.stack(np.meshgrid(along, side, side, indexing="ij"), axis=-1)[..., direction]
    grid = grid * (1 if direction[0] == 0 else -1)
    held, free = grid[0].reshape(-1, 3), grid[1:].reshape(-1, 3)
    points = np.concatenate([free, held])
    pairs = np.sort(object_springs(points, np.full(len(points), 1.5 * along[1]), np.full(len(points), 27)), axis=1)
    outer = pairs[:, 1] >= len(free)
    pairs = np.concatenate([pairs[~outer], pairs[outer & (pairs[:, 0] < len(free))]])
    mass = np.full(len(free), DENSITY * along[1] * spacing**2)
    mass[-(across**2) :] /= 2
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    body = scene(len(free), pairs, lengths, stiffness=STIFFNESS, mass=mass, gravity=gravity, frame_time=0.01, substeps=60)
    return twin_of(body, free, held)


def test_a_node_hangs_where_the_spring_bears_it_and_a_load_is_mass():
    for mass in (1.0, 3.0):
        found = at_rest(held_node(mass)).topology
        np.testing.assert_allclose(found.nodes, [[0, 0, -0.5 * mass * 9.8 / 80]], atol=1e-7)
        np.testing.assert_allclose(found.rest_shape, [[0.1, 0, 0], HAND[0]], atol=1e-7)
        assert found.rest_lengths == pytest.approx(0.5)


def test_a_bent_block_stays_where_it_is_at_rest():
    twin = at_rest(block(3, (0, 1, 2), 9.8))
    drop = (twin.topology.rest_shape[: len(twin.topology.nodes)] - twin.topology.nodes)[-9:, 2].mean()
    assert 0.4 < drop / LENGTH < 0.7, "a large bend"
    moved = roll_out(twin, np.repeat(twin.topology.controllers[None], 4, axis=0)).positions - twin.topology.nodes
    assert np.abs(moved).max() < 2e-6


def test_a_block_is_as_stiff_as_its_modulus_says():
    """Stretched by its weight q L^2 / 2 E, bent by q L^4 / 8 E I and sheared by q L^2 / 2 k G A, k = 5/6.

    I is that of areas at n nodes across, (1 - 1 / n^2) of the square's. Surfaces have fewer springs than the volume.
    """
    weight, area = 0.01 * DENSITY * SIDE**2, SIDE**2
    across = 4
    inertia = SIDE**4 / 12 * (1 - across**-2)
    twin = block(across, (1, 2, 0), 0.01)
    drop = (twin.topology.nodes - at_rest(twin).topology.nodes)[-(across**2) :, 2].mean()
    assert young(twin, DENSITY)[2] * drop == pytest.approx(weight * LENGTH**2 / 2 / area, rel=0.06)
    twin = block(across, (0, 1, 2), 0.01)
    drop = (twin.topology.nodes - at_rest(twin).topology.nodes)[-(across**2) :, 2].mean()
    shear = elasticity(twin, DENSITY)[0, 2, 0, 2]
    theory = weight * LENGTH**4 / 8 / inertia / young(twin, DENSITY)[0] + weight * LENGTH**2 / 2 / (shear * area * 5 / 6)
    assert drop == pytest.approx(theory, rel=0.06)


def test_springs_in_all_directions_make_an_isotropic_body_of_poissons_ratio_a_quarter():
    """The six axes of an icosahedron average polynomials of degree 4 as the sphere does."""
    golden = (1 + 5**0.5) / 2
    ends = [np.roll([0.0, 1.0, sign * golden], k) for k in range(3) for sign in (1, -1)]
    length, mass = float(np.linalg.norm(ends[0])), 0.5
    body = scene(7, [(0, k + 1) for k in range(6)], [length] * 6, stiffness=STIFFNESS, mass=[mass] * 7)
    twin = twin_of(body, np.array([np.zeros(3), *ends]), np.zeros((0, 3)))
    volume = 7 * mass / DENSITY
    np.testing.assert_allclose(young(twin, DENSITY), 6 * STIFFNESS * length / (6 * volume), rtol=1e-6)
    tensor = elasticity(twin, DENSITY)
    assert tensor[0, 0, 1, 1] / (tensor[0, 0, 0, 0] + tensor[0, 0, 1, 1]) == pytest.approx(0.25)
    assert tensor[0, 1, 0, 1] == pytest.approx(tensor[0, 0, 1, 1])


@pytest.mark.parametrize(
    ("twin", "error", "words"),
    [
        (
            held_node(on_ground=True),
            InputError,
            r"simulation\.ground: .*above the ground.*received z = -0\.0613 m\. Set ground to false",
        ),
        (twin_of(scene(2, [(0, 1)], [0.5], gravity=9.8), np.eye(3)[:2], HAND), NumericalFailure, r"a part may not be held"),
    ],
)
def test_what_does_not_come_to_rest_is_named(twin, error, words):
    with pytest.raises(error, match=words):
        at_rest(twin)
