"""The capture folder: files are read as they were written, and every error names the file, the field and the value."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.data.camera import Camera, CameraEntry
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture, Writer
from tests.support.captures import FRAMES, POSE, describe, entry, write


def edit(folder, **changes):
    path = folder / CAPTURE
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize("form", ["png", "npy"])
def test_what_is_written_is_read(tmp_path, form):
    tracks = np.random.default_rng(1).normal(size=(FRAMES, 3, 3)).round(6)
    tracks[2, 1] = np.nan
    written = write(tmp_path, describe(depth_format=form), tracks)
    read = Capture.load(tmp_path)
    assert read.description == written.description
    rng = np.random.default_rng(0)
    depth, color = rng.integers(500, 900, (24, 32)), rng.integers(0, 256, (24, 32, 3), np.uint8)
    mask = rng.integers(0, 3, (24, 32), np.uint8)
    np.testing.assert_array_equal(read.color("0", 0), color)
    np.testing.assert_allclose(read.depth("0", 0), depth / 1000)
    np.testing.assert_array_equal(read.mask("0", 0), mask)
    np.testing.assert_array_equal(read.tracks(), tracks)
    assert read.train_end == 3


def test_lifting_and_projecting_are_inverse():
    rng = np.random.default_rng(0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    camera = Camera("0", 32, 24, np.array(entry().intrinsics), pose)
    pixels, depth = rng.uniform(0, 24, (50, 2)), rng.uniform(0.3, 1.5, 50)
    projected, distance = camera.project(camera.lift(pixels, depth))
    np.testing.assert_allclose(projected, pixels, atol=1e-9)
    np.testing.assert_allclose(distance, depth)


def test_the_optical_axis_by_hand():
    camera = Camera("0", 32, 24, np.array(entry().intrinsics), np.array(POSE))
    np.testing.assert_allclose(camera.lift(np.array([15.5, 11.5]), np.array(0.9)), [0.1, 0.2, 0.0], atol=1e-12)
    # Forty pixels to the right at a focal length of forty: as far as deep. Down in the image is down the camera's y.
    np.testing.assert_allclose(camera.lift(np.array([55.5, 11.5]), np.array(0.5)), [0.6, 0.2, 0.4], atol=1e-12)
    np.testing.assert_allclose(camera.lift(np.array([15.5, 51.5]), np.array(0.5)), [0.1, -0.3, 0.4], atol=1e-12)


SKEWED = [list(row) for row in POSE]
SKEWED[0][0] = 1.01
TWICE = [TypeAdapter(CameraEntry).dump_python(entry(), mode="json")] * 2
MIRRORED = [list(row) for row in POSE]
MIRRORED[0][0] = -1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_to_world": SKEWED}, r"cameras\.0\.camera_to_world: the upper left 3 x 3 block must be a rotation.*0\.02"),
        ({"camera_to_world": MIRRORED}, r"camera_to_world: .*right-handed.*a mirror image"),
        ({"intrinsics": [[40.0, 1.0, 15.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]]}, r"cameras\.0\.intrinsics"),
        ({"intrinsics": [[40.0, 0.0, 99.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]]}, r"\(cx, cy\) must lie in the 32 x 24 image"),
        ({"missing": [0]}, r"missing: frame 0, in which every twin starts"),
        ({"missing": [7]}, r"frames must be below 5; received 7"),
    ],
)
def test_bad_cameras_are_refused(tmp_path, change, message):
    write(tmp_path)
    camera = json.loads((tmp_path / CAPTURE).read_text())["cameras"][0]
    edit(tmp_path, cameras=[camera | change])
    with pytest.raises(InputError, match=message):
        Capture.load(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train_end": 9}, "train_end: must be at most frame_count = 5; received 9"),
        ({"frame_count": 2}, "frame_count"),
        ({"format": 2}, "format"),
        ({"cameras": []}, "cameras"),
        ({"mass": 0.0}, "mass"),
        ({"frame_rate": 3000.0}, "frame_rate"),
        ({"cameras": TWICE}, r"names must differ; received \['0', '0'\]"),
        ({"obstacles": [{"shape": "sphere", "center": [0, 0, 0], "radius": 1}]}, "obstacles"),
    ],
)
def test_bad_descriptions_are_refused(tmp_path, change, message):
    write(tmp_path)
    edit(tmp_path, **change)
    with pytest.raises(InputError, match=message):
        Capture.load(tmp_path)


def test_missing_and_damaged_files_and_unknown_labels_are_refused(tmp_path):
    capture = write(tmp_path)
    capture.path("color", "0", 3).unlink()
    with pytest.raises(InputError, match=r"00003\.png: this image must exist.* list it in cameras\.0\.missing"):
        capture.color("0", 3)
    cv2.imwrite(str(capture.path("depth", "0", 2)), np.zeros((12, 16), np.uint16))
    with pytest.raises(InputError, match=r"images of camera 0 must be 32 x 24; received 16 x 12\. Align depth to color"):
        capture.depth("0", 2)
    capture.path("color", "0", 2).write_bytes(b"no picture")
    with pytest.raises(InputError, match="must be a readable image"):
        capture.color("0", 2)
    cv2.imwrite(str(capture.path("depth", "0", 1)), np.zeros((24, 32), np.uint8))
    with pytest.raises(InputError, match="depth must be 16-bit integers"):
        capture.depth("0", 1)
    cv2.imwrite(str(capture.path("mask", "0", 1)), np.ones((24, 32, 3), np.uint8))
    with pytest.raises(InputError, match="masks must be gray, palette or one-bit images; received 3 color channels"):
        capture.mask("0", 1)
    cv2.imwrite(str(capture.path("mask", "0", 2)), np.full((24, 32), 7, np.uint8))
    with pytest.raises(
        InputError, match=r"labels must be 0 \(nothing\), 1 \(object\), 2 \(hands\) or 3 \(person\); received label 7"
    ):
        capture.mask("0", 2)
    capture.path("mask", "0", 3).write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"00003\.png: this file must be a readable PNG"):
        capture.mask("0", 3)


def palette(labels):
    image = Image.fromarray(labels, "P")
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    return image


@pytest.mark.parametrize(
    ("made", "hands"),
    [
        (palette, True),
        (Image.fromarray, True),
        (lambda labels: Image.fromarray(labels.astype(np.uint16)), True),
        (lambda labels: Image.fromarray(np.uint8(labels == OBJECT) * 255), False),
        (lambda labels: Image.fromarray(labels == OBJECT), False),
    ],
    ids=["palette", "gray", "16 bits", "0 and 255", "one bit"],
)
def test_masks_of_other_tools_are_read_as_what_they_say(tmp_path, made, hands):
    labels = np.zeros((24, 32), np.uint8)
    labels[4:12, 5:20], labels[12:18, 8:10] = OBJECT, HANDS
    capture = write(tmp_path)
    made(labels).save(capture.path("mask", "0", 1))
    read = capture.mask("0", 1)
    assert read.dtype == np.uint8
    np.testing.assert_array_equal(read, labels if hands else np.where(labels == OBJECT, OBJECT, 0))


def test_writing_never_reaches_through_links(tmp_path):
    """Imported images are links to the user's own."""
    capture = write(tmp_path / "capture")
    original = tmp_path / "original.png"
    original.hardlink_to(capture.path("color", "0", 0))
    before = original.read_bytes()
    Writer(capture.folder, describe()).frame("0", 0, np.zeros((24, 32, 3), np.uint8), np.zeros((24, 32), np.uint16))
    assert original.read_bytes() == before


