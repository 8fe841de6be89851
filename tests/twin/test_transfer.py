"""Twins on other recordings of the same object."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.twin.candidates import candidate
from neuspring.twin.fit import FitProblem
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import corresponds, move
from tests.support import small

# Rest lengths are float32.
SINGLE = 1e-6
PLACES = ("object_points", "surface_points", "controller_points")
STILL = 1e-5
"""m: what the rounding of rest lengths moves a node in five frames; the wrong rest length moves it by centimeters."""


def scaled(seen: Observations, factor: float | tuple[float, ...]) -> Observations:
    """Tracked points, surface and hands times a factor, or one per axis."""
    return replace(seen, **{name: getattr(seen, name) * np.float32(factor) for name in PLACES})


def test_rest_lengths_follow_the_new_first_frame_and_keep_what_was_learned():
    problem = small.fit_problem()
    learned = replace(problem.twin.topology, rest_lengths=problem.twin.topology.rest_lengths * 1.03)
    seen = problem.observations
    larger = scaled(seen, 2)
    moved = move(replace(problem.twin, topology=learned), larger)
    np.testing.assert_allclose(moved.topology.rest_lengths, problem.twin.topology.rest_lengths * 2.06, rtol=SINGLE)
    assert np.array_equal(moved.topology.nodes, larger.nodes)


def test_a_twin_may_keep_its_rest_lengths():
    problem = small.fit_problem()
    larger, topology = scaled(problem.observations, 1.1), problem.twin.topology
    moved = move(problem.twin, larger, rest_lengths="twin").topology
    np.testing.assert_array_equal(moved.rest_lengths, topology.rest_lengths)
    np.testing.assert_array_equal(moved.canonical, topology.canonical)
    np.testing.assert_array_equal(moved.nodes, larger.nodes)


def test_rest_lengths_follow_the_rest_shape_where_there_is_one():
    problem = small.fit_problem()
    seen, topology = problem.observations, problem.twin.topology
    straight = replace(seen, rest_shape=seen.canonical * 2)
    bent = replace(straight, object_points=seen.object_points * 4, surface_points=seen.surface_points * 4)
    moved = move(problem.twin, bent)
    np.testing.assert_allclose(moved.topology.rest_lengths, topology.rest_lengths * 2, rtol=SINGLE)
    assert np.array_equal(moved.topology.canonical, bent.rest_shape)
    assert np.array_equal(moved.topology.nodes, bent.nodes)
    # Another pose of a body in the same rest shape changes nothing.
    again = move(moved, replace(bent, object_points=seen.object_points * 3))
    np.testing.assert_array_equal(again.topology.rest_lengths, moved.topology.rest_lengths)


def calibrated():
    """Observations in another rest shape, a twin on them whose controllers rest in frame 0, and the first of their springs."""
    seen = replace(small.observations(), rest_shape=small.observations().canonical * 1.5)
    search = replace(small.search_problem(seen), search=config.Search(controller_rest="first_frame"))
    values = small.start_values() | {"object_radius": 0.07, "controller_radius": 0.07}
    twin = candidate(search, values)
    assert 0 < twin.topology.object_spring_count < len(twin.topology.springs)
    return seen, twin, twin.topology.object_spring_count


def test_calibrated_grips_pull_at_nothing_in_frame_0():
    seen, twin, body = calibrated()
    alone = twin.material.stiffness.copy()
    alone[:body] = 0.0
    still = np.repeat(seen.controller_points[:1], 6, axis=0)

    def moved(rest: str) -> float:
        search = replace(small.search_problem(seen), search=config.Search(controller_rest=rest))
        held = candidate(search, {**small.start_values(), "object_radius": 0.07, "controller_radius": 0.07})
        free = replace(held.simulation, gravity=0.0, ground=False)
        result = roll_out(replace(held, material=replace(held.material, stiffness=alone), simulation=free), still, check=False)
        return float(np.abs(result.positions - seen.nodes).max())

    assert moved("first_frame") < STILL
    assert moved("rest_shape") > 1000 * STILL


def pushing() -> tuple[FitProblem, float]:
    """A twin whose hands push from 6 mm on; they begin 2 cm away."""
    problem, touch = small.fit_problem(), 0.006
    topology = problem.twin.topology
    led = np.arange(len(topology.springs)) >= topology.object_spring_count
    lengths = np.where(led, touch, topology.rest_lengths).astype(np.float32)
    twin = replace(problem.twin, topology=replace(topology, rest_lengths=lengths, pushes=led))
    return replace(problem, twin=twin), touch


def test_hands_that_push_touch_at_one_distance_wherever_they_begin():
    problem, touch = pushing()
    seen = problem.observations
    farther = replace(seen, controller_points=seen.controller_points + np.float32([0, 0, 0.05]))
    topology = move(problem.twin, farther).topology
    np.testing.assert_allclose(topology.rest_lengths[topology.pushes], touch, rtol=SINGLE)
    # The body itself is the same.
    own = slice(0, topology.object_spring_count)
    np.testing.assert_allclose(topology.rest_lengths[own], problem.twin.topology.rest_lengths[own], rtol=SINGLE)


def test_more_substeps_where_the_new_distances_need_them():
    problem = small.fit_problem()
    seen = problem.observations
    smaller = scaled(seen, 0.25)
    moved = move(problem.twin, smaller)
    assert moved.simulation.substeps > problem.twin.simulation.substeps
    assert roll_out(moved, smaller.controller_points).diverged_frame is None


def test_the_frame_time_follows_the_recording_unless_it_is_kept():
    problem = small.fit_problem()
    released = replace(problem.twin, simulation=replace(problem.twin.simulation, frame_time=0.03335))
    assert move(released, problem.observations).simulation.frame_time == 1 / problem.observations.scenario.frame_rate
    assert move(released, problem.observations, keep_frame_time=True).simulation.frame_time == 0.03335


def test_the_same_nodes_are_told_from_others():
    problem = small.fit_problem()
    topology, seen = problem.twin.topology, problem.observations
    assert corresponds(topology, seen)
    assert corresponds(topology, scaled(seen, 3))
    assert not corresponds(topology, replace(seen, surface_points=seen.surface_points[1:]))
    assert not corresponds(topology, replace(seen, controller_points=seen.controller_points[:, 1:]))
    order = np.random.default_rng(0).permutation(seen.object_points.shape[1])
    shuffled = replace(seen, object_points=seen.object_points[:, order], surface_points=seen.surface_points[::-1])
    assert not corresponds(topology, shuffled)
    with pytest.raises(InputError, match=r"transfer to small: the recording must have the twin's 124 nodes and 3 controllers"):
        move(problem.twin, shuffled)
