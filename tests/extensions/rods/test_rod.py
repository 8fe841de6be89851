"""Twins that are rods: the line through a body, its vertices and nodes, rollouts, other recordings."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring import config
from neuspring.extensions.rods.center_line import center_line
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move
from tests.extensions.rods import ropes

SINGLE = 1e-6
"""m: rounding of float32 nodes."""


def arc(count: int) -> np.ndarray:
    """Points on two thirds of a circle of radius 10 cm."""
    angle = np.linspace(0, 4 * np.pi / 3, count)
    return 0.1 * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def test_a_line_is_found_in_unordered_nodes():
    nodes = ropes.tube(arc(60))
    line = center_line(np.random.default_rng(0).permutation(nodes), 20)
    # A tenth of the radius of the tube.
    assert np.abs(np.linalg.norm(line[:, :2], axis=1) - 0.1).max() < 1e-3
    assert np.abs(line[:, 2]).max() < 1e-3
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert np.ptp(lengths) < 0.02 * lengths.mean()
    ends = {tuple(np.round(point, 2)) for point in (arc(2)[0], arc(2)[1])}
    assert {tuple(np.round(point, 2)) for point in line[[0, -1]]} == ends
    assert np.array_equal(center_line(nodes, 20), line)


def test_markers_along_a_cable_are_the_vertices_and_clamps_move_theirs():
    seen = ropes.cable(move=(0.0, 0.01, 0.005))
    twin = ropes.twin(seen)
    assert twin.body is not None
    assert twin.body.held.tolist() == [0, 1, -1, -1, -1, 2, 3]
    assert twin.counts == {"vertices": 7, "nodes": 3, "springs": 0, "object_springs": 0, "substeps": 17}
    np.testing.assert_allclose(twin.body.vertices[2:5], seen.nodes, atol=SINGLE)
    # 1 kg/m, and the markers.
    assert twin.body.mass.sum() == pytest.approx(twin.body.lengths.sum() + 7 * ropes.SETTINGS.rod.marker_mass)
    moved = roll_out(twin, seen.controller_points).positions
    np.testing.assert_array_equal(moved[0], seen.nodes)
    assert 0.002 < moved[-1, -1, 1] < 0.03, "the marker beside the clamp goes with it"
    again = roll_out(twin, seen.controller_points).positions
    np.testing.assert_array_equal(moved, again)


def test_the_shape_of_frame_0_may_be_without_moments():
    seen = ropes.cable(frames=8)
    settings = replace(
        ropes.SETTINGS, rod=replace(ropes.ROD, rest="first_frame"), simulation=config.SimulationSettings(gravity=0.0)
    )
    twin = ropes.twin(seen, settings)
    at_rest = roll_out(twin, seen.controller_points).positions
    assert np.abs(at_rest - at_rest[0]).max() < SINGLE
    t = np.diff(twin.body.vertices, axis=0) / np.linalg.norm(np.diff(twin.body.vertices, axis=0), axis=1, keepdims=True)
    angle = np.arccos((t[1:] * t[:-1]).sum(axis=1))
    np.testing.assert_allclose(np.linalg.norm(twin.body.curvature[1:-1], axis=1), 2 * np.tan(angle / 2), rtol=1e-6)
    assert not ropes.twin(seen).body.curvature.any()


def test_a_hand_lifts_a_rope_and_lets_it_go():
    up = np.ones((8, 3), bool)
    seen = ropes.rope(frames=8, height=0.02, move=(0.0, 0.0, 0.01))
    twin = ropes.twin(seen)
    assert twin.topology.object_spring_count == 0 < len(twin.topology.springs)
    lifted = roll_out(twin, seen.controller_points).positions[-1]
    middle = np.abs(lifted[:, 0] - 0.2) < 0.02
    assert lifted[middle, 2].mean() > 0.07 > lifted[~middle, 2].min()
    up[2:] = False
    fallen = roll_out(twin, seen.controller_points, valid=up).positions[-1]
    assert fallen[:, 2].max() < 0.06
    assert fallen[:, 2].min() > -ropes.RADIUS


@pytest.mark.parametrize("body", [ropes.rope, ropes.cable])
def test_another_recording_moves_the_same_elsewhere(body):
    here = body(frames=5, move=(0.0, 0.01, 0.004))
    shift = np.array([0.5, -0.25, 0.0])
    there = replace(here, object_points=here.object_points + shift, controller_points=here.controller_points + shift)
    twin = ropes.twin(here)
    moved = move(twin, there)
    assert moved.body is not None
    assert moved.body.lengths is not None
    np.testing.assert_array_equal(moved.body.lengths, twin.body.lengths)
    expected = roll_out(twin, here.controller_points).positions + shift
    # The line is found anew, in float32 coordinates.
    np.testing.assert_allclose(roll_out(moved, there.controller_points).positions, expected, atol=1e-4)
