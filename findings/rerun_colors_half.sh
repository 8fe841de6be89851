#!/usr/bin/env bash
# Guess: colors as floats from 0 to 1 are scaled to 0 to 255, as the documentation of Points3D says, also in half precision.
# Seen: float32 and float64 are scaled. float16 is cut to integers: 1.0 becomes 1 of 255 and smaller values 0, so everything is black.
#   There is no error and no warning, also with strict=True.
# Source: rerun-sdk 0.41.0; rerun.Points3D, parameter colors ("either 0-1 floats or 0-255 integers").
# Matters: colors of splats and of networks are often in half precision. Their recording is black, which resembles a wrong exposure or
#   wrong harmonics.
# Works: colors.astype("float32"), or numpy.rint(255 * colors).astype("uint8").
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv && venv/bin/python -m pip install --quiet --disable-pip-version-check rerun-sdk==0.41.0 numpy==2.4.6 || exit 2

cat >colors.py <<'PYTHON'
import warnings

import numpy as np
import rerun as rr
from rerun.chunk import RrdReader

COLORS = np.array([[1.0, 0.5, 0.0], [0.75, 0.25, 1.0]])
FORMS = "float64", "float32", "float16"
recording = rr.RecordingStream("colors")
recording.save("colors.rrd")
with warnings.catch_warnings(record=True) as warned:
    warnings.simplefilter("always")
    for form in FORMS:
        recording.log(form, rr.Points3D(np.zeros((2, 3)), colors=COLORS.astype(form)), static=True, strict=True)
recording.disconnect()
seen = {}
for chunk in RrdReader("colors.rrd").stream():
    batch = chunk.to_record_batch()
    if "Points3D:colors" in batch.schema.names:
        packed = batch.column("Points3D:colors").to_pylist()[0]
        seen[chunk.entity_path.strip("/")] = [[value >> shift & 255 for shift in (24, 16, 8)] for value in packed]
print("rerun-sdk", rr.__version__)
print("given:", COLORS.tolist())
for form in FORMS:
    print(f"{form}: in the file {seen[form]}")
print("warnings:", len(warned))
right = np.abs(np.array([seen["float64"], seen["float32"]]) - 255 * COLORS).max() <= 1
raise SystemExit(not (right and seen["float16"] == [[1, 0, 0], [0, 0, 1]] and not warned))
PYTHON
venv/bin/python colors.py
