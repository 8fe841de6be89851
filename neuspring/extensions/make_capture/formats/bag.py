"""A recording of ROS: a ROS 1 .bag, a ROS 2 folder, or one .mcap or .db3 file, read by rosbags.

Pictures are those of a topic, in the order of the stamps in their headers, which alone say when they were taken: the times of the
log say when they arrived. Messages are read by ROS's own definitions, not by the bag's: some bags define a part of their types.

librealsense (.bag up to 2.57, then .db3) departs from it: images of a .bag have four bytes more than the bag defines, their unit of
depth; the stamps of a .db3 are times of the log, and text beside the images has the camera's; depth is not aligned to color.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.feeds import Kind, Paired, Recorded, names_of
from neuspring.extensions.make_capture.formats import CaptureFormat, require_kind
from neuspring.extensions.make_capture.moments import Series


@dataclass(frozen=True)
class Encoding:
    """One way to store pixels."""

    kind: Kind
    channels: int = 1
    form: str = "u1"
    to_rgb: int | None = None
    """OpenCV's code."""
    unit: float | None = None
    """m per count of depth, as ROS has it."""


# fmt: off
ENCODINGS = {
    "rgb8": Encoding("color", 3), "bgr8": Encoding("color", 3, to_rgb=cv2.COLOR_BGR2RGB),
    "rgba8": Encoding("color", 4, to_rgb=cv2.COLOR_RGBA2RGB), "bgra8": Encoding("color", 4, to_rgb=cv2.COLOR_BGRA2RGB),
    **dict.fromkeys(("yuv422", "uyvy"), Encoding("color", 2, to_rgb=cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), Encoding("color", 2, to_rgb=cv2.COLOR_YUV2RGB_YUYV)),
    **dict.fromkeys(("mono8", "8uc1"), Encoding("color", to_rgb=cv2.COLOR_GRAY2RGB)),
    **dict.fromkeys(("16uc1", "mono16"), Encoding("depth", form="u2", unit=0.001)), "32fc1": Encoding("depth", form="f4", unit=1.0),
}
"""Names of ROS and librealsense, in small letters."""
# fmt: on
DECODED = {("uint8", 1): "mono8", ("uint8", 3): "bgr8", ("uint8", 4): "bgra8", ("uint16", 1): "16uc1"}
"""OpenCV's result of JPEG and PNG: type and channels -> encoding."""
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, STRING = "sensor_msgs/msg/CameraInfo", "std_msgs/msg/String"
MESSAGES = (IMAGE, COMPRESSED, INFO, STRING, "geometry_msgs/msg/Transform", "std_msgs/msg/Float32")
"""Types of messages."""
TRANSPORT = struct.Struct("<iff")
"""The head of compressedDepth, before its PNG: a number, and A and B of depth = A / (count - B), for floating point."""
CAPTURED, DECIMAL = re.compile(r"(?:^|;)timestamp=([0-9.]+)"), re.compile(r"-?[0-9.]+(?:e-?[0-9]+)?")
"""Patterns of librealsense's text: ms of an image, and the numbers of a transform, by columns."""
ZSTANDARD = b"\x28\xb5\x2f\xfd"
"""First bytes of what Zstandard compressed; rosbags brings it."""
GAP = 0.3
"""Pixels. Noise of depth parts areas that are neighbors in another view: a gap is filled from as far as this."""
SINCE_1970 = 1e9
"""s. Stamps below it are those of a device's clock."""


def decoded(where: Path, message: Any) -> tuple[str, np.ndarray]:
    """The encoding of an image message, and its pixels: RGB [H, W, 3] uint8, or depth [H, W]. Raises InputError for another one."""
    if hasattr(message, "format"):
        name, image = _decompressed(where, message)
    else:
        name = message.encoding.lower()
        if name not in ENCODINGS:
            raise _unread(where, message.encoding)
        form = np.dtype(ENCODINGS[name].form).newbyteorder(">" if message.is_bigendian else "<")
        length = message.width * ENCODINGS[name].channels * form.itemsize
        if message.step < length or message.data.size != message.height * message.step:
            rule = f"{message.height} rows of {message.step} bytes, {length} of them pixels, are required"
            raise InputError(where, rule, f"{message.data.size} bytes", "Leave these frames out with --frames.")
        rows = message.data.reshape(message.height, message.step)[:, :length]
        image = np.ascontiguousarray(rows).view(form).astype(ENCODINGS[name].form).reshape(message.height, message.width, -1)
    if (code := ENCODINGS[name].to_rgb) is not None:
        return name, cv2.cvtColor(image, code)
    return name, image if image.shape[2] == 3 else image[..., 0]


