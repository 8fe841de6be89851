"""Spring graphs: the released simulator's sets, and the rules they follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from neuspring.physics import topology as graphs
from tests.support.clips import NAMES, clip

LENGTH = 2e-7
"""Relative: rest lengths are rounded to float32 (1.2e-7), and the record's distances were computed in another order."""
DOUBLE = 1e-12
"""Relative, in float64."""
seeds = st.integers(0, 10**6)


def cloud(seed: int, count: int = 25) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (count, 3))


def undirected(springs: np.ndarray) -> set[tuple[int, int]]:
    pairs = [tuple(sorted(pair)) for pair in springs.tolist()]
    assert len(set(pairs)) == len(pairs), "no spring twice"
    return set(pairs)


def same(nodes: np.ndarray, radius: float, neighbors: int) -> np.ndarray:
    """Object springs with one radius and neighbor count."""
    return graphs.object_springs(nodes, np.full(len(nodes), radius), np.full(len(nodes), neighbors))


def test_springs_and_rest_lengths_are_those_of_the_rest_shape():
    nodes, hands = cloud(1, 12), cloud(2, 2) + 2
    shape = np.concatenate([cloud(3, 12), cloud(4, 2)])
    labels = (np.arange(12) % 2).astype(np.int32)
    rules = (labels, [0.4, 0.6], [4, 5], 0.5, 3)
    straight = graphs.piecewise_topology(nodes, hands, *rules, rest_shape=shape)
    other = graphs.piecewise_topology(shape[:12], shape[12:], *rules)
    np.testing.assert_array_equal(straight.springs, other.springs)
    np.testing.assert_array_equal(straight.rest_lengths, other.rest_lengths)
    np.testing.assert_array_equal(straight.canonical, other.canonical)
    np.testing.assert_array_equal(straight.nodes, nodes.astype(np.float32))
    np.testing.assert_array_equal(straight.controllers, hands.astype(np.float32))


# The released simulator -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_golden_springs(name):
    """The same set of springs as the released code builds from the same points, and the same rest lengths."""
    c = clip(name)
    recorded = c.twin.topology
    topology = graphs.uniform_topology(recorded.nodes, c.controllers[0], *c.topology_params)
    assert undirected(topology.springs) == undirected(recorded.springs)
    assert topology.object_spring_count == c.object_springs
    order = {tuple(sorted(pair)): length for pair, length in zip(topology.springs.tolist(), topology.rest_lengths, strict=True)}
    lengths = [order[tuple(sorted(pair))] for pair in recorded.springs.tolist()]
    np.testing.assert_allclose(lengths, recorded.rest_lengths, rtol=LENGTH)
    # Controllers come first in their springs, and all controller springs last.
    outer = topology.springs[topology.object_spring_count :]
    assert (outer[:, 0] >= len(topology.nodes)).all()
    assert (outer[:, 1] < len(topology.nodes)).all()


# Rules ----------------------------------------------------------------------------------------------------------------


def brute(nodes: np.ndarray, radius: np.ndarray, neighbors: np.ndarray) -> set[tuple[int, int]]:
    """The definition: i asks for its nearest, itself included, closer than its radius; the union of all answers."""
    pairs = set()
    for i, node in enumerate(nodes):
        distance = np.linalg.norm(nodes - node, axis=1)
        for j in np.argsort(distance, kind="stable")[: neighbors[i]]:
            if j != i and graphs.MIN_LENGTH < distance[j] < radius[i]:
                pairs.add((min(i, int(j)), max(i, int(j))))
    return pairs


@settings(max_examples=60, deadline=None)
@given(seed=seeds, count=st.integers(1, 30))
def test_object_springs_are_the_union_of_what_nodes_ask_for(seed, count):
    """Also with a radius and a count of its own for every node, as piecewise topologies have."""
    rng, nodes = np.random.default_rng(seed), cloud(seed, count)
    radius, neighbors = rng.uniform(0.05, 0.8, count), rng.integers(1, 12, count)
    assert undirected(graphs.object_springs(nodes, radius, neighbors)) == brute(nodes, radius, neighbors)


def test_the_radius_is_strict():
    nodes = np.array([[0.0, 0, 0], [0.5, 0, 0]])
    assert len(same(nodes, 0.5, 5)) == 0
    assert len(same(nodes, np.nextafter(0.5, 1), 5)) == 1
    assert len(graphs.controller_springs(nodes[:1], nodes[1:], 0.5, 5)) == 0
    assert len(graphs.controller_springs(nodes[:1], nodes[1:], np.nextafter(0.5, 1), 5)) == 1


# Regions --------------------------------------------------------------------------------------------------------------


def blocks(counts: tuple[int, ...] = (6, 9, 4)) -> np.ndarray:
    """Tight groups of nodes along x, 1 m apart: what any clustering must find; the group at the largest x comes first."""
    rng = np.random.default_rng(0)
    groups = [rng.uniform(0, 0.1, (count, 3)) + np.array([place, 0, 0]) for place, count in enumerate(counts)]
    return np.concatenate(groups[::-1])


