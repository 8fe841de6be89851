"""Recordings of ROS and of RealSense cameras become captures; what cannot be read is refused by its name."""

import sqlite3
import sys

import cv2
import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.make_capture.formats.bag import Bag, Topic, decoded, open_bags
from neuspring.extensions.make_capture.make import Intake, make_capture
from neuspring.intake.check import check_layout
from tests.support.bags import COLOR, DEPTH, FORMS, START, STEP, desk, packed_depth, realsense, recorded
from tests.support.desk import FRAMES, SIZE, K, camera, counts, seen, write_json, write_poses
from tests.support.findings import serious

NAMES = dict(zip(FORMS, ("film.bag", "film", "film"), strict=True))


def words(root, *more):
    """The command line for one recording."""
    command = ["make-capture", "--bag", str(root), *more, "--category", "ball"]
    return [*command, "--output", str(root.with_name("capture"))]


@pytest.mark.parametrize("form", FORMS)
def test_a_recording_says_all_but_the_category(tmp_path, capsys, form):
    path = tmp_path / NAMES[form]
    with recorded(path, form) as bag:
        desk(bag)
    assert main(words(path)) == 0
    made = Capture.load(tmp_path / "capture")
    assert (made.frame_count, made.description.frame_rate, made.description.depth_unit) == (FRAMES, 30.0, 0.001)
    np.testing.assert_array_equal(made.cameras["0"].intrinsics, K)
    for frame in range(FRAMES):
        color, depth = seen(camera(), frame)
        np.testing.assert_array_equal(made.color("0", frame), color)
        np.testing.assert_allclose(made.depth("0", frame), counts(depth) / 1000)
    assert serious(check_layout(made.folder)) == []
    assert "time stamps, at most 2 ms apart" in capsys.readouterr().out


def test_messages_that_are_compressed_without_a_word_are_read(tmp_path, monkeypatch):
    """As librealsense 2.58 records them by default."""
    zstd = pytest.importorskip("backports.zstd")
    with recorded(tmp_path / "film", "sqlite3") as bag:
        monkeypatch.setattr(bag, "packed", zstd.compress, raising=False)
        desk(bag)
    (view,) = open_bags([tmp_path / "film"]).views
    color, depth = next(view.read([2]))
    np.testing.assert_array_equal(color, seen(camera(), 2)[0])
    np.testing.assert_array_equal(depth, counts(seen(camera(), 2)[1]))


def test_one_mcap_file_holds_two_cameras(tmp_path):
    with recorded(tmp_path / "film") as bag:
        desk(bag)
        desk(bag, 1, "/left")
    file = next((tmp_path / "film").glob("*.mcap"))
    topics = (COLOR, DEPTH, f"/left{COLOR}", f"/left{DEPTH}")
    poses = write_poses(tmp_path / "poses.json")
    said = {"bag": (file,), "topics": topics, "poses": poses, "cameras": ("a", "b")}
    made, _ = make_capture(Intake(output=tmp_path / "capture", category="ball", **said))
    assert [*made.cameras] == ["a", "b"]
    np.testing.assert_array_equal(made.color("b", 3), seen(camera(1), 3)[0])
    with pytest.raises(InputError, match=r"2 and 2\. Name them, --topics COLOR DEPTH\. There are: .*/left/camera/color/image_raw"):
        open_bags([file])
    with pytest.raises(InputError, match=r"--topics: pairs COLOR DEPTH are required, one or as many as recordings, 1; received 3"):
        open_bags([file], topics=topics[:3])


def test_a_recording_per_camera(tmp_path):
    for view in range(2):
        with recorded(tmp_path / f"{view}.bag", "ros1") as bag:
            desk(bag, view)
    views = open_bags([tmp_path / "0.bag", tmp_path / "1.bag"]).views
    assert [next(view.read([2]))[0].tolist() for view in views] == [seen(camera(view), 2)[0].tolist() for view in range(2)]


