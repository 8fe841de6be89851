"""The cable reader: rings, clamped ends, refusals, and the released recordings where they are present."""

from __future__ import annotations

import dataclasses
import pickle
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
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


def test_a_straightened_cable_keeps_its_arc_lengths() -> None:
    markers, nodes = mocap.straightened(helix(), number=20, radius=0.006, count=4)
    length = np.hypot(0.2 * 1.6 * np.pi, 0.3)
    np.testing.assert_allclose(markers[:, 0], np.linspace(0, length, 12), rtol=0, atol=SPLINE * length)
    assert (markers[:, 1:] == 0).all()
    circles = nodes.reshape(20, 4, 3)
    np.testing.assert_allclose(circles[:, 0, 0], np.linspace(0, markers[-1, 0], 20), atol=EDGE)
    np.testing.assert_allclose(np.linalg.norm(circles[:, :, 1:], axis=2), 0.006, atol=EDGE)
    assert (circles[:, :, 1:] == circles[0, :, 1:]).all(), "without twist"


def test_a_straight_cable_is_its_own_rest_shape(tmp_path: Path) -> None:
    markers = np.linspace([0.1, 0.2, 0.3], [0.5, 0.9, 0.4], 12)
    path = write(tmp_path, np.repeat(markers.T[None], 40, axis=0))
    observations = mocap.read(ROW, path, Mocap(rest_shape="straight"))
    frame0 = np.concatenate([observations.nodes, observations.controller_points[0]])
    distances = [np.linalg.norm(points[:, None] - points[None], axis=2) for points in (observations.canonical, frame0)]
    np.testing.assert_allclose(*distances, atol=1e-6)


def test_the_rest_shape_is_that_of_the_first_frame_unless_it_is_said_to_be_straight(tmp_path: Path) -> None:
    path = write(tmp_path, recording())
    plain, straight = mocap.read(ROW, path, Mocap()), mocap.read(ROW, path, Mocap(rest_shape="straight"))
    assert len(plain.rest_shape) == 0
    np.testing.assert_array_equal(plain.canonical, np.concatenate([plain.nodes, plain.controller_points[0]]))
    assert straight.canonical.shape == plain.canonical.shape
    np.testing.assert_array_equal(straight.nodes, plain.nodes)
    assert "rest_shape=straight" in straight.scenario.provenance["options"]
    # Held markers come last, in the order of the controllers.
    assert (np.diff(straight.canonical[-4:, 0]) > 0).all()
    assert straight.canonical[-4, 0] == 0


def recording(samples: int = 40, count: int = 12) -> np.ndarray:
    """[T, 3, n] as released: the helix swinging rigidly along x."""
    swing = 0.05 * np.sin(np.linspace(0, 3, samples))[:, None, None] * np.array([1.0, 0.0, 0.0])
    return (helix(count) + swing).transpose(0, 2, 1)


def write(tmp_path: Path, value: Any) -> Path:
    path = tmp_path / "7.pkl"
    path.write_bytes(pickle.dumps(value, protocol=4))
    return path


@pytest.mark.parametrize("as_lists", [True, False], ids=["lists, as released", "array"])
def test_markers_and_time(tmp_path: Path, as_lists: bool) -> None:
    data = recording()
    path = write(tmp_path, data.tolist() if as_lists else data)
    observations = mocap.read(ROW, path, Mocap(stride=2))
    scenario = observations.scenario
    assert (scenario.frame_count, scenario.train_end, scenario.frame_rate, scenario.up) == (20, 14, 50.0, "+z")
    assert not scenario.ground
    np.testing.assert_array_equal(observations.object_points, data[::2, :, 2:-2].transpose(0, 2, 1).astype(np.float32))
    np.testing.assert_array_equal(
        observations.controller_points, data[::2][:, :, [0, 1, -2, -1]].transpose(0, 2, 1).astype(np.float32)
    )
    np.testing.assert_array_equal(observations.tracks, observations.object_points)
    assert observations.object_visibility.all()
    assert observations.object_motion_valid[:-1].all()
    assert not observations.object_motion_valid[-1].any()
    assert len(observations.interior_points) == 0
    assert scenario.provenance["7.pkl"].startswith("sha256:")
    assert "stride=2" in scenario.provenance["options"]


