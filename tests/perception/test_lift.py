"""From pixels to the world: cleaned masks, agreement of motion, controllers, and their limits."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import Lift
from neuspring.core.errors import InputError
from neuspring.core.geometry import farthest
from neuspring.data.capture import HANDS, OBJECT, Capture, Writer
from neuspring.data.results import Masks, PixelTracks
from neuspring.perception import lift as lifting
from neuspring.perception.controllers import GRASP_REACH, choose_controllers, fill_rigidly, hands_of, rigid_motion
from tests.support.captures import FRAMES, describe, entry

SETTINGS = Lift(neighborhood=0.045, least_controllers=3)


@pytest.fixture(autouse=True)
def few_pixels(monkeypatch):
    """Images of 32 x 24 pixels show 40 neighbors only where the limit is that of a shorter focal length."""
    monkeypatch.setattr(lifting, "OUTLIER_NEIGHBORS", 460.0)


NEAR = np.zeros((1, 3))
"""An object's cloud, for hands whose distance from it does not matter."""


@pytest.fixture
def scene(tmp_path):
    """One camera that looks straight down at 0.9 m: an object on the left, a hand on the right, both half a pixel further right
    in every frame. Depth is 0.8 m there, 0.9 m on the table."""
    writer = Writer(tmp_path, describe())
    for frame in range(FRAMES):
        labels = np.zeros((24, 32), np.uint8)
        labels[6:16, 4 + frame // 2 : 14 + frame // 2] = OBJECT
        labels[6:16, 18 + frame // 2 : 28 + frame // 2] = HANDS
        depth, color = np.where(labels > 0, 800, 900).astype(np.uint16), np.full((24, 32, 3), 40 * labels[..., None], np.uint8)
        # Noise in a corner: images that are equal to the bit are no new ones.
        depth[0, 0], color[0, 0] = 900 + frame, frame
        writer.frame("0", frame, color, depth, labels)
    return writer.finish()


def masks_of(capture):
    return {"0": Masks(labels=np.stack([capture.mask("0", f) for f in range(FRAMES)]), backend="given")}


def tracks_of(capture):
    y, x = np.nonzero(capture.mask("0", 0))
    start = np.stack([x, y], axis=1).astype(float)
    pixels = start + np.arange(FRAMES)[:, None, None] // 2 * [1.0, 0.0]
    return {"0": PixelTracks(pixels=pixels, visible=np.ones(pixels.shape[:2], bool), backend="opencv")}


def test_points_lie_where_the_camera_saw_them(scene):
    lifted = lifting.lift_tracks(scene, masks_of(scene), tracks_of(scene), SETTINGS)
    assert lifted.object_points.shape == (FRAMES, 100, 3)
    assert lifted.object_visibility.all()
    assert lifted.object_motion_valid[:-1].all()
    assert not lifted.object_motion_valid[-1].any()
    camera = scene.cameras["0"]
    np.testing.assert_allclose(lifted.object_points[0].min(axis=0), camera.lift(np.array([4.0, 15.0]), np.array(0.8)), atol=1e-6)
    moved = lifted.object_points[-1] - lifted.object_points[0]
    np.testing.assert_allclose(moved, np.tile([2 * 0.8 / 40, 0, 0], (100, 1)), atol=1e-6)
    np.testing.assert_allclose(lifted.object_colors, 40 / 255, atol=1e-6)
    assert lifted.controller_points.shape == (FRAMES, 30, 3)
    assert len(lifted.cloud) == 100


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_repeated_images_show_nothing_of_the_object(scene, kind):
    for frame in (2, 3):
        shutil.copyfile(scene.path(kind, "0", 1), scene.path(kind, "0", frame))
    capture = Capture.load(scene.folder)
    assert capture.repeats["0"][kind] == [2, 3] and [capture.shows("0", frame) for frame in range(FRAMES)] == [1, 1, 0, 0, 1]
    lifted = lifting.lift_tracks(capture, masks_of(capture), tracks_of(capture), SETTINGS)
    assert lifted.object_visibility.all(axis=1).tolist() == [True, True, False, False, True]
    assert not lifted.object_visibility[2:4].any() and lifted.controller_points.shape[0] == FRAMES


def test_a_track_that_leaves_the_mask_is_invisible_and_zero(scene):
    tracks = tracks_of(scene)["0"]
    pixels = tracks.pixels.copy()
    pixels[2, 0] = [31.0, 23.0]
    lifted = lifting.lift_tracks(
        scene, masks_of(scene), {"0": PixelTracks(pixels=pixels, visible=tracks.visible, backend="x")}, SETTINGS
    )
    assert not lifted.object_visibility[2, 0]
    np.testing.assert_array_equal(lifted.object_points[2, 0], 0.0)
    assert lifted.object_visibility[3, 0]
    assert not lifted.object_motion_valid[[1, 2], 0].any()


def test_specks_and_depth_out_of_range_are_cleaned_away(scene, monkeypatch):
    masks = masks_of(scene)["0"]
    labels = masks.labels.copy()
    labels[:, 20, 3] = OBJECT
    clean, cloud, _ = lifting.clean_masks(scene, {"0": Masks(labels=labels, backend="x")}, SETTINGS.neighborhood)
    assert not clean["0"][:, 20, 3].any()
    np.testing.assert_array_equal(clean["0"], masks.labels)
    monkeypatch.setattr(lifting, "FARTHEST", 0.7)
    clean, cloud, _ = lifting.clean_masks(scene, masks_of(scene), SETTINGS.neighborhood)
    assert not clean["0"].any()
    assert not len(cloud)


def test_no_object_and_no_hand_are_named(scene):
    for label, message in ((OBJECT, "at least one tracked point must be on"), (HANDS, "at least 3 points of the hands")):
        labels = np.where(masks_of(scene)["0"].labels == label, 0, masks_of(scene)["0"].labels).astype(np.uint8)
        with pytest.raises(InputError, match=message):
            lifting.lift_tracks(scene, {"0": Masks(labels=labels, backend="x")}, tracks_of(scene), SETTINGS)


def grid(count=6):
    return np.stack(np.meshgrid(*[np.arange(count) * 0.004] * 2, [0.0]), axis=-1).reshape(-1, 3)


def test_a_point_that_moves_alone_is_not_trusted():
    points = np.stack([grid(), grid() + np.array([0.002, 0, 0])])
    points[1, 7] += [0.0, 0.0, 0.02]
    seen = lifting.Seen(points, np.ones(points.shape[:2], bool), np.zeros((36, 3)))
    assert np.flatnonzero(~lifting.agreeing_motion(seen, 0.01)[0]).tolist() == [7]


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(0)
    points = np.stack([grid(8), grid(8) + rng.normal(0, 0.002, (64, 3))])
    order = rng.permutation(64)
    first, second = (lifting.Seen(p, np.ones(p.shape[:2], bool), np.zeros((64, 3))) for p in (points, points[:, order]))
    valid = lifting.agreeing_motion(first, 0.01)
    assert 0 < valid[0].sum() < 64
    np.testing.assert_array_equal(valid[:, order], lifting.agreeing_motion(second, 0.01))


def test_few_neighbors_are_not_enough():
    for side, trusted in ((2, False), (3, True)):
        points = np.stack([grid(side), grid(side)])
        seen = lifting.Seen(points, np.ones(points.shape[:2], bool), np.zeros((side**2, 3)))
        assert lifting.agreeing_motion(seen, 0.01)[0].all() == trusted


def test_depth_at_an_edge_comes_from_the_same_mask():
    depth, inside = np.full((5, 5), 0.9), np.zeros((5, 5), bool)
    depth[:, :2], inside[:, :2] = 0.5, True
    depth[2, 1] = 0.53
    assert lifting.local_depth(depth, inside, np.array([1]), np.array([2]))[0] == pytest.approx(0.5)


def test_rigid_motions_are_recovered_and_fill_gaps():
    start = np.random.default_rng(0).uniform(-0.02, 0.02, (12, 3))
    rotation, shift = Rotation.from_rotvec([0.3, -0.2, 0.5]), np.array([0.1, 0.0, 0.2])
    recovered, offset = rigid_motion(start, rotation.apply(start) + shift)
    np.testing.assert_allclose(recovered.as_matrix(), rotation.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(offset, shift, atol=1e-9)
    points = np.stack([start, rotation.apply(start) + shift, start])
    trusted = np.ones((3, 12), bool)
    trusted[1, :5] = False
    damaged = np.where(trusted[..., None], points, 0.0)
    np.testing.assert_allclose(fill_rigidly(damaged, trusted), points, atol=1e-9)


def grasp(frames=8):
    """Two hands of 150 points each that turn and move in their own ways, [T, 300, 3]; the object's cloud; the hands' turns. Each
    hand reaches 15 cm away from the object."""
    rng = np.random.default_rng(1)
    cloud = rng.uniform([-0.05, -0.02, 0.0], [0.05, 0.02, 0.02], (400, 3))
    arm = rng.uniform([0.0, -0.03, 0.0], [0.15, 0.03, 0.04], (2, 150, 3)) * np.array([[[-1.0, 1, 1]], [[1.0, 1, 1]]])
    arm[0, :, 0] -= 0.06
    arm[1, :, 0] += 0.08
    turns = [Rotation.from_rotvec(np.linspace(0, 1, frames)[:, None] * turn) for turn in ([0.4, 0.1, -0.3], [-0.2, 0.5, 0.2])]
    shifts = np.linspace(0, 1, frames)[:, None] * [[0.1, 0.0, 0.2]], np.linspace(0, 1, frames)[:, None] * [[-0.2, 0.1, 0.1]]
    moving = [
        np.stack([one.apply(part) + shift for one, shift in zip(turn, way, strict=True)])
        for part, turn, way in zip(arm, turns, shifts, strict=True)
    ]
    return np.concatenate(moving, axis=1), cloud, rng.random((frames, 300)) < 0.5, turns


PATCH = Lift(grip="patch", controller_gaps="rigid", controller_share=0.1)


def test_patches_lie_near_the_object_and_move_rigidly_with_their_hand():
    points, cloud, seen, _ = grasp()
    seen[0] = True
    controllers, facts = choose_controllers(np.where(seen[..., None], points, 0.0), seen, seen, cloud, PATCH, "here")
    assert controllers.shape == (8, 30, 3)
    # Each is a point of the hands throughout, hidden or not: it has gone where the hand has.
    distance, own = cKDTree(points[0]).query(controllers[0])
    assert distance.max() == 0
    np.testing.assert_allclose(controllers, points[:, own], atol=1e-9)
    assert facts["patch_misfit_mm"] < 1e-6
    from_object = cKDTree(cloud).query(points[0])[0]
    for hand in (range(150), range(150, 300)):
        part = [k for k in own if k in hand]
        assert part, "every hand holds"
        assert from_object[part].max() <= from_object[hand].min() + GRASP_REACH
    spread, _ = choose_controllers(points, seen | True, seen | True, cloud, replace(PATCH, grip="points"), "here")
    assert cKDTree(cloud).query(spread[0])[0].max() > 0.1, "forearm and all"


def test_the_misfit_of_patches_is_the_noise_in_mm():
    points, cloud, _, _ = grasp()
    seen, noise = np.ones(points.shape[:2], bool), np.random.default_rng(2).normal(0, 0.002, points.shape)
    noise[0] = 0
    _, facts = choose_controllers(points + noise, seen, seen, cloud, PATCH, "here")
    # Seven of eight frames have three coordinates of noise, less what the six fitted numbers take up.
    assert facts["patch_misfit_mm"] == pytest.approx(2.0 * np.sqrt(3 * 7 / 8), rel=0.05)


def test_a_hand_that_has_yet_to_come_grips_with_what_is_foremost_and_a_small_patch_is_named():
    points, cloud, _, _ = grasp()
    seen = np.ones(points.shape[:2], bool)
    controllers, _ = choose_controllers(points, seen, seen, cloud - np.array([0.5, 0, 0]), PATCH, "here")
    assert (controllers[0, :, 0] < -0.1).any()
    assert (controllers[0, :, 0] > 0.05).any()
    with pytest.raises(InputError, match=r"near the object in frame 0.*least_controllers"):
        choose_controllers(points, seen, seen, cloud, replace(PATCH, least_controllers=300), "here")


@pytest.mark.parametrize(("second", "hands"), [(8, [8, 8]), (2, [10])])
def test_hands_apart_move_apart_and_two_points_apart_follow_the_nearest_hand(second, hands):
    rng = np.random.default_rng(0)
    start = np.concatenate([rng.uniform(0, 0.03, (8, 3)), rng.uniform(0, 0.03, (second, 3)) + np.array([0.3, 0, 0])])
    assert [len(hand) for hand in hands_of(start)] == hands
    down = -0.05 if second == 8 else 0.1
    points = np.stack([start, start + np.repeat([[0, 0, 0.1], [0, 0, down]], [8, second], axis=0)])
    trusted = np.ones((2, 8 + second), bool)
    trusted[1, [0, 9]] = False
    np.testing.assert_allclose(fill_rigidly(np.where(trusted[..., None], points, 0.0), trusted), points, atol=1e-9)


def test_a_small_camera_keeps_what_it_alone_sees(tmp_path):
    """Beside a camera of many pixels one of few would lose its view, were both held to the same number of neighbors."""
    few, many = entry("few", 32, 24), entry("many", 32, 24)
    large = (*(tuple(4 * v for v in row) for row in many.intrinsics[:2]), many.intrinsics[2])
    many = replace(many, width=128, height=96, intrinsics=large)
    writer = Writer(tmp_path, describe(cameras=(few, many)))
    labels = np.zeros((24, 32), np.uint8)
    labels[6:16, 4:14] = OBJECT
    for frame in range(FRAMES):
        writer.frame("few", frame, np.zeros((24, 32, 3), np.uint8), np.full((24, 32), 800, np.uint16), labels)
        nothing = np.zeros((96, 128, 3), np.uint8)
        writer.frame("many", frame, nothing, np.full((96, 128), 800, np.uint16), nothing[..., 0])
    capture = writer.finish()
    masks = {n: Masks(labels=np.stack([capture.mask(n, f) for f in range(FRAMES)]), backend="given") for n in capture.cameras}
    clean, _, _ = lifting.clean_masks(capture, masks, SETTINGS.neighborhood)
    assert clean["few"][0].sum() == labels.sum()


def test_released_controllers_are_visible_throughout():
    points = np.repeat(grid(6)[None], 4, axis=0)
    visible, valid = np.ones((4, 36), bool), np.ones((4, 36), bool)
    visible[2, :10], valid[1, 10:20] = False, False
    controllers, facts = choose_controllers(points, visible, valid, NEAR, Lift(least_controllers=16), "here")
    assert facts["hand_tracks_kept"] == 16
    assert controllers.shape == (4, 16, 3)
    with pytest.raises(InputError, match=r"here: at least 17 points of the hands.*received 16 of 36"):
        choose_controllers(points, visible, valid, NEAR, Lift(least_controllers=17), "here")
    # With gaps filled, everything that is seen in enough frames counts.
    _, facts = choose_controllers(points, visible, valid, NEAR, Lift(controller_gaps="rigid", controller_share=0.7), "here")
    assert facts["hand_tracks_kept"] == 36


def test_farthest_points_are_spread():
    line = np.stack([np.linspace(0, 1, 101), np.zeros(101), np.zeros(101)], axis=1)
    assert farthest(line, 3).tolist() == [0, 100, 50]
    assert farthest(line[:2], 5).tolist() == [0, 1]
