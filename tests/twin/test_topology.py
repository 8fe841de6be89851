"""Spring graphs: the released simulator's sets, and the rules they follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.core.errors import InputError
from neuspring.twin.topology import (
    MIN_LENGTH,
    REPAIR_SPRINGS,
    build,
    controller_springs,
    distances,
    isolated,
    join,
    object_springs,
    piecewise_topology,
    regions,
    uniform_topology,
)
from tests.support.clips import NAMES, clip

LENGTH = 2e-7
"""Relative: rest lengths are rounded to float32 (1.2e-7), and the record's distances were computed in another order."""
seeds = st.integers(0, 10**6)


def cloud(seed: int, count: int = 25) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (count, 3))


def undirected(springs: np.ndarray) -> set[tuple[int, int]]:
    pairs = [tuple(sorted(pair)) for pair in springs.tolist()]
    assert len(set(pairs)) == len(pairs), "no spring twice"
    return set(pairs)


def same(nodes: np.ndarray, radius: float, neighbors: int) -> np.ndarray:
    """Object springs with one radius and neighbor count."""
    return object_springs(nodes, np.full(len(nodes), radius), np.full(len(nodes), neighbors))


def test_springs_and_rest_lengths_are_those_of_the_rest_shape() -> None:
    nodes, hands = cloud(1, 12), cloud(2, 2) + 2
    shape = np.concatenate([cloud(3, 12), cloud(4, 2)])
    labels = (np.arange(12) % 2).astype(np.int32)
    rules = (labels, [0.4, 0.6], [4, 5], 0.5, 3)
    straight = piecewise_topology(nodes, hands, *rules, rest_shape=shape)
    other = piecewise_topology(shape[:12], shape[12:], *rules)
    np.testing.assert_array_equal(straight.springs, other.springs)
    np.testing.assert_array_equal(straight.rest_lengths, other.rest_lengths)
    np.testing.assert_array_equal(straight.canonical, other.canonical)
    np.testing.assert_array_equal(straight.nodes, nodes.astype(np.float32))
    np.testing.assert_array_equal(straight.controllers, hands.astype(np.float32))


# The released simulator -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_golden_springs(name: str) -> None:
    """The same set of springs as the released code builds from the same points, and the same rest lengths."""
    c = clip(name)
    recorded = c.twin.topology
    topology = uniform_topology(recorded.nodes, c.controllers[0], *c.topology_params)
    assert undirected(topology.springs) == undirected(recorded.springs)
    assert topology.object_spring_count == c.object_springs
    order = {tuple(sorted(pair)): length for pair, length in zip(topology.springs.tolist(), topology.rest_lengths, strict=True)}
    lengths = [order[tuple(sorted(pair))] for pair in recorded.springs.tolist()]
    np.testing.assert_allclose(lengths, recorded.rest_lengths, rtol=LENGTH)


@pytest.mark.parametrize("name", NAMES)
def test_golden_springs_have_the_released_order_of_ends(name: str) -> None:
    """Controllers come first in their springs, and all controller springs last."""
    c = clip(name)
    topology = uniform_topology(c.twin.topology.nodes, c.controllers[0], *c.topology_params)
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
            if j != i and MIN_LENGTH < distance[j] < radius[i]:
                pairs.add((min(i, int(j)), max(i, int(j))))
    return pairs


@settings(max_examples=60, deadline=None)
@given(seed=seeds, count=st.integers(1, 30))
def test_object_springs_are_the_union_of_what_nodes_ask_for(seed: int, count: int) -> None:
    """Also with a radius and a count of its own for every node, as piecewise topologies have."""
    rng, nodes = np.random.default_rng(seed), cloud(seed, count)
    radius, neighbors = rng.uniform(0.05, 0.8, count), rng.integers(1, 12, count)
    assert undirected(object_springs(nodes, radius, neighbors)) == brute(nodes, radius, neighbors)


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_the_set_does_not_depend_on_node_order(seed: int) -> None:
    nodes, order = cloud(seed), np.random.default_rng(seed + 1).permutation(25)
    shuffled = same(nodes[order], 0.4, 7)
    assert undirected(order[shuffled]) == undirected(same(nodes, 0.4, 7))