def _decompressed(where: Path, message: Any) -> tuple[str, np.ndarray]:
    source, data, deep = message.format, message.data, "compressedDepth" in message.format
    packed = data[TRANSPORT.size if deep else 0 :]
    image = cv2.imdecode(packed, cv2.IMREAD_UNCHANGED) if packed.size else None
    image = None if image is None else image.reshape(*image.shape[:2], -1)
    if image is None or (image.dtype.name, image.shape[2]) not in DECODED:
        raise _unread(where, source)
    name = DECODED[image.dtype.name, image.shape[2]]
    if deep and source.startswith("32FC1"):
        _, scale, shift = TRANSPORT.unpack(data[: TRANSPORT.size].tobytes())
        return "32fc1", np.where(image > 0, scale / np.maximum(image.astype(float) - shift, 1e-6), 0).astype(np.float32)
    # ROS's transport names the order in which it gave the channels to the codec; without any it is that of OpenCV.
    if ";" in source and "compressed bgr" not in source:
        name = name.replace("bgr", "rgb")
    return name, image


def _unread(where: Path, encoding: str) -> InputError:
    read = f"Read are {' '.join(ENCODINGS)}, JPEG and PNG, and compressedDepth as PNG. "
    remedy = read + "Record it so, or convert it with ROS's image_transport (republish)."
    return InputError(where, "images of an encoding that is read are required", repr(encoding), remedy)


@dataclass(frozen=True, eq=False)
class Summary:
    """A topic in short."""

    kind: str
    """Type of its messages."""
    count: int
    rate: float
    """Messages per second of the recording."""
    first: Any
    """Its first message, if it is one of `MESSAGES`; else None."""
    more: bytes
    """Bytes of the first that its definition leaves over."""


