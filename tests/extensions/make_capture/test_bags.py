"""Bags of ROS: images, stamps and lenses are read in every storage; other encodings and unaligned depth are refused."""

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.extensions.make_capture.formats.bag import Bag, open_bags
from neuspring.extensions.make_capture.make import make_capture
from neuspring.extensions.make_capture.options import Intake
from tests.support.bags import COLOR, DEPTH, FORMS, START, STEP, desk, packed_depth, recorded
from tests.support.desk import FRAMES, SIZE, K, camera, counts, seen, write_rig


def of(path, **changes):
    return open_bags(Intake(recording=(path,), **changes))


def path_of(tmp_path, form):
    return tmp_path / ("film.bag" if form == "ros1" else "film")


@pytest.mark.parametrize("form", FORMS)
def test_a_bag_becomes_a_capture(tmp_path, form):
    with recorded(path_of(tmp_path, form), form) as bag:
        desk(bag)
    rig = write_rig(
        tmp_path / "rig.json", frame_rate="stamps", depth_unit=None, cameras=[{"pose": camera().camera_to_world.tolist()}]
    )
    given = {"recording": (path_of(tmp_path, form),), "rig": rig, "category": "ball"}
    capture, _ = make_capture(Intake(output=tmp_path / "capture", **given))
    assert (capture.frame_count, capture.description.frame_rate, capture.description.depth_unit) == (FRAMES, 30.0, 0.001)
    np.testing.assert_array_equal(capture.color("0", 3), seen(camera(), 3)[0])
    np.testing.assert_allclose(capture.depth("0", 3), seen(camera(), 3)[1], atol=0.0006)
    np.testing.assert_array_equal(capture.cameras["0"].intrinsics, K)
    assert f"{COLOR}: sensor_msgs/msg/Image, {FRAMES} messages" in Bag(given["recording"][0]).text()


@pytest.mark.parametrize(
    ("encoding", "change", "options"),
    [
        ("rgb8", lambda image: image, {"pad": 4}),
        ("bgr8", lambda image: image[..., ::-1], {}),
        ("rgba8", lambda image: np.dstack([image, image[..., :1]]), {}),
        ("16UC1", None, {"big": True}),
        ("32FC1", None, {}),
    ],
)
def test_encodings_and_order_of_the_log(tmp_path, encoding, change, options):
    color, depth = seen(camera())
    stored = change(color) if change else counts(depth) if encoding == "16UC1" else depth.astype(np.float32)
    with recorded(tmp_path / "film") as bag:
        for frame in (1, 0, 2):  # the log has the second before the first
            for topic, image, name, more in (
                (COLOR, color if change is None else stored, encoding if change else "rgb8", options if change else {}),
                (DEPTH, counts(depth) if change else stored, "16UC1" if change else encoding, {} if change else options),
            ):
                bag.image(topic, START + frame * STEP, image + np.array(frame, image.dtype), name, log=START, **more)
    (view,) = of(tmp_path / "film")
    assert view.unit == (1.0 if encoding == "32FC1" else 0.001) and view.lens is None
    for frame, (read_color, read_depth) in enumerate(view.read([0, 1, 2])):
        np.testing.assert_array_equal(read_color, color + np.uint8(frame))
        np.testing.assert_allclose(view.unit * read_depth, depth + view.unit * frame, atol=0.0006)


def test_compressed_images_and_packed_depth(tmp_path):
    color, depth = seen(camera())
    with recorded(tmp_path / "film") as bag:
        for frame in range(5):
            for form, image in (("rgb8; png compressed bgr8", color[..., ::-1]), ("rgb8; png compressed rgb8", color)):
                png = cv2.imencode(".png", image)[1].tobytes()
                bag.compressed(f"/{'a' if 'bgr8' in form else 'b'}/compressed", START + frame * STEP, png, form)
            deep = packed_depth(counts(depth))
            bag.compressed("/depth/compressedDepth", START + frame * STEP, deep, "16UC1; compressedDepth png")
            bag.compressed("/float/compressedDepth", START + frame * STEP, deep, "32FC1; compressedDepth png")
    with pytest.raises(InputError, match=r"one topic of color and one of depth are required; received 2 of color, 1 of depth"):
        of(tmp_path / "film")
    for name in "ab":
        (view,) = of(tmp_path / "film", topics=(f"/{name}/compressed", "/depth/compressedDepth"))
        (pair,) = view.read([2])
        np.testing.assert_array_equal(pair[0], color)
        np.testing.assert_array_equal(pair[1], counts(depth))
    for topics, words in (
        (("/a/compressed", "/float/compressedDepth"), r"a color and a depth topic are required.*depth /depth/compressedDepth"),
        (("/a/compressed", "/gone"), "received /a/compressed /gone"),
        (("/a/compressed",), "pairs COLOR DEPTH are required"),
    ):
        with pytest.raises(InputError, match=words):
            of(tmp_path / "film", topics=topics)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ("none", 0)),
        ({"d": np.array([0.1, 0.0, 0.0, 0.0, 0.0])}, ("opencv", 5)),
        ({"d": np.full(4, 0.1), "distortion_model": "equidistant"}, ("fisheye", 4)),
        ({"d": np.full(5, 0.1), "distortion_model": "inverse_brown_conrady"}, ("inverse_brown_conrady", 5)),
        ({"binning_x": 2}, "full images without binning"),
        ({"matrix": np.zeros((3, 3))}, None),
    ],
)
def test_the_lens_of_a_topic(tmp_path, changes, expected):
    with recorded(tmp_path / "film") as bag:
        bag.info("/camera/color/camera_info", **changes)
        for frame in range(2):
            bag.image(COLOR, START + frame * STEP, seen(camera())[0], "rgb8")
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            Bag(tmp_path / "film").lens(COLOR)
        return
    lens = Bag(tmp_path / "film").lens(COLOR)
    assert (lens and (lens.model, len(lens.distortion))) == expected
    assert lens is None or lens.size == SIZE


def test_depth_of_another_lens_and_other_files_are_refused(tmp_path):
    with recorded(tmp_path / "film") as bag:
        desk(bag)
        bag.info("/camera/aligned_depth_to_color/camera_info", np.diag([2.0, 2.0, 1.0]) @ K)
    with pytest.raises(InputError, match=r"depth must be aligned to color.*rs-convert or rs\.align"):
        of(tmp_path / "film")
    (tmp_path / "bad.mcap").write_bytes(b"no bag")
    for name in ("bad.mcap", "absent.bag"):
        with pytest.raises(InputError, match=rf"{name}: a readable ROS 1"):
            of(tmp_path / name)
