"""Frame 0 without depth: objects on the table, and areas that hands hide."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from neuspring.config.perception import Perception, Sampling
from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT
from neuspring.data.results import Masks, PixelTracks
from neuspring.extensions.color_alone.first_frame import SHEET_THICKNESS, FirstFrame, beneath_hands, camera_depth
from neuspring.extensions.color_alone.lift import lift
from neuspring.perception.sample import structure
from neuspring.perception.track_opencv import choose
from tests.support.colored import HEIGHT, WIDTH, camera, paint

PIXEL = 0.005
"""m: the width of a pixel at 0.8 m."""


def capture_of(category, up="+z", pose=None, view=None, ground=True):
    view = view or camera(np.zeros(3))
    described = SimpleNamespace(up_sign=up_sign(up), category=category, pose=pose, ground=ground)
    return SimpleNamespace(folder=Path("painted"), cameras={"0": view}, description=described, frame_count=1, train_end=1)


def shown(corners):
    """Labels of a thing on the table with these corners, m."""
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    pixels = camera(np.zeros(3)).project(np.array([[*corner, 0.0] for corner in corners]))[0]
    cv2.fillPoly(labels, [np.round(pixels).astype(np.int32)], OBJECT)
    return labels


SQUARE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]


def object_points(first):
    y, x = np.nonzero(first.filled)
    return first.points(np.stack([x, y], axis=1))


def test_a_sheet_has_its_size_on_the_table():
    first = FirstFrame.of(capture_of("cloth"), shown(SQUARE))
    points = object_points(first)
    np.testing.assert_allclose(points[:, 2], SHEET_THICKNESS / 2, atol=1e-9)
    # Rows of pixels are 1.6 times as far apart on the table, seen at 40 degrees.
    np.testing.assert_allclose(points[:, :2].max(axis=0), 0.1, atol=1.6 * PIXEL)
    np.testing.assert_allclose(points[:, :2].min(axis=0), -0.1, atol=1.6 * PIXEL)
    assert first.pixel_size == pytest.approx(0.8 / 180, rel=0.02)


def test_a_sheet_that_hangs_is_upright():
    """The camera looks along y; what is seen of the sheet is 25 cm deep on the table, and 15 to 20 cm high."""
    points = object_points(FirstFrame.of(capture_of("package", ground=False), shown(SQUARE)))
    assert np.ptp(points[:, 1]) < 2 * SHEET_THICKNESS
    assert 0.1 < np.ptp(points[:, 2]) < 0.2
    assert points[:, 2].min() == pytest.approx(0, abs=PIXEL)


def test_a_rope_is_as_thick_as_it_is_wide():
    first = FirstFrame.of(capture_of("rope"), shown([[-0.15, -0.02], [0.15, -0.02], [0.15, 0.02], [-0.15, 0.02]]))
    upper = object_points(first)[:, 2]
    # 4 cm of the table are 2.6 cm in the image at 40 degrees.
    assert np.median(upper[upper > 0.5 * upper.max()]) == pytest.approx(0.0257, abs=1.5 * PIXEL)
    assert upper.min() > 0


def filled_outline(points, elevation=40.0):
    """Labels of a convex body of these points [n, 3], m."""
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    pixels = camera(np.zeros(3), elevation=elevation).project(points)[0]
    cv2.fillConvexPoly(labels, cv2.convexHull(np.round(pixels).astype(np.int32)), OBJECT)
    return labels


def ball(radius):
    """Points [n, 3] of a sphere that rests on the table."""
    points = np.random.default_rng(0).normal(size=(4000, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True) + (0, 0, radius)


def box(x, y, z):
    """Corners [8, 3] of a box of these sides on the table."""
    return np.array([[a * x, b * y, c * z] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (0, 1)])


def sides(labels, pose):
    """Upper and lower points [n, 3], m, of a body in a pose that is as thick as it is wide."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuspring.extensions.color_alone.first_frame.BODY_THICKNESS", 1.0)
        first = FirstFrame.of(capture_of("toy", pose=pose), labels)
    y, x = np.nonzero(labels == OBJECT)
    pixels = np.stack([x, y], axis=1)
    upper, lower = first.points(pixels), first.camera.lift(pixels.astype(float), first.depths(0.0)[y, x])
    np.testing.assert_allclose(first.camera.project(upper)[0], pixels, atol=1e-6)
    assert (lower[:, 2] > -1e-9).all()
    np.testing.assert_allclose(first.fingers(pixels)[:, 2], 0.5 * (upper + lower)[:, 2], atol=1e-9)
    return upper, lower


@pytest.mark.parametrize("pose", [None, "lying", "standing"])
def test_a_ball_is_a_ball(pose):
    """Both of its sides are on the sphere, in every pose: nothing of it lies behind, and nothing rises."""
    radius = 0.07
    for side in sides(filled_outline(ball(radius)), pose):
        off = np.abs(np.linalg.norm(side - (0, 0, radius), axis=1) - radius)
        assert np.mean(off) < PIXEL
        assert np.quantile(off, 0.95) < 3 * PIXEL


