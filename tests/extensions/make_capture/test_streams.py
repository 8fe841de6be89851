"""Which images belong together: by stamps, by equal numbers, or as the user states; anything else is refused with both readings."""

import shutil
from datetime import datetime, timedelta
from fractions import Fraction

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.core.text import spans
from neuspring.extensions.make_capture.formats import open_images
from neuspring.extensions.make_capture.streams import CameraStreams, Series, choose, chosen, matched
from tests.support.desk import FRAMES, write_folders, write_video

BEGIN = datetime(2024, 5, 1, 12, 30, 15, 33000)
NAMES = {
    "numbers": lambda k, late: f"frame_{k:06d}",
    "dates": lambda k, late: (BEGIN + timedelta(seconds=k / 30 + late)).strftime("%Y%m%d_%H%M%S_%f"),
    "device clock": lambda k, late: f"{421_733_366 + round((k / 30 + late) * 1e6)}",
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return write_folders(tmp_path_factory.mktemp("desk"), 2)


def renamed(desk, folder, kind, name, kept=range(FRAMES), late=0.0, first=0, stamps=False):
    """Images of a stream of camera 0 under other names."""
    to = folder / kind
    to.mkdir(parents=True)
    rows = ["file,seconds"]
    for k in kept:
        path = to / f"{NAMES[name](k + first, late)}.png"
        shutil.copyfile(desk / f"{kind}_0" / f"frame_{k}.png", path)
        rows.append(f"{path.name},{k / 30 + late}")
    if stamps:
        (to / "stamps.csv").write_text("\n".join(rows) + "\n")
    return open_images(to, kind)


def paired(desk, folder, name, pairing=None, **depth):
    """The frames of depth that belong to those of color; NaN: none."""
    view = CameraStreams("0", renamed(desk, folder, "color", name), renamed(desk, folder, "depth", name, **depth), pairing=pairing)
    kept = [*depth.get("kept", range(FRAMES))]
    return [(left, kept[right]) for left, right in view.pairs]


SAME = [(k, k) for k in range(FRAMES)]


@pytest.mark.parametrize("name", NAMES)
def test_equal_names_pair_whatever_they_mean(desk, tmp_path, name):
    assert paired(desk, tmp_path, name) == SAME


def test_depth_from_1_is_refused_with_both_readings_and_taken_as_stated(desk, tmp_path):
    words = r"7 images \(0 to 6\) and 7 \(1 to 7\): equal numbers pair 6, the order pairs 7.*--pair names or --pair order"
    with pytest.raises(InputError, match=words):
        paired(desk, tmp_path / "none", "numbers", first=1)
    assert paired(desk, tmp_path / "order", "numbers", "order", first=1) == SAME
    assert paired(desk, tmp_path / "names", "numbers", "names", first=1) == [(k + 1, k) for k in range(FRAMES - 1)]


@pytest.mark.parametrize("name", ["dates", "device clock"])
def test_names_with_times_are_not_read_and_stamps_are(desk, tmp_path, name):
    with pytest.raises(InputError, match=r"equal numbers pair (none|0), .*stamps\.csv \(file,seconds\)"):
        paired(desk, tmp_path / "none", name, late=0.002)
    color = renamed(desk, tmp_path, "color", name, stamps=True, kept=[0, 1, 3, 4, 5, 6])
    depth = renamed(desk, tmp_path, "depth", name, stamps=True, late=0.002, kept=[0, 1, 2, 3, 4, 6])
    view = CameraStreams("0", color, depth)
    assert view.pairs == [(0, 0), (1, 1), (2, 3), (3, 4), (5, 5)] and view.without_partner == 2
    assert view.color.series.rate == pytest.approx(30, rel=1e-3)


def test_images_that_another_stream_lacks_are_left_out_where_names_are_stated(desk, tmp_path):
    assert paired(desk, tmp_path, "numbers", "names", kept=[0, 1, 4, 5, 6]) == [(k, k) for k in (0, 1, 4, 5, 6)]
    with pytest.raises(InputError, match=r"equal numbers pair 5, the order pairs none"):
        paired(desk, tmp_path / "none", "numbers", kept=[0, 1, 4, 5, 6])


def test_names_without_numbers_pair_by_order_only_as_stated():
    one, other = Series([0, 1, 2], named=False), Series([0, 1, 2], named=False)
    with pytest.raises(InputError, match="equal numbers pair none, the order pairs 3"):
        matched("x", ("a", "b"), one, other, None)
    assert matched("x", ("a", "b"), one, other, "order") == {0: 0, 1: 1, 2: 2}


def times(values, clock=""):
    return Series(list(range(len(values))), np.array(values), clock)


def test_streams_without_a_common_clock_begin_together_and_must_end_together():
    step = np.arange(10) / 30
    assert matched("x", ("a", "b"), times(step), times(step + 50), None) == {k: k for k in range(10)}
    assert matched("x", ("a", "b"), times(step, "wall"), times(step + 1 / 30, "wall"), None) == {k: k - 1 for k in range(1, 10)}
    for other in (times(step[:7]), times(step * 2), times(step + 50, "wall")):
        with pytest.raises(InputError, match=r"must show the same moments by their stamps"):
            matched("x", ("a", "b"), times(step, other.clock), other, None)


def views(desk, names="01", missing=()):
    color = {name: open_images(desk / f"color_{name}", "color") for name in names}
    found = [CameraStreams(name, color[name], None) for name in names]
    if missing:
        object.__setattr__(found[1].color, "paths", [p for k, p in enumerate(color["1"].paths) if k not in missing])
    return found


def test_frames_are_kept_by_number_and_a_camera_may_miss_some(desk):
    choice = choose(views(desk), "1-5", None, {})
    assert (choice.numbers, choice.step, choice.places["1"]) == ([1, 2, 3, 4, 5], 1, {k: k + 1 for k in range(5)})
    assert choice.text() == "5 frames, numbers 1 to 5 of the source"
    assert choose(views(desk), "", None, {"1": 2}).places["1"] == {k: k + 2 for k in range(5)}
    gap = choose(views(desk, missing=(3,)), "", "names", {})
    assert gap.missing("1") == (3,) and len(gap.places["1"]) == FRAMES - 1
    with pytest.raises(InputError, match=r"camera 1 must have the first.*number 0.*Start at number 1"):
        choose(views(desk, missing=(0,)), "", "names", {})
    with pytest.raises(InputError, match="at least 5 frames"):
        choose(views(desk), "2-4", None, {})


def test_ranges_of_frames():
    assert chosen("0-6/3", range(7)) == [0, 3, 6] and chosen("", [4, 5]) == [4, 5]
    for wrong in ("1,5", "3", "0-", "a-b", "0-9/0"):
        with pytest.raises(InputError, match="FIRST-LAST or FIRST-LAST/STEP"):
            chosen(wrong, range(9))
    assert spans([6, 13, 20, 21, 22]) == "6, 13, 20 to 22"


@pytest.mark.parametrize(
    ("made", "received", "line"),
    [
        ({"options": {"x264-params": "interlaced=1:tff=1"}}, "interlaced", "bwdif=mode=send_frame"),
        ({"color_primaries": 9, "color_trc": 18, "colorspace": 9}, r"HDR \(PQ or HLG\)", "tonemap"),
        ({"color_primaries": 9, "color_trc": 14, "colorspace": 9}, "colors of BT.2020", "p=bt709"),
        ({"sample_aspect_ratio": Fraction(4, 3)}, "pixels of 4/3", "setsar=1"),
        ({}, "a mark that makes players rotate or flip it", "scale=WIDTH:HEIGHT"),
    ],
)
def test_videos_of_other_kinds_are_refused_with_the_line_that_converts_them(desk, tmp_path, made, received, line):
    frames = list(open_images(desk / "color_0", "color").read(range(FRAMES)))
    path = write_video(tmp_path / "color.mp4", frames, "libx264", "yuv420p", **made)
    if not made:
        data = bytearray(path.read_bytes())
        at = data.index(b"tkhd") + 44  # the display matrix of version 0, by rows
        data[at + 16 : at + 20] = (-(1 << 16)).to_bytes(4, "big", signed=True)
        path.write_bytes(data)
    with pytest.raises(InputError, match=f"received {received}.*ffmpeg -i VIDEO -vf .*{line}"):
        open_images(path, "color").series  # noqa: B018


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image: image * np.uint16(16), "use its range, 0 to 65535; received at most [1-4][0-9]{3}. .*12 bits by 16"),
        (
            lambda image: np.dstack([image, 255 * (np.indices(image.shape[:2])[0] > 3)]).astype(np.uint8),
            "opaque; received .*alpha off",
        ),
        (lambda image: image * np.uint16(257), None),
        (lambda image: np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]), None),
    ],
)
def test_color_that_8_bits_do_not_show_is_refused(desk, tmp_path, change, words):
    image = cv2.imread(str(desk / "color_0" / "frame_0.png"))
    cv2.imwrite(str(tmp_path / "0.png"), change(image))
    if words:
        with pytest.raises(InputError, match=words):
            next(open_images(tmp_path, "color").read([0]))
    else:
        np.testing.assert_array_equal(next(open_images(tmp_path, "color").read([0])), image[..., ::-1])


