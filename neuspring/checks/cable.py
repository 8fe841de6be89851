"""A recording of markers along a cable, [T, 3, n]: its form; and in space its length, the order of its markers, and gravity."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.moving import Moving, apart, spanned
from neuspring.config import Mocap
from neuspring.core.checks import Check
from neuspring.core.findings import Finding

MIN_MARKERS = 6
"""Two controllers at either end and at least two observed markers."""
MIN_FRAMES = 4
MIN_DISTANCE = 1e-4
"""Nodes must be farther apart than this, m; otherwise their spring would have no length."""
RELEASED_SAMPLES = 500
SHORTEST, LONGEST = 0.05, 10.0
"""m. Cables of another length are in another unit. Those of DEFORM are 0.91 to 1.07 m long."""
UNITS = {"meters": 1.0, "millimeters": 0.001, "centimeters": 0.01, "inches": 0.0254}
"""Units of recordings, m."""
RATES = (25, 30, 50, 60, 90, 100, 120, 150, 180, 200, 240, 250, 300, 360, 400, 480, 500, 1000)
"""Usual rates of motion capture, Hz."""
DETOUR = 1.5
"""Neighbors in the order of the file that are so many times as far apart as the longest step of the way over other markers are no
neighbors along the cable. Those of DEFORM's cables are at most 1.3 times as far apart, where branches of DEFT's follow each
other 4.6 times."""
LEAST_SAG, HANGS = 0.05, 0.5
"""Part of the cable's length by which it must sag to say where down is, and the cosine of the angle to what the settings call down.
DEFORM's cables sag by 0.13 of their length at least, within 18 degrees (0.95) of down."""
SWINGS = 0.9
"""Correlation of what turns a cable about the line of its ends and what gravity turns it with, from which the two are compared."""
TURNED = (0.5, 3.5)
"""Range of their ratio. DEFORM's cables have 0.90 to 2.57: grips hold stiff ones back."""
GRAVITY = 9.81
"""m/s^2."""
SPANS, LEAST_SPANS = (1, 2, 4, 8), 10
"""Frames, before and after, over which accelerations are measured: the first that noise does not hide; and how many of these a
recording needs."""
AXES = {
    "+x": ((2, 1, 0), (-1, 1, 1)),
    "-x": ((2, 1, 0), (1, 1, -1)),
    "+y": ((0, 2, 1), (1, -1, 1)),
    "-y": ((0, 2, 1), (1, 1, -1)),
    "+z": ((0, 1, 2), (1, 1, 1)),
    "-z": ((0, 1, 2), (1, -1, -1)),
}
"""What is up in a file -> the file's axes that become x, y and z, and their signs."""


def in_space(raw: Any, settings: Mocap) -> np.ndarray:
    """Positions [T, 3, n], m, z up, of a recording of the right form, by the unit and the up axis of the settings."""
    data, (axes, signs) = np.asarray(raw), AXES[settings.up]
    scale = settings.unit * np.array(signs, data.dtype)[:, None]
    return np.asarray(np.take(data, axes, axis=1) * scale.astype(data.dtype))


def look(file: Path, raw: Any, settings: Mocap) -> list[Finding]:
    """Every finding about a recording."""
    found = examine("cable", file, raw)
    if any(one.level == "error" for one in found):
        return found
    cable = Cable(Moving(in_space(raw, settings).transpose(0, 2, 1), settings.rate), settings)
    found += examine("cable in space", file, cable)
    if SHORTEST <= cable.length <= LONGEST:
        found += examine("moving", file, cable.moving, UNSEEN)
    return found


UNSEEN = "A cable needs a place of every marker in every sample: fill short gaps, or cut the recording (mocap.start, mocap.frames)"