def test_frames_are_cut_after_the_stride(tmp_path: Path) -> None:
    observations = mocap.read(ROW, write(tmp_path, recording()), Mocap(stride=3, frames=10))
    assert observations.scenario.frame_count == 10
    np.testing.assert_array_equal(observations.object_points[9], recording()[27, :, 2:-2].T.astype(np.float32))


@pytest.mark.parametrize(("spacing", "radius", "ring"), [(0.012, 0.006, 4), (0.02, 0.003, 3), (0.01, 0.01, 8)])
def test_ring_geometry(spacing: float, radius: float, ring: int) -> None:
    centers, tangents = mocap.centerline(helix(), spacing)
    nodes = rings(helix(), spacing, radius, ring).reshape(-1, ring, 3)
    offsets = nodes - centers[:, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=2), radius, rtol=0, atol=EDGE)
    np.testing.assert_allclose(np.einsum("rki,ri->rk", offsets, tangents), 0, atol=EDGE)
    np.testing.assert_allclose(nodes.mean(axis=1), centers, atol=EDGE)
    neighbor = np.linalg.norm(offsets - np.roll(offsets, 1, axis=1), axis=2)
    np.testing.assert_allclose(neighbor, 2 * radius * np.sin(np.pi / ring), atol=EDGE)
    np.testing.assert_allclose(centers[[0, -1]], helix()[[0, -1]], atol=EDGE)
    step = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    np.testing.assert_allclose(step, step.mean(), rtol=SPLINE)
    # Dividing the arc evenly moves the spacing by at most half a step over all rings.
    assert abs(step.mean() - spacing) <= spacing / (2 * len(step)) + SPLINE * spacing


def test_markers_lie_on_the_centerline() -> None:
    centers, _ = mocap.centerline(helix(), 0.0005)
    assert cKDTree(centers).query(helix())[0].max() <= 0.00026  # half the spacing


def assert_no_twist(nodes: np.ndarray, ring: int) -> None:
    rings = nodes.reshape(-1, ring, 3)
    for one, other in pairwise(rings):
        assert (cKDTree(other).query(one)[1] == np.arange(ring)).all()


def rings(markers: np.ndarray, spacing: float, radius: float, ring: int, number: int | None = None) -> np.ndarray:
    """Nodes [R * ring, 3] of rings whose roll starts from y."""
    centers, tangents = mocap.centerline(markers, spacing, number)
    return mocap.rings(centers, tangents, mocap.rolled(tangents, mocap.Y), radius, ring)


def test_neighboring_nodes_of_rings_have_the_same_number() -> None:
    assert_no_twist(rings(helix(), 0.012, 0.006, 4), 4)
    vertical = np.array([[0.0, 0.0, 1.0 - 0.1 * i] for i in range(8)])  # a tangent along a coordinate axis
    assert_no_twist(rings(vertical, 0.012, 0.006, 4), 4)


def test_both_ends_are_rolled_from_one_axis_and_the_twist_between_them_is_even() -> None:
    _, tangents = mocap.centerline(helix(), 0.005)
    normals = mocap.rolled(tangents, mocap.Y)
    for normal, tangent in zip(normals[[0, -1]], tangents[[0, -1]], strict=True):
        projected = mocap.Y - (mocap.Y @ tangent) * tangent
        np.testing.assert_allclose(normal, projected / np.linalg.norm(projected), atol=EDGE)
    np.testing.assert_allclose(np.einsum("ri,ri->r", normals, tangents), 0, atol=EDGE)
    # The turn of each normal against the one before it, carried along by the smallest rotation.
    steps = [
        np.arctan2(np.cross(carried, after) @ tangent, carried @ after)
        for carried, after, tangent in (
            (mocap.transport(tangents[i : i + 2], normals[i])[1], normals[i + 1], tangents[i + 1]) for i in range(len(tangents) - 1)
        )
    ]
    np.testing.assert_allclose(steps, steps[0], atol=1e-9)
    assert abs(sum(steps)) > 0.1


