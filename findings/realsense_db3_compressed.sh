#!/usr/bin/env bash
# Guess: since 2.58 librealsense records to ROS 2 (.db3, "serialization_format: cdr"), so readers of ROS 2 read its default recordings.
# Seen: readers list topics and counts but cannot read one message: "Invalid or unsupported CDR encapsulation". Each message, also text,
#   is a Zstandard frame, because rs.recorder(file, device) compresses. The file does not say so: ROS 2 states compression in a
#   metadata.yaml, and librealsense writes none.
# Source: pyrealsense2 2.58.4.10922, rosbags 0.11.9; doc/record-and-playback.md of librealsense, whose later text (2.59) describes
#   compressed recordings as PNG in CompressedImage.
# Matters: recordings of 2.58 appear damaged to other tools, although all frames are there.
# Works: record with rs.recorder(file, device, False), or decompress each message with Zstandard.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv && venv/bin/python -m pip install --quiet --disable-pip-version-check \
    pyrealsense2==2.58.4.10922 rosbags==0.11.9 backports.zstd==1.8.0 numpy==2.4.6 || exit 2

cat >record.py <<'PYTHON'
"""Three frames of a depth camera that exists in software, by librealsense's own recorder: as by default, and not compressed."""

import time

import numpy as np
import pyrealsense2 as rs


def record(path, *compressed):
    lens, stream, device, queue = rs.intrinsics(), rs.video_stream(), rs.software_device(), rs.frame_queue(50)
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 64, 48, 60.0, 60.0, 31.5, 23.5
    lens.model = rs.distortion.brown_conrady
    stream.type, stream.fmt, stream.uid, stream.index, stream.fps, stream.bpp = rs.stream.depth, rs.format.z16, 0, 0, 30, 2
    stream.width, stream.height, stream.intrinsics = 64, 48, lens
    camera = device.add_sensor("Stereo Module")
    camera.add_read_only_option(rs.option.depth_units, 0.001)
    profile = camera.add_video_stream(stream)
    recorder = rs.recorder(path, device, *compressed)
    sensor = recorder.query_sensors()[0]
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(queue)
    for number in range(3):
        frame = rs.software_video_frame()
        frame.profile, frame.pixels = profile.as_video_stream_profile(), np.full((48, 64), 700, np.uint16)
        frame.frame_number, frame.stride, frame.bpp, frame.depth_units = number, 128, 2, 0.001
        frame.timestamp, frame.domain = 1.7e12 + number * 1000 / 30, rs.timestamp_domain.global_time
        camera.on_video_frame(frame)
        time.sleep(0.05)
    sensor.stop()
    sensor.close()


record("default.db3")
record("plain.db3", False)
PYTHON
cat >read.py <<'PYTHON'
from importlib.metadata import version
from pathlib import Path

from backports import zstd
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

print(*(f"{name} {version(name)}" for name in ("pyrealsense2", "rosbags")), sep=", ")
TYPES = get_typestore(Stores.ROS2_HUMBLE)
said, total, frames, depth = {}, {}, 0, set()
for name in ("default.db3", "plain.db3"):
    said[name], total[name] = [], 0
    with AnyReader([Path(name)], default_typestore=TYPES) as reader:
        for connection, _, raw in reader.messages():
            total[name] += 1
            try:
                reader.deserialize(raw, connection.msgtype)
            except AnyReaderError as error:
                said[name].append(str(error))
            if name == "default.db3" and raw[:4] == b"\x28\xb5\x2f\xfd":
                frames += 1
                message = TYPES.deserialize_cdr(zstd.decompress(raw), connection.msgtype)
                if connection.msgtype == "sensor_msgs/msg/Image":
                    depth |= set(message.data.view("<u2").tolist())
    print(f"{name}: {len(said[name])} of {total[name]} messages cannot be read", *sorted(set(said[name])))
print(f"frames of Zstandard in default.db3: {frames}; depth inside: {sorted(depth)}; metadata.yaml: {Path('metadata.yaml').exists()}")
compressed = total["default.db3"] == len(said["default.db3"]) == frames > 0 and depth == {700}
raise SystemExit(not (compressed and total["plain.db3"] and not said["plain.db3"]))
PYTHON
venv/bin/python record.py
venv/bin/python read.py
