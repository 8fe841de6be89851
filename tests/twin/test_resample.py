"""Twins on other nodes of the same body."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Material, Observations, Simulation, Twin
from neuspring.core.errors import InputError
from neuspring.physics import stability
from neuspring.physics.topology import distances, infer_controller_radius, piecewise_topology, uniform_topology
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import infer_radii, move, resampled, scale_between
from tests.support import scenarios

FRAMES, RATE = 20, 30.0
SUMS = 1e-4
"""Relative: sums over springs kept in float32."""


def grid(size, spacing: float, seed: int = 0) -> np.ndarray:
    """Nodes [N, 3] of a box about the origin, a tenth of the spacing beside a lattice, so that no distances tie."""
    axes = [np.linspace(-s / 2, s / 2, round(s / spacing) + 1) for s in size]
    nodes = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)
    return nodes + 0.1 * spacing * np.random.default_rng(seed).standard_normal(nodes.shape) * (np.array(size) > 0)


def recording(nodes: np.ndarray, hands: np.ndarray) -> Observations:
    """Hands lift the body and shake it; where it goes is not looked at."""
    t = np.arange(FRAMES) / RATE
    way = np.stack([0.06 * np.sin(4 * t) ** 2, 0 * t, 0.10 * np.sin(3 * t)], axis=1)
    still = np.repeat(nodes[None], FRAMES, axis=0)
    return scenarios.seen(still, hands[None] + way[:, None], {"train_end": 14, "frame_rate": RATE, "ground": False})


def hands_of(size, count: int = 4) -> np.ndarray:
    """Points at one end of a box."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.full(count, -size[0] / 2 - 0.005), 0.02 * np.cos(angle), 0.02 * np.sin(angle) + 0.002], axis=1)


def twin_of(seen: Observations, spacing: float) -> Twin:
    """A twin whose stiffness grows fourfold along x."""
    topology = uniform_topology(seen.nodes, seen.controller_points[0], 2.3 * spacing, 30, 0.06, 50)
    middle = topology.canonical[topology.springs].mean(axis=1)
    scalars = dict.fromkeys(("ground_elasticity", "contact_elasticity"), 0.5) | {"drag": 1.0, "contact_distance": 0.02}
    scalars |= dict.fromkeys(("ground_friction", "contact_friction"), 0.3)
    stiffness, dashpot = 2e3 * 2.0 ** (middle[:, 0] / 0.15), np.full(len(topology.springs), 2.0)
    material = Material(stiffness=stiffness, dashpot=dashpot, **scalars)
    twin = Twin(topology=topology, material=material, simulation=Simulation(frame_time=1 / RATE, substeps=1, ground=False))
    count = stability.smallest_safe_substeps(stability.twin_spectrum(twin), 1 / RATE, 0.8)
    return replace(twin, simulation=replace(twin.simulation, substeps=count))


BODIES = {"bar": (0.3, 0.06, 0.06), "cloth": (0.3, 0.3, 0.0)}