def test_regions_are_found_and_numbered_by_centroid():
    assert graphs.regions(blocks(), 3).tolist() == [2] * 4 + [1] * 9 + [0] * 6


def lattices() -> dict[str, np.ndarray]:
    """Bodies as they are sampled: a filled box, a sheet, rings of a cable, two lattices in each other, and one turned in space."""
    box = np.argwhere(np.ones((9, 7, 5))) * 0.013 + [0.1, -0.3, 0.02]
    ring = np.stack([np.zeros(6), *(f(np.arange(6) * np.pi / 3) for f in (np.cos, np.sin))], axis=1) * 0.004
    return {
        "box": box,
        "sheet": np.argwhere(np.ones((20, 20, 1))) * 0.01,
        "cable": (np.arange(40)[:, None, None] * np.array([0.01, 0, 0]) + ring).reshape(-1, 3),
        "two lattices": np.concatenate([np.argwhere(np.ones((6, 6, 6))), np.argwhere(np.ones((5, 5, 5))) + 0.5]) * 0.012 - 0.05,
        "turned": Rotation.from_euler("xyz", [20, 30, 40], degrees=True).apply(box),
        "cloud": cloud(0, 300),
    }


@pytest.mark.parametrize("count", [2, 5, 8])
@pytest.mark.parametrize("name", lattices())
def test_regions_depend_neither_on_the_unit_nor_on_the_order_of_nodes(name, count):
    """On a lattice nearly all merges are ties: Ward's method alone agrees with itself by an adjusted Rand index of 0.3."""
    nodes = lattices()[name].astype(np.float32)
    labels, rng = graphs.regions(nodes, count), np.random.default_rng(0)
    for unit in (1.0, 0.01, 1000.0):
        order = rng.permutation(len(nodes))
        np.testing.assert_array_equal(graphs.regions((nodes * np.float32(unit))[order], count), labels[order])


# Piecewise ------------------------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(seed=seeds, repair=st.booleans())
def test_node_order_permutes_labels_and_springs_and_changes_nothing_else(seed, repair):
    nodes, hands = cloud(seed), cloud(seed + 1, 2) + 0.3
    order = np.random.default_rng(seed + 2).permutation(25)
    # The last region asks for so little that some nodes are left alone, which `repair` then joins.
    values = [0.35, 0.3, 0.05], [7, 4, 3], 0.4, 3

    def graph(points: np.ndarray) -> tuple[np.ndarray, dict[tuple[int, int], float], int]:
        labels = graphs.regions(points, 3)
        topology = graphs.piecewise_topology(points, hands, labels, *values, repair=repair)
        pairs = [tuple(sorted(pair)) for pair in topology.springs.tolist()]
        return labels, dict(zip(pairs, topology.rest_lengths.tolist(), strict=True)), topology.object_spring_count

    labels, springs, inner = graph(nodes)
    shuffled_labels, shuffled, shuffled_inner = graph(nodes[order])
    np.testing.assert_array_equal(shuffled_labels, labels[order])
    # Controllers keep their numbers behind the nodes.
    name = np.concatenate([order, 25 + np.arange(2)])
    renamed = {tuple(sorted((int(name[i]), int(name[j])))): length for (i, j), length in shuffled.items()}
    assert (renamed.keys(), shuffled_inner) == (springs.keys(), inner)
    assert [renamed[pair] for pair in springs] == pytest.approx(list(springs.values()), rel=LENGTH)


def test_a_spring_across_a_border_exists_if_either_side_asks():
    nodes, nobody = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]]), np.array([[0.0, 9, 0]])
    labels = np.array([0, 0, 1, 1], np.int32)

    def springs(radius: list[float], neighbors: list[int]) -> set[tuple[int, int]]:
        return undirected(graphs.piecewise_topology(nodes, nobody, labels, radius, neighbors, 0.1, 1).springs)

    assert springs([0.15, 0.01], [5, 5]) == {(0, 1), (1, 2)}, "the left region asks"
    assert springs([0.01, 0.15], [5, 5]) == {(1, 2), (2, 3)}, "the right region asks"
    assert springs([0.01, 0.01], [5, 5]) == set()
    # A node's own values decide whom it asks, whichever region the other is in.
    assert springs([0.25, 0.01], [5, 1]) == {(0, 1), (0, 2), (1, 2), (1, 3)}


# Where the springs of controllers have no force -----------------------------------------------------------------------


