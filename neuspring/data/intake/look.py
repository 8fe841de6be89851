"""What cameras saw in a few frames: sizes, kinds, intrinsics and the unit of depth, before anything is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.intake.choice import Choice
from neuspring.data.intake.lenses import Straightener, require_lens
from neuspring.data.intake.units import Unit, find_unit
from neuspring.data.intake.views import Lens, Pair, View

SAMPLED = 5
"""Frames per camera, evenly spaced, in which the unit of depth and the table are looked for."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What a camera saw in a few frames."""

    path: Path
    size: tuple[int, int]
    """(width, height)."""
    lens: Lens
    colors: list[np.ndarray]
    """[H, W, 3] uint8 RGB, without distortion."""
    depths: list[np.ndarray]
    """[H, W], m, without distortion; none with color alone."""
    unit: float | None
    """m per count of its images; None where they are floating point, or there are none."""


def look(
    views: Sequence[View], choice: Choice, listed: Mapping[str, Lens], file: Path | None, given_unit: float | None
) -> tuple[dict[str, Seen], Unit | None]:
    """A few of the chosen frames of every camera, with intrinsics, and the unit of depth, which is one for all; None without any.

    `listed` are the intrinsics of `file`; those of the source count where there are none. Raises InputError.
    """
    samples: dict[str, list[Pair]] = {}
    lenses: dict[str, Lens] = {}
    for view in views:
        frames = sorted(choice.places[view.name])
        picked = sorted({frames[k] for k in np.linspace(0, len(frames) - 1, SAMPLED).astype(int)})
        samples[view.name] = list(view.read([choice.places[view.name][frame] for frame in picked]))
        lens = listed.get(view.name) or view.lens
        if lens is None:
            remedy = "Give a JSON file with fx, fy, cx, cy."
            raise InputError("--intrinsics", f"intrinsics of camera {view.name} are required", "none", remedy)
        lenses[view.name] = lens
        color, depth = samples[view.name][0]
        require_aligned(view.path, view.name, color, depth)
        require_lens(file or view.path, view.name, lens, (color.shape[1], color.shape[0]))
    depths = [depth for pairs in samples.values() for _, depth in pairs if depth is not None]
    if len({stored_as(depth) for depth in depths}) > 1:
        raise InputError("--depth", "all depth images must be of one kind, 16-bit integers or another", "both")
    known = {view.unit for view in views}
    if len(known) > 1 and given_unit is None:
        raise InputError("--depth-unit", "all cameras must have one unit of depth", " and ".join(sorted(map(str, known))))
    unit = find_unit(views[0].path, depths, given_unit, known.pop() if len(known) == 1 else None) if depths else None
    return {view.name: straightened(view, samples[view.name], lenses[view.name], unit) for view in views}, unit


def straightened(view: View, pairs: Sequence[Pair], lens: Lens, unit: Unit | None) -> Seen:
    """Pairs of one camera, without distortion and in meters; `unit` is None with color alone. Raises InputError where their sizes
    differ."""
    size = (pairs[0][0].shape[1], pairs[0][0].shape[0])
    for color, depth in pairs:
        require_aligned(view.path, view.name, color, depth, size)
    straight = Straightener(lens, size)
    colors = [straight.color(color) for color, _ in pairs]
    if unit is None:
        return Seen(view.path, size, lens, colors, [], None)
    depths = [depth for _, depth in pairs if depth is not None]
    meters = [meters_of(straight.depth(plain(depth)), unit) for depth in depths]
    return Seen(view.path, size, lens, colors, meters, unit.meters if stored_as(depths[0]) == "png" else None)


def require_aligned(
    where: Path, name: str, color: np.ndarray, depth: np.ndarray | None, size: tuple[int, int] | None = None
) -> None:
    """Raise InputError unless depth, where there is any, has the size of color, which is `size`."""
    if depth is not None and color.shape[:2] != depth.shape:
        received = f"{depth.shape[1]} x {depth.shape[0]} for {color.shape[1]} x {color.shape[0]}"
        remedy = "Let the camera's software align depth to color (RealSense: rs.align; ROS: aligned_depth_to_color)."
        raise InputError(where, f"camera {name}: depth must be aligned to color, pixel by pixel", received, remedy)
    if size is not None and color.shape[1::-1] != size:
        raise InputError(where, f"camera {name}: all images must be {size[0]} x {size[1]}", f"{color.shape[1]} x {color.shape[0]}")


def stored_as(depth: np.ndarray) -> str:
    """How the capture stores it: 16-bit counts as png, anything else as npy in meters."""
    return "png" if depth.dtype == np.uint16 else "npy"


def plain(depth: np.ndarray) -> np.ndarray:
    """Counts, or floating point without what is no depth."""
    return depth if depth.dtype == np.uint16 else np.nan_to_num(depth.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0).clip(0)


def meters_of(depth: np.ndarray, unit: Unit) -> np.ndarray:
    """Depth in meters, of counts."""
    return (depth * unit.meters).astype(np.float32)