@dataclass(frozen=True, eq=False)
class Cable:
    """Markers in space in the order of the file."""

    moving: Moving
    settings: Mocap

    @cached_property
    def points(self) -> np.ndarray:
        """[T, n, 3], m, NaN where lost, of the frames before labels are exchanged, if they are."""
        end = min((frame for frames in self.moving.swapped.values() for frame in frames), default=None)
        return self.moving.points[:end]

    @cached_property
    def lengths(self) -> np.ndarray:
        """Median distances [n - 1], m, of neighbors."""
        return np.asarray(np.nanmedian(np.linalg.norm(np.diff(self.points, axis=1), axis=2), axis=0))

    @property
    def length(self) -> float:
        """m."""
        return float(self.lengths.sum())

    @cached_property
    def apart(self) -> np.ndarray:
        """Largest distances [n, n], m: those that are not neighbors are far apart at some time."""
        return apart(self.points, 1.0)

    @cached_property
    def detour(self) -> tuple[float, int]:
        """The distance of neighbors as a multiple of the longest step of the way over others, where that is largest, and the first
        of the two."""
        direct = self.apart
        widest = direct.copy()
        for over in range(len(widest)):
            widest = np.minimum(widest, np.maximum(widest[:, over, None], widest[over]))
        factors = np.diag(direct, 1) / np.maximum(np.diag(widest, 1), MIN_DISTANCE)
        return float(factors.max()), int(factors.argmax())

    @cached_property
    def in_order(self) -> bool:
        """True where neighbors in the file are neighbors in space, and the length is one of a cable."""
        return SHORTEST <= self.length <= LONGEST and self.detour[0] <= DETOUR

    @cached_property
    def along(self) -> np.ndarray:
        """Part [n] of the length at which each marker is."""
        arc = np.append(0.0, np.cumsum(self.lengths))
        return arc / arc[-1]

    @cached_property
    def sag(self) -> np.ndarray:
        """Mean place [3], m, of the inner markers from that on the line of the ends at their part of the length."""
        first, last, part = self.points[:, :1], self.points[:, -1:], self.along[:, None]
        return np.asarray(np.nanmean((self.points - (1 - part) * first - part * last)[:, 2:-2], axis=(0, 1)))

    def turned(self, span: int) -> tuple[float, float]:
        """The ratio of what turns the inner markers about the line of the ends, by their accelerations over `span` frames before
        and after, and of what gravity turns them with; and the correlation of the two over time. Forces at the ends turn nothing
        about that line."""
        places = self.points[span:-span]
        second = (self.points[2 * span :] - 2 * places + self.points[: -2 * span]) * (self.settings.rate / span) ** 2
        line = places[:, -1] - places[:, 0]
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        arms = (places - places[:, :1])[:, 2:-2] * np.gradient(self.along)[2:-2, None]
        moved = np.einsum("tkc,tc->t", np.cross(arms, second[:, 2:-2]), line)
        pulled = np.einsum("tc,tc->t", np.cross(arms.sum(axis=1), (0.0, 0.0, -GRAVITY)), line)
        known = np.isfinite(moved)
        # Single large accelerations are jumps.
        known &= np.abs(moved) <= np.quantile(np.abs(moved[known]), 0.95)
        moved, pulled = moved[known], pulled[known]
        both, square = float(moved @ pulled), max(float(pulled @ pulled), 1e-12)
        return both / square, both / max(float(np.sqrt(square * (moved @ moved))), 1e-12)


def form(raw: Any) -> tuple[str, object] | np.ndarray:
    """Positions [T, 3, n]; or the rule that they break, and what was there."""
    if not isinstance(raw, (np.ndarray, list, tuple)):
        return "positions [T, 3, n] are required", type(raw).__name__
    try:
        data = np.asarray(raw)
    except ValueError:
        return "positions [T, 3, n] are required", "nested lists of different lengths"
    if data.ndim != 3 or data.shape[1] != 3 or len(data) == 1:
        turned = ". Transposed (0, 2, 1) they would be" if data.ndim == 3 and data.shape[2] == 3 else ""
        rows = data.ndim >= 2 and data.shape[-2] == 3 and data.size == 3 * data.shape[-1]
        flat = ". Rows of all x, y and z, as of DEFT: reshape to (3, T, n), transpose by (1, 0, 2)" if rows else ""
        return "the shape must be [T, 3, n]", f"{data.shape}{turned or flat}"
    return data if data.dtype.kind == "f" else ("the dtype must be floating point", data.dtype)


def malformed(raw: Any) -> dict[str, Any] | None:
    """The rule that the form breaks."""
    return None if isinstance(data := form(raw), np.ndarray) else {"rule": data[0], "received": data[1]}


def sized(raw: Any, axis: int) -> int | None:
    """Frames (0) or markers (2)."""
    return data.shape[axis] if isinstance(data := form(raw), np.ndarray) else None


def not_finite(raw: Any) -> dict[str, Any] | None:
    """The first coordinate that is not finite, and how many there are."""
    if not isinstance(data := form(raw), np.ndarray) or not len(bad := np.argwhere(~np.isfinite(data))):
        return None
    t, axis, marker = (int(i) for i in bad[0])
    return {"value": float(data[t, axis, marker]), "frame": t, "marker": marker, "count": len(bad), "frames": (t,)}


def unlike_released(raw: Any) -> list[dict[str, Any]]:
    """Type and number of samples that are not as released."""
    if not isinstance(data := form(raw), np.ndarray):
        return []
    found = [{"text": f"the released dtype is float64; received {data.dtype}"}] if data.dtype != np.float64 else []
    text = f"released recordings have {RELEASED_SAMPLES} samples; received {len(data)}"
    return found + ([{"text": text}] if len(data) != RELEASED_SAMPLES else [])


def length(cable: Cable) -> dict[str, Any]:
    """The length, m, and the unit by which it would be nearest to one meter."""
    raw = cable.length / cable.settings.unit
    name = min(UNITS, key=lambda name: abs(np.log(UNITS[name] * raw)))
    return {"value": cable.length, "unit": UNITS[name], "name": name}