@settings(max_examples=40, deadline=None)
@given(seed=seeds, neighbors=st.integers(1, 9))
def test_every_spring_is_asked_for_by_an_end_and_counts_are_capped(seed: int, neighbors: int) -> None:
    """A node asks for at most neighbors - 1 others; it may have more springs, because others ask for it."""
    nodes, radius = cloud(seed), 0.5
    springs = same(nodes, radius, neighbors)
    assert len(springs) <= len(nodes) * (neighbors - 1)
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    rank = distance.argsort(axis=1).argsort(axis=1)
    for i, j in springs:
        assert min(rank[i, j], rank[j, i]) < neighbors
        assert distance[i, j] < radius


def test_either_side_may_ask() -> None:
    """Node 2 is nearest to nobody, but asks for node 1; the spring exists once, whichever side asks."""
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [2.5, 0, 0]])
    assert undirected(same(nodes, 9.0, 2)) == {(0, 1), (1, 2)}
    one_sided = object_springs(nodes, np.array([9.0, 9.0, 0.1]), np.array([2, 2, 2]))
    assert undirected(one_sided) == {(0, 1)}


def test_the_radius_is_strict() -> None:
    nodes = np.array([[0.0, 0, 0], [0.5, 0, 0]])
    assert len(same(nodes, 0.5, 5)) == 0
    assert len(same(nodes, np.nextafter(0.5, 1), 5)) == 1
    assert len(controller_springs(nodes[:1], nodes[1:], 0.5, 5)) == 0
    assert len(controller_springs(nodes[:1], nodes[1:], np.nextafter(0.5, 1), 5)) == 1


def test_springs_must_be_longer_than_the_minimum() -> None:
    """Nearly coincident nodes get no spring between them, and the node itself uses up one of its neighbors."""
    nodes = np.array([[0.0, 0, 0], [MIN_LENGTH / 2, 0, 0], [0.3, 0, 0]])
    assert undirected(same(nodes, 1.0, 3)) == {(0, 2), (1, 2)}
    assert undirected(same(nodes, 1.0, 1)) == set()


@pytest.mark.parametrize("copies", [2, 4])
def test_duplicate_nodes_are_not_joined(copies: int) -> None:
    nodes = np.concatenate([np.zeros((copies, 3)), [[0.3, 0, 0]]])
    assert undirected(same(nodes, 1.0, copies + 1)) == {(i, copies) for i in range(copies)}


def test_controllers_ask_for_nodes_only_and_without_a_minimum_length() -> None:
    nodes, hands = np.array([[0.0, 0, 0], [0.2, 0, 0], [9, 0, 0]]), np.array([[MIN_LENGTH / 2, 0, 0], [0.01, 0, 0]])
    springs = controller_springs(nodes, hands, 1.0, 5)
    assert springs.tolist() == [[3, 0], [3, 1], [4, 0], [4, 1]]
    assert controller_springs(nodes, hands, 1.0, 1).tolist() == [[3, 0], [4, 0]]
    assert controller_springs(nodes, hands, 1e-6, 5).shape == (0, 2)


def test_a_controller_on_a_node_is_refused() -> None:
    nodes = np.array([[0.0, 0, 0], [0.2, 0, 0]])
    with pytest.raises(InputError, match=r"controller may not coincide.*zero-length spring \[2, 1\]"):
        uniform_topology(nodes, nodes[1:], 0.5, 5, 0.5, 5)


def test_zero_length_springs_are_refused() -> None:
    with pytest.raises(InputError, match=r"zero-length spring \[0, 1\]"):
        build(np.zeros((2, 3)), np.zeros((0, 3)), np.array([[0, 1]]))


def test_a_topology_may_have_no_springs() -> None:
    topology = uniform_topology(np.array([[0.0, 0, 0]]), np.array([[5.0, 0, 0]]), 0.1, 5, 0.1, 5)
    assert topology.springs.shape == (0, 2)
    assert topology.object_spring_count == 0


def test_labels_and_rest_lengths() -> None:
    nodes = cloud(3)
    springs = same(nodes, 0.4, 6)
    topology = build(nodes, np.zeros((0, 3)), springs, labels=np.arange(25) % 4)
    np.testing.assert_array_equal(topology.labels, np.arange(25) % 4)
    np.testing.assert_allclose(
        topology.rest_lengths, np.linalg.norm(nodes[springs[:, 0]] - nodes[springs[:, 1]], axis=1), rtol=LENGTH
    )
    assert not build(nodes, np.zeros((0, 3)), springs).labels.any()


