"""Checks of a recording of markers along a cable, [T, 3, n]: its form, length, order of markers, up axis and sampling rate."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import depth_first_order

from neuspring.checks import examine
from neuspring.checks.moving import Moving, apart, spanned
from neuspring.config import Config
from neuspring.core.checks import Check
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, refusal, refused
from neuspring.core.text import listed, spans
from neuspring.data.unpickle import load_pickle
from neuspring.extensions.rods.rod import pieces
from neuspring.extensions.rods.settings import Mocap
from neuspring.intake.check import Layout

MIN_MARKERS = 6
"""Minimum number of markers: two controllers at each end and two observed markers."""
MIN_FRAMES = 4
MIN_DISTANCE = 1e-4
"""Minimum distance of nodes, m; otherwise their spring would have no length."""
SHORTEST, LONGEST = 0.05, 10.0
"""Range of the length of a cable, m; other lengths indicate another unit. DEFORM's cables are 0.91 to 1.07 m long."""
CABLE_UNITS = {"meters": 1.0, "millimeters": 0.001, "centimeters": 0.01, "inches": 0.0254}
"""Units of recordings, m."""
DETOUR = 1.5
"""Maximum distance of neighbors in the file, in longest steps of the best path over other markers.

Markers beyond are not neighbors along the cable. DEFORM's cables have at most 1.3; DEFT's branches have at least 4.6."""
LEAST_SAG, HANGS = 0.05, 0.5
"""Minimum sag from which down is measured, as a fraction of the cable's length, and minimum cosine of its angle to down.

DEFORM's cables sag by at least 0.13 of their length, within 18 degrees (0.95) of down."""
SWINGS = 0.9
"""Minimum correlation of measured moments about the line of the ends and moments of gravity, from which their ratio is used."""
TURNED = (0.5, 3.5)
"""Range of this ratio. DEFORM's cables have 0.90 to 2.57, because grippers hold stiff cables back."""
STANDARD_GRAVITY = 9.81
"""Gravity, m/s^2."""
SPANS, LEAST_SPANS = (1, 2, 4, 8), 10
"""Frames before and after over which accelerations are measured (the first that is above noise), and minimum length in spans."""
CABLE_UNSEEN = "A cable needs every marker in every sample: fill gaps, or cut the recording (mocap.start, mocap.frames)"


def turn(up: str) -> np.ndarray:
    """Rotation [3, 3] from the axes of a file to a world with +z up."""
    upward = np.eye(3)["xyz".index(up[1])] * (1 if up[0] == "+" else -1)
    side = np.eye(3)[1 if up[1] == "x" else 0]
    return np.array([side, np.cross(upward, side), upward])


def in_space(raw: Any, settings: Mocap) -> np.ndarray:
    """Positions [T, 3, n], m, with +z up, of a well-formed recording, by the unit and up axis of the settings."""
    data = np.asarray(raw)
    return np.asarray((settings.unit * turn(settings.up)).astype(data.dtype) @ data)


def look(file: Path, raw: Any, settings: Mocap) -> list[Finding]:
    """Every finding about a recording. Later checks are skipped after an error, because they depend on the earlier ones."""
    found = examine("cable", file, raw)
    if refused(found):
        return found
    cable = Cable(Moving(in_space(raw, settings).transpose(0, 2, 1), settings.rate), settings)
    found += examine("cable in space", file, cable)
    found += [] if refused(found) else examine("moving", file, cable.moving, CABLE_UNSEEN)
    return found if refused(found) else found + examine("cable in motion", file, cable)


def check_recording(file: Path, config: Config) -> list[Finding]:
    """Every finding about the file of a recording. Bad content is a finding, not an exception."""
    try:
        return look(file, load_pickle(file), config.section(Mocap))
    except InputError as error:
        return [refusal(error)]


RECORDINGS = Layout(recognizes=lambda path: path.suffix == ".pkl", check=check_recording)