def difference(a: Observations, b: Observations, of_a: np.ndarray, of_b: np.ndarray) -> float:
    """Mean distance between the displacements of two samplings, as a part of the mean displacement."""
    distance, index = cKDTree(a.nodes).query(b.nodes, k=4)
    weights = 1 / np.maximum(distance, 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    one = np.einsum("nk,fnkd->fnd", weights, (of_a - of_a[0])[:, index])
    return float(np.linalg.norm(one - (of_b - of_b[0]), axis=2).mean() / np.linalg.norm(one, axis=2).mean())


@pytest.mark.parametrize(("body", "here", "there"), [("bar", 0.03, 0.02), ("cloth", 0.03, 0.02), ("cloth", 0.02, 0.03)])
def test_a_body_moves_alike_at_another_spacing(body, here, there):
    size = BODIES[body]
    a, b = recording(grid(size, here), hands_of(size)), recording(grid(size, there, 1), hands_of(size))
    twin = twin_of(a, here)
    moved = move(twin, b)[0]
    of_a, of_b = roll_out(twin, a.controller_points).positions, roll_out(moved, b.controller_points).positions
    ratio = difference(a, b, of_a, of_b)
    assert ratio < 0.15
    # The same stiffness per spring on other nodes is another body. A cloth mostly hangs and bends, whatever its stiffness.
    inner = moved.topology.object_spring_count
    unscaled = moved.material.stiffness.copy()
    unscaled[:inner] *= there / here
    kept = replace(moved, material=replace(moved.material, stiffness=unscaled))
    assert ratio < {"bar": 0.7, "cloth": 1.0}[body] * difference(a, b, of_a, roll_out(kept, b.controller_points).positions)


@pytest.mark.parametrize("body", BODIES)
def test_stiffness_and_dashpots_scale_with_the_spacing_and_keep_their_sums(body):
    size = BODIES[body]
    a, b = recording(grid(size, 0.03), hands_of(size)), recording(grid(size, 0.02, 1), hands_of(size, 8))
    twin = twin_of(a, 0.03)
    moved, _ = resampled(twin, b)

    def sums(one: Twin) -> list[float]:
        t, m, inner = one.topology, one.material, one.topology.object_spring_count
        length, held = distances(t.canonical, t.springs), len(np.unique(t.springs[inner:].min(axis=1)))
        within = [(m.stiffness * length)[:inner].sum(), (m.dashpot * length**2)[:inner].sum()]
        return [
            *(value / len(t.nodes) for value in within),
            (m.stiffness / length)[inner:].sum() / held,
            m.dashpot[inner:].sum() / held,
        ]

    np.testing.assert_allclose(sums(moved), sums(twin), rtol=SUMS)
    for name, expected in (("stiffness", 1.5), ("dashpot", 1.5**2)):
        mean = [np.exp(np.log(getattr(one.material, name)[: one.topology.object_spring_count]).mean()) for one in (moved, twin)]
        assert mean[0] / mean[1] == pytest.approx(expected, rel=0.25)
    assert moved.material.drag == twin.material.drag
    assert moved.material.contact_distance == pytest.approx(0.02 / 1.5, rel=0.1)


def test_what_made_a_topology_is_read_from_its_springs():
    nodes = grid((0.3, 0.2, 0.06), 0.02)
    labels = (nodes[:, 0] > 0).astype(np.int32)
    topology = piecewise_topology(nodes, hands_of((0.3, 0, 0)), labels, [0.05, 0.035], [12, 40], 0.06, 9)
    radii, neighbors = infer_radii(topology)
    reach, held = infer_controller_radius(topology)
    # By both: in region 0 the count limits, in region 1 the radius.
    assert neighbors[0] == 12
    assert 0.033 < radii[1] <= 0.035
    again = piecewise_topology(nodes, topology.controllers, labels, radii, neighbors, reach, held)
    assert {frozenset(pair) for pair in again.springs.tolist()} == {frozenset(pair) for pair in topology.springs.tolist()}


def test_lonely_nodes_that_were_joined_do_not_widen_the_radius():
    nodes = np.concatenate([grid((0.2, 0.06, 0.06), 0.02), [[0.4, 0.0, 0.0]]])
    zero = np.zeros(len(nodes), np.int32)
    topology = piecewise_topology(nodes, hands_of((0.2, 0, 0)), zero, [0.045], [30], 0.06, 9, repair=True)
    assert distances(topology.canonical, topology.springs).max() > 0.25
    assert infer_radii(topology)[0][0] < 0.0451


def test_regions_and_strain_at_rest_are_carried():
    size = BODIES["cloth"]
    a, b = recording(grid(size, 0.03), hands_of(size)), recording(grid(size, 0.02, 1), hands_of(size))
    twin = twin_of(a, 0.03)
    labels = (a.nodes[:, 0] > 0).astype(np.int32)
    middle = twin.topology.canonical[twin.topology.springs].mean(axis=1)
    lengths = twin.topology.rest_lengths * np.where(middle[:, 1] > 0, 1.05, 0.95)
    moved, _ = resampled(replace(twin, topology=replace(twin.topology, labels=labels, rest_lengths=lengths)), b)
    far = np.abs(b.nodes[:, 0]) > 0.03
    np.testing.assert_array_equal(moved.topology.labels[far], (b.nodes[:, 0] > 0)[far])
    topology = moved.topology
    middle = topology.canonical[topology.springs].mean(axis=1)
    strain = topology.rest_lengths / distances(topology.canonical, topology.springs)
    inner = np.arange(len(strain)) < topology.object_spring_count
    np.testing.assert_allclose(strain[inner & (middle[:, 1] > 0.06)], 1.05, rtol=0.01)
    np.testing.assert_allclose(strain[inner & (middle[:, 1] < -0.06)], 0.95, rtol=0.01)


def test_masses_are_those_of_the_nearest_nodes_and_calibrated_grips_stay_calibrated():
    size = BODIES["cloth"]
    a, b = recording(grid(size, 0.03), hands_of(size)), recording(grid(size, 0.02, 1), hands_of(size))
    a, b = (replace(seen, rest_shape=1.2 * seen.canonical) for seen in (a, b))
    plain = twin_of(a, 0.03)
    parts = a.nodes, a.controller_points[0], np.zeros(len(a.nodes), np.int32), [2.8 * 0.03], [30], 0.08, 50
    topology = piecewise_topology(*parts, rest_shape=a.rest_shape, controller_rest="first_frame")
    count, strain = len(topology.springs), 0.97
    values = {"stiffness": np.full(count, 2e3), "dashpot": np.full(count, 2.0), "mass": 1 + a.nodes[:, 0]}
    topology = replace(topology, rest_lengths=strain * topology.rest_lengths)
    moved = move(replace(plain, topology=topology, material=replace(plain.material, **values)), b)[0]
    np.testing.assert_allclose(moved.material.mass, 1 + b.nodes[:, 0], atol=0.03)
    assert moved.topology.controller_rest == "first_frame"
    new, body = moved.topology, moved.topology.object_spring_count
    assert 0 < body < len(new.springs)
    frame_0 = np.concatenate([b.nodes, b.controller_points[0]])
    np.testing.assert_allclose(new.rest_lengths[:body], strain * distances(b.canonical, new.springs[:body]), rtol=1e-5)
    np.testing.assert_allclose(new.rest_lengths[body:], strain * distances(frame_0, new.springs[body:]), rtol=1e-5)


def test_a_body_that_lies_elsewhere_and_turned_is_found():
    size = (0.3, 0.12, 0.06)
    nodes = grid(size, 0.03)
    # A corner is missing, so that there is one way to lay it.
    a = recording(nodes[nodes @ [1.0, 1.0, 0.5] < 0.15], hands_of(size))
    twin = twin_of(a, 0.03)
    other = grid(size, 0.024, 1)
    other = other[other @ [1.0, 1.0, 0.5] < 0.15]
    turn = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    here, _ = resampled(twin, recording(other, hands_of(size)))
    there, laid = resampled(twin, recording(other @ turn + [0.5, 0.2, 0.0], hands_of(size) @ turn + [0.5, 0.2, 0.0]))
    assert laid.residual < 0.02
    np.testing.assert_allclose(there.material.stiffness, here.material.stiffness, rtol=1e-3)


def test_another_object_is_refused():
    a, b = (recording(grid(BODIES[name], 0.03), hands_of(BODIES[name])) for name in BODIES)
    with pytest.raises(InputError, match=r"must be of the same object.*; received .*% of .* m.*recording of this object"):
        resampled(twin_of(a, 0.03), b)


def test_hands_out_of_reach_are_refused():
    size = BODIES["bar"]
    a = recording(grid(size, 0.03), hands_of(size))
    far = recording(grid(size, 0.02), hands_of(size) - [0.2, 0.0, 0.0])
    with pytest.raises(InputError, match=r"a hand must be within 0\.\d+ m of a node.*Check the controllers"):
        resampled(twin_of(a, 0.03), far)


def test_scale_is_the_ratio_of_spacings():
    twin = twin_of(recording(grid(BODIES["cloth"], 0.03), hands_of(BODIES["cloth"])), 0.03)
    assert scale_between(twin.topology, twin.topology.nodes * 0.4) == pytest.approx(0.4)
