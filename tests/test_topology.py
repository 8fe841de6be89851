"""Spring graphs: the released simulator's sets, and the rules they follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.errors import InputError
from neuspring.topology import MIN_LENGTH, build, controller_springs, object_springs, uniform_topology

from .physics.golden import NAMES, clip

LENGTH = 2e-7
"""Relative: rest lengths are rounded to float32 (1.2e-7), and the record's distances were computed in another order."""
seeds = st.integers(0, 10**6)


def cloud(seed: int, count: int = 25) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (count, 3))


def undirected(springs: np.ndarray) -> set[tuple[int, int]]:
    pairs = [tuple(sorted(pair)) for pair in springs.tolist()]
    assert len(set(pairs)) == len(pairs), "no spring twice"
    return set(pairs)


def same(nodes: np.ndarray, radius: float, neighbours: int) -> np.ndarray:
    """Object springs with one radius and neighbour count."""
    return object_springs(nodes, np.full(len(nodes), radius), np.full(len(nodes), neighbours))


# The released simulator -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_golden_springs(name: str) -> None:
    """The same set of springs as the released code builds from the same points, and the same rest lengths."""
    c = clip(name)
    recorded = c.twin.topology
    made = uniform_topology(recorded.nodes, c.controllers[0], *c.topology_params)
    assert undirected(made.springs) == undirected(recorded.springs)
    assert made.object_spring_count == c.object_springs
    order = {tuple(sorted(pair)): length for pair, length in zip(made.springs.tolist(), made.rest_lengths, strict=True)}
    lengths = [order[tuple(sorted(pair))] for pair in recorded.springs.tolist()]
    np.testing.assert_allclose(lengths, recorded.rest_lengths, rtol=LENGTH)


@pytest.mark.parametrize("name", NAMES)
def test_golden_springs_have_the_released_order_of_ends(name: str) -> None:
    """Controllers come first in their springs, and all controller springs last."""
    c = clip(name)
    made = uniform_topology(c.twin.topology.nodes, c.controllers[0], *c.topology_params)
    outer = made.springs[made.object_spring_count :]
    assert (outer[:, 0] >= len(made.nodes)).all()
    assert (outer[:, 1] < len(made.nodes)).all()


# Rules ----------------------------------------------------------------------------------------------------------------


def brute(nodes: np.ndarray, radius: np.ndarray, neighbours: np.ndarray) -> set[tuple[int, int]]:
    """The definition: i asks for its nearest, itself included, closer than its radius; the union of all answers."""
    asked = set()
    for i, node in enumerate(nodes):
        distance = np.linalg.norm(nodes - node, axis=1)
        for j in np.argsort(distance, kind="stable")[: neighbours[i]]:
            if j != i and MIN_LENGTH < distance[j] < radius[i]:
                asked.add((min(i, int(j)), max(i, int(j))))
    return asked


@settings(max_examples=60, deadline=None)
@given(seed=seeds, count=st.integers(1, 30))
def test_object_springs_are_the_union_of_what_nodes_ask_for(seed: int, count: int) -> None:
    """Also with a radius and a count of its own for every node, as piecewise topologies have."""
    rng, nodes = np.random.default_rng(seed), cloud(seed, count)
    radius, neighbours = rng.uniform(0.05, 0.8, count), rng.integers(1, 12, count)
    assert undirected(object_springs(nodes, radius, neighbours)) == brute(nodes, radius, neighbours)


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_the_set_does_not_depend_on_node_order(seed: int) -> None:
    nodes, order = cloud(seed), np.random.default_rng(seed + 1).permutation(25)
    shuffled = same(nodes[order], 0.4, 7)
    assert undirected(order[shuffled]) == undirected(same(nodes, 0.4, 7))


@settings(max_examples=40, deadline=None)
@given(seed=seeds, neighbours=st.integers(1, 9))
def test_every_spring_is_asked_for_by_an_end_and_counts_are_capped(seed: int, neighbours: int) -> None:
    """A node asks for at most neighbours - 1 others; it may have more springs, because others ask for it."""
    nodes, radius = cloud(seed), 0.5
    springs = same(nodes, radius, neighbours)
    assert len(springs) <= len(nodes) * (neighbours - 1)
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    rank = distance.argsort(axis=1).argsort(axis=1)
    for i, j in springs:
        assert min(rank[i, j], rank[j, i]) < neighbours
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
    """Nearly coincident nodes get no spring between them, and the node itself uses up one of its neighbours."""
    nodes = np.array([[0.0, 0, 0], [MIN_LENGTH / 2, 0, 0], [0.3, 0, 0]])
    assert undirected(same(nodes, 1.0, 3)) == {(0, 2), (1, 2)}
    assert undirected(same(nodes, 1.0, 1)) == set()


@pytest.mark.parametrize("copies", [2, 4])
def test_duplicate_nodes_are_not_joined(copies: int) -> None:
    nodes = np.concatenate([np.zeros((copies, 3)), [[0.3, 0, 0]]])
    assert undirected(same(nodes, 1.0, copies + 1)) == {(i, copies) for i in range(copies)}


def test_controllers_ask_for_nodes_only_and_without_a_minimum_length() -> None:
    nodes, hands = np.array([[0.0, 0, 0], [0.2, 0, 0], [9, 0, 0]]), np.array([[MIN_LENGTH / 2, 0, 0], [0.01, 0, 0]])
    found = controller_springs(nodes, hands, 1.0, 5)
    assert found.tolist() == [[3, 0], [3, 1], [4, 0], [4, 1]]
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
    made = uniform_topology(np.array([[0.0, 0, 0]]), np.array([[5.0, 0, 0]]), 0.1, 5, 0.1, 5)
    assert made.springs.shape == (0, 2)
    assert made.object_spring_count == 0


def test_labels_and_rest_lengths() -> None:
    nodes = cloud(3)
    springs = same(nodes, 0.4, 6)
    made = build(nodes, np.zeros((0, 3)), springs, labels=np.arange(25) % 4)
    np.testing.assert_array_equal(made.labels, np.arange(25) % 4)
    np.testing.assert_allclose(made.rest_lengths, np.linalg.norm(nodes[springs[:, 0]] - nodes[springs[:, 1]], axis=1), rtol=LENGTH)
    assert not build(nodes, np.zeros((0, 3)), springs).labels.any()
