"""Annotated points in images: exact under shifts parallel to the image, bound to visible nodes, no value without annotation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Trajectory
from neuspring.data.camera import Camera
from neuspring.scores import metrics
from neuspring.scores.carried import FAR_SIDE, carried_in_image, points_in_image, points_on_table
from tests.support.colored import observed

K = np.array([[400.0, 0, 320], [0, 410.0, 240], [0, 0, 1]])
DEPTH = 0.8
ROUND_OFF = 1e-9
"""px: float64 at coordinates of some hundreds."""


def pose() -> np.ndarray:
    """A camera to the world [4, 4] that is turned about all axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.7, 1.9]).as_matrix()
    matrix[:3, 3] = [0.2, -0.4, 0.9]
    return matrix


VIEW = Camera("", 0, 0, K, pose())


def in_world(local: np.ndarray) -> np.ndarray:
    """World points [..., 3] of points in the camera's own axes."""
    return local @ pose()[:3, :3].T + pose()[:3, 3]


def sheet(side: int = 12, depth: float = DEPTH) -> np.ndarray:
    """A square grid parallel to the image, in the camera's axes [N, 3], m."""
    line = np.linspace(-0.1, 0.1, side)
    x, y = np.meshgrid(line, line)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])


def marked_pixels(rng: np.random.Generator, count: int = 6) -> np.ndarray:
    return rng.uniform([290, 210], [350, 270], (count, 2))


def test_a_shift_parallel_to_the_image_is_exact():
    rng = np.random.default_rng(0)
    shifts = np.array([[0, 0, 0], [0.03, -0.02, 0], [-0.05, 0.04, 0]])
    positions = in_world(sheet()[None] + shifts[:, None])
    moved = shifts[:, :2] * np.diag(K)[:2] / DEPTH
    start = marked_pixels(rng)
    places = carried_in_image(VIEW, positions, start, positions.shape[1])
    np.testing.assert_allclose(places, start + moved[:, None], atol=ROUND_OFF)
    assert points_in_image(VIEW, positions, start + moved[:, None], positions.shape[1]) == pytest.approx(0, abs=ROUND_OFF)
    # Of a prediction that stands still the error is the shift.
    still = points_in_image(VIEW, np.repeat(positions[:1], 3, axis=0), start + moved[:, None], positions.shape[1])
    assert still == pytest.approx(np.linalg.norm(moved, axis=1), abs=ROUND_OFF)


def test_nodes_on_the_other_side_and_in_the_inside_do_not_count():
    rng = np.random.default_rng(1)
    front, back = sheet(), sheet(depth=DEPTH + 2 * FAR_SIDE)
    start = marked_pixels(rng)
    positions = np.stack([in_world(np.concatenate([front, back]))] * 2)
    positions[1, len(front) :] += 1.0
    places = carried_in_image(VIEW, positions, start, positions.shape[1])
    np.testing.assert_allclose(places[1], start, atol=ROUND_OFF)
    # Interior nodes come after those of the surface, here nearer to the camera.
    positions = np.stack([in_world(np.concatenate([back, front]))] * 2)
    positions[1, len(back) :] += 1.0
    np.testing.assert_allclose(carried_in_image(VIEW, positions, start, len(back))[1], start, atol=ROUND_OFF)


def test_nearer_nodes_weigh_more():
    local = np.array([[-0.1, 0, DEPTH], [0.1, 0, DEPTH]])
    positions = np.stack([in_world(local), in_world(local + np.array([[0, 0, 0], [0, 0.02, 0]]))])
    pixels, _ = Camera("", 0, 0, K, pose()).project(positions)
    start = pixels[0, :1] + [[20.0, 0]]
    place = carried_in_image(VIEW, positions, start, 2)[1, 0]
    share = (1 / 81) / (1 / 21 + 1 / 81)
    np.testing.assert_allclose(place, start[0] + share * (pixels[1, 1] - pixels[0, 1]), atol=ROUND_OFF)


def test_what_is_not_marked_says_nothing():
    positions = np.repeat(in_world(sheet())[None], 4, axis=0)
    marked = np.full((4, 3, 2), np.nan)
    marked[0, :2] = [[320, 240], [330, 250]]
    marked[2, 0] = [323, 244]
    marked[2, 2] = marked[3, 2] = [300, 200]
    errors = points_in_image(VIEW, positions, marked, positions.shape[1])
    assert errors[[0, 2]] == pytest.approx([0, 5])
    assert np.isnan(errors[[1, 3]]).all()
    assert points_in_image(VIEW, positions[:2], marked, positions.shape[1]).shape == (2,)
    assert points_in_image(VIEW, positions, np.zeros((4, 0, 2)), 10).shape == (4,)


def test_points_on_the_table_are_measured_on_it():
    """A sheet on the table that is shifted along it: the mark is where it was, so the error is the shift."""
    line = np.linspace(-0.1, 0.1, 15)
    x, y = np.meshgrid(line, line)
    nodes = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.002)])
    view = Camera("", 0, 0, K, np.array([[1, 0, 0, 0], [0, -0.6, 0.8, -0.5], [0, -0.8, -0.6, 0.5], [0, 0, 0, 1.0]]))
    shift = np.array([0.02, -0.01, 0.0])
    positions = np.stack([nodes, nodes + shift, nodes + np.array([0, 0, 0.1])])
    start = view.project(np.array([[0.031, 0.012, 0.002], [-0.05, 0.04, 0.002]]))[0]
    marked = np.stack([start] * 3)
    found = points_on_table(view, positions, marked, len(nodes), 1.0)
    assert found[:2] == pytest.approx([0.0, np.linalg.norm(shift)], abs=1e-9)
    assert np.isnan(found[2])
    # A thing that is high in frame 0 is not flat.
    high = np.concatenate([positions, positions[:, :1] + np.array([0, 0, 0.05])], axis=1)
    assert np.isnan(points_on_table(view, high, marked, len(nodes), 1.0)).all()


def test_scores_of_color_alone_have_the_errors_of_marked_points():
    seen = observed()
    view = Camera("", 0, 0, seen.image.intrinsics, seen.image.camera_to_world)
    still = np.repeat(seen.nodes[None], seen.scenario.frame_count, axis=0)
    pixel = view.project(seen.nodes[:1].astype(float))[0]
    marked = np.full((seen.scenario.frame_count, 1, 2), np.nan)
    marked[0], marked[3], marked[-1] = pixel, pixel + np.array([3.0, 4.0]), pixel + np.array([0.0, 12.0])
    own = replace(seen, image=replace(seen.image, marked=marked))
    rows = metrics.score(Trajectory(positions=still, frame_count=len(still)), own, "still", 0)
    found = rows[rows["metric"] == "image_error"].set_index("task")
    assert found["value"].to_dict() == pytest.approx({"reconstruction": 5.0, "future": 12.0}, abs=1e-3)
    assert set(found["unit"]) == {"px"}
    scores = metrics.score(Trajectory(positions=still, frame_count=len(still)), seen, "m", 0)
    assert not len(scores.query("metric == 'image_error'"))