def test_calibrated_controller_springs_rest_in_frame_0_and_body_springs_in_the_rest_shape():
    nodes, hands, one = cloud(3), cloud(4, 3), np.zeros(25, np.int32)
    rest_shape = np.concatenate([cloud(5), cloud(6, 3)])
    plain, calibrated = (
        graphs.piecewise_topology(nodes, hands, one, [0.5], [6], 0.6, 4, rest_shape=rest_shape, controller_rest=rest)
        for rest in ("rest_shape", "first_frame")
    )
    np.testing.assert_array_equal(calibrated.springs, plain.springs)
    body, frame0 = plain.object_spring_count, np.concatenate([nodes, hands])
    assert 0 < body < len(plain.springs)
    np.testing.assert_array_equal(calibrated.rest_lengths[:body], plain.rest_lengths[:body])
    np.testing.assert_allclose(plain.rest_lengths, graphs.distances(rest_shape, plain.springs), rtol=LENGTH)
    np.testing.assert_allclose(calibrated.rest_lengths[body:], graphs.distances(frame0, plain.springs[body:]), rtol=LENGTH)


# One piece ------------------------------------------------------------------------------------------------------------

TWO = np.array([[0, 1], [2, 1]])
"""Springs of the first three nodes of a row."""


def pieces(count: int, springs: np.ndarray) -> int:
    return connected_components(coo_array((np.ones(len(springs)), springs.T), shape=(count, count)), directed=False)[0]


def test_a_node_without_a_spring_asks_for_its_nearest_nodes_behind_the_springs_that_are_there():
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [2.1, 0, 0], [4.6, 0, 0]])
    mended = graphs.joined(nodes, TWO)
    assert mended.tolist() == [[0, 1], [2, 1], [3, 2], [3, 1], [3, 0]]
    assert len(mended) - len(TWO) == graphs.REPAIR_SPRINGS
    np.testing.assert_array_equal(graphs.joined(nodes[:3], TWO), TWO, err_msg="it is one piece")


def test_a_part_behind_a_gap_is_joined_along_its_seam():
    """Two sheets of 8 x 3 and 8 x 2 nodes, 1 apart, with a gap of 2.5: two rows are within a spacing of the gap."""
    large, small = (
        np.stack(np.meshgrid(np.arange(8.0), row, [0.0], indexing="ij"), -1).reshape(-1, 3) for row in ([0, 1, 2], [4.5, 5.5])
    )
    nodes = np.concatenate([large, small])
    torn = same(nodes, 1.2, 9)
    assert pieces(len(nodes), torn) == 2
    mended = graphs.joined(nodes, torn)
    np.testing.assert_array_equal(mended[: len(torn)], torn)
    seam = mended[len(torn) :]
    assert pieces(len(nodes), mended) == 1
    assert set(seam[:, 0].tolist()) == set(range(len(large), len(nodes))), "the smaller part asks, all along"
    assert set(nodes[seam[:, 1], 1]) == {2.0}, "for the row that is nearest"
    assert len(seam) == graphs.REPAIR_SPRINGS * len(small)


def test_many_parts_become_one_whatever_is_near_to_what():
    """Pairs that are nearer to each other than to the body join first, and then the body."""
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [20, 0, 0], [21, 0, 0], [23, 0, 0], [24, 0, 0]])
    assert pieces(8, graphs.joined(nodes, np.array([[0, 1], [1, 2], [2, 3], [4, 5], [6, 7]]))) == 1
    assert pieces(6, graphs.joined(nodes[:6], np.zeros((0, 2), int))) == 1, "from no spring at all"


# The spacing of nodes -------------------------------------------------------------------------------------------------


def lattice(*counts: int) -> np.ndarray:
    return np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, len(counts)).astype(float)


def rings(count: int, of: int, apart: float, radius: float) -> np.ndarray:
    """A straight cable along x."""
    angle = 2 * np.pi * np.arange(of) / of
    ring = np.stack([0 * angle, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return (ring[None] + apart * np.array([1.0, 0, 0]) * np.arange(count)[:, None, None]).reshape(-1, 3)


@pytest.mark.parametrize("counts", [(40, 1, 1), (15, 15, 1), (9, 8, 7)])
def test_a_grid_has_the_spacing_of_its_nodes(counts):
    assert graphs.node_spacing(0.018 * lattice(*counts)) == pytest.approx(0.018, rel=DOUBLE)


@pytest.mark.parametrize("of", [3, 4, 8])
def test_rings_of_near_nodes_have_the_distance_of_the_rings(of):
    cable = rings(40, of, apart=0.025, radius=0.006)
    assert np.linalg.norm(cable[1:of] - cable[0], axis=1).min() < 0.025 / 2
    assert graphs.node_spacing(cable) == pytest.approx(0.025, rel=DOUBLE)


def test_it_scales_with_the_body_and_forgets_the_order_of_its_nodes():
    rng = np.random.default_rng(0)
    nodes = lattice(12, 12, 1) + 0.3 * rng.random((144, 3))
    expected = graphs.node_spacing(nodes)
    assert graphs.node_spacing(1000 * nodes) == pytest.approx(1000 * expected, rel=DOUBLE)
    assert graphs.node_spacing(nodes[rng.permutation(144)]) == pytest.approx(expected, rel=DOUBLE)


def test_the_reach_is_that_of_the_nearest_controller():
    hands = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 0.5], [0.0, 0.0, 9.0]])
    assert graphs.controller_reach(lattice(5, 5, 1), hands) == 0.5