def test_videos_are_paired_by_their_stamps_and_depth_must_be_exact(desk, tmp_path):
    frames = list(open_images(desk / "color_0", "color").read(range(FRAMES)))
    depths = list(open_images(desk / "depth_0", "depth").read(range(FRAMES)))
    color = open_images(write_video(tmp_path / "color.mp4", frames, "libx264", "yuv420p"), "color")
    depth = open_images(write_video(tmp_path / "depth.mkv", depths, "ffv1", "gray16le"), "depth")
    view = CameraStreams("0", color, depth)
    assert view.pairs == SAME and view.color.series.rate == pytest.approx(15, rel=1e-3)
    for (_, read), stored in zip(view.read([2, 5]), (depths[2], depths[5]), strict=True):
        np.testing.assert_array_equal(read, stored)
    with pytest.raises(InputError, match="a depth video must be gray with 16 bits"):
        _ = open_images(tmp_path / "color.mp4", "depth").series
    with pytest.raises(InputError, match=r"a video track below 1 is required"):
        _ = open_images(tmp_path / "color.mp4#3", "color").series
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match="readable video"):
        _ = open_images(tmp_path / "bad.mp4", "color").series


@pytest.mark.parametrize(
    ("names", "words"), [((), "a folder without any"), (("a.png", "b.jpg"), "images of one format are required")]
)
def test_folders_without_one_kind_of_image_are_refused(tmp_path, names, words):
    for name in names:
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=words):
        _ = open_images(tmp_path, "color").series