def too_near(cable: Cable) -> dict[str, Any] | None:
    """The first marker of frame 0 that lies on its neighbor."""
    short = np.flatnonzero(np.linalg.norm(np.diff(cable.points[0], axis=0), axis=1) < MIN_DISTANCE)
    return {"value": int(short[0]), "next": int(short[0]) + 1} if len(short) else None


def disordered(cable: Cable) -> dict[str, Any] | None:
    """Neighbors in the file that are none in space, and the order or the branches that would be."""
    if cable.in_order or cable.detour[0] <= DETOUR:
        return None
    links = spanned(cable.apart)
    ends = np.bincount(links.ravel())
    told = {"value": cable.detour[0], "one": cable.detour[1], "two": cable.detour[1] + 1}
    if (branches := np.flatnonzero(ends > 2)).size:
        form = f"their neighbors in space form branches at markers {', '.join(map(str, branches))}"
        return told | {"next": f"{form}: a branched cable is not read. Give one branch, from end to end"}
    order = [int(np.flatnonzero(ends == 1)[0])]
    while len(order) <= len(links):
        near = [int(link.sum()) - order[-1] for link in links if order[-1] in link]
        order.append(next(marker for marker in near if marker not in order))
    return told | {"next": f"along the cable they are in the order {order}: write data[:, :, {order}]"}


def hangs(cable: Cable) -> dict[str, Any] | None:
    """The cosine of the angle between the way that the cable sags and down, and the axis of the file along which it sags."""
    if not cable.in_order or np.linalg.norm(cable.sag) < LEAST_SAG * cable.length:
        return None
    axes, signs = AXES[cable.settings.up]
    in_file = np.zeros(3)
    in_file[list(axes)] = cable.sag * signs
    axis = int(np.abs(in_file).argmax())
    sides = "-+" if in_file[axis] > 0 else "+-"
    told = {"cm": 100 * np.linalg.norm(cable.sag), "down": f"{sides[1]}{'xyz'[axis]}", "up": f"{sides[0]}{'xyz'[axis]}"}
    return told | {"value": float(-cable.sag[2] / np.linalg.norm(cable.sag))}


def swings(cable: Cable) -> dict[str, Any] | None:
    """The ratio of what turns the cable and what gravity turns it with, and the rate at which it would be 1."""
    spans = [span for span in SPANS if len(cable.points) >= LEAST_SPANS * span]
    if not cable.in_order or not (found := [ratio for ratio, alike in map(cable.turned, spans) if alike > SWINGS]):
        return None
    fits = cable.settings.rate / np.sqrt(found[0])
    usual = min(RATES, key=lambda rate: abs(np.log(rate / fits)))
    return {"value": found[0], "fits": usual if abs(np.log(usual / fits)) < 0.1 else round(fits)}


# fmt: off
checks = (
    Check("form of a recording", "cable", malformed, None, "error", "{rule}; received {received}", title=""),
    Check("markers", "cable", lambda raw: sized(raw, 2), (MIN_MARKERS, np.inf), "error",
          "at least {low} markers are required (4 of them are controllers); received {value}", title=""),
    Check("samples", "cable", lambda raw: sized(raw, 0), (MIN_FRAMES, np.inf), "error",
          "at least {low} frames are required; received {value}", title=""),
    Check("finite positions", "cable", not_finite, None, "error",
          "every coordinate must be finite; received {value} at frame {frame}, marker {marker} ({count} in all)", title=""),
    Check("unlike the release", "cable", unlike_released, None, "warning", "{text}", title=""),
    Check("length of the cable", "cable in space", length, (SHORTEST, LONGEST), "error",
          "a cable must be {low:g} to {high:g} m long; received {value:.4g} m, with mocap.unit {0.settings.unit:g} m. "
          "Set mocap.unit: {unit:g}, if it is in {name}", title=""),
    Check("markers on one place", "cable in space", too_near, None, "error",
          f"neighboring markers must be {MIN_DISTANCE} m apart in frame 0; received markers {{value}} and {{next}}", title=""),
    Check("order along the cable", "cable in space", disordered, None, "error",
          "markers must be in their order along one cable; received markers {one} and {two} {value:.1f} times as far apart as the "
          "way over others has steps; {next}", title=""),
    Check("up of the recording", "cable in space", hangs, (HANGS, np.inf), "warning",
          "a cable sags down; received one that sags by {cm:.0f} cm along {down}, with mocap.up {0.settings.up}. Set mocap.up: "
          "'{up}'", title=""),
    Check("rate of the recording", "cable in space", swings, TURNED, "warning",
          "a cable should swing by gravity; received {value:.2f} times as much with mocap.rate {0.settings.rate:g} Hz. About "
          "{fits} Hz would fit: set mocap.rate, or look at mocap.unit", title=""),
)
