"""Depth of make-capture: its unit, the table among its planes, and where the world is: z = 0 on the table. The frame rate is judged
here too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.camera import FAR, FASTEST, NEAR, ROLL, SLOWEST, Plane
from neuspring.data.planes import planes

LIKELY = (0.2, 3.0)
"""m. A guessed unit must bring the median depth into this range."""
KNOWN = {
    0.001: "millimeters",
    0.0001: "tenths of a millimeter",
    0.00025: "quarters of a millimeter",
    0.0002: "1/5000 m",
    1.0: "meters",
}
"""m per count, and where it is used: most cameras, RealSense L515 and D405, L515's default, TUM's data sets, floating point."""


@dataclass(frozen=True)
class Unit:
    """Meters per count of depth, and how it is known."""

    meters: float
    how: str

    def text(self) -> str:
        """In one line."""
        name = KNOWN.get(float(f"{self.meters:.6g}"))  # librealsense says it in single precision
        return f"{self.meters:g} m per count{f' ({name})' if name else ''}, {self.how}"


def find_unit(where: object, depths: Sequence[np.ndarray], given: float | None, known: float | None = None) -> Unit:
    """The unit of depth images [H, W] as stored: the given one, that of the source, or a guess from the type and the scene.

    Whole numbers are guessed to be millimeters, floating point meters or millimeters. Raises InputError where the guess does not
    fit or the scene would be smaller than NEAR or larger than FAR, with the units that would do.
    """
    values = np.concatenate([depth[np.isfinite(depth) & (depth > 0)].astype(float) for depth in depths])
    if not len(values):
        raise InputError(where, "some depth is required", "0 in every pixel of the images that were looked at")
    count, whole = float(np.median(values)), depths[0].dtype.kind in "ui"
    kind = "whole numbers" if whole else "floating point"
    chosen = given if given is not None else known
    if chosen is not None:
        if not (np.isfinite(chosen) and chosen > 0):
            raise InputError("--depth-unit", "meters per count, above 0, are required", chosen)
        median = count * chosen
        if not NEAR < median < FAR:
            said = "--depth-unit" if given is not None else "the unit that it says"
            rule = f"{said}: the median depth must lie between {NEAR:g} and {FAR:g} m"
            raise InputError(where, rule, f"{chosen:g} m per count, which makes it {median:.4g} m", _advice(count))
        return Unit(chosen, "given" if given is not None else f"as the source says; median depth {median:.2f} m")
    order = [0.001] if whole else [1.0, 0.001]
    fitting = [unit for unit in order if LIKELY[0] <= count * unit <= LIKELY[1]]
    if not fitting:
        rule = f"the unit of depth cannot be guessed: {kind} with a median of {count:.4g}"
        raise InputError(where, rule, remedy=_advice(count) + " Give --depth-unit.")
    return Unit(fitting[0], f"guessed from {kind} with a median of {count:.4g}: median depth {count * fitting[0]:.2f} m")


def find_rate(given: float | None, known: Sequence[float | None], step: int, fastest: float = FASTEST) -> tuple[float, str]:
    """Frames per second of the capture and how they are known: `given` or that of the videos, over every `step`-th frame.

    Raises InputError where there is none, or one that no camera has; `fastest`: the highest that one has.
    """
    told = [rate for rate in known if rate is not None]
    if given is None and not told:
        raise InputError("--rate", "frames per second are required: folders, and points in space, do not have them", "none")
    if given is None and max(told) > 1.02 * min(told):
        raise InputError("--rate", "all cameras must film at one rate", " and ".join(f"{rate:.3g}" for rate in told))
    rate = given if given is not None else round(told[0], 2)
    if not (np.isfinite(rate) and SLOWEST <= rate <= fastest):
        rule = f"frames per second of a camera lie between {SLOWEST:g} and {fastest:g}"
        raise InputError("--rate", rule, f"{rate:g}", "Give the rate at which it was filmed, not a time step.")
    how = "given" if given is not None else "as the source says"
    if given is not None and told and abs(told[0] - given) > 0.02 * given:
        how = f"given; the source says {told[0]:.3g}"
    thinned = f", one in {step} of {rate:g}" if step > 1 else ""
    return rate / step, f"{rate / step:g} frames per second, {how}{thinned}"


def _advice(count: float) -> str:
    fitting = [f"{unit:g} ({name})" for unit, name in KNOWN.items() if NEAR < count * unit < FAR]
    if not fitting:
        return "No common unit makes it a scene on a table: is this a raw depth image?"
    return f"Plausible would be {' or '.join(fitting)}."


TABLE_SHARE = 0.1
"""Share of the pixels with depth below which a plane is no table."""
FRONTAL = 12.0
"""Degrees between the optical axis and the normal below which a table seen from straight above and a wall look alike."""
ROUGH = 0.02
"""m rms. A plane that fits worse is no table."""
CAMERA_ABOVE = 4.0
"""m. A camera higher above the table has another unit of depth."""
LEVEL_ANGLE, LEVELS_APART = 10.0, 0.03
"""Degrees and m: planes with nearly the normal of the table, this far above or below it, are other level surfaces."""
CENTER_OF_VIEW = 1.0 / 3.0
"""Part of the image, in its center, that is the center of view."""


def find_table(where: object, points: np.ndarray, top_down: bool = False, at: np.ndarray | None = None) -> tuple[Plane, list[str]]:
    """The table among the planes in points [n, 3], m, in the coordinates of a camera, and what the user should know of the choice.

    It is the largest plane whose normal points up in the image; with `at`, the one through this point [3]. Raises InputError
    where there is none: the largest plane is a wall or a ceiling, or a plane that faces the camera without `top_down`, too small a
    part of the image, or not flat.
    """
    if not (found := planes(points)):
        remedy = "Film more of the table, or give --poses."
        raise InputError(where, "the table must be seen: no plane was found in depth", remedy=remedy)
    if at is not None:
        found = [min(found, key=lambda plane: abs(plane.above(at)))]
        away = float(abs(found[0].above(at)))
        if away > 0.02:
            raise InputError("--table-at", "this pixel must lie on a plane", f"one {away:.3f} m from the nearest")
    reasons = [_objection(plane, top_down) for plane in found]
    fitting = [plane for plane, reason in zip(found, reasons, strict=True) if not reason]
    if not fitting:
        remedy = "Film the table from above its edge, upright; or give the poses of the cameras (--poses, --board)."
        raise InputError(where, f"no plane can be the table. The largest: {found[0].text()}: {reasons[0]}", remedy=remedy)
    table, remarks = fitting[0], []
    if table is not found[0]:
        remarks.append(f"the largest plane is not taken for the table: {reasons[0]}")
    for other in fitting[1:]:
        height = float(np.median(table.above(other.points)))
        level = np.degrees(np.arccos(np.clip(other.normal @ table.normal, -1, 1))) < LEVEL_ANGLE
        if level and abs(height) > LEVELS_APART:
            side = "above" if height > 0 else "below"
            remarks.append(
                f"another level surface, {100 * abs(height):.0f} cm {side} it, has {other.share:.0%} of the pixels: if that is the "
                "table, name a pixel of it by --table-at"
            )
    return table, remarks


def _objection(plane: Plane, top_down: bool) -> str:
    """Why a plane is not the table; empty if it may be."""
    if plane.share < TABLE_SHARE:
        return f"it has less than {TABLE_SHARE:.0%} of the pixels with depth"
    if plane.rms > ROUGH:
        return f"it is not flat: more than {1e3 * ROUGH:g} mm rms"
    if plane.height > CAMERA_ABOVE:
        return f"the camera would be more than {CAMERA_ABOVE:g} m above it: is the unit of depth right?"
    if 90.0 - plane.elevation < FRONTAL:
        facing = "it faces the camera: a wall, or a table seen from straight above; --top-down says that it is the table"
        return "" if top_down else facing
    roll = float(np.degrees(np.arctan2(abs(plane.normal[0]), -plane.normal[1])))
    if roll > ROLL:
        return f"it is a wall or a ceiling: its normal leans {roll:.0f} degrees from the upward direction of the image"
    return ""


def pose_on(table: Plane, points: np.ndarray, size: tuple[int, int], intrinsics: np.ndarray) -> np.ndarray:
    """Camera to world [4, 4], m, of a camera that sees `table`: z along its normal, x to the right of the image.

    The origin lies on the table below the center of view: the median of the points [n, 3] within a third of the image, of `size`
    (width, height), around its center.
    """
    up = table.normal
    y = np.cross(up, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    axes = np.stack([np.cross(y, up), y, up])
    rays = points[:, :2] / points[:, 2:]
    middle = points[(np.abs(rays) < 0.5 * CENTER_OF_VIEW * np.array(size) / np.diag(intrinsics)[:2]).all(axis=1)]
    target = np.median(middle if len(middle) else table.points, axis=0)
    origin = target - table.above(target) * up
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ origin
    return pose
