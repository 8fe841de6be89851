"""Frame 0 without depth: what lies on the table, and what hands hide."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from neuspring.config.perception import ColorSettings, Perception, Sampling
from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT
from neuspring.perception.color import FirstFrame, beneath_hands, camera_depth, from_color
from neuspring.perception.results import Masks, PixelTracks
from neuspring.perception.sample import structure
from neuspring.perception.track_opencv import choose
from tests.support.colored import HEIGHT, WIDTH, camera, paint

PIXEL = 0.005
"""m: the width of a pixel at 0.8 m."""


def capture_of(category: str, up: str = "+z") -> SimpleNamespace:
    view = camera(np.zeros(3))
    described = SimpleNamespace(up_sign=up_sign(up), category=category)
    return SimpleNamespace(folder=Path("painted"), cameras={"0": view}, description=described, frame_count=1, train_end=1)


def shown(corners: list[list[float]]) -> np.ndarray:
    """Labels of a thing on the table with these corners, m."""
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    pixels = camera(np.zeros(3)).project(np.array([[*corner, 0.0] for corner in corners]))[0]
    cv2.fillPoly(labels, [np.round(pixels).astype(np.int32)], OBJECT)
    return labels


SQUARE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]


def object_points(first: FirstFrame) -> np.ndarray:
    y, x = np.nonzero(first.filled)
    return first.points(np.stack([x, y], axis=1))


def test_a_sheet_has_its_size_on_the_table():
    first = FirstFrame.of(capture_of("cloth"), shown(SQUARE), ColorSettings(sheet_thickness=0.002))
    points = object_points(first)
    np.testing.assert_allclose(points[:, 2], 0.001, atol=1e-9)
    # Rows of pixels are 1.6 times as far apart on the table, seen at 40 degrees.
    np.testing.assert_allclose(points[:, :2].max(axis=0), 0.1, atol=1.6 * PIXEL)
    np.testing.assert_allclose(points[:, :2].min(axis=0), -0.1, atol=1.6 * PIXEL)
    assert first.pixel_size == pytest.approx(0.8 / 180, rel=0.02)


def test_a_rope_is_as_thick_as_it_is_wide():
    first = FirstFrame.of(capture_of("rope"), shown([[-0.15, -0.02], [0.15, -0.02], [0.15, 0.02], [-0.15, 0.02]]), ColorSettings())
    upper = object_points(first)[:, 2]
    # 4 cm of the table are 2.6 cm in the image at 40 degrees.
    assert np.median(upper[upper > 0.5 * upper.max()]) == pytest.approx(0.0257, abs=1.5 * PIXEL)
    assert upper.min() > 0


def test_a_body_rests_on_the_table_and_its_silhouette_is_that_of_the_mask():
    settings = ColorSettings(body_thickness=0.8)
    labels = shown(SQUARE)
    first = FirstFrame.of(capture_of("zebra"), labels, settings)
    y, x = np.nonzero(labels == OBJECT)
    pixels = np.stack([x, y], axis=1)
    upper, lower = first.points(pixels), first.camera.lift(pixels.astype(float), first.depths(0.0)[y, x])
    np.testing.assert_allclose(lower[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(first.camera.project(upper)[0], pixels, atol=1e-6)
    np.testing.assert_allclose(first.fingers(pixels)[:, 2], 0.5 * upper[:, 2], atol=1e-9)
    half = 0.5 * 0.2 * np.sin(np.deg2rad(40))
    assert upper[:, 2].max() == pytest.approx(0.8 * 2 * half, rel=0.15)


def test_up_may_be_minus_z():
    view = camera(np.zeros(3))
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    capture = capture_of("zebra", "-z")
    capture.cameras = {"0": replace(view, camera_to_world=turn @ view.camera_to_world)}
    first = FirstFrame.of(capture, shown(SQUARE), ColorSettings())
    assert object_points(first)[:, 2].max() <= 0
    assert object_points(first)[:, 2].min() < -0.05


def test_what_a_hand_hides_between_parts_of_the_object_belongs_to_it():
    labels = shown(SQUARE)
    y, x = (int(v.mean()) for v in np.nonzero(labels == OBJECT))
    cv2.circle(labels, (x, y), 4, HANDS, -1)
    outside = np.zeros_like(labels)
    outside[5:15, 5:15] = 1
    labels[outside > 0] = HANDS
    filled = beneath_hands(labels, reach=8)
    assert filled[y, x]
    assert not filled[outside > 0].any()
    assert filled[labels == OBJECT].all()


def test_an_object_above_the_horizon_is_refused():
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[:5] = OBJECT
    capture = capture_of("cloth")
    view = capture.cameras["0"]
    level = view.camera_to_world.copy()
    level[:3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], axis=1)
    capture.cameras = {"0": replace(view, camera_to_world=level)}
    with pytest.raises(InputError, match="must look at the table"):
        FirstFrame.of(capture, labels, ColorSettings())
    with pytest.raises(InputError, match="must be in view"):
        FirstFrame.of(capture_of("cloth"), 0 * labels, ColorSettings())


def test_rays_beyond_the_horizon_never_meet_the_table():
    view = camera(np.zeros(3), elevation=5.0)
    assert np.isinf(camera_depth(view, np.array([[80.0, 0.0]]), 0.0)).all()


@pytest.mark.parametrize("category", ["cloth", "rope", "zebra"])
def test_observations_of_a_painted_capture(tmp_path, category):
    """Nodes where the square is, controllers at its far edge; a body's hull is closed and above the table."""
    capture = paint(tmp_path, category)
    labels = np.stack([capture.mask("0", frame) for frame in range(capture.frame_count)])
    start = choose(labels[0], 600, 0)
    still = np.repeat(start[None], capture.frame_count, axis=0)
    tracks = PixelTracks(pixels=still, visible=np.ones(still.shape[:2], bool), backend="test")
    masks = {"0": Masks(labels=labels, backend="given")}
    settings = Perception(sample=Sampling(voxel=0.01, nodes=300))
    lifted, prior, image = from_color(capture, masks, {"0": tracks}, settings)
    assert image.hands == 1
    assert not image.visible[capture.train_end :].any()
    assert len(image.inside) == capture.train_end
    assert abs(lifted.controller_points[0, :, 1].mean() - 0.1) < 0.03
    # It rises by 28 mm in a plane that faces the camera.
    rise = lifted.controller_points[-1].mean(axis=0) - lifted.controller_points[0].mean(axis=0)
    np.testing.assert_allclose(rise, [0, 0, 0.028], atol=0.006)
    indices, surface, interior, _ = structure(lifted, prior, settings.sample, 1.0, 0, image.visible.sum(axis=0))
    nodes = np.concatenate([lifted.object_points[0, indices], surface, interior])
    assert np.abs(nodes[:, 0]).max() < 0.1 + 2 * PIXEL
    assert nodes[:, 2].min() >= 0
    if category == "cloth":
        assert not len(prior.faces)
    else:
        corners = prior.vertices[prior.faces].astype(float)
        volume = (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6
        assert volume > 0.2 * 0.2 * 0.02
        # Nodes lie on the table, and do not fall to it.
        assert nodes[:, 2].min() < 0.01
        assert 0.1 < prior.facts["invented_share"] < 0.9