@pytest.mark.parametrize("end", [(1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0.1, 0.995, 0)], ids=str)
def test_ends_may_point_anywhere(tmp_path: Path, end: tuple[float, float, float]) -> None:
    lines = {"straight": np.outer(np.linspace(0, 0.8, 12), end), "bent": helix() - helix()[0]}
    for name, line in lines.items():
        if name == "bent":
            line[:2] = [-0.03 * np.array(end), np.zeros(3)]
        data = np.repeat(line.T[None], 40, axis=0)
        seen = mocap.read(ROW, write(tmp_path, data), Mocap(rings=20, ring=3, grip="clamp"))
        rings = seen.nodes[8:].reshape(20, 3, 3)
        offsets = rings - rings.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(np.linalg.norm(offsets, axis=2), 0.006, atol=SINGLE)
        along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        clamp = seen.controller_points[0, 4:7] - seen.controller_points[0, 0]
        np.testing.assert_allclose(clamp @ along, 0, atol=SINGLE)


@pytest.mark.parametrize("angle", [95, 127, 180, -100])
def test_a_cable_that_was_recorded_elsewhere_takes_its_rings_with_it(tmp_path: Path, angle: float) -> None:
    """It heads along -x within the quarter turn in which grippers keep to the world, or it does not."""
    x, turn = np.linspace(0.4, -0.4, 12), Rotation.from_euler("z", angle, degrees=True).as_matrix()
    data = np.repeat(np.stack([x, np.zeros(12), 2 * x**2])[None], 40, axis=0)
    here, there = (mocap.read(ROW, write(tmp_path, each), Mocap(rings=20, grip="clamp")) for each in (data, turn @ data))
    for name in ("surface_points", "controller_points"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name) @ turn.T, atol=SINGLE)


@pytest.mark.parametrize("grip", ["markers", "clamp"])
def test_the_line_runs_through_all_markers_and_its_velocity_is_that_before_frame_0(tmp_path: Path, grip: Any) -> None:
    data = recording()
    # The ends turn too, so that points of clamps have velocities of their own.
    data[:, :, :2] += 0.01 * np.sin(np.linspace(0, 3, 40))[:, None, None] * np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.5]])
    seen = mocap.read(ROW, write(tmp_path, data), Mocap(start=3, stride=2, grip=grip))
    places = np.concatenate([seen.nodes, seen.controller_points[0]])
    np.testing.assert_array_equal(places[seen.line], data[3].T.astype(np.float32))
    before = mocap.read(ROW, write(tmp_path, data), Mocap(start=2, stride=1, grip=grip))
    first = np.concatenate([before.object_points, before.controller_points], axis=1)
    if grip == "markers":
        np.testing.assert_allclose(seen.velocity_before, (first[1] - first[0]) * 100.0, atol=1e-4)
    else:
        # A rigid turn of the ring with the direction of the end: its points keep their distance to the marker.
        marker, ring = seen.velocity_before[8], seen.velocity_before[12:16]
        offsets = seen.controller_points[0, 4:8] - seen.controller_points[0, 0]
        np.testing.assert_allclose(np.einsum("ki,ki->k", ring - marker, offsets), 0, atol=1e-4)
        assert np.abs(ring - marker).max() > 1e-3
    assert len(mocap.read(ROW, write(tmp_path, data), Mocap()).velocity_before) == 0