class Cable:
    """Markers in space, in the order of the file.

    - `points` [T, n, 3], m: positions, NaN for lost markers, up to the first exchange of labels.
    - `apart` [n, n], m: largest distances; markers that are not neighbors are far apart at some time.
    - `along` [n], m: positions along the cable.
    """

    def __init__(self, moving: Moving, settings: Mocap) -> None:
        self.moving, self.settings = moving, settings
        self.points = moving.points[: min((frame for frame, *_ in moving.swapped), default=None)]
        self.apart = apart(self.points, np.nanmax)
        self.along = np.append(0.0, np.cumsum(np.diag(apart(self.points, np.nanmedian), 1)))

    def turned(self, span: int) -> tuple[float, float]:
        """Ratio of the inner markers' moments about the line of the ends to those of gravity, and the correlation of both.

        Accelerations over `span` frames before and after give the moments. Forces at the ends have no moment about this line.
        """
        points = self.points[span:-span]
        second = (self.points[2 * span :] - 2 * points + self.points[: -2 * span]) * (self.settings.rate / span) ** 2
        line = points[:, -1] - points[:, 0]
        arms = (points - points[:, :1])[:, 2:-2] * np.gradient(self.along)[2:-2, None]
        moments = np.cross(arms, second[:, 2:-2]).sum(axis=1), np.cross(arms.sum(axis=1), (0.0, 0.0, -STANDARD_GRAVITY))
        moved, pulled = (np.einsum("tc,tc->t", moment, line) / np.linalg.norm(line, axis=1) for moment in moments)
        # The largest accelerations are jumps.
        usual = np.abs(moved) <= np.quantile(np.abs(moved), 0.95)
        moved, pulled = moved[usual], pulled[usual]
        product, square = float(moved @ pulled), max(float(pulled @ pulled), 1e-12)
        return product / square, product / max(float(np.sqrt(square * (moved @ moved))), 1e-12)


def malformed(raw: Any) -> dict[str, Any] | None:
    """The first rule of the form that the recording breaks, and the received value."""
    if not isinstance(raw, (np.ndarray, list, tuple)):
        return {"rule": "positions [T, 3, n] are required", "value": type(raw).__name__}
    try:
        data = np.asarray(raw)
    except ValueError:
        return {"rule": "positions [T, 3, n] are required", "value": "nested lists of different lengths"}
    if data.ndim != 3 or data.shape[1] != 3 or len(data) == 1:
        form = ". Transpose it by (0, 2, 1)" if data.ndim == 3 and data.shape[2] == 3 else ""
        if data.ndim > 1 and data.size == 3 * data.shape[-1]:
            form = ". For rows of x, y and z, as in DEFT, reshape to (3, T, n) and transpose by (1, 0, 2)"
        return {"rule": "the shape must be [T, 3, n]", "value": f"{data.shape}{form}"}
    if data.dtype.kind != "f":
        return {"rule": "the dtype must be floating point", "value": data.dtype}
    if data.shape[2] < MIN_MARKERS:
        return {"rule": f"at least {MIN_MARKERS} markers are required (4 are controllers)", "value": data.shape[2]}
    if len(data) < MIN_FRAMES:
        return {"rule": f"at least {MIN_FRAMES} frames are required", "value": len(data)}
    if len(bad := np.argwhere(~np.isfinite(data))):
        t, _, marker = bad[0]
        first = f"{data[tuple(bad[0])]} at frame {t}, marker {marker} ({len(bad)} in total)"
        return {"rule": "every coordinate must be finite", "value": f"{first}. {CABLE_UNSEEN}", "frames": np.unique(bad[:, 0])}
    return None


def length(cable: Cable) -> dict[str, Any]:
    """The length, m, and the unit in which it would be nearest to one meter."""
    total = cable.along[-1]
    name = min(CABLE_UNITS, key=lambda name: abs(np.log(CABLE_UNITS[name] * total / cable.settings.unit)))
    return {"value": total, "unit": CABLE_UNITS[name], "name": name}


def too_near(cable: Cable) -> dict[str, Any] | None:
    """The first marker of frame 0 that is too near to its neighbor."""
    short = np.flatnonzero(pieces(cable.points[0]) < MIN_DISTANCE)
    return {"value": int(short[0]), "next": int(short[0]) + 1} if len(short) else None