# Regions --------------------------------------------------------------------------------------------------------------


def blocks(counts: tuple[int, ...] = (6, 9, 4)) -> np.ndarray:
    """Tight groups of nodes along x, 1 m apart: what any clustering must find; the group at the largest x comes first."""
    rng = np.random.default_rng(0)
    groups = [rng.uniform(0, 0.1, (count, 3)) + np.array([place, 0, 0]) for place, count in enumerate(counts)]
    return np.concatenate(groups[::-1])


def test_regions_are_found_and_numbered_by_centroid() -> None:
    labels = regions(blocks(), 3)
    assert labels.tolist() == [2] * 4 + [1] * 9 + [0] * 6


@pytest.mark.parametrize("count", [1, 2, 5, 25])
def test_every_region_has_a_node_and_numbers_have_no_gaps(count: int) -> None:
    labels = regions(cloud(1), count)
    assert (labels.shape, labels.dtype) == ((25,), np.int32)
    assert np.unique(labels).tolist() == list(range(count))


def test_equal_coordinates_of_centroids_are_ties() -> None:
    """Groups whose centroids differ in x by rounding alone are ordered by y, then by z."""
    corner = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
    places = np.array([[0.1, 1, 0], [0.1 + 1e-9, 0, 1], [0.1, 0, 0]])
    labels = regions(np.concatenate([corner + place for place in places]), 3)
    assert labels.tolist() == [2] * 3 + [1] * 3 + [0] * 3


def test_more_regions_than_nodes_are_refused() -> None:
    with pytest.raises(InputError, match=r"search\.clusters: .* need at least 5 nodes; received 4 nodes"):
        regions(cloud(0, 4), 5)
    regions(cloud(0, 5), 5)


@pytest.mark.parametrize("count", [0, -1])
def test_less_than_one_region_is_refused(count: int) -> None:
    with pytest.raises(InputError, match=r"search\.clusters"):
        regions(cloud(0), count)


# Piecewise ------------------------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(seed=seeds, count=st.integers(2, 5))
def test_equal_regions_are_the_uniform_topology(seed: int, count: int) -> None:
    nodes, hands = cloud(seed), cloud(seed + 1, 2) + 0.3
    labels = regions(nodes, count)
    pieces = piecewise_topology(nodes, hands, labels, [0.3] * count, [6] * count, 0.5, 4)
    whole = uniform_topology(nodes, hands, 0.3, 6, 0.5, 4)
    np.testing.assert_array_equal(pieces.springs, whole.springs)
    np.testing.assert_array_equal(pieces.rest_lengths, whole.rest_lengths)
    np.testing.assert_array_equal(pieces.labels, labels)


@settings(max_examples=20, deadline=None)
@given(seed=seeds, repair=st.booleans())
def test_node_order_permutes_labels_and_springs_and_changes_nothing_else(seed: int, repair: bool) -> None:
    nodes, hands = cloud(seed), cloud(seed + 1, 2) + 0.3
    order = np.random.default_rng(seed + 2).permutation(25)
    # The last region asks for so little that some nodes are left alone, which `repair` then joins.
    values = [0.35, 0.3, 0.05], [7, 4, 3], 0.4, 3

    def graph(points: np.ndarray) -> tuple[np.ndarray, dict[tuple[int, int], float], int]:
        labels = regions(points, 3)
        topology = piecewise_topology(points, hands, labels, *values, repair=repair)
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


def test_a_spring_across_a_border_exists_if_either_side_asks() -> None:
    nodes, nobody = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]]), np.array([[0.0, 9, 0]])
    labels = np.array([0, 0, 1, 1], np.int32)

    def springs(radius: list[float], neighbors: list[int]) -> set[tuple[int, int]]:
        return undirected(piecewise_topology(nodes, nobody, labels, radius, neighbors, 0.1, 1).springs)

    assert springs([0.15, 0.01], [5, 5]) == {(0, 1), (1, 2)}, "the left region asks"
    assert springs([0.01, 0.15], [5, 5]) == {(1, 2), (2, 3)}, "the right region asks"
    assert springs([0.01, 0.01], [5, 5]) == set()
    # A node's own values decide whom it asks, whichever region the other is in.
    assert springs([0.25, 0.01], [5, 1]) == {(0, 1), (0, 2), (1, 2), (1, 3)}