@dataclass(frozen=True)
class Bag:
    """A recording with its topics."""

    path: Path

    @cached_property
    def _new(self) -> bool:
        """True for ROS 2."""
        return self.path.suffix.lower() != ".bag"

    @cached_property
    def _types(self) -> Any:
        """ROS's own definitions."""
        types = needed("rosbags.typesys")
        return types.get_typestore(types.Stores.ROS2_HUMBLE if self._new else types.Stores.ROS1_NOETIC)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """The reader of rosbags. Raises InputError."""
        library = needed("rosbags.rosbag2" if self._new else "rosbags.rosbag1")
        rule = "a ROS 1 .bag, a ROS 2 folder with metadata.yaml, an .mcap or a .db3 file is required"
        try:
            with library.Reader(self.path) as reader:
                yield reader
        except InputError:
            raise
        except FileNotFoundError as error:
            raise InputError(self.path, rule, "nothing there") from error
        except Exception as error:  # rosbags and its codecs raise whatever a damaged file leads them to
            remedy = "If it was cut off: rosbag reindex FILE (ROS 1), ros2 bag reindex FOLDER (ROS 2), mcap recover FILE (.mcap)."
            raise InputError(self.path, rule, f"{type(error).__name__}: {error}".rstrip("."), remedy) from error

    @cached_property
    def topics(self) -> dict[str, Summary]:
        """Facts of the topics, by name. Raises InputError."""
        with self._opened() as reader:
            seconds = max(reader.duration, 1) / 1e9
            found = {}
            for name, one in sorted(reader.topics.items()):
                first, more = next(self._all(reader, name) if one.msgtype in MESSAGES else iter(()), (None, b""))
                found[name] = Summary(one.msgtype or "", one.msgcount, max(one.msgcount - 1, 0) / seconds, first, more)
            return found

    def messages(self, topic: str) -> Iterator[tuple[Any, bytes]]:
        """Its messages, and what their definition leaves over. Raises InputError."""
        with self._opened() as reader:
            yield from self._all(reader, topic)

    def _all(self, reader: Any, topic: str) -> Iterator[tuple[Any, bytes]]:
        for connection, _, raw in reader.messages([one for one in reader.connections if one.topic == topic]):
            if self._new:
                # librealsense 2.58 compresses each message, and the file does not say so.
                plain = needed("backports.zstd").decompress(raw) if bytes(raw[:4]) == ZSTANDARD else raw
                yield self._types.deserialize_cdr(plain, connection.msgtype), b""
                continue
            # Not the store's own deserialize_ros1, which refuses bytes that are left over.
            definition = self._types.get_msgdef(connection.msgtype)
            message, end = definition.deserialize_ros1(raw, 0, definition.cls, self._types)
            yield message, raw[end:]

    def stamps(self, topic: str) -> list[int]:
        """When the images of a topic were taken, ns; 0: not said. Raises InputError."""
        beside = topic.partition("/image/data")[0] + "/image/metadata"
        if beside not in self.topics or self.topics[beside].kind != STRING:
            stamps = [message.header.stamp for message, _ in self.messages(topic)]
            return [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps]
        said = [CAPTURED.search(message.data) for message, _ in self.messages(beside)]
        times = [round(1e6 * float(one[1])) for one in said if one]
        if len(times) != self.topics[topic].count:
            rule = f"a timestamp in {beside} is required for each image, {self.topics[topic].count}"
            raise InputError(self.path, rule, len(times), "Export it with librealsense, and give folders.")
        return times

    def first(self, beside: str, suffix: str = "") -> Any:
        """The first message of the topic that begins and ends so; None without any."""
        named = (one.first for name, one in self.topics.items() if name.startswith(beside) and name.lower().endswith(suffix))
        return next(named, None)

    @cached_property
    def images(self) -> dict[str, tuple[str, str]]:
        """Topics of images: the encoding, empty if it is not read, and the first image in words. Raises InputError."""
        found = {}
        for topic, one in self.topics.items():
            if one.kind not in (IMAGE, COMPRESSED) or one.first is None:
                continue
            try:
                name, image = decoded(self.path, one.first)
                found[topic] = name, f"{ENCODINGS[name].kind}, {name}, {image.shape[1]} x {image.shape[0]}"
            except InputError:
                found[topic] = "", f"images that are not read, {getattr(one.first, 'format', '') or one.first.encoding}"
        return found

    def text(self) -> str:
        """All topics, a line each."""
        lines = []
        for name, one in self.topics.items():
            told = self.images[name][1] if name in self.images else "not images"
            lines.append(f"  {name}: {one.kind}, {one.count} messages, {one.rate:.3g} Hz: {told}")
        return "\n".join([f"{self.path}:", *lines])

    def pair(self, topics: Sequence[str]) -> tuple[str, str]:
        """The topics of color and depth that are named, or the only ones. Raises InputError that lists those that are there."""
        listed = "; ".join(f"{name} ({text})" for name, (_, text) in self.images.items()) or "none"
        for name in topics:
            if name not in self.images:
                raise InputError(self.path, "--topics: topics of images are required", name, f"There are: {listed}.")
        if topics:
            return topics[0], topics[1]
        of = {name: ENCODINGS[encoding] for name, (encoding, _) in self.images.items() if encoding}
        color = [name for name, one in of.items() if one.kind == "color" and one.channels > 1]
        depth = [name for name, one in of.items() if one.kind == "depth"]
        if len(color) != 1 or len(depth) != 1:
            rule, remedy = "without --topics one topic of color and one of depth are required", "Name them, --topics COLOR DEPTH."
            raise InputError(self.path, rule, f"{len(color)} and {len(depth)}", f"{remedy} There are: {listed}.")
        return color[0], depth[0]

    def lens(self, topic: str) -> Lens | None:
        """The lens by the camera_info beside a topic of images, or one level above; None without any, or uncalibrated."""
        near = topic.rpartition("/")[0]
        places = [f"{folder}{inside}/camera_info" for folder in (near, near.rpartition("/")[0]) for inside in ("", "/info")]
        known = (self.topics[name] for name in places if name in self.topics)
        message = next((one.first for one in known if one.kind == INFO), None)
        if message is None:
            return None
        said = {name.lower(): value for name, value in vars(message).items()}  # K of ROS 1 is k of ROS 2
        rectified = "rect" in topic.rpartition("/")[2] or "rect" in near.rpartition("/")[2]
        matrix = np.array(said["p"]).reshape(3, 4)[:, :3] if rectified else np.array(said["k"]).reshape(3, 3)
        if not matrix[0, 0]:
            return None
        roi, binned = said["roi"], np.maximum([said["binning_x"], said["binning_y"]], 1)
        whole = (roi.width, roi.height) if roi.width else (said["width"], said["height"])
        matrix[:2, 2] -= [roi.x_offset, roi.y_offset]
        matrix[:2] /= binned[:, None]
        size = (int(whole[0] // binned[0]), int(whole[1] // binned[1]))
        model = said["distortion_model"].lower().replace(" ", "_")
        return Lens(matrix=matrix, distortion=np.zeros(0) if rectified else np.array(said["d"]), model=model or "opencv", size=size)


@dataclass(frozen=True, eq=False)
class Topic:
    """The images of a topic."""

    bag: Bag
    name: str
    kind: Kind
    onto: Callable[[np.ndarray], np.ndarray] | None = None
    """Moves depth into the view of color."""

    @property
    def path(self) -> Path:
        """The recording and the topic."""
        return Path(f"{self.bag.path}#{self.name}")

    @cached_property
    def _order(self) -> list[tuple[int, int]]:
        """Stamp, ns, and place in the log, in the order of stamps: each is one image. Without stamps, 0 and that of the log."""
        listed = [(stamp, place) for place, stamp in enumerate(self.bag.stamps(self.name))]
        if max(stamp for stamp, _ in listed) <= 0:
            return [(0, place) for _, place in listed]
        return sorted({stamp: (stamp, place) for stamp, place in reversed(listed)}.values())

    @cached_property
    def series(self) -> Series:
        """By the stamps."""
        times = np.array([stamp for stamp, _ in self._order]) * 1e-9
        numbers = list(range(len(times)))
        if not times.any():
            return Series(numbers)
        return Series(numbers, times=times, clock="wall" if times[-1] > SINCE_1970 else str(self.bag.path))

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """As a folder, in one pass; only what the log has too early is held. Raises InputError."""
        wanted = {self._order[place][1]: turn for turn, place in enumerate(places)}
        early: dict[int, np.ndarray] = {}
        turn = 0
        for place, (message, _) in enumerate(self.bag.messages(self.name) if wanted else ()):
            if place in wanted:
                image = require_kind(self.path, self.kind, decoded(self.path, message)[1])
                early[wanted[place]] = image if self.onto is None else self.onto(image)
            while turn in early:
                yield early.pop(turn)
                turn += 1
            if turn == len(wanted):
                return

    def files(self, places: Sequence[int]) -> list[Path]:
        """The recording."""
        return sorted(filter(Path.is_file, self.bag.path.iterdir())) if self.bag.path.is_dir() else [self.bag.path]


@dataclass(frozen=True, eq=False)
class DepthRegistration:
    """Moves depth into the view of another camera: every pixel is an area there, and the nearest counts."""

    source: Lens
    target: Lens
    motion: np.ndarray
    """[4, 4], from the one to the other, m."""
    unit: float

    def __call__(self, depth: np.ndarray) -> np.ndarray:
        """In the size of the other camera, in the same unit."""
        assert self.target.size is not None, "the lens is of a camera_info"
        y, x = np.nonzero(depth)
        if not len(x):
            return np.zeros(self.target.size[::-1], depth.dtype)
        meters = depth[y, x] * self.unit
        (one, _), (other, _), (_, far) = (self._moved(x + side, y + side, meters) for side in (-0.5, 0.5, 0.0))
        left, right = np.minimum(one, other), np.maximum(one, other)
        plain, wide = (self._nearest(left - more, right + more, far) for more in (0.0, GAP))
        seen = np.where(np.isfinite(plain), plain, wide)
        counts = np.where(np.isfinite(seen), seen / self.unit, 0.0)
        return (np.round(counts) if depth.dtype.kind == "u" else counts).astype(depth.dtype)

    def _nearest(self, left: np.ndarray, right: np.ndarray, far: np.ndarray) -> np.ndarray:
        """The least depth of the areas, from `left` to `right` [n, 2], that a pixel's center [H, W] lies in; infinite: none."""
        assert self.target.size is not None, "the lens is of a camera_info"
        seen = np.full(self.target.size[::-1], np.inf)
        first, end = np.ceil(left).astype(int), np.ceil(right).astype(int)
        for across, down in np.ndindex(*(end - first).max(axis=0, initial=0)):
            column, row = first[:, 0] + across, first[:, 1] + down
            inside = (column < end[:, 0]) & (row < end[:, 1]) & (far > 0)
            inside &= (column >= 0) & (row >= 0) & (column < seen.shape[1]) & (row < seen.shape[0])
            np.minimum.at(seen, (row[inside], column[inside]), far[inside])
        return seen

    def _moved(self, x: np.ndarray, y: np.ndarray, meters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [n, 2] and depth [n], m, in the other view."""
        rays = np.stack([x, y, np.ones_like(meters)], axis=1) @ np.linalg.inv(self.source.matrix).T
        points = (rays * meters[:, None]) @ self.motion[:3, :3].T + self.motion[:3, 3]
        if not self.target.distortion.any():
            flat = points @ self.target.matrix.T
            return flat[:, :2] / flat[:, 2:], points[:, 2]
        still = np.zeros(3)
        # librealsense reads the coefficients so whatever it calls the model.
        pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), still, still, self.target.matrix, self.target.distortion)
        return pixels.reshape(-1, 2), points[:, 2]


def _camera(bag: Bag, topics: Sequence[str], name: str) -> Paired:
    """One camera. What librealsense records is not aligned: it is moved into the view of color. Raises InputError."""
    color, depth = bag.pair(topics)
    lens, encoding = bag.lens(color), ENCODINGS.get(bag.images[depth][0])
    streams = [topic.partition("/image/data")[0] for topic in (color, depth)]
    said, more = bag.first(streams[1].rpartition("/")[0] + "/option/", "units/value"), bag.topics[depth].more
    told = struct.unpack("<f", more)[0] if len(more) == 4 else said.data if said else 0.0
    # A float of 32 bits: 0.001 is 0.0010000000475.
    unit = round(float(told), 9) or (encoding.unit if encoding else None)
    motions = [_motion(bag.first(f"{stream}/tf/")) for stream in streams]
    onto, deep = None, bag.lens(depth)
    if lens is not None and deep is not None and unit and all(motion is not None for motion in motions):
        if deep.distortion.any():
            remedy = "Align it with librealsense (rs.align), and give folders."
            raise InputError(bag.path, f"depth of {depth} must be without distortion to be aligned", deep.model, remedy)
        onto = DepthRegistration(deep, lens, motions[0] @ np.linalg.inv(motions[1]), unit)
    return Paired(name, Topic(bag, color, "color"), Topic(bag, depth, "depth", onto), unit=unit, lens=lens)


def _motion(message: Any) -> Any:
    """[4, 4] of a transform, as a message or in words; None of none."""
    if message is None:
        return None
    motion = np.eye(4)
    if hasattr(message, "data"):
        numbers = [float(number) for number in DECIMAL.findall(message.data)]
        motion[:3, :3], motion[:3, 3] = np.reshape(numbers[:9], (3, 3)).T, numbers[9:]
        return motion
    turn, shift = message.rotation, message.translation
    motion[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    motion[:3, 3] = shift.x, shift.y, shift.z
    return motion


def open_bags(paths: Sequence[Path], cameras: Sequence[str] = (), topics: Sequence[str] = ()) -> Recorded:
    """Cameras by pairs of topics, all of one recording or one of each, or by the only pair of each. Raises InputError."""
    pairs = [topics[k : k + 2] for k in range(0, len(topics), 2)] or [()]
    if len(topics) % 2 or (len(pairs) != len(paths) and min(len(pairs), len(paths)) > 1):
        rule = f"pairs COLOR DEPTH are required, one or as many as recordings, {len(paths)}"
        raise InputError("--topics", rule, f"{len(topics)} topics", "--list prints them.")
    bags = [Bag(path) for path in paths]
    chosen = list(zip(bags * len(pairs) if len(bags) == 1 else bags, pairs * len(bags) if len(pairs) == 1 else pairs, strict=True))
    names = names_of(len(chosen), cameras)
    return Recorded(views=[_camera(bag, pair, name) for (bag, pair), name in zip(chosen, names, strict=True)])


def is_bag(path: Path) -> bool:
    """True for a recording of ROS."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


capture_format = CaptureFormat(about="a ROS bag", recognizes=is_bag, recording=open_bags)