def disordered(cable: Cable) -> dict[str, Any]:
    """Distance of neighbors in the file, in longest steps of the best path over other markers, and the order in space."""
    longest = cable.apart.copy()
    for over in range(len(longest)):
        longest = np.minimum(longest, np.maximum(longest[:, over, None], longest[over]))
    factors = np.diag(cable.apart, 1) / np.maximum(np.diag(longest, 1), MIN_DISTANCE)
    links, words = spanned(cable.apart), {"value": float(factors.max()), "one": factors.argmax(), "two": factors.argmax() + 1}
    ends = np.bincount(links.ravel())
    if (branches := np.flatnonzero(ends > 2)).size:
        form = f"The cable branches at markers {listed(branches)}"
        return words | {"next": f"{form}: give one branch, from end to end"}
    order = depth_first_order(coo_array((links[:, 0], links.T), cable.apart.shape), int(ends.argmin()), directed=False)[0].tolist()
    return words | {"next": f"Write the order along the cable: data[:, :, {order}]"}


def ends(cable: Cable) -> Iterator[dict[str, Any]]:
    """Frames in which the outer two of the first or last three markers are not the farthest apart.

    A gripper holds the cable straight there. In DEFORM's correct recordings the outer two are at least 1.05 times as far apart as
    neighbors.
    """
    for end, three in {"first": cable.points[:, :3], "last": cable.points[:, -3:]}.items():
        frames = np.linalg.norm(three - np.roll(three, 1, axis=1), axis=2).argmax(axis=1).nonzero()[0]
        if len(frames):
            yield {"frames": frames, "detail": f"the {end} three in frames {spans(frames)}"}


def hangs(cable: Cable) -> dict[str, Any] | None:
    """Cosine of the angle between the cable's sag and down, and the axis of the file along which it sags."""
    points, fraction = cable.points, (cable.along / cable.along[-1])[:, None]
    # Mean displacement [3], m, of the inner markers from the straight line between the ends.
    sag = (points - (1 - fraction) * points[:, :1] - fraction * points[:, -1:])[:, 2:-2].mean(axis=(0, 1))
    deep = float(np.linalg.norm(sag))
    in_file = turn(cable.settings.up).T @ sag
    axis = int(np.abs(in_file).argmax())
    down, up = (f"{sign}{'xyz'[axis]}" for sign in ("+-" if in_file[axis] > 0 else "-+"))
    words = {"value": float(-sag[2] / deep), "cm": 100 * deep, "down": down, "up": up}
    return words if deep > LEAST_SAG * cable.along[-1] else None


def swings(cable: Cable) -> dict[str, Any] | None:
    """Ratio of the cable's measured moments to those of gravity, and the sampling rate at which it would be 1, Hz."""
    spans = [span for span in SPANS if len(cable.points) >= LEAST_SPANS * span]
    ratio = next((ratio for ratio, correlation in map(cable.turned, spans) if correlation > SWINGS), None)
    return {"value": ratio, "fits": float(f"{cable.settings.rate / np.sqrt(ratio):.2g}")} if ratio else None


# fmt: off
checks = (
    Check("form of a recording", "cable", malformed, None, "error", "{rule}; received {value}", title=""),
    Check("length of the cable", "cable in space", length, (SHORTEST, LONGEST), "error",
          "a cable must be {low:g} to {high:g} m long; received {value:.4g} m, with mocap.unit {0.settings.unit:g} m. "
          "If the file is in {name}, set mocap.unit: {unit:g}", title=""),
    Check("markers on one place", "cable in space", too_near, None, "error",
          f"neighboring markers must be {MIN_DISTANCE} m apart in frame 0; received markers {{value}} and {{next}}", title=""),
    Check("order along the cable", "cable in space", disordered, (0, DETOUR), "error",
          "markers must be in their order along one cable; received markers {one} and {two}, {value:.1f} times as far apart as "
          "the longest step of a path over other markers. {next}", title=""),
    Check("order at the ends", "cable in motion", ends, None, "warning", "markers at an end are not in their order along the cable",
          "Exchange two columns in these frames, or omit them.", effect="a controller has the position of another controller"),
    Check("up of the recording", "cable in motion", hangs, (HANGS, np.inf), "warning",
          "a cable must sag down; received a sag of {cm:.0f} cm along {down}, with mocap.up {0.settings.up}. Set mocap.up: '{up}'",
          title=""),
    Check("rate of the recording", "cable in motion", swings, TURNED, "warning",
          "a cable must swing by gravity; received {value:.2f} times this motion, with mocap.rate {0.settings.rate:g} Hz. Set "
          "mocap.rate: {fits:g}, or check mocap.unit", title=""),
)