def test_whole_recordings_may_be_for_training_and_short_ones_are_refused(tmp_path: Path) -> None:
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
        (np.where(np.arange(12) == 3, np.nan, recording()), r"finite.*nan at frame 0, marker 3 \(120 in all\)"),
        ([[1.0, 2.0], [3.0]], r"different lengths"),
        ({"positions": 1}, r"required; received dict"),
        (recording()[:, :, [0, 1, 2, 2, 4, 5, 6, 7]], r"markers 2 and 3"),
    ],
)
def test_bad_recordings_are_refused(tmp_path: Path, value: Any, message: str) -> None:
    path = write(tmp_path, value)
    with pytest.raises(InputError, match=rf"7\.pkl: .*{message}"):
        mocap.read(ROW, path, Mocap())
    assert [d.level for d in check_layout(path) if d.level == "error"]


@pytest.mark.parametrize(("settings", "message"), [(Mocap(stride=20), "stride = 20"), (Mocap(start=37), "mocap.start = 37")])
def test_settings_that_do_not_fit_are_refused(tmp_path: Path, settings: Mocap, message: str) -> None:
    with pytest.raises(InputError, match=rf"7\.pkl: .*{message}"):
        mocap.read(ROW, write(tmp_path, recording()), settings)


def test_rings_that_would_touch_markers_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mocap, "RING_RADIUS", 1e-5)
    with pytest.raises(InputError, match=r"7\.pkl: .*must be 0\.0001 m apart"):
        mocap.read(ROW, write(tmp_path, recording()), Mocap())


def test_check_of_files_and_folders(tmp_path: Path) -> None:
    data = recording(samples=500)
    data[30, :, [4, 5]] = data[30, :, [5, 4]]
    path = write(tmp_path, data.tolist())
    for target in (path, tmp_path):
        swapped, hanging = check_layout(target)
        assert (swapped.name, swapped.level, swapped.frames) == ("labels swapped", "warning", (30, 31))
        assert (hanging.name, hanging.level) == ("up of the recording", "warning"), "a helix hangs from nothing"


@pytest.mark.skipif(not REAL.is_dir(), reason="the released recordings are not part of the repository")
@pytest.mark.parametrize(("cable", "observed"), [("DLO1", 9), ("DLO2", 8), ("DLO3", 8), ("DLO4", 8)])
def test_released_recordings(cable: str, observed: int) -> None:
    file = min((REAL / cable / "train").glob("*.pkl"))
    assert [d for d in check_layout(file) if d.level != "note"] == []
    observations = mocap.read(dataclasses.replace(ROW, scenario=cable), file, Mocap())
    assert observations.scenario.frame_count == 250
    assert observations.object_points.shape[1] == observed
    assert 300 < len(observations.nodes) < 380
    assert_no_twist(observations.surface_points, Mocap().ring)


def test_a_given_number_of_rings_spaces_them_equally_from_end_to_end() -> None:
    nodes = rings(helix(), 0.012, 0.006, 3, number=9).reshape(-1, 3, 3)
    centers = nodes.mean(axis=1)
    assert len(centers) == 9
    np.testing.assert_allclose(centers[[0, -1]], helix()[[0, -1]], atol=1e-9)
    # Chords of equal arcs of a helix are equal; 2 % allows for the spline and the arc's integration.
    chords = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    np.testing.assert_allclose(chords, chords.mean(), rtol=0.02)


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
    return mocap.clamps(held, normals, RADIUS, COUNT, 1e-4, "cable").reshape(len(held), 4, COUNT, 3)


def test_points_keep_their_distance_to_the_marker_and_lie_normal_to_the_end() -> None:
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
def test_a_planar_motion_turns_the_normal_in_the_plane_by_the_same_angle(roll: float) -> None:
    angle = 1.2 * np.sin(np.linspace(0, 7, 300))
    out_of_plane = np.array([0.0, 1.0, 0.0])
    in_plane = turning(angle + np.pi / 2)
    expected = np.cos(roll) * out_of_plane + np.sin(roll) * in_plane
    np.testing.assert_allclose(mocap.transport(turning(angle), expected[0]), expected, atol=CLAMP_EDGE)


