"""ROS recordings: a ROS 1 .bag, a ROS 2 folder, or one .mcap or .db3 file, read with rosbags.

The images of a topic are sorted by the stamps in their headers. The lens is the `camera_info` next to the topic, or one level
above. Depth must be aligned to color; other depth, as in RealSense's own recordings, raises InputError.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.formats import CaptureFormat, require_kind
from neuspring.extensions.make_capture.options import Intake
from neuspring.extensions.make_capture.streams import CameraStreams, Kind, Series

ENCODINGS: dict[str, tuple[Kind, int, str, int | None]] = {
    "rgb8": ("color", 3, "u1", None),
    "bgr8": ("color", 3, "u1", cv2.COLOR_BGR2RGB),
    "rgba8": ("color", 4, "u1", cv2.COLOR_RGBA2RGB),
    "bgra8": ("color", 4, "u1", cv2.COLOR_BGRA2RGB),
    "yuv422_yuy2": ("color", 2, "u1", cv2.COLOR_YUV2RGB_YUYV),
    "16uc1": ("depth", 1, "u2", None),
    "mono16": ("depth", 1, "u2", None),
    "32fc1": ("depth", 1, "f4", None),
}
"""Encoding -> kind, channels, type of a channel, OpenCV's code for the conversion to RGB."""
ROS_UNITS = {"u": 0.001, "f": 1.0}
"""m per count of integers and of floating-point numbers (ROS, REP 118)."""
MODELS = {"plumb_bob": "opencv", "rational_polynomial": "opencv", "equidistant": "fisheye", "fisheye": "fisheye", "": "none"}
IMAGE_TYPES, INFO = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"), "sensor_msgs/msg/CameraInfo"


def decoded(where: Path, message: Any) -> np.ndarray:
    """RGB [H, W, 3] uint8 or depth [H, W] of an image message. Raises InputError for another encoding."""
    if hasattr(message, "format"):
        # compressedDepth has a header of 12 bytes before its PNG.
        data = message.data[12:] if "compressedDepth" in message.format else message.data
        image = None if message.format.startswith("32FC1") else cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if image is not None and (image.ndim == 2 or image.shape[2] == 3):
            # ROS's transport states the order in which the codec received the channels; OpenCV returns BGR.
            stored_rgb = ";" in message.format and "compressed bgr" not in message.format
            return image if image.ndim == 2 or stored_rgb else np.ascontiguousarray(image[..., ::-1])
        raise _unread(where, message.format)
    if message.encoding.lower() not in ENCODINGS:
        raise _unread(where, message.encoding)
    _, channels, form, code = ENCODINGS[message.encoding.lower()]
    stored = np.dtype(form).newbyteorder(">" if message.is_bigendian else "<")
    length = message.width * channels * stored.itemsize
    if message.step < length or message.data.size != message.height * message.step:
        raise InputError(where, f"{message.height} rows of {message.step} bytes are required", f"{message.data.size} bytes")
    rows = np.ascontiguousarray(message.data.reshape(message.height, message.step)[:, :length])
    image = rows.view(stored).astype(form).reshape(message.height, message.width, -1)
    image = image if code is None else cv2.cvtColor(image, code)
    return image if image.shape[2] == 3 else image[..., 0]


def _unread(where: Path, encoding: str) -> InputError:
    remedy = f"Record {' '.join(ENCODINGS)}, JPEG, PNG or compressedDepth of 16UC1, or convert with image_transport (republish)."
    return InputError(where, "images must have a supported encoding", repr(encoding), remedy)


