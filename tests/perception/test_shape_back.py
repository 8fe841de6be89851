"""The hull of one camera: depth holes carve it, and the stated prior defines its back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.config.perception import ShapePriorSettings
from neuspring.data.capture import OBJECT
from neuspring.perception.figures import lifted_figure
from neuspring.perception.shape import front, round_chord, shape_prior, visual_hull
from neuspring.scenes.shapes import capsule, sphere
from tests.support.still import overlap, still, tracked

RADIUS = 0.05
EYE = np.array([0.5, 0.0, 0.35])
SETTINGS = ShapePriorSettings()


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Voxels of 4 mm, which are faster."""
    monkeypatch.setattr("neuspring.perception.shape.HULL_VOXEL", 0.004)


def film(folder, body, box, eyes=(EYE,)):
    """A body at a height of 0.2 m; pixels are 3 mm wide there."""
    return still(folder, body, box, eyes, (0.0, 0.0, 0.2), scale=2)


def ball(folder, eyes=(EYE,)):
    return film(folder, sphere((0, 0, 0.2), RADIUS), ((-0.07, -0.07, 0.13), (0.07, 0.07, 0.27)), eyes)


def volume(prior):
    corners = prior.vertices[prior.faces].astype(float)
    return float((np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6.0)


def test_one_camera_and_a_prior_find_a_ball(tmp_path):
    capture, masks, cloud, truth = ball(tmp_path)
    without = visual_hull(capture, masks, cloud, replace(SETTINGS, back="none"))
    hull = visual_hull(capture, masks, cloud, SETTINGS)
    assert overlap(hull, truth) > max(0.8, overlap(without, truth) + 0.05)
    assert volume(hull) == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=0.25)


def test_an_oblique_rod_is_as_thick_as_it_is_wide(tmp_path):
    """Its middle lies in no plane perpendicular to the view."""
    rod = film(tmp_path, capsule((0.08, -0.06, 0.15), (-0.08, 0.06, 0.25), 0.03), ((-0.13, -0.11, 0.1), (0.13, 0.11, 0.3)))
    assert overlap(visual_hull(*rod[:3], replace(SETTINGS, back="symmetry")), rod[3]) > 0.7


def test_several_cameras_carve_the_back_and_guess_nothing(tmp_path):
    capture, masks, cloud, _ = ball(tmp_path, (EYE, np.array([-0.5, 0.1, 0.4])))
    hulls = [visual_hull(capture, masks, cloud, replace(SETTINGS, back=how)) for how in ("none", "symmetry")]
    for hull in hulls:
        assert hull.backend == "visual_hull"
        np.testing.assert_array_equal(hull.vertices, hulls[0].vertices)


def test_pixels_without_depth_do_not_keep_voxels(tmp_path):
    """A disc of holes in the middle of the ball: what lies before its surface is carved as elsewhere."""
    capture, masks, cloud, truth = ball(tmp_path)
    whole = visual_hull(capture, masks, cloud, replace(SETTINGS, back="none"))
    path = capture.path("depth", "0", 0)
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    y, x = np.nonzero(masks["0"].labels[0] == OBJECT)
    cv2.circle(depth, (int(x.mean()), int(y.mean())), 9, 0, -1)
    cv2.imwrite(str(path), depth)
    holed = visual_hull(capture, masks, cloud, replace(SETTINGS, back="none"))
    assert volume(holed) == pytest.approx(volume(whole), rel=0.03)
    assert holed.facts["depth_filled"] > 0.1
    assert overlap(visual_hull(capture, masks, cloud, replace(SETTINGS, back="symmetry")), truth) > 0.75


def test_depth_far_behind_the_object_counts_as_none():
    mask = np.ones((5, 5), bool)
    depth = np.full((5, 5), 0.5)
    depth[2, 2], depth[0, 0] = 3.0, 0.0
    np.testing.assert_array_equal(front(mask, depth, 0.4, 0.6), np.full((5, 5), 0.5))
    assert not front(mask, depth, 0.8, 0.9).any()


def test_the_chord_of_a_bar_is_its_width_in_the_middle_and_falls_to_its_edge():
    bar = np.zeros((40, 60), bool)
    bar[10:31, 2:58] = True
    chord = round_chord(bar)
    assert chord[20, 30] == pytest.approx(21, abs=2)
    assert 0 < chord[10, 30] < chord[14, 30] < chord[20, 30]
    assert not chord[5].any()


def test_record_and_picture_say_what_is_invented(tmp_path):
    capture, masks, cloud, _ = ball(tmp_path)
    prior = shape_prior(capture, masks, cloud, SETTINGS)
    assert prior.backend == "visual_hull, back: symmetry"
    # Half of a ball faces a camera that is far away.
    assert prior.facts["invented_share"] == pytest.approx(0.5, abs=0.12)
    assert len(prior.seen) == len(prior.vertices)
    toward = (EYE - [0, 0, 0.2]) / np.linalg.norm(EYE - [0, 0, 0.2])
    height = (prior.vertices - np.array([0, 0, 0.2])) @ toward
    assert prior.seen[height > 0.03].mean() > 0.95
    assert prior.seen[height < -0.03].mean() < 0.05
    pictures = []
    for shown in (prior, replace(prior, seen=np.ones(len(prior.vertices), bool))):
        pictures.append(cv2.imread(str(lifted_figure(tracked(cloud[:50], 2), shown, tmp_path / "lifted.png"))).astype(int))
    # Orange is there where something is invented: much red, some green, little blue (BGR).
    orange = [int(((image[..., 2] > 220) & (image[..., 0] < 160) & (image[..., 1] > 120)).sum()) for image in pictures]
    assert orange[0] > orange[1] + 100