@pytest.mark.parametrize("pose", [None, "standing"])
def test_a_box_that_stands_rises_from_where_it_touches_the_table(pose):
    upper, lower = sides(filled_outline(box(0.06, 0.06, 0.24)), pose)
    both = np.concatenate([upper, lower])
    assert both[:, 2].max() == pytest.approx(0.24, abs=0.03)
    assert np.abs(both[:, :2]).max() < 0.03 + 0.04
    # Laid onto the table it is as long as its shadow, 24 cm / tan(40 degrees).
    laid = sides(filled_outline(box(0.06, 0.06, 0.24)), "lying")[1]
    assert laid[:, 1].max() > 0.28
    assert laid[:, 2].max() < 0.12


@pytest.mark.parametrize(("x", "y"), [(0.3, 0.06), (0.15, 0.15)])
def test_a_box_that_lies_keeps_its_place(x, y):
    """With or without a known pose, if the object is not longer than wide in this view."""
    for pose in (None, "lying"):
        upper, lower = sides(filled_outline(box(x, y, 0.06)), pose)
        middle = 0.5 * (upper + lower)
        assert np.abs(middle[:, 0]).max() < 0.5 * x + 2 * PIXEL
        assert np.abs(middle[:, 1]).max() < 0.5 * y + 0.03
        assert lower[:, 2].min() == pytest.approx(0, abs=PIXEL)


def test_a_long_body_that_points_away_lies_only_if_the_capture_says_so():
    labels = filled_outline(box(0.05, 0.3, 0.05))
    unknown, lying = (sides(labels, pose)[0] for pose in (None, "lying"))
    assert np.ptp(lying[:, 1]) == pytest.approx(0.3, abs=0.05)
    assert lying[:, 2].max() < 0.07
    assert unknown[:, 2].max() > 0.15
    known = [FirstFrame.of(capture_of("toy", pose=pose), labels).facts for pose in (None, "lying")]
    assert known[0]["raised"] > 0.5
    assert known[1]["raised"] == 0
    assert known[0]["longest"] == pytest.approx(0.3, abs=0.05)


@pytest.mark.parametrize(("size", "elevation"), [((0.15, 0.18, 0.10), 50.0), ((0.20, 0.24, 0.06), 60.0)])
def test_a_compact_box_does_not_rise(size, elevation):
    """Its outline is one disc, which is as wide as it is."""
    capture = capture_of("toy", view=camera(np.zeros(3), elevation=elevation))
    assert FirstFrame.of(capture, filled_outline(box(*size), elevation)).facts["raised"] == 0


def test_up_may_be_minus_z():
    view = camera(np.zeros(3))
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    capture = capture_of("zebra", "-z", view=replace(view, camera_to_world=turn @ view.camera_to_world))
    first = FirstFrame.of(capture, shown(SQUARE))
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
    level = camera(np.zeros(3)).camera_to_world.copy()
    level[:3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], axis=1)
    with pytest.raises(InputError, match="must meet the table"):
        FirstFrame.of(capture_of("cloth", view=replace(camera(np.zeros(3)), camera_to_world=level)), labels)
    with pytest.raises(InputError, match="must be in view"):
        FirstFrame.of(capture_of("cloth"), 0 * labels)


def test_rays_beyond_the_horizon_never_meet_the_table():
    assert np.isinf(camera_depth(camera(np.zeros(3), elevation=5.0), np.array([[80.0, 0.0]]), 0.0)).all()


@pytest.mark.parametrize("category", ["cloth", "rope", "zebra"])
def test_observations_of_a_painted_capture(tmp_path, category):
    """Nodes where the square is, controllers at its far edge; a body's hull is closed and above the table."""
    capture = paint(tmp_path, category)
    labels = np.stack([capture.mask("0", frame) for frame in range(capture.frame_count)])
    start = choose(labels[0], 600)
    still = np.repeat(start[None], capture.frame_count, axis=0)
    tracks = PixelTracks(pixels=still, visible=np.ones(still.shape[:2], bool), backend="test")
    masks = {"0": Masks(labels=labels, backend="given")}
    settings = Perception(sample=Sampling(voxel=0.01, nodes=300))
    known = lift(capture, masks, {"0": tracks}, settings)
    lifted, prior, image = known.tracks, known.prior, known.image
    assert image.hands == 1
    assert not image.visible[capture.train_end :].any()
    assert len(image.inside) == capture.train_end
    # The hand holds the far edge: there in the image, and at half the height of what it holds.
    view, held = capture.cameras["0"], lifted.controller_points[0].astype(float)
    edge = view.project(np.array([0.0, 0.1, 0.0]))[0][1]
    assert abs(view.project(held)[0][:, 1].mean() - edge) < 3
    assert 0 < held[:, 2].mean() < 0.1
    if category == "cloth":
        assert abs(held[:, 1].mean() - 0.1) < 0.03
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
