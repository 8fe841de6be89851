"""Hands in the image and in space, and which future frames are read."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.config import Config
from neuspring.data.capture import HANDS, OBJECT
from neuspring.data.results import PixelTracks
from neuspring.extensions.color_alone.first_frame import FirstFrame
from neuspring.extensions.color_alone.hands import along_arms, follow_hands, grips, place
from neuspring.extensions.color_alone.lift import lift_color, silhouettes
from neuspring.intake.points import read
from neuspring.stages.lift import lift
from neuspring.stages.segment import segment
from neuspring.stages.track import track
from tests.support import colored
from tests.support.colored import camera, paint

SIZE = 240
PIXEL32 = 1e-4
"""Pixels are stored in single precision: 1e-5 px at 1 m are far less than this, m."""


class Film:
    """A speckled hand that moves, turns and grows before a still background."""

    def __init__(self, frames=14):
        rng = np.random.default_rng(0)
        texture = cv2.GaussianBlur(rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8), (0, 0), 2.0)
        texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
        self.background = cv2.GaussianBlur(rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8), (0, 0), 2.0)
        hand = np.zeros((SIZE, SIZE), np.uint8)
        cv2.rectangle(hand, (90, 60), (150, 130), HANDS, -1)
        self.frame_count = frames
        self.colors, self.labels, self.true = [], [], []
        for frame in range(frames):
            angle, size = 0.02 * frame, 1.02**frame
            matrix = cv2.getRotationMatrix2D((120, 95), -np.rad2deg(angle), size)
            matrix[:, 2] += [2.0 * frame, -1.0 * frame]
            labels = cv2.warpAffine(hand, matrix, (SIZE, SIZE), flags=cv2.INTER_NEAREST)
            moved = cv2.warpAffine(texture, matrix, (SIZE, SIZE))
            self.labels.append(labels)
            self.colors.append(np.where(labels[..., None] == HANDS, moved, self.background).astype(np.uint8))
            self.true.append((matrix @ [120, 125, 1], angle, size))

    def has(self, camera, frame):
        return True

    def color(self, camera, frame):
        return self.colors[frame]


def test_a_hand_is_followed_with_its_turn_and_size():
    film = Film()
    grip = np.array([[120, 125]])
    motion = follow_hands(film, "0", np.stack(film.labels), [grip], radius=60)
    places, angles, sizes = (np.array([one[k] for one in film.true]) for k in range(3))
    assert motion.lost == 0
    np.testing.assert_allclose(motion.centers[:, 0], places, atol=1.0)
    np.testing.assert_allclose(motion.angles[:, 0], angles, atol=0.03)
    np.testing.assert_allclose(motion.sizes[:, 0], sizes, rtol=0.03)


def test_only_pixels_of_hands_are_read():
    film, other = Film(), Film()
    pairs = zip(film.colors, film.labels, strict=True)
    other.colors = [np.where(labels[..., None] == HANDS, color, 255 - color) for color, labels in pairs]
    grip = np.array([[120, 125]])
    one, two = (follow_hands(each, "0", np.stack(film.labels), [grip], radius=60) for each in (film, other))
    np.testing.assert_array_equal(one.centers, two.centers)
    np.testing.assert_array_equal(one.sizes, two.sizes)


def test_a_hand_that_disappears_goes_on_for_a_moment_and_is_counted():
    film = Film()
    labels = np.stack(film.labels)
    labels[8:] = 0
    motion = follow_hands(film, "0", labels, [np.array([[120, 125]])], radius=60)
    assert motion.lost == 6
    assert np.isfinite(motion.centers).all()
    assert np.abs(motion.centers[-1] - motion.centers[7]).max() < 10


def test_a_hand_that_is_seen_again_is_where_frame_0_says():
    film = Film()
    labels = np.stack(film.labels)
    labels[4:8] = 0
    motion = follow_hands(film, "0", labels, [np.array([[120, 125]])], radius=60)
    np.testing.assert_allclose(motion.centers[8:, 0], [place for place, _, _ in film.true[8:]], atol=1.5)


def test_two_hands_are_told_apart_and_specks_are_none():
    labels = np.zeros((SIZE, SIZE), np.uint8)
    labels[100:160, 40:200] = OBJECT
    labels[60:104, 40:60], labels[60:104, 180:200] = HANDS, HANDS
    labels[98:100, 120:122] = HANDS
    held = grips(labels, labels == OBJECT, reach=8, apart=20)
    assert [round(one[:, 0].mean()) for one in held] == [50, 189]
    far = np.where(labels == OBJECT, OBJECT, 0)
    far[20:40, 100:120] = HANDS
    (nearest,) = grips(far, far == OBJECT, reach=8, apart=20)
    assert nearest[:, 1].min() >= 36
    assert not grips(np.where(labels == OBJECT, OBJECT, 0), labels == OBJECT, 8, 20)


def test_fingers_above_a_sheet_hold_it_and_not_all_that_the_hand_hides():
    labels = np.zeros((SIZE, SIZE), np.uint8)
    labels[60:200, 20:220] = OBJECT
    # An arm that enters from the left and turns down: its tip is the pixel farthest along it, not the one farthest from its entry.
    labels[80:100, :150], labels[100:150, 130:150] = HANDS, HANDS
    (all_of_it,) = grips(labels, labels == OBJECT, reach=8, apart=20)
    (held,) = grips(labels, labels == OBJECT, reach=8, apart=20, length=25)
    assert np.ptp(all_of_it, axis=0).min() > 60
    assert held[:, 1].max() == 149
    assert np.ptp(held[:, 1]) <= 25
    assert held[:, 0].min() >= 130
    assert {tuple(pixel) for pixel in held} < {tuple(pixel) for pixel in all_of_it}
    # Where no arm enters the image, nothing says where its tip is.
    labels[:, :40] = 0
    assert len(grips(labels, labels == OBJECT, 8, 20, length=25)[0]) == len(grips(labels, labels == OBJECT, 8, 20)[0])


def test_the_way_along_an_arm_is_within_its_mask():
    arm = np.zeros((40, 60), bool)
    arm[10:14, :50], arm[10:36, 46:50] = True, True
    along = along_arms(arm)
    assert along[11, 0] == 0
    assert along[11, 40] == pytest.approx(40, abs=1)
    # Around the corner: 46 to the right and 25 down, corners cut by diagonals.
    assert 60 < along[35, 49] < 49 + 25
    assert not along[~arm].any()


@pytest.mark.parametrize(("category", "fingers"), [("cloth", True), ("toy", False)])
def test_sheets_alone_are_held_by_fingers_alone(tmp_path, monkeypatch, category, fingers):
    capture = paint(tmp_path, category=category, frames=3)
    labels = np.stack([capture.mask("0", frame) for frame in range(3)])
    y, x = np.nonzero(labels[0] == HANDS)
    # The painted hand gets an arm.
    labels[0, : y.max(), x.min() : x.max()] = HANDS
    first = FirstFrame.of(capture, labels[0])
    y, x = np.nonzero(labels[0] == OBJECT)
    pixels = np.repeat(np.stack([x, y], axis=1)[None, ::50].astype(np.float32), 3, axis=0)
    tracks = PixelTracks(pixels=pixels, visible=np.ones(pixels.shape[:2], bool), backend="test")
    monkeypatch.setattr("neuspring.extensions.color_alone.lift.GRIP_LENGTH", 3 * first.pixel_size)
    _, image = lift_color(capture, labels, tracks, first, read(capture))
    assert (len(image.hand_of) < 30) == fingers


def seen_on(path):
    """Images of one hand of four points that moves along `path` [T, 3], m, without rotation."""
    view, frames = camera(path[0]), len(path)
    return replace(
        colored.observed().image,
        intrinsics=view.intrinsics,
        camera_to_world=view.camera_to_world,
        hand_centers=view.project(path[:, None])[0],
        hand_angles=np.zeros((frames, 1)),
        hand_sizes=np.ones((frames, 1)),
        pixels=np.zeros((frames, 1, 2)),
        visible=np.zeros((frames, 1), bool),
        marked=np.zeros((frames, 0, 2)),
        hand_of=np.zeros(4, int),
    )


def way(direction):
    """A wavy way of 20 cm in a direction."""
    share = np.linspace(0, 1, 12)[:, None]
    return np.array([0.05, 0.1, 0.02]) + 0.2 * share * direction + 0.02 * np.sin(3 * share) * [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("direction", "ground"), [((0, 0, 1), True), ((0, -1, 0), True), ((0, 0, -1), False)])
def test_hands_move_upright_and_above_a_table_not_below_their_grip(direction, ground):
    """The camera looks along y. A hand that rises is where it is, and so is one that is pulled towards the camera on the table, or
    goes down where there is no table."""
    path = way(direction)
    grip = path[0] + 0.01 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    placed = place(seen_on(path), grip, ground=ground)
    np.testing.assert_allclose(placed[0], grip, atol=1e-12)
    np.testing.assert_allclose(placed.mean(axis=1), path, atol=PIXEL32)


def test_a_hand_that_goes_away_counts_as_one_that_rises():
    path = way((0, 1, 0))
    placed = place(seen_on(path), np.repeat(path[:1], 4, axis=0)).mean(axis=1)
    np.testing.assert_allclose(placed[:, 1], path[0, 1], atol=PIXEL32)
    assert placed[-1, 2] - placed[0, 2] > 0.1


def test_seen_from_above_up_in_the_image_is_the_plane_s_normal():
    path = way((1, 0, 0))
    view = camera(path[0], elevation=90.0)
    image = replace(seen_on(path), camera_to_world=view.camera_to_world, hand_centers=view.project(path[:, None])[0])
    np.testing.assert_allclose(place(image, np.repeat(path[:1], 4, axis=0)).mean(axis=1), path, atol=PIXEL32)


def test_a_patch_is_rigid_and_turns_about_the_ray():
    path = np.repeat(way((0, 0, 1))[:1], 12, axis=0)
    image = replace(seen_on(path), hand_angles=np.linspace(0, 1.0, 12)[:, None])
    grip = path[0] + 0.02 * np.random.default_rng(0).normal(size=(4, 3))
    placed = place(image, grip - grip.mean(axis=0) + path[0])
    apart = np.linalg.norm(placed[:, :, None] - placed[:, None], axis=-1)
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-12)
    view = camera(path[0])
    start, end = (view.project(placed[frame])[0] - image.hand_centers[0, 0] for frame in (0, -1))
    turned = np.arctan2(end[:, 1], end[:, 0]) - np.arctan2(start[:, 1], start[:, 0])
    # Perspective bends angles by less than a tenth of a radian over 2 cm.
    np.testing.assert_allclose(np.angle(np.exp(1j * (turned - 1.0))), 0.0, atol=0.1)


def test_silhouettes_of_frames():
    labels = np.zeros((2, 64, 62), np.uint8)
    labels[0, 20:40, 20:40], labels[0, 10:20, 20:40] = OBJECT, HANDS
    found = silhouettes(labels, 50)
    inside = found["inside"][0].astype(int)
    assert (labels[0, inside[:, 1], inside[:, 0]] == OBJECT).all()
    assert found["outside"].shape == (2, 16, 16)
    # Hands hide what is behind them: they are not outside.
    assert found["outside"][0, 3, 7] == 0
    # Cell (7, 0) is centered at (1.5, 29.5).
    assert found["outside"][0, 7, 0] == pytest.approx(20 - 1.5, abs=0.5)
    # A frame without the object says nothing.
    assert np.isnan(found["inside"][1]).all()
    assert not found["outside"][1].any()


def test_nothing_of_the_object_is_read_in_future_frames(tmp_path):
    """All that is not hand is painted over in future frames: perception hands on the same."""
    made = []
    for name, spoiled in (("plain", False), ("spoiled", True)):
        capture = paint(tmp_path / name, spoiled=spoiled)
        out = tmp_path / f"{name}_out"
        given = {"capture": capture.folder / "capture.json", "settings": Config()}
        one = given | {"camera": "0", "device": "cpu"}
        segment(output=out / "masks.json", **one)
        track(masks=out / "masks.json", output=out / "tracks.json", **one)
        lift(masks=[out / "masks.json"], tracks=[out / "tracks.json"], output=out / "lifted.json", **given)
        made.append({file: np.load(out / file) for file in ("image.npz", "lifted.npz")})
    # The painted hand rises by 4 mm per frame; its middle is painted at a whole pixel, 4 mm wide.
    hands = made[0]["lifted.npz"]["controller_points"].mean(axis=1)
    np.testing.assert_allclose(hands - hands[0], 0.004 * np.arange(len(hands))[:, None] * colored.UP, atol=0.004)
    for file, arrays in made[0].items():
        for name in arrays.files:
            if name != "meta":
                np.testing.assert_array_equal(arrays[name], made[1][file][name], err_msg=f"{file}: {name}")
