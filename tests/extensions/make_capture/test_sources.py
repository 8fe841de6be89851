"""Folders and videos of images: their order, their numbers, what is refused, and which frames are kept."""

import re

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.extensions.make_capture.formats import pairs
from neuspring.extensions.make_capture.formats.folder import ImageFolder
from neuspring.extensions.make_capture.formats.video import VideoFile
from neuspring.extensions.make_capture.poses import choose, chosen
from tests.support.desk import camera, counts, seen, write_folders, write_video


def test_numbers_sort_as_numbers_and_count_from_the_names(tmp_path):
    folder = ImageFolder(write_folders(tmp_path, frames=12, first=5) / "color_0", "color")
    assert folder.series.numbers == list(range(5, 17))
    assert [path.stem for path in folder.paths][-1] == "frame_16"
    np.testing.assert_array_equal(next(folder.read([10])), seen(camera(), 10)[0])


def test_names_without_a_common_form_count_from_zero(tmp_path):
    for name in ("12.10", "9.3", "12.9"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((4, 4, 3), np.uint8))
    folder = ImageFolder(tmp_path, "color")
    assert folder.series.numbers == [0, 1, 2]
    assert [path.name for path in folder.paths] == ["9.3.png", "12.9.png", "12.10.png"]


def image_of(value, ending=".png"):
    def write(folder):
        path = folder / f"0{ending}"
        np.save(path, value) if ending == ".npy" else cv2.imwrite(str(path), value)

    return write


@pytest.mark.parametrize(
    ("write", "kind", "message"),
    [
        (lambda folder: None, "color", "color images of one format are required (.png .jpg .jpeg .bmp .npy); received none"),
        (image_of(np.zeros((4, 4), np.uint8)), "depth", "depth must be integers of at least 16 bits, or floating point"),
        (image_of(np.zeros((4, 4, 3), np.uint8)), "depth", "A picture of depth in colors is none"),
        (image_of(np.zeros((4, 4, 3)), ".npy"), "color", "color must be 8-bit RGB [H, W, 3]; received float64"),
        (lambda folder: (folder / "0.png").write_bytes(b"no image"), "color", "0.png: this file must be a readable image"),
        (lambda folder: [(folder / name).touch() for name in ("0.png", "0.npy")], "depth", "received .npy and .png"),
    ],
)  # fmt: skip
def test_what_is_no_folder_of_images_is_refused(tmp_path, write, kind, message):
    write(tmp_path)
    with pytest.raises(InputError, match=re.escape(message)):
        list(ImageFolder(tmp_path, kind).read(range(len(ImageFolder(tmp_path, kind).series.numbers))))


def test_a_depth_video_keeps_every_count(tmp_path):
    depths = [counts(seen(camera(), frame)[1]) for frame in range(4)]
    film = VideoFile(write_video(tmp_path / "depth.mkv", depths, "ffv1", "gray16le"), "depth")
    assert film.series.numbers == [0, 1, 2, 3]
    for found, depth in zip(film.read([1, 3]), [depths[1], depths[3]], strict=True):
        np.testing.assert_array_equal(found, depth)
    assert film.series.rate == pytest.approx(15, rel=0.01)


@pytest.mark.parametrize(
    ("codec", "stored", "message"),
    [("mpeg4", "yuv420p", "gray with 16 bits; received yuv420p"), ("jpeg2000", "gray16le", "must be lossless")],
)
def test_a_depth_video_that_loses_depth_is_refused(tmp_path, codec, stored, message):
    images = [np.zeros((48, 64, 3), np.uint8) if stored == "yuv420p" else np.zeros((48, 64), np.uint16)] * 2
    path = write_video(tmp_path / "depth.mkv", images, codec, stored)
    with pytest.raises(InputError, match="a depth video must be") as caught:
        list(VideoFile(path, "depth").series)
    assert message in str(caught.value)


def test_a_video_in_whole_milliseconds_knows_its_rate(tmp_path):
    frames = [np.full((16, 16, 3), 8 * k, np.uint8) for k in range(31)]
    film = VideoFile(write_video(tmp_path / "color.mkv", frames, "mpeg4", "yuv420p", rate=30), "color")
    assert film.series.rate == pytest.approx(30, rel=1e-3)
    assert len(film.series.numbers) == 31
    dark, light = film.read([2, 30])
    assert dark.mean() < light.mean() - 100


def test_a_damaged_video_is_refused(tmp_path):
    (tmp_path / "color.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match="this file must be a readable video"):
        list(VideoFile(tmp_path / "color.mp4", "color").series)


@pytest.mark.parametrize(
    ("wanted", "numbers"),
    [("", [3, 4, 5, 6, 8]), ("4-6", [4, 5, 6]), ("4-", [4, 5, 6, 8]), ("4-8/2", [4, 6, 8]), ("3,6-8", [3, 6, 8]), ("100", [])],
)
def test_ranges_of_frames(wanted, numbers):
    assert chosen(wanted, [3, 4, 5, 6, 8]) == numbers


@pytest.mark.parametrize("wanted", ["a", "5-3-1", "1:5", "3/2", "1-9/0"])
def test_ranges_that_are_none(wanted):
    with pytest.raises(InputError, match="--frames: ranges like 250-335"):
        chosen(wanted, [1, 2, 3])


def test_a_stride_and_a_jump_are_known(tmp_path):
    root = write_folders(tmp_path, frames=12)
    views = pairs([root / "color_0"], [root / "depth_0"])
    assert (choose(views, "0-10/2").step, choose(views, "0-10/2").jumps) == (2, [])
    assert choose(views, "0-3,8-11").jumps == [3]
    with pytest.raises(InputError, match="a capture needs at least 5 frames; received 3 of the numbers 0 to 11"):
        choose(views, "0-2")


def test_a_camera_without_the_first_frame_is_refused(tmp_path):
    root = write_folders(tmp_path, cameras=2)
    for kind in ("color", "depth"):
        (root / f"{kind}_1" / "frame_0.png").unlink()
    with pytest.raises(InputError, match=r"camera 1 must have the first of the chosen frames, number 0.* that all have is 1"):
        choose(pairs([root / "color_0", root / "color_1"], [root / "depth_0", root / "depth_1"]))
