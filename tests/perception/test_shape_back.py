"""The hull of one camera: depth holes carve, and its back is where the stated prior puts it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.config.perception import ShapePriorSettings
from neuspring.data.capture import OBJECT, CameraEntry, Writer
from neuspring.data.synthetic.make import looking
from neuspring.data.synthetic.meshes import capsule, sphere, surface
from neuspring.data.synthetic.render import Part, Renderer, quantized
from neuspring.perception.figures import lifted_figure
from neuspring.perception.results import LiftedTracks, Masks, ShapePrior
from neuspring.perception.sample import inside
from neuspring.perception.shape import front, round_chord, shape_prior, visual_hull
from tests.support.captures import FRAMES, K, describe

RADIUS = 0.05
EYE = np.array([0.5, 0.0, 0.35])
SETTINGS = ShapePriorSettings(voxel=0.004)
TWICE = np.diag([2.0, 2.0, 1.0]) @ K
"""A camera of 240 x 136 pixels: 3 mm each at the object."""


def film(folder, body, box, eyes=(EYE,)):
    """Capture, masks, the cloud that the cameras saw, and the truth, of a still body at a height of 0.2 m."""
    vertices, faces = surface(body, *box, 0.004)
    renderer = Renderer([Part(vertices, faces, np.full((len(vertices), 3), 0.5), OBJECT, (30.0, 0.3))])
    renderer.move([vertices])
    poses = [looking(eye, np.array([0.0, 0.0, 0.2])) for eye in eyes]
    entries = tuple(
        CameraEntry(
            name=str(k),
            width=240,
            height=136,
            intrinsics=tuple(map(tuple, TWICE.tolist())),
            camera_to_world=tuple(map(tuple, pose.tolist())),
        )
        for k, pose in enumerate(poses)
    )
    writer = Writer(folder, describe(cameras=entries))
    cloud, masks = [], {}
    for name, camera in writer.capture.cameras.items():
        view = renderer.render(camera)
        for frame in range(FRAMES):
            writer.frame(name, frame, view.color, quantized(view.depth, 0.001), view.label)
        y, x = np.nonzero(view.label == OBJECT)
        cloud.append(camera.lift(np.stack([x, y], axis=1).astype(float), view.depth[y, x].astype(float)))
        masks[name] = Masks(labels=np.repeat(view.label[None], FRAMES, axis=0), backend="given")
    return writer.finish(), masks, np.concatenate(cloud), ShapePrior(vertices=vertices, faces=faces, backend="truth")


def ball(folder, eyes=(EYE,)):
    return film(folder, sphere((0, 0, 0.2), RADIUS), ((-0.07, -0.07, 0.13), (0.07, 0.07, 0.27)), eyes)


def overlap(first: ShapePrior, second: ShapePrior) -> float:
    points = np.random.default_rng(0).uniform((-0.25, -0.12, 0.0), (0.12, 0.12, 0.32), (20000, 3))
    a, b = inside(first, points), inside(second, points)
    return float((a & b).sum() / (a | b).sum())


def volume(prior: ShapePrior) -> float:
    corners = prior.vertices[prior.faces].astype(float)
    return float((np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6.0)


@pytest.mark.parametrize(("changes", "least"), [({"back": "symmetry"}, 0.8), ({"back": "fraction", "back_fraction": 1.0}, 0.8)])
def test_one_camera_and_a_prior_find_a_ball(tmp_path, changes, least):
    capture, masks, cloud, truth = ball(tmp_path)
    without = visual_hull(capture, masks, cloud, replace(SETTINGS, back="none"))
    hull = visual_hull(capture, masks, cloud, replace(SETTINGS, **changes))
    assert overlap(hull, truth) > max(least, overlap(without, truth) + 0.05)
    assert volume(hull) == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=0.25)


def test_thickness_goes_with_the_fraction(tmp_path):
    capture, masks, cloud, _ = ball(tmp_path)
    thin, thick = (
        visual_hull(capture, masks, cloud, replace(SETTINGS, back="fraction", back_fraction=share)) for share in (0.5, 1.0)
    )
    assert volume(thick) == pytest.approx(2.0 * volume(thin), rel=0.2)


def test_an_oblique_rod_is_as_thick_as_it_is_wide(tmp_path):
    """Its middle lies in no plane perpendicular to the view."""
    rod = film(tmp_path, capsule((0.08, -0.06, 0.15), (-0.08, 0.06, 0.25), 0.03), ((-0.13, -0.11, 0.1), (0.13, 0.11, 0.3)))
    hull = visual_hull(*rod[:3], replace(SETTINGS, back="symmetry"))
    assert overlap(hull, rod[3]) > 0.7


def test_several_cameras_carve_the_back_and_guess_nothing(tmp_path):
    capture, masks, cloud, _ = ball(tmp_path, (EYE, np.array([-0.5, 0.1, 0.4])))
    hulls = [visual_hull(capture, masks, cloud, replace(SETTINGS, back=how)) for how in ("none", "symmetry", "fraction")]
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
        lifted = LiftedTracks(
            object_points=np.repeat(cloud[None, :50], 2, axis=0),
            object_visibility=np.ones((2, 50), bool),
            object_motion_valid=np.ones((2, 50), bool),
            object_colors=np.zeros((50, 3)),
            controller_points=np.zeros((2, 1, 3)),
            cloud=cloud,
            cloud_colors=np.zeros((len(cloud), 3)),
            backend="x",
        )
        pictures.append(cv2.imread(str(lifted_figure(lifted, shown, tmp_path / "lifted.png"))).astype(int))
    # Orange is there where something is invented: much red, some green, little blue (BGR).
    orange = [int(((image[..., 2] > 220) & (image[..., 0] < 160) & (image[..., 1] > 120)).sum()) for image in pictures]
    assert orange[0] > orange[1] + 100