# Where the springs of controllers have no force -----------------------------------------------------------------------


def test_calibrated_controller_springs_rest_in_frame_0_and_body_springs_in_the_rest_shape() -> None:
    nodes, hands, one = cloud(3), cloud(4, 3), np.zeros(25, np.int32)
    rest_shape = np.concatenate([cloud(5), cloud(6, 3)])
    plain, calibrated = (
        piecewise_topology(nodes, hands, one, [0.5], [6], 0.6, 4, rest_shape=rest_shape, controller_rest=rest)
        for rest in ("rest_shape", "first_frame")
    )
    np.testing.assert_array_equal(calibrated.springs, plain.springs)
    body, frame0 = plain.object_spring_count, np.concatenate([nodes, hands])
    assert 0 < body < len(plain.springs)
    np.testing.assert_array_equal(calibrated.rest_lengths[:body], plain.rest_lengths[:body])
    np.testing.assert_allclose(plain.rest_lengths, distances(rest_shape, plain.springs), rtol=LENGTH)
    np.testing.assert_allclose(calibrated.rest_lengths[body:], distances(frame0, plain.springs[body:]), rtol=LENGTH)


def test_without_a_rest_shape_calibration_changes_nothing() -> None:
    one = np.zeros(25, np.int32)
    first, other = (
        piecewise_topology(cloud(3), cloud(4, 3), one, [0.5], [6], 0.6, 4, controller_rest=rest)
        for rest in ("rest_shape", "first_frame")
    )
    np.testing.assert_array_equal(first.rest_lengths, other.rest_lengths)


def test_another_place_of_rest_is_refused() -> None:
    with pytest.raises(InputError, match=r"rest_shape.*first_frame.*'hands'"):
        replace(piecewise_topology(cloud(3), cloud(4, 3), np.zeros(25, np.int32), [0.5], [6], 0.6, 4), controller_rest="hands")


# Isolated nodes -------------------------------------------------------------------------------------------------------


def test_isolated_nodes_are_those_without_any_spring() -> None:
    assert isolated(5, np.array([[0, 1], [6, 3]])).tolist() == [2, 4]
    assert isolated(3, np.zeros((0, 2), np.int32)).tolist() == [0, 1, 2]


def test_join_gives_lonely_nodes_their_nearest_nodes_behind_the_springs_that_are_there() -> None:
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [2.1, 0, 0], [3.3, 0, 0], [4.6, 0, 0], [0, 0, MIN_LENGTH / 2]])
    springs = np.array([[0, 1], [2, 1]])
    joined = join(nodes, springs, np.array([4]))
    assert joined.tolist() == [[0, 1], [2, 1], [4, 3], [4, 2], [4, 1]]
    assert len(joined) - len(springs) == REPAIR_SPRINGS
    # Two lonely nodes that ask for each other get one spring, and a node at the same place is no partner.
    undirected(join(nodes, springs, np.array([3, 4])))
    assert (0, 5) not in undirected(join(nodes, springs, np.array([5])))
    np.testing.assert_array_equal(join(nodes, springs, np.zeros(0, int)), springs)


def test_repair_joins_only_nodes_that_nothing_holds() -> None:
    nodes, hands = np.array([[0.0, 0, 0], [0.1, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[2.0, 0.05, 0]])
    one, values = np.zeros(4, np.int32), ([0.2], [5], 0.1, 5)
    broken = piecewise_topology(nodes, hands, one, *values)
    assert undirected(broken.springs) == {(0, 1), (3, 4)}
    mended = piecewise_topology(nodes, hands, one, *values, repair=True)
    # Node 3 hangs on the controller, so it is left as it is; node 2 asks for its three nearest.
    assert undirected(mended.springs) == {(0, 1), (3, 4), (1, 2), (2, 3), (0, 2)}
    assert mended.object_spring_count == 4
    assert len(isolated(4, mended.springs)) == 0


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_join_looks_past_nodes_at_the_same_place(copies: int) -> None:
    nodes = np.concatenate([np.zeros((copies, 3)), np.eye(3)])
    assert undirected(join(nodes, np.zeros((0, 2), int), np.array([0]))) == {(0, copies + i) for i in range(REPAIR_SPRINGS)}