@pytest.mark.parametrize("form", FORMS)
def test_topics_are_listed_without_writing(tmp_path, capsys, form):
    path = tmp_path / NAMES[form]
    with recorded(path, form) as bag:
        desk(bag)
        bag.image("/fisheye/image_raw", START, np.zeros((6, 4), np.uint8), "nv12")
        bag.put("/note", "std_msgs/String", START, data="hello")
    assert main(["make-capture", "--bag", str(path), "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = {line.split()[0].rstrip(":"): line for line in lines[1:]}
    assert told[COLOR].endswith("color, rgb8, 80 x 60") and f"sensor_msgs/msg/Image, {FRAMES} messages, " in told[COLOR]
    assert told[DEPTH].endswith("depth, 16uc1, 80 x 60")
    assert told["/fisheye/image_raw"].endswith("not read, nv12")
    assert told["/note"].endswith("std_msgs/msg/String, 1 messages, 0 Hz: not images")
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    assert main(["make-capture", "--list"]) == 2


def test_a_topic_that_is_not_there_lists_those_that_are(tmp_path, capsys):
    with recorded(tmp_path / "film") as bag:
        desk(bag)
        bag.put("/note", "std_msgs/String", START, data="hello")
    for absent in ("/camera/depth/image_raw", "/note"):
        assert main(words(tmp_path / "film", "--topics", COLOR, absent)) == 2
        told = capsys.readouterr().err
        assert f"received {absent}. There are: {DEPTH} (depth, 16uc1, 80 x 60); {COLOR} (color, rgb8, 80 x 60)" in told
    assert not (tmp_path / "capture").exists()


def one_image(tmp_path, data, encoding, form="mcap", **options):
    """What is read of an image message with these pixels."""
    path = tmp_path / NAMES[form]
    with recorded(path, form) as bag:
        bag.image("/image", START, data, encoding, **options)
    return decoded(path, next(Bag(path).messages("/image"))[0])[1]


PICTURE = seen(camera())[0]
COUNTS = counts(seen(camera())[1])


@pytest.mark.parametrize("pad", [0, 13])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    ("encoding", "data", "right"),
    [
        ("rgb8", PICTURE, PICTURE),
        ("bgr8", PICTURE[..., ::-1], PICTURE),
        ("rgba8", np.dstack([PICTURE, PICTURE[..., 0]]), PICTURE),
        ("bgra8", np.dstack([PICTURE[..., ::-1], PICTURE[..., 0]]), PICTURE),
        ("mono8", PICTURE[..., 0], np.repeat(PICTURE[..., :1], 3, axis=2)),
        ("16UC1", COUNTS, COUNTS),
        ("mono16", COUNTS, COUNTS),
        ("32FC1", COUNTS.astype(np.float32) / 1000, COUNTS.astype(np.float32) / 1000),
    ],
)
def test_step_and_byte_order_of_rows_are_honored(tmp_path, encoding, data, right, pad, big):
    """A library of its makers takes neither."""
    read = one_image(tmp_path, data, encoding, pad=pad, big=big, form="ros1" if big else "mcap")
    assert read.dtype == right.dtype
    np.testing.assert_array_equal(read, right)


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv"), ("YUYV", "yuyv")])
def test_packed_colors_are_read(tmp_path, encoding, order):
    """A gray of 100 on the left, red on the right: luma 16 to 235, chroma about 128."""
    data = np.zeros((2, 4, 2), np.uint8)
    for column, (luma, blue, red) in enumerate(((102, 128, 128), (102, 128, 128), (81, 90, 240), (81, 90, 240))):
        chroma = blue if column % 2 == 0 else red
        data[:, column] = (chroma, luma) if order == "uyvy" else (luma, chroma)
    read = one_image(tmp_path, data, encoding).astype(int)
    assert np.abs(read[:, :2] - 100).max() <= 1
    assert np.abs(read[:, 2:] - [254, 0, 0]).max() <= 2


@pytest.mark.parametrize("encoding", ["nv12", "bayer_rggb8", "8UC3", "rgb16", "64FC1"])
def test_another_encoding_is_refused_by_its_name(tmp_path, encoding):
    with pytest.raises(InputError, match=rf"received '{encoding}'\. Read are rgb8 bgr8 .*compressedDepth as PNG"):
        one_image(tmp_path, np.zeros((6, 4), np.uint8), encoding)


def test_rows_that_are_cut_off_are_refused(tmp_path):
    with recorded(tmp_path / "film") as bag:
        fields = {"height": 6, "width": 4, "encoding": "rgb8", "is_bigendian": 0, "step": 12}
        bag.put("/image", "sensor_msgs/Image", START, header=bag.header(START), data=np.zeros(60, np.uint8), **fields)
    with pytest.raises(InputError, match="6 rows of 12 bytes, 12 of them pixels, are required; received 60 bytes"):
        decoded(tmp_path, next(Bag(tmp_path / "film").messages("/image"))[0])


def compressed(tmp_path, data, form):
    """What is read of a compressed image."""
    with recorded(tmp_path / "film") as bag:
        bag.compressed("/image", START, data, form)
    return decoded(tmp_path, next(Bag(tmp_path / "film").messages("/image"))[0])


@pytest.mark.parametrize(
    ("form", "turned"),
    [("jpeg", True), ("bgr8; png compressed bgr8", True), ("rgb8; png compressed bgr8", True), ("rgb8; png compressed ", False)],
)
def test_compressed_colors_are_in_the_order_that_the_transport_says(tmp_path, form, turned):
    data = cv2.imencode(".png", PICTURE[..., ::-1] if turned else PICTURE)[1].tobytes()
    encoding, image = compressed(tmp_path, data, form)
    assert encoding == ("bgr8" if turned else "rgb8")
    np.testing.assert_array_equal(image, PICTURE)


def test_compressed_depth_keeps_its_sixteen_bits(tmp_path):
    assert COUNTS.max() > 255
    encoding, image = compressed(tmp_path, packed_depth(COUNTS), "16UC1; compressedDepth png")
    assert (encoding, image.dtype) == ("16uc1", np.uint16)
    np.testing.assert_array_equal(image, COUNTS)
    (tmp_path / "png").mkdir()
    encoding, image = compressed(tmp_path / "png", cv2.imencode(".png", COUNTS)[1].tobytes(), "16UC1; png compressed ")
    np.testing.assert_array_equal(image, COUNTS)


def test_compressed_depth_of_floating_point_is_meters_by_its_parameters(tmp_path):
    """The transport of ROS stores A / depth + B, A = q (q + 1), B = 1 - A / farthest; 0 is no depth."""
    depth, quantum, farthest = np.array([[0.0, 0.5, 1.25, 9.9]], np.float32), 100.0, 10.0
    scale = quantum * (quantum + 1)
    shift = 1 - scale / farthest
    stored = np.where(depth > 0, np.round(scale / np.maximum(depth, 1e-3) + shift), 0).astype(np.uint16)
    encoding, image = compressed(tmp_path, packed_depth(stored, scale, shift), "32FC1; compressedDepth png")
    assert (encoding, image.dtype) == ("32fc1", np.float32)
    np.testing.assert_allclose(image, depth, rtol=0.006)
    assert image[0, 0] == 0


@pytest.mark.parametrize("form", ["16UC1; compressedDepth rvl", "h264", "rgb8; jpeg compressed bgr8"])
def test_what_is_no_png_or_jpeg_is_refused_by_its_name(tmp_path, form):
    with pytest.raises(InputError, match=f"received '{form}'"):
        compressed(tmp_path, bytes(range(64)), form)


@pytest.mark.parametrize("form", FORMS)
def test_compressed_topics_as_most_labs_record_them(tmp_path, form):
    path = tmp_path / NAMES[form]
    with recorded(path, form) as bag:
        bag.info("/camera/color/camera_info")
        for frame in range(FRAMES):
            color, depth = seen(camera(), frame)
            stamp = START + frame * STEP
            packed = cv2.imencode(".jpg", color[..., ::-1])[1].tobytes()
            bag.compressed(f"{COLOR}/compressed", stamp, packed, "rgb8; jpeg compressed bgr8")
            bag.compressed(f"{DEPTH}/compressedDepth", stamp, packed_depth(counts(depth)), "16UC1; compressedDepth png")
    assert main(words(path)) == 0
    made = Capture.load(tmp_path / "capture")
    np.testing.assert_allclose(made.depth("0", 4), counts(seen(camera(), 4)[1]) / 1000)
    assert np.abs(made.color("0", 4).astype(int) - seen(camera(), 4)[0]).mean() < 8


def test_stamps_of_headers_pair_and_not_the_times_of_the_log(tmp_path):
    """Depth arrives two frames late, and two of its images in the other order."""
    with recorded(tmp_path / "film") as bag:
        bag.info("/camera/color/camera_info")
        logs = np.argsort([0, 2, 1, 3, 4, 5, 6])
        for frame in range(FRAMES):
            color, depth = seen(camera(), frame)
            bag.image(COLOR, START + frame * STEP, color, "rgb8", log=START + frame * STEP)
        for turn in range(FRAMES):
            frame = int(logs[turn])
            late = START + (turn + 2) * STEP
            bag.image(DEPTH, START + frame * STEP, counts(seen(camera(), frame)[1]), "16UC1", log=late)
    view = open_bags([tmp_path / "film"]).views[0]
    places = [1, 2, 5]
    for place, (color, depth) in zip(places, view.read(places), strict=True):
        np.testing.assert_array_equal(color, seen(camera(), place)[0])
        np.testing.assert_array_equal(depth, counts(seen(camera(), place)[1]))
    assert view.rate(places) == pytest.approx(30, rel=1e-6)


def test_an_image_that_comes_twice_is_one(tmp_path):
    with recorded(tmp_path / "film") as bag:
        for frame in (0, 1, 1, 2):
            log = START + len(bag.topics) + frame
            bag.image("/image", START + frame * STEP, np.full((2, 2), frame, np.uint16), "16UC1", log=log)
    topic = Topic(Bag(tmp_path / "film"), "/image", "depth")
    assert [image[0, 0] for image in topic.read([0, 1, 2])] == [0, 1, 2] and len(topic.series.numbers) == 3


def test_without_stamps_there_is_no_time(tmp_path):
    with recorded(tmp_path / "film") as bag:
        for frame in range(3):
            bag.image("/image", 0, np.full((2, 2), frame, np.uint16), "16UC1", log=START + frame * STEP)
    topic = Topic(Bag(tmp_path / "film"), "/image", "depth")
    assert topic.series.times is None and [image[0, 0] for image in topic.read([0, 2])] == [0, 2]


def test_definitions_of_a_part_of_the_types_are_enough(tmp_path):
    """A reader that goes by the bag's definitions raises KeyError at the first message of the others."""
    with recorded(tmp_path / "film", "sqlite3") as bag:
        desk(bag)
        bag.put("/note", "std_msgs/String", START, data="hello")
    with sqlite3.connect(next((tmp_path / "film").glob("*.db3"))) as stored:
        stored.execute("DELETE FROM message_definitions WHERE topic_type != 'std_msgs/msg/String'")
    stored.close()
    assert main(words(tmp_path / "film")) == 0


def test_types_that_nobody_knows_are_passed_over(tmp_path):
    with recorded(tmp_path / "film") as bag:
        desk(bag)
        about = {"msgdef": "my_lab/Unknown what\n", "rihs01": "RIHS01_" + 64 * "0"}
        own = bag.writer.add_connection("/gripper", "my_lab/msg/Gripper", **about)
        bag.writer.write(own, START, b"\x00\x01\x00\x00")
    assert "/gripper: my_lab/msg/Gripper, 1 messages" in Bag(tmp_path / "film").text()
    assert main(words(tmp_path / "film")) == 0


@pytest.mark.parametrize("form", FORMS)
def test_the_lens_is_that_of_the_image(tmp_path, form):
    """Of a rectified image it is in P, without distortion; of a binned part of the sensor it is smaller; all zeros are none."""
    path = tmp_path / NAMES[form]
    bent, new = np.array([0.1, 0, 0, 0, 0]), np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
    with recorded(path, form) as bag:
        bag.info("/a/camera_info", d=bent, p=np.column_stack([new, np.zeros(3)]).ravel())
        bag.info("/b/camera_info", binning_x=2, binning_y=2, roi={"x_offset": 10, "y_offset": 20, "width": 40, "height": 20})
        bag.info("/c/camera_info", np.zeros((3, 3)))
    raw, rectified = Bag(path).lens("/a/image_raw/compressed"), Bag(path).lens("/a/image_rect_color")
    np.testing.assert_array_equal(raw.matrix, K)
    assert (raw.distortion.tolist(), raw.model, raw.size) == (bent.tolist(), "plumb_bob", SIZE)
    np.testing.assert_array_equal(rectified.matrix, new)
    assert not rectified.distortion.any()
    part = Bag(path).lens("/b/image")
    np.testing.assert_allclose(part.matrix, [[35, 0, 14.75], [0, 35, 4.75], [0, 0, 1]])
    assert part.size == (20, 10)
    assert Bag(path).lens("/c/image_raw") is None and Bag(path).lens("/d/image_raw") is None


@pytest.mark.parametrize("version", ["old", "2.57", "2.59"])
def test_a_realsense_recording_is_aligned_and_has_its_own_unit(tmp_path, version):
    """Images of 2.57 have four bytes more than the bag defines: rosbags' own reader refuses them. Headers of 2.59 have no time."""
    path = realsense(tmp_path / "film.bag", version)
    made, report = make_capture(Intake(output=tmp_path / "capture", category="ball", bag=(path,)))
    assert (made.description.depth_unit, made.description.frame_rate, made.frame_count) == (0.0001, 30.0, FRAMES)
    found, right = made.depth("0", 4), seen(camera(), 4)[1]
    both = (found > 0) & (right > 0)
    assert both[:, 3:].mean() > 0.995
    apart = np.abs(found - right)[10:]  # not at the far end of the table, where a pixel is decimeters long
    assert np.median(apart[both[10:]]) < 0.003
    assert (apart[both[10:]] > 0.05).sum() < 8  # the rim of the ball: 34 without alignment, 68 the other way round
    assert not any("not aligned" in line for line in report)


def test_a_realsense_recording_that_lacks_a_time_is_refused(tmp_path):
    path = realsense(tmp_path / "film", "2.59")
    with sqlite3.connect(path) as stored:
        stored.execute("DELETE FROM messages WHERE id = (SELECT MAX(id) FROM messages)")
    stored.close()
    view = open_bags([path]).views[0]
    with pytest.raises(InputError, match=rf"a timestamp in /device_0/.*/Depth_0/image/metadata is required.*received {FRAMES - 1}"):
        next(view.read([0]))


def test_a_realsense_lens_with_two_meanings_is_refused(tmp_path, capsys):
    realsense(tmp_path / "film.bag", d=np.array([0.1, 0, 0, 0, 0]))
    assert main(words(tmp_path / "film.bag")) == 2
    assert "camera 0: inverse_brown_conrady has two meanings" in capsys.readouterr().err
    about = {"width": SIZE[0], "height": SIZE[1], "K": K.tolist(), "dist": [0.1, 0, 0, 0, 0], "model": "brown_conrady"}
    assert main(words(tmp_path / "film.bag", "--intrinsics", str(write_json(tmp_path / "k.json", about)))) == 0
    assert "distortion, camera 0: removed, up to" in capsys.readouterr().out


def test_what_is_no_recording_says_what_is(tmp_path, monkeypatch, capsys):
    (tmp_path / "film").mkdir()
    for path in (tmp_path / "film.bag", tmp_path / "film.mcap", tmp_path / "film.db3"):
        path.write_bytes(b"nothing of the kind")
    for name in ("film.bag", "film.mcap", "film.db3", "film", "absent.bag"):
        assert main(words(tmp_path / name)) == 2
        assert "a ROS 1 .bag, a ROS 2 folder with metadata.yaml, an .mcap or a .db3 file is required" in capsys.readouterr().err
    for name in [name for name in sys.modules if name.partition(".")[0] == "rosbags"]:
        monkeypatch.setitem(sys.modules, name, None)
    assert main(words(tmp_path / "film.bag")) == 2
    assert 'pip install -c workflow/envs/constraints.txt -e ".[recordings]"' in capsys.readouterr().err


@pytest.mark.parametrize(("option", "value"), [("output", None), ("category", ""), ("topics", ("/a",))])
def test_options_that_are_required_or_of_another_source(tmp_path, option, value):
    given = {"output": tmp_path / "capture", "category": "ball"} | {option: value}
    with pytest.raises(InputError, match=f"^--{option}: is "):
        make_capture(Intake(**{key: value for key, value in given.items() if value is not None}))
