#!/usr/bin/env bash
# Guess: cv2.imread reads a depth map in .exr if OPENCV_IO_ENABLE_OPENEXR=1 is set before the import, as all advice says. Without the
#   variable, an error names it.
# Seen: the wheel of 4.14.0.94 behaves so. The wheel of 5.0.0.93 is built without OpenEXR: imread returns None with and without the
#   variable, without a message, and haveImageReader is False.
# Source: opencv-python-headless 5.0.0.93 and 4.14.0.94, OpenEXR 3.5.3; cv2.getBuildInformation(), line OpenEXR; for the advice,
#   opencv/opencv issue 21928.
# Matters: renderers and depth networks write .exr. An update of OpenCV turns each depth map into None. A loader that skips unreadable
#   files takes this for missing depth.
# Works: OpenEXR.File(path).channels()[name].pixels.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
for version in 4.14.0.94 5.0.0.93; do
    python3 -m venv "$version" && "$version/bin/python" -m pip install --quiet --disable-pip-version-check \
        "opencv-python-headless==$version" OpenEXR==3.5.3 || exit 2
done

cat >read.py <<'PYTHON'
import sys

import cv2
import numpy as np
import OpenEXR

depth = 0.5 + np.arange(12, dtype=np.float32).reshape(3, 4) / 8
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
with OpenEXR.File(header, {"Y": depth}) as file:
    file.write("depth.exr")
with OpenEXR.File("depth.exr") as file:
    back = file.channels()["Y"].pixels
try:
    image = cv2.imread("depth.exr", cv2.IMREAD_UNCHANGED)
except cv2.error as error:
    print(f"OpenCV {cv2.__version__}: error, names the variable: {'OPENCV_IO_ENABLE_OPENEXR' in str(error)}")
    raise SystemExit(sys.argv[1] != "error") from None
built = next(line.split(":")[1].strip() for line in cv2.getBuildInformation().splitlines() if "OpenEXR:" in line)
same = image is not None and np.array_equal(image, depth)
told = "None" if image is None else "an image"
print(f"OpenCV {cv2.__version__}: built with OpenEXR: {built}; imread gives {told}, equal: {same};", end=" ")
print(f"haveImageReader: {cv2.haveImageReader('depth.exr')}; by OpenEXR {OpenEXR.__version__} equal: {np.array_equal(back, depth)}")
seen = "read" if same else "none" if image is None else "other"
raise SystemExit(not (seen == sys.argv[1] and np.array_equal(back, depth)))
PYTHON
export OPENCV_IO_ENABLE_OPENEXR=1
4.14.0.94/bin/python read.py read
5.0.0.93/bin/python read.py none
unset OPENCV_IO_ENABLE_OPENEXR
4.14.0.94/bin/python read.py error
5.0.0.93/bin/python read.py none
