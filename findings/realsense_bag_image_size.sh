#!/usr/bin/env bash
# Guess: a recording of librealsense is a ROS 1 bag that contains the definitions of its messages, so any reader of bags returns its images.
# Seen: each image is four bytes longer than the bag's own definition of sensor_msgs/Image, and rosbags refuses it: "ROS1 message size
#   mismatch". The four bytes are a float: meters per count for depth, 0 for color. The checksum of the type is still that of ROS.
# Source: pyrealsense2 2.56.5.9235, rosbags 0.11.9; Image.h of librealsense (third-party/realsense-file/rosbag/msgs/sensor_msgs) writes
#   depth_units after data if the header's version is "1", and its definition in the same file does not contain it.
# Matters: many reconstructions start from recordings of these cameras. A reader that skips unreadable messages returns no images. A
#   reader that ignores the four bytes loses the only unit of depth in the message.
# Works: get_msgdef(type).deserialize_ros1 returns where it ended; the remaining bytes are the unit.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv && venv/bin/python -m pip install --quiet --disable-pip-version-check \
    pyrealsense2==2.56.5.9235 rosbags==0.11.9 numpy==2.4.6 || exit 2

cat >record.py <<'PYTHON'
"""Three frames of a depth and a color camera that exist in software, by librealsense's own recorder."""

import time

import numpy as np
import pyrealsense2 as rs

SIZE = 64, 48


def stream(kind, form, number, count):
    lens, made = rs.intrinsics(), rs.video_stream()
    lens.width, lens.height = SIZE
    lens.fx = lens.fy = 60.0
    lens.ppx, lens.ppy, lens.model = 31.5, 23.5, rs.distortion.brown_conrady
    made.type, made.fmt, made.uid, made.index, made.fps, made.bpp = kind, form, number, 0, 30, count
    made.width, made.height = SIZE
    made.intrinsics = lens
    return made


def record():
    device, queue = rs.software_device(), rs.frame_queue(50)
    cameras = device.add_sensor("Stereo Module"), device.add_sensor("RGB Camera")
    cameras[0].add_read_only_option(rs.option.depth_units, 0.0001)
    profiles = [
        cameras[0].add_video_stream(stream(rs.stream.depth, rs.format.z16, 0, 2)),
        cameras[1].add_video_stream(stream(rs.stream.color, rs.format.rgb8, 1, 3)),
    ]
    recorder = rs.recorder("film.bag", device)
    for sensor in recorder.query_sensors():
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    images = np.full(SIZE[::-1], 7000, np.uint16), np.full((*SIZE[::-1], 3), 90, np.uint8)
    for number in range(3):
        for camera, profile, image in zip(cameras, profiles, images):
            frame = rs.software_video_frame()
            frame.profile, frame.pixels, frame.frame_number = profile.as_video_stream_profile(), image, number
            frame.stride, frame.bpp = image[0].nbytes, image[0, 0].nbytes
            frame.timestamp, frame.domain = 1.7e12 + number * 1000 / 30, rs.timestamp_domain.global_time
            frame.depth_units = 0.0001 if camera is cameras[0] else 0.0
            camera.on_video_frame(frame)
        time.sleep(0.05)
    for sensor in recorder.query_sensors():
        sensor.stop()
        sensor.close()


record()
PYTHON
cat >read.py <<'PYTHON'
import struct
from importlib.metadata import version
from pathlib import Path

from rosbags.highlevel import AnyReader, AnyReaderError

print(*(f"{name} {version(name)}" for name in ("pyrealsense2", "rosbags")), sep=", ")
refused, more = [], []
with AnyReader([Path("film.bag")]) as reader:
    for connection, _, raw in reader.messages([one for one in reader.connections if one.msgtype == "sensor_msgs/msg/Image"]):
        named = "depth_units" in connection.msgdef.data
        try:
            reader.deserialize(raw, connection.msgtype)
        except AnyReaderError as error:
            refused.append(str(error))
        definition = reader.typestore.get_msgdef(connection.msgtype)
        image, end = definition.deserialize_ros1(raw, 0, definition.cls, reader.typestore)
        more.append(raw[end:])
        print(f"{connection.topic}: {image.encoding}, {len(raw)} bytes, defined {end}, left {raw[end:].hex()}, defined unit: {named}")
print(f"{len(refused)} of {len(more)} images are refused:", *sorted(set(refused)))
units = sorted({round(struct.unpack("<f", one)[0], 9) for one in more if len(one) == 4})
print("the four bytes as a float:", *units)
raise SystemExit(not (more and len(refused) == len(more) and units == [0.0, 0.0001] and not named))
PYTHON
venv/bin/python record.py
venv/bin/python read.py