@dataclass(frozen=True)
class Bag:
    """A recording with its topics."""

    path: Path

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the recording with rosbags. Raises InputError."""
        library = needed("rosbags.highlevel")
        try:
            with library.AnyReader([self.path]) as reader:
                yield reader
        except InputError:
            raise
        except Exception as error:  # A damaged file can raise any exception in rosbags and its codecs.
            rule = "a readable ROS 1 .bag, ROS 2 folder with metadata.yaml, .mcap or .db3 file is required"
            remedy = "Repair a truncated recording: rosbag reindex FILE, ros2 bag reindex FOLDER, or mcap recover FILE."
            raise InputError(self.path, rule, f"{type(error).__name__}: {error}".rstrip("."), remedy) from error

    @cached_property
    def topics(self) -> dict[str, tuple[str, int]]:
        """Topic -> type and number of messages. Raises InputError."""
        with self.opened() as reader:
            return {name: (one.msgtype or "", one.msgcount) for name, one in sorted(reader.topics.items())}

    def messages(self, topic: str) -> Iterator[Any]:
        """The messages of a topic, in the order of the log. Raises InputError."""
        with self.opened() as reader:
            for connection, _, raw in reader.messages([one for one in reader.connections if one.topic == topic]):
                yield reader.deserialize(raw, connection.msgtype)

    def text(self) -> str:
        """All topics, one per line."""
        return "\n".join([f"{self.path}:", *(f"  {name}: {kind}, {count} messages" for name, (kind, count) in self.topics.items())])

    def images(self, kind: Kind) -> list[str]:
        """Topics with images of one kind, judged by their first message."""
        names = []
        for name in (name for name, (type_, count) in self.topics.items() if type_ in IMAGE_TYPES and count):
            try:
                image = decoded(self.path, next(self.messages(name)))
            except InputError:
                continue
            names += [name] if (image.ndim == 3) == (kind == "color") else []
        return names

    def lens(self, topic: str) -> Lens | None:
        """The lens from the camera_info next to an image topic or one level above; None if there is none or it is uncalibrated."""
        near = topic.rpartition("/")[0]
        places = [f"{folder}/camera_info" for folder in (near, near.rpartition("/")[0])]
        info = next((name for name in places if self.topics.get(name, ("", 0))[0] == INFO), None)
        if info is None:
            return None
        message = next(self.messages(info))
        facts = {name.lower(): value for name, value in vars(message).items()}  # ROS 1 writes K, ROS 2 writes k.
        rectified, matrix = "rect" in topic.rsplit("/", 2)[-2] + topic.rsplit("/", 1)[-1], np.array(facts["k"]).reshape(3, 3)
        if rectified:
            matrix = np.array(facts["p"]).reshape(3, 4)[:, :3]
        if not matrix[0, 0]:
            return None
        if facts["roi"].width or max(facts["binning_x"], facts["binning_y"]) > 1:
            raise InputError(
                f"{self.path}#{info}", "full images without binning are required", "roi or binning", "State the lens with --rig."
            )
        distortion, model = np.array(facts["d"]), facts["distortion_model"].lower().replace(" ", "_")
        if rectified or not distortion.any():
            distortion, model = np.zeros(0), ""
        return Lens(matrix=matrix, distortion=distortion, model=MODELS.get(model, model), size=(facts["width"], facts["height"]))


@dataclass(frozen=True, eq=False)
class Topic:
    """The images of a topic."""

    bag: Bag
    name: str
    kind: Kind

    @property
    def path(self) -> Path:
        """The recording and the topic."""
        return Path(f"{self.bag.path}#{self.name}")

    @cached_property
    def order(self) -> list[tuple[float, int]]:
        """Stamp, s, and index in the log of each image, sorted by stamp. Raises InputError without stamps."""
        stamps = [message.header.stamp for message in self.bag.messages(self.name)]
        index_of = {stamp.sec + 1e-9 * stamp.nanosec: index for index, stamp in reversed(list(enumerate(stamps)))}
        if len(index_of) < 2:
            raise InputError(self.path, "headers with stamps are required", f"{len(index_of)} stamps", "Export folders of images.")
        return sorted(index_of.items())

    @cached_property
    def series(self) -> Series:
        """Times from the stamps."""
        return Series(list(range(len(self.order))), np.array([stamp for stamp, _ in self.order]), clock="ROS")

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """See `ImageSource.read`. Reads the log once, and keeps only images in memory that it contains early. Raises InputError."""
        wanted = {self.order[place][1]: turn for turn, place in enumerate(places)}
        early, turn = dict[int, np.ndarray](), 0
        for place, message in enumerate(self.bag.messages(self.name) if wanted else ()):
            if place in wanted:
                early[wanted[place]] = require_kind(self.path, self.kind, decoded(self.path, message))
            while turn in early:
                yield early.pop(turn)
                turn += 1

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files of the recording."""
        return sorted(filter(Path.is_file, self.bag.path.iterdir())) if self.bag.path.is_dir() else [self.bag.path]


def open_bags(intake: Intake) -> list[CameraStreams]:
    """One camera per pair of topics, all from one recording or one from each. Raises InputError that lists the topics."""
    views, topics = list[CameraStreams](), intake.topics
    pairs, paths = [topics[k : k + 2] for k in range(0, len(topics), 2)] or [()], list(intake.recording)
    paths = paths * len(pairs) if len(paths) == 1 else paths
    pairs = pairs * len(paths) if len(pairs) == 1 else pairs
    if len(topics) % 2 or len(pairs) != len(paths):
        raise InputError("--topics", f"pairs COLOR DEPTH are required, one or as many as recordings, {len(paths)}", len(topics))
    for number, (path, pair) in enumerate(zip(paths, pairs, strict=True)):
        bag = Bag(path)
        known = [bag.images("color"), bag.images("depth")]
        if not pair and any(len(names) != 1 for names in known):
            received, remedy = (
                f"{len(known[0])} of color, {len(known[1])} of depth",
                "State --topics COLOR DEPTH; --list prints all topics.",
            )
            raise InputError(path, "one topic of color and one of depth are required", received, remedy)
        color, depth = pair or (known[0][0], known[1][0])
        if color not in known[0] or depth not in known[1]:
            listed = f"color {' '.join(known[0])}; depth {' '.join(known[1])}"
            raise InputError(path, "--topics: a color and a depth topic are required", f"{color} {depth}", f"Choose from {listed}.")
        lens, other = bag.lens(color), bag.lens(depth)
        if lens is not None and other is not None and not np.allclose(lens.matrix, other.matrix):
            remedy = "Align depth with rs-convert or rs.align (RealSense), or record aligned_depth_to_color (ROS)."
            raise InputError(path, "depth must be aligned to color, with the same camera_info", f"two lenses, {depth}", remedy)
        unit = ROS_UNITS[decoded(path, next(bag.messages(depth))).dtype.kind]
        views.append(CameraStreams(str(number), Topic(bag, color, "color"), Topic(bag, depth, "depth"), unit=unit, lens=lens))
    return views


def is_bag(path: Path) -> bool:
    """True for a ROS recording."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


capture_format = CaptureFormat(about="a ROS bag", recognizes=is_bag, recording=open_bags)
