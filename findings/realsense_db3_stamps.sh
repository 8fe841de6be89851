#!/usr/bin/env bash
# Guess: in a ROS 2 recording of librealsense, header.stamp of an image is the time of exposure, as in ROS and in the .bag of its
#   version 2.56, and 16UC1 depth is in millimeters (REP 118).
# Seen: header.stamp is the time at which the image reached the recorder, counted from the start of the recording. It begins near 0 and
#   has the jitter of arrival. The camera's time is text in image/metadata, in milliseconds. Depth is in counts of the device, whose size
#   is text in option/Depth_Units/value. At 0.1 mm a reader that follows ROS returns ten times the distance, without error or warning.
# Source: pyrealsense2 2.59.1.11053, rosbags 0.11.9; src/media/ros2/ros2_writer.cpp of librealsense; REP 118 of ROS.
# Matters: headers cannot synchronize two cameras. Steps between frames are those of the computer, so velocities are wrong. An object
#   that is reconstructed with the usual unit has a wrong size, and with gravity in m/s2 a wrong stiffness.
# Works: read timestamp= in image/metadata and the value of Depth_Units.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv && venv/bin/python -m pip install --quiet --disable-pip-version-check \
    pyrealsense2==2.59.1.11053 rosbags==0.11.9 opencv-python-headless==5.0.0.93 numpy==2.4.6 || exit 2

cat >record.py <<'PYTHON'
"""Four frames of a wall at 0.7 m, taken every 40 ms on 14 November 2023 and handed over every 100 ms, by librealsense's recorder."""

import time

import numpy as np
import pyrealsense2 as rs


def record():
    lens, stream, device, queue = rs.intrinsics(), rs.video_stream(), rs.software_device(), rs.frame_queue(50)
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 64, 48, 60.0, 60.0, 31.5, 23.5
    lens.model = rs.distortion.brown_conrady
    stream.type, stream.fmt, stream.uid, stream.index, stream.fps, stream.bpp = rs.stream.depth, rs.format.z16, 0, 0, 25, 2
    stream.width, stream.height, stream.intrinsics = 64, 48, lens
    camera = device.add_sensor("Stereo Module")
    camera.add_read_only_option(rs.option.depth_units, 0.0001)
    profile = camera.add_video_stream(stream)
    recorder = rs.recorder("film.db3", device)
    sensor = recorder.query_sensors()[0]
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(queue)
    for number in range(4):
        frame = rs.software_video_frame()
        frame.profile, frame.pixels = profile.as_video_stream_profile(), np.full((48, 64), 7000, np.uint16)
        frame.frame_number, frame.stride, frame.bpp, frame.depth_units = number, 128, 2, 0.0001
        frame.timestamp, frame.domain = 1.7e12 + 40 * number, rs.timestamp_domain.global_time
        camera.on_video_frame(frame)
        time.sleep(0.1)
    sensor.stop()
    sensor.close()


record()
PYTHON
cat >read.py <<'PYTHON'
import re
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

print(*(f"{name} {version(name)}" for name in ("pyrealsense2", "rosbags")), sep=", ")
stamps, taken, depths, unit = [], [], set(), 0.0
with AnyReader([Path("film.db3")], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
    for connection, _, raw in reader.messages():
        message = reader.deserialize(raw, connection.msgtype)
        if connection.topic.endswith("image/data/compressedDepth"):
            stamps.append(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)
            form = message.format
            depths |= set(np.unique(cv2.imdecode(message.data[12:], cv2.IMREAD_UNCHANGED)).tolist())
        elif connection.topic.endswith("image/metadata"):
            taken.append(float(re.search(r"timestamp=([\d.]+)", message.data)[1]) / 1000)
        elif connection.topic.endswith("Depth_Units/value"):
            unit = float(message.data)
print("header.stamp, s:            ", *(f"{one:.3f}" for one in stamps))
print("timestamp in the text, s:   ", *(f"{one:.3f}" for one in taken))
print(f"mean step, s: headers {np.diff(stamps).mean():.3f}, text {np.diff(taken).mean():.3f}; frames were taken every 0.040")
print(f"depth as {form}: {sorted(depths)}: {max(depths) / 1000} m by REP 118, {max(depths) * unit:.3f} m with Depth_Units {unit}")
early = max(stamps) < 60 and abs(taken[0] - 1.7e9) < 0.01
other = np.diff(stamps).mean() > 0.08 and abs(np.diff(taken).mean() - 0.04) < 0.002
counts = form.startswith("16UC1") and depths == {7000} and unit == 0.0001
raise SystemExit(not (len(stamps) == len(taken) == 4 and early and other and counts))
PYTHON
venv/bin/python record.py
venv/bin/python read.py
