"""SPZ, version 3: splats quantized and gzipped, a file per frame. Written from the public description of the format.

A header of 16 bytes, then the values of all splats, one attribute after the other: positions (24-bit fixed point), opacity, color,
scales, orientation ("smallest three"), harmonics of degree 1 and more.
"""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically
from neuspring.export.source import Source
from neuspring.splats.model import Splats

MAGIC, VERSION = 0x5053474E, 3
MOST_BITS = 16
"""Fractional bits of positions, at most: 15 micrometers."""
COLOR_SCALE = 0.15
"""Of the first harmonic, so that values beyond black and white fit."""
TURN = np.array([1.0, -1.0, -1.0])
"""Half a turn about x, of positions and of a quaternion's x, y, z."""
TURN_HARMONICS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1.0])
"""The same of the coefficients of degrees 1, 2, 3: the signs of y, z, x; xy, yz, zz, xz, xx - yy; and so on."""
MAGNITUDE = 2**9 - 1
"""Of a component of an orientation: sqrt(1/2)."""


def write(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write splats_<frame>.spz to the folder `output`."""
    source.require_splats()
    made = []
    for frame, splats in source.moved_splats(frames):
        made.append(output / f"splats_{frame:05d}.spz")
        content = encoded(splats)
        write_atomically(made[-1], lambda temporary, content=content: temporary.write_bytes(content))  # type: ignore[misc]
    return made


def encoded(splats: Splats) -> bytes:
    """A whole file, turned by half a turn about x: readers take PLY's axes as right, down, front, and SPZ's as right, up, back."""
    count, degree = len(splats.means), math.isqrt(splats.harmonics.shape[1]) - 1
    bits = fractional_bits(splats.means)
    fixed = np.rint(splats.means.astype(np.float64) * TURN * 2**bits).astype("<i4")
    parts = [
        struct.pack("<IIIBBBB", MAGIC, VERSION, count, degree, bits, 0, 0),
        np.ascontiguousarray(fixed[..., None]).view(np.uint8)[..., :3].tobytes(),
        _byte(255 / (1 + np.exp(-splats.opacity_logits.astype(np.float64)))).tobytes(),
        _byte(255 * (0.5 + COLOR_SCALE * splats.harmonics[:, 0])).tobytes(),
        _byte(16 * (np.broadcast_to(splats.log_scales, (count, 3)) + 10)).tobytes(),
        smallest_three(splats.quaternions * [1, *TURN]).tobytes(),
        _byte(128 + 128 * splats.harmonics[:, 1:] * TURN_HARMONICS[: splats.harmonics.shape[1] - 1, None]).tobytes(),
    ]
    return gzip.compress(b"".join(parts), mtime=0)


def fractional_bits(means: np.ndarray) -> int:
    """The most bits behind the point with which all positions [G, 3], m, fit 24 bits. Raises InputError if they fit with none."""
    largest = max(float(np.abs(means).max()), 1.0)
    bits = min(MOST_BITS, math.floor(math.log2((2**23 - 1) / largest)))
    if bits < 0:
        raise InputError("splats", f"positions of SPZ must lie within {2**23 - 1} m", largest)
    return bits


def smallest_three(quaternions: np.ndarray) -> np.ndarray:
    """Orientations [G, 4], w first, as 32 bits [G]: 2 for the index of the largest of x, y, z, w, then a sign and 9 bits each."""
    unit = quaternions.astype(np.float64) / np.linalg.norm(quaternions, axis=1, keepdims=True)
    xyzw = np.roll(unit, -1, axis=1)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    packed: np.ndarray = largest.astype("<u4")
    for component in range(4):
        value = xyzw[:, component]
        size = np.minimum(np.rint(MAGNITUDE * np.abs(value) / math.sqrt(0.5)), MAGNITUDE).astype("<u4")
        shifted = (packed << np.uint32(10)) | ((value < 0).astype("<u4") << np.uint32(9)) | size
        packed = np.where(component == largest, packed, shifted).astype("<u4")
    return packed


def _byte(values: np.ndarray) -> np.ndarray:
    rounded: np.ndarray = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return rounded