def test_tracks_do_not_outlive_their_capture_and_may_be_none(tmp_path):
    write(tmp_path, tracks=np.zeros((FRAMES, 2, 3)))
    Writer(tmp_path, describe())
    with pytest.raises(InputError, match=r"capture\.json: this file must be readable"):
        Capture.load(tmp_path)
    assert write(tmp_path).tracks().shape == (FRAMES, 0, 3)
    (tmp_path / "tracks.json").write_text("[]")
    assert Capture.load(tmp_path).tracks().shape == (FRAMES, 0, 3)
    (tmp_path / "tracks.json").write_text("{}")
    with pytest.raises(InputError, match="a list of tracks is required; received dict"):
        Capture.load(tmp_path).tracks()


def test_a_capture_names_the_digest_of_its_images(tmp_path):
    first = write(tmp_path / "a").description.provenance["images"]
    assert write(tmp_path / "b").description.provenance["images"] == first
    assert write(tmp_path / "c", describe(depth_format="npy")).description.provenance["images"] != first


@pytest.mark.parametrize(
    ("text", "message"), [("[[[0, 0]]]", "x, y, z"), ("[[[0, 0, 0]]]", "every track needs 5 entries"), ("{", "JSON")]
)
def test_bad_tracks_are_refused(tmp_path, text, message):
    capture = write(tmp_path)
    (tmp_path / "tracks.json").write_text(text)
    with pytest.raises(InputError, match=message):
        capture.tracks()
