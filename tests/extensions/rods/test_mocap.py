"""The cable reader: rings, clamped ends, refusals, and the released recordings where they are present."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.extensions.rods import mocap
from neuspring.extensions.rods.settings import Mocap
from neuspring.intake.check import check_layout
from tests.support.real import FOLDER

ROW = ScenarioRow(scenario="cable", source="mocap", category="cable", path="x", self_collision=False, ground=False)
REAL = FOLDER / "mocap_dlo"
EDGE = 1e-9
"""Rounding of float64 geometry of size 1."""
SPLINE = 1e-3
"""Relative error of the spacing: the arc is measured by 63 chords per marker interval, and rings are chords of the curve."""


def helix(count: int = 12) -> np.ndarray:
    """Markers [n, 3] along 0.8 turns of a helix of radius 0.2 m that climbs 0.3 m."""
    angle = np.linspace(0, 1.6 * np.pi, count)
    return np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.3 + 0.3 * angle / angle[-1]], axis=1)


def test_a_straightened_cable_keeps_its_arc_lengths():
    markers, nodes = mocap.straightened(helix(), number=20, radius=0.006, count=4)
    length = np.hypot(0.2 * 1.6 * np.pi, 0.3)
    np.testing.assert_allclose(markers[:, 0], np.linspace(0, length, 12), rtol=0, atol=SPLINE * length)
    assert (markers[:, 1:] == 0).all()
    circles = nodes.reshape(20, 4, 3)
    np.testing.assert_allclose(circles[:, 0, 0], np.linspace(0, markers[-1, 0], 20), atol=EDGE)
    np.testing.assert_allclose(np.linalg.norm(circles[:, :, 1:], axis=2), 0.006, atol=EDGE)
    assert (circles[:, :, 1:] == circles[0, :, 1:]).all(), "without twist"


def recording(samples: int = 40, count: int = 12) -> np.ndarray:
    """[T, 3, n] as released: the helix swinging rigidly along x."""
    swing = 0.05 * np.sin(np.linspace(0, 3, samples))[:, None, None] * np.array([1.0, 0.0, 0.0])
    return (helix(count) + swing).transpose(0, 2, 1)


def write(tmp_path: Path, value: Any) -> Path:
    path = tmp_path / "7.pkl"
    path.write_bytes(pickle.dumps(value, protocol=4))
    return path


@pytest.mark.parametrize("as_lists", [True, False], ids=["lists, as released", "array"])
def test_markers_and_time(tmp_path, as_lists):
    data = recording()
    path = write(tmp_path, data.tolist() if as_lists else data)
    observations = mocap.read(ROW, path, Mocap(stride=2))
    scenario = observations.scenario
    assert (scenario.frame_count, scenario.train_end, scenario.frame_rate, scenario.up) == (20, 14, 50.0, "+z")
    assert not scenario.ground
    np.testing.assert_array_equal(observations.object_points, data[::2, :, 2:-2].transpose(0, 2, 1).astype(np.float32))
    np.testing.assert_array_equal(
        observations.controller_points[:, :4], data[::2][:, :, [0, 1, -2, -1]].transpose(0, 2, 1).astype(np.float32)
    )
    np.testing.assert_array_equal(observations.tracks, observations.object_points)
    assert observations.object_visibility.all()
    assert observations.object_motion_valid[:-1].all()
    assert not observations.object_motion_valid[-1].any()
    assert len(observations.interior_points) == 0
    assert scenario.provenance["7.pkl"].startswith("sha256:")
    assert "stride=2" in scenario.provenance["options"]


def test_the_line_runs_through_all_markers_and_its_velocity_is_that_before_frame_0(tmp_path):
    data = recording()
    # The ends turn too, so that points of clamps have velocities of their own.
    data[:, :, :2] += 0.01 * np.sin(np.linspace(0, 3, 40))[:, None, None] * np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.5]])
    seen = mocap.read(ROW, write(tmp_path, data), Mocap(start=3, stride=2))
    places = np.concatenate([seen.nodes, seen.controller_points[0]])
    np.testing.assert_array_equal(places[seen.line], data[3].T.astype(np.float32))
    before = mocap.read(ROW, write(tmp_path, data), Mocap(start=2, stride=1))
    first = np.concatenate([before.object_points, before.controller_points[:, :4]], axis=1)
    np.testing.assert_allclose(seen.velocity_before[:12], (first[1] - first[0]) * 100.0, atol=1e-4)
    # A rigid turn of the ring with the direction of the end: its points keep their distance to the marker.
    marker, ring = seen.velocity_before[8], seen.velocity_before[12:15]
    offsets = seen.controller_points[0, 4:7] - seen.controller_points[0, 0]
    np.testing.assert_allclose(np.einsum("ki,ki->k", ring - marker, offsets), 0, atol=1e-4)
    assert np.abs(ring - marker).max() > 1e-3
    assert len(mocap.read(ROW, write(tmp_path, data), Mocap()).velocity_before) == 0


def test_whole_recordings_may_be_for_training_and_short_ones_are_refused(tmp_path):
    path = write(tmp_path, recording())
    seen = mocap.read(ROW, path, Mocap(start=1, stride=1, frames=39, train_fraction=1.0))
    assert (seen.scenario.frame_count, seen.scenario.train_end) == (39, 39)
    with pytest.raises(InputError, match=r"7\.pkl: 40 frames are required after start 1 and stride 1.*39 of 40 samples"):
        mocap.read(ROW, path, Mocap(start=1, stride=1, frames=40))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (recording()[:, :2], r"shape must be \[T, 3, n\].*\(40, 2, 12\)"),
        (recording().transpose(0, 2, 1), r"shape must be"),
        (recording(count=5), r"at least 6 markers.*5"),
        ((recording() * 1000).astype(int), r"dtype must be floating point.*int"),
        (recording()[:3], r"at least 4 frames.*3"),
        (np.where(np.arange(12) == 3, np.nan, recording()), r"finite.*nan at frame 0, marker 3 \(120 in total\)"),
        ([[1.0, 2.0], [3.0]], r"different lengths"),
        ({"positions": 1}, r"required; received dict"),
        (recording()[:, :, [0, 1, 2, 2, 4, 5, 6, 7]], r"markers 2 and 3"),
    ],
)
def test_bad_recordings_are_refused(tmp_path, value, message):
    path = write(tmp_path, value)
    with pytest.raises(InputError, match=rf"7\.pkl: .*{message}"):
        mocap.read(ROW, path, Mocap())
    assert [d.level for d in check_layout(path) if d.level == "error"]


@pytest.mark.parametrize(("settings", "message"), [(Mocap(stride=20), "stride 20"), (Mocap(start=37), "start 37")])
def test_settings_that_do_not_fit_are_refused(tmp_path, settings, message):
    with pytest.raises(InputError, match=rf"7\.pkl: .*{message}"):
        mocap.read(ROW, write(tmp_path, recording()), settings)


@pytest.mark.skipif(not REAL.is_dir(), reason="the released recordings are not part of the repository")
@pytest.mark.parametrize(("cable", "observed"), [("DLO1", 9), ("DLO2", 8), ("DLO3", 8), ("DLO4", 8)])
def test_released_recordings(cable, observed):
    file = min((REAL / cable / "train").glob("*.pkl"))
    assert [d for d in check_layout(file) if d.level != "note"] == []
    observations = mocap.read(dataclasses.replace(ROW, scenario=cable), file, Mocap())
    assert observations.scenario.frame_count == 250
    assert observations.object_points.shape[1] == observed
    assert len(observations.nodes) == observed + 40 * 3


RADIUS, COUNT = 0.006, 3
CLAMP_EDGE = 1e-12
"""Rounding of float64 geometry of size 1 over a few hundred steps."""
SINGLE = 1e-6
"""Observations are float32; coordinates are below 1 m."""


def turning(angle: np.ndarray) -> np.ndarray:
    """Unit vectors [T, 3] in the plane x, z at `angle` [T] from x."""
    return np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)


def wild(samples: int = 200) -> np.ndarray:
    """Two markers at either end [T, 4, 3] that move and turn in space."""
    t = np.linspace(0, 4, samples)
    one = np.stack([np.sin(t), np.cos(1.7 * t), 0.3 * t], axis=1)
    other = np.stack([1.5 + 0.1 * np.cos(t), np.sin(0.6 * t), -np.cos(t)], axis=1)
    ends = []
    for place, phase in ((one, 0.0), (other, 1.0)):
        along = np.stack([np.cos(2 * t + phase), np.sin(3 * t), np.sin(t + phase)], axis=1)
        ends += [place, place + 0.02 * along / np.linalg.norm(along, axis=1, keepdims=True)]
    return np.stack(ends, axis=1)


def clamp_rings(held: np.ndarray) -> np.ndarray:
    """Clamps [T, 4, count, 3] of held markers."""
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    return mocap.clamps(held, normals, RADIUS, COUNT, "cable").reshape(len(held), 4, COUNT, 3)


def test_points_keep_their_distance_to_the_marker_and_lie_normal_to_the_end():
    held = wild()
    offsets = clamp_rings(held) - held[:, :, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=3), RADIUS, rtol=0, atol=CLAMP_EDGE)
    for end in (0, 2):
        along = held[:, end + 1] - held[:, end]
        for marker in (end, end + 1):
            np.testing.assert_allclose(np.einsum("tkc,tc->tk", offsets[:, marker], along), 0, atol=CLAMP_EDGE)
    # The rings of both markers of an end point the same way: one rigid grip.
    np.testing.assert_allclose(offsets[:, 0], offsets[:, 1], atol=CLAMP_EDGE)
    np.testing.assert_allclose(offsets[:, 2], offsets[:, 3], atol=CLAMP_EDGE)


@pytest.mark.parametrize("roll", [0.0, 0.7, np.pi / 2])
def test_a_planar_motion_turns_the_normal_in_the_plane_by_the_same_angle(roll):
    angle = 1.2 * np.sin(np.linspace(0, 7, 300))
    out_of_plane = np.array([0.0, 1.0, 0.0])
    in_plane = turning(angle + np.pi / 2)
    expected = np.cos(roll) * out_of_plane + np.sin(roll) * in_plane
    np.testing.assert_allclose(mocap.transport(turning(angle), expected[0]), expected, atol=CLAMP_EDGE)


def test_a_direction_that_goes_around_a_circle_of_latitude_turns_the_normal_by_the_enclosed_solid_angle():
    # Parallel transport along a closed curve on the sphere: by Gauss-Bonnet it turns by the area 2 pi (1 - cos(polar angle)).
    polar, steps = 0.4, 20_000
    turn = np.linspace(0, 2 * np.pi, steps)
    directions = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.full(steps, np.cos(polar))], axis=1)
    start = np.array([np.cos(polar), 0.0, -np.sin(polar)])
    end = mocap.transport(directions, start)[-1]
    angle = np.arctan2(np.cross(start, end) @ directions[0], start @ end)
    # The polygon of the steps has less area than the circle, by a share of (2 pi / steps)^2.
    assert angle % (2 * np.pi) == pytest.approx(2 * np.pi * (1 - np.cos(polar)), abs=1e-6)


def test_markers_of_an_end_that_meet_are_refused():
    held = wild()
    held[7, 3] = held[7, 2]
    with pytest.raises(InputError, match=r"two held markers.*sample 7"):
        clamp_rings(held)


def cable(samples: int = 41, count: int = 12) -> np.ndarray:
    """A recording [T, 3, n]: a quarter of a circle whose ends swing."""
    turn = np.linspace(0, np.pi / 2, count)
    arc = 0.4 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    swing = [Rotation.from_euler("xyz", [0.3 * np.sin(t), 0.2 * t, 0.1 * t]).apply(arc) for t in np.linspace(0, 2, samples)]
    return np.stack(swing).transpose(0, 2, 1)


def read(folder: Path, **settings: object) -> mocap.Observations:
    return mocap.read(ROW, write(folder, cable()), Mocap(**settings))  # type: ignore[arg-type]


def test_clamps_follow_the_markers_among_the_controllers(tmp_path):
    clamped = read(tmp_path)
    assert clamped.controller_points.shape == (21, 4 + 4 * 3, 3)
    offsets = clamped.controller_points[:, 4:].reshape(21, 4, 3, 3) - clamped.controller_points[:, :4, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=3), 0.006, atol=SINGLE)


def test_a_clamp_turns_as_it_does_at_the_full_rate_and_does_not_know_later_frames(tmp_path):
    every, second = read(tmp_path, stride=1), read(tmp_path, stride=2)
    np.testing.assert_array_equal(every.controller_points[::2], second.controller_points)
    first = read(tmp_path, stride=2, frames=9)
    np.testing.assert_array_equal(first.controller_points, second.controller_points[:9])
