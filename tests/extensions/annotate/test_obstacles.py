"""Marked things that stand still are measured by depth, and written where simulations read them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.config.perception import MarksSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.annotate.masks import MasksMode
from neuspring.extensions.annotate.obstacles import fit
from tests.support.moving import FAR, NEAR, moving

EYE = np.array([0.5, -0.6, 0.7])
NOISE = 0.0015


def seen(points: np.ndarray, normals: np.ndarray, flying: int = 0) -> np.ndarray:
    """The points [n, 3] that face the eye, with the noise of a depth camera, and every so-many-th one off along its ray."""
    rng = np.random.default_rng(1)
    shown = points[((EYE - points) * normals).sum(axis=1) > 0]
    shown = shown + rng.normal(0, NOISE, shown.shape)
    if flying:
        shown[::flying] += rng.uniform(0, 0.3, (len(shown[::flying]), 1)) * (shown[::flying] - EYE)
    return shown


def box(half: np.ndarray, turn: np.ndarray, center: tuple[float, ...], flying: int = 0) -> np.ndarray:
    rng, points, normals = np.random.default_rng(0), [], []
    for axis in range(3):
        for sign in (-1, 1):
            own = rng.uniform(-1, 1, (2000, 3)) * half
            own[:, axis] = sign * half[axis]
            points.append(own @ turn.T + center)
            normals.append(np.tile(sign * turn[:, axis], (len(own), 1)))
    return seen(np.concatenate(points), np.concatenate(normals), flying)


@pytest.mark.parametrize(
    ("angles", "height", "flying"), [((0, 0, 25), 0.06, 0), ((0, 0, 25), 0.06, 20), ((20, -35, 50), 0.16, 0)], ids=str
)
def test_a_box_is_found_whatever_its_turn(angles, height, flying):
    half, turn = np.array([0.08, 0.05, 0.06]), Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    found = fit(box(half, turn, (0.1, 0.05, height), flying), 1.0, EYE)
    assert (found.kind, found.obstacle.wrong()) == ("box", None)
    np.testing.assert_allclose(sorted(found.obstacle.half_sizes), sorted(half), atol=0.008)
    np.testing.assert_allclose(found.obstacle.center, (0.1, 0.05, height), atol=0.008)
    assert found.residual < 0.004
    assert f"residual {1e3 * found.residual:.1f} mm" in found.text()


def test_a_box_whose_foot_is_not_seen_stands_on_the_table():
    points = box(np.array([0.08, 0.05, 0.06]), np.eye(3), (0.1, 0.05, 0.06))
    for up in (1, -1):
        found = fit(points[points[:, 2] > 0.05] * (1, 1, up), up, EYE * (1, 1, up)).obstacle
        assert abs(up * found.center[2] - 0.06) < 0.003
        assert found.depth(np.array([[0.1, 0.05, 0.01 * up]]))[0] > 0


def test_a_ball_is_found():
    way = np.random.default_rng(0).normal(size=(4000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    found = fit(seen(0.07 * way + (0.0, 0.1, 0.07), way), 1.0, EYE)
    assert (found.kind, found.obstacle.shape) == ("ball", "sphere")
    np.testing.assert_allclose([*found.obstacle.center, found.obstacle.radius], [0, 0.1, 0.07, 0.07], atol=0.003)


def test_a_plane_becomes_a_slab_behind_what_was_seen():
    flat = np.random.default_rng(0).uniform(-0.2, 0.2, (2000, 3))
    level = fit(seen(flat * (1, 1, 0) + (0, 0, 0.1), np.tile((0, 0, 1.0), (2000, 1))), 1.0, EYE)
    wall = fit(seen(flat * (1, 0, 1) + (0, 0.3, 0.3), np.tile((0, -1.0, 0), (2000, 1))), 1.0, EYE)
    assert (level.kind, wall.kind) == ("plane", "plane")
    assert level.obstacle.depth(np.array([[0, 0, 0.09], [0, 0, 0.01], [0, 0, 0.11]])).round(2).tolist() == [0.01, 0.01, -0.01]
    assert wall.obstacle.depth(np.array([[0, 0.31, 0.3], [0, 0.29, 0.3]])).round(2).tolist() == [0.01, -0.01]
    np.testing.assert_allclose(sorted(wall.obstacle.half_sizes)[1:], (0.2, 0.2), atol=0.01)


def marked(*points: tuple[float, float], label: str = "obstacle") -> dict:
    one = {"frame": 0, "label": label, "kind": "polygon", "points": [list(point) for point in points], "radius": 1.0}
    return {"format": 1, "cameras": {"0": [one]}}


def test_marks_are_measured_into_capture_json_once_and_others_stay(tmp_path):
    capture = moving(tmp_path / "capture")
    path = capture.folder / "capture.json"
    other = {"shape": "sphere", "center": [5.0, 5.0, 5.0], "radius": 0.1}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"obstacles": [other]}))
    page = MasksMode(Capture.load(capture.folder), MarksSegmentation())
    with pytest.raises(InputError, match="an obstacle must be marked"):
        page.measure()
    # A part of the wall, with the border of the square before it.
    page.write("none", marked((80, 10), (120, 10), (120, 90), (80, 90)))
    said = [page.measure(), page.measure()]
    assert said[0] == said[1]
    assert said[0].startswith("Wrote to capture.json: plane (as a slab) of ") and "residual 0.0 mm" in said[0]
    kept, wall = Capture.load(capture.folder).description.obstacles
    assert kept.shape == "sphere"
    view = capture.cameras["0"]
    on, behind, before = (view.lift(np.array([100.0, 50.0]), depth) for depth in (FAR, FAR + 0.01, (NEAR + FAR) / 2))
    assert abs(wall.depth(on[None])[0]) < 1e-3
    assert wall.depth(behind[None])[0] > 0 > wall.depth(before[None])[0]


def test_what_cannot_be_measured_is_said(tmp_path):
    capture = moving(tmp_path)
    deep, flat = (
        MasksMode(Capture(tmp_path, replace(capture.description, depth=depth)), MarksSegmentation())
        for depth in ("measured", "none")
    )
    deep.write("none", marked((80, 10), (84, 10), (84, 14)))
    with pytest.raises(InputError, match="50 of its pixels must have depth; received"):
        deep.measure()
    with pytest.raises(InputError, match="obstacles are measured by depth"):
        flat.measure()
