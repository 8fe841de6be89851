"""Recordings of ROS, written message by message: ROS 1, ROS 2 in both storages, and what librealsense writes."""

import struct
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from tests.support.desk import FRAMES, SIZE, K, camera, counts, seen

FORMS = ("ros1", "sqlite3", "mcap")
START = 1_700_000_000 * 10**9
STEP = 33_333_333
COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"


class Recording:
    """An open recording; topics come into being with their first message."""

    def __init__(self, writer, old):
        self.writer, self.old, self.topics = writer, old, dict[str, Any]()
        self.store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)

    def made(self, kind, **fields):
        """A message of a type like sensor_msgs/Image."""
        return self.store.types[kind.replace("/", "/msg/")](**fields)

    def header(self, stamp):
        """A header with a stamp, ns."""
        time = self.made("builtin_interfaces/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.made("std_msgs/Header", stamp=time, frame_id="1", **({"seq": 0} if self.old else {}))

    def put(self, topic, kind, log, more=b"", **fields):
        """Write a message at a time of the log, ns, with bytes that its definition does not have."""
        name = kind.replace("/", "/msg/")
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        message = self.made(kind, **fields)
        raw = self.store.serialize_ros1(message, name) if self.old else self.store.serialize_cdr(message, name)
        self.writer.write(self.topics[topic], log, self.packed(bytes(raw) + more))

    def packed(self, raw):
        """A message as it is stored."""
        return raw

    def image(self, topic, stamp, data, encoding, log=None, **options):
        """An image as stored [H, W, ...]; `pad`: bytes at the end of each row; `big`: of big endian."""
        big = options.get("big", False)
        rows = np.ascontiguousarray(data.astype(data.dtype.newbyteorder(">")) if big else data).view(np.uint8)
        rows = np.pad(rows.reshape(len(data), -1), ((0, 0), (0, options.get("pad", 0))), constant_values=77)
        about = {"height": data.shape[0], "width": data.shape[1], "is_bigendian": int(big), "step": rows.shape[1]}
        fields = about | {"header": self.header(stamp), "encoding": encoding, "data": rows.ravel()}
        self.put(topic, "sensor_msgs/Image", stamp if log is None else log, options.get("more", b""), **fields)

    def compressed(self, topic, stamp, data, form):
        """A compressed image."""
        packed = np.frombuffer(data, np.uint8)
        self.put(topic, "sensor_msgs/CompressedImage", stamp, header=self.header(stamp), format=form, data=packed)

    def info(self, topic, matrix=K, size=SIZE, **changes):
        """A camera_info."""
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False} | changes.pop("roi", {})
        said = {"d": np.zeros(5), "k": matrix.ravel(), "r": np.eye(3).ravel(), "p": np.zeros(12)} | changes
        names = {key.upper() if self.old and key in "dkrp" else key: value for key, value in said.items()}
        plain = {"header": self.header(START), "height": size[1], "width": size[0], "distortion_model": "plumb_bob"}
        plain |= {"binning_x": 0, "binning_y": 0, "roi": self.made("sensor_msgs/RegionOfInterest", **roi)}
        self.put(topic, "sensor_msgs/CameraInfo", START, **(plain | names))


@contextmanager
def recorded(path, form="mcap"):
    """A recording at a path, .bag for ROS 1."""
    if form == "ros1":
        writer = rosbag1.Writer(path)
        writer.set_compression(writer.CompressionFormat.LZ4)  # as librealsense does
        with writer:
            yield Recording(writer, True)
        return
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[form.upper()]) as writer:
        yield Recording(writer, False)


def desk(bag, view=0, prefix="", late=2_000_000):
    """A film of the desk by one of its cameras: depth is stamped a little later."""
    bag.info(f"{prefix}/camera/color/camera_info")
    for frame in range(FRAMES):
        color, depth = seen(camera(view), frame)
        bag.image(prefix + COLOR, START + frame * STEP, color, "rgb8")
        bag.image(prefix + DEPTH, START + frame * STEP + late, counts(depth), "16UC1")


def packed_depth(depth, scale=0.0, shift=0.0):
    """Counts [H, W] as compressedDepth has them."""
    return struct.pack("<iff", 0, scale, shift) + cv2.imencode(".png", depth)[1].tobytes()