def test_a_direction_that_goes_around_a_circle_of_latitude_turns_the_normal_by_the_enclosed_solid_angle() -> None:
    # Parallel transport along a closed curve on the sphere: by Gauss-Bonnet it turns by the area 2 pi (1 - cos(polar angle)).
    polar, steps = 0.4, 20_000
    turn = np.linspace(0, 2 * np.pi, steps)
    directions = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.full(steps, np.cos(polar))], axis=1)
    start = np.array([np.cos(polar), 0.0, -np.sin(polar)])
    end = mocap.transport(directions, start)[-1]
    angle = np.arctan2(np.cross(start, end) @ directions[0], start @ end)
    # The polygon of the steps has less area than the circle, by a share of (2 pi / steps)^2.
    assert angle % (2 * np.pi) == pytest.approx(2 * np.pi * (1 - np.cos(polar)), abs=1e-6)


def test_a_recording_seen_from_elsewhere_has_its_clamps_there() -> None:
    held, rotation = wild(), Rotation.from_rotvec([0.3, -1.1, 0.6])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    one = mocap.clamps(held, normals, RADIUS, COUNT, 1e-4, "cable")
    other = mocap.clamps(held @ rotation.as_matrix().T + 1.0, rotation.apply(normals), RADIUS, COUNT, 1e-4, "cable")
    np.testing.assert_allclose(other, one @ rotation.as_matrix().T + 1.0, atol=1e-11)


def test_markers_of_an_end_that_meet_are_refused() -> None:
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
    return mocap.read(ROW, write(folder, cable()), Mocap(ring=3, **settings))  # type: ignore[arg-type]


def test_clamps_follow_the_markers_among_the_controllers(tmp_path: Path) -> None:
    plain, clamped = read(tmp_path), read(tmp_path, grip="clamp")
    assert clamped.controller_points.shape == (21, 4 + 4 * 3, 3)
    np.testing.assert_array_equal(clamped.controller_points[:, :4], plain.controller_points)
    for name in ("object_points", "surface_points", "tracks"):
        np.testing.assert_array_equal(getattr(clamped, name), getattr(plain, name))
    offsets = clamped.controller_points[:, 4:].reshape(21, 4, 3, 3) - clamped.controller_points[:, :4, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=3), 0.006, atol=SINGLE)


def test_a_clamp_turns_as_it_does_at_the_full_rate_and_does_not_know_later_frames(tmp_path: Path) -> None:
    every, second = read(tmp_path, grip="clamp", stride=1), read(tmp_path, grip="clamp", stride=2)
    np.testing.assert_array_equal(every.controller_points[::2], second.controller_points)
    first = read(tmp_path, grip="clamp", stride=2, frames=9)
    np.testing.assert_array_equal(first.controller_points, second.controller_points[:9])


def test_clamps_lie_around_the_straight_cable_at_rest(tmp_path: Path) -> None:
    straight = read(tmp_path, grip="clamp", rest_shape="straight")
    held, around = straight.canonical[-16:-12], straight.canonical[-12:].reshape(4, 3, 3)
    np.testing.assert_allclose(around[..., 0], np.broadcast_to(held[:, None, 0], (4, 3)), atol=SINGLE)
    np.testing.assert_allclose(np.linalg.norm(around - held[:, None], axis=2), 0.006, atol=SINGLE)
    # Half a step from the nodes of the body's first and last ring, in the rest shape and about so in the bent frame 0.
    for shape in (straight.canonical, np.concatenate([straight.nodes, straight.controller_points[0]])):
        body, clamp = shape[:-16], shape[-12:]
        for nodes, points in ((body[8:11], clamp[:3]), (body[-3:], clamp[-3:])):
            nearest = np.linalg.norm(nodes[:, None] - points, axis=2).min(axis=0)
            np.testing.assert_allclose(nearest, 0.006, rtol=0.2)
