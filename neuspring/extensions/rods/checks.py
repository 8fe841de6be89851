"""A recording of markers along a cable, [T, 3, n]: its form; and in space its length, the order of its markers, and gravity."""

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
"""Two controllers at either end and at least two observed markers."""
MIN_FRAMES = 4
MIN_DISTANCE = 1e-4
"""Nodes must be farther apart than this, m; otherwise their spring would have no length."""
SHORTEST, LONGEST = 0.05, 10.0
"""m. Cables of another length are in another unit. Those of DEFORM are 0.91 to 1.07 m long."""
CABLE_UNITS = {"meters": 1.0, "millimeters": 0.001, "centimeters": 0.01, "inches": 0.0254}
"""Units of recordings, m."""
DETOUR = 1.5
"""Neighbors in the order of the file that are so many times as far apart as the longest step of the way over other markers are no
neighbors along the cable. Those of DEFORM's cables are at most 1.3 times as far apart; where DEFT's branches follow each other, it
is 4.6 times at least."""
LEAST_SAG, HANGS = 0.05, 0.5
"""Part of the cable's length by which it must sag to say where down is, and the cosine of the angle to what the settings call down.
DEFORM's cables sag by 0.13 of their length at least, within 18 degrees (0.95) of down."""
SWINGS = 0.9
"""Correlation of what turns a cable about the line of its ends and what gravity turns it with, from which the two are compared."""
TURNED = (0.5, 3.5)
"""Range of their ratio. DEFORM's cables have 0.90 to 2.57: grips hold stiff ones back."""
STANDARD_GRAVITY = 9.81
"""m/s^2."""
SPANS, LEAST_SPANS = (1, 2, 4, 8), 10
"""Frames, before and after, over which accelerations are measured: the first that noise does not hide; and how many of these a
recording needs."""
CABLE_UNSEEN = "A cable needs a place of every marker in every sample: fill gaps, or cut the recording (mocap.start, mocap.frames)"


def turn(up: str) -> np.ndarray:
    """The rotation [3, 3] from the axes of a file to a world with z up."""
    upward = np.eye(3)["xyz".index(up[1])] * (1 if up[0] == "+" else -1)
    side = np.eye(3)[1 if up[1] == "x" else 0]
    return np.array([side, np.cross(upward, side), upward])


def in_space(raw: Any, settings: Mocap) -> np.ndarray:
    """Positions [T, 3, n], m, z up, of a recording of the right form, by the unit and the up axis of the settings."""
    data = np.asarray(raw)
    return np.asarray((settings.unit * turn(settings.up)).astype(data.dtype) @ data)


def look(file: Path, raw: Any, settings: Mocap) -> list[Finding]:
    """Every finding about a recording. Of one with an error no more is asked: without its form there is no length, and so on."""
    found = examine("cable", file, raw)
    if refused(found):
        return found
    cable = Cable(Moving(in_space(raw, settings).transpose(0, 2, 1), settings.rate), settings)
    found += examine("cable in space", file, cable)
    found += [] if refused(found) else examine("moving", file, cable.moving, CABLE_UNSEEN)
    return found if refused(found) else found + examine("cable in motion", file, cable)


def check_recording(file: Path, config: Config) -> list[Finding]:
    """Every finding about the file of a recording; nothing is raised for bad content."""
    try:
        return look(file, load_pickle(file), config.section(Mocap))
    except InputError as error:
        return [refusal(error)]


RECORDINGS = Layout(recognizes=lambda path: path.suffix == ".pkl", check=check_recording)


class Cable:
    """Markers in space in the order of the file.

    `points` [T, n, 3], m, NaN where lost, are those before labels are exchanged, if they are; `apart` [n, n], m, their largest
    distances: those that are not neighbors are far apart at some time; `along` [n], m, their places along the cable.
    """

    def __init__(self, moving: Moving, settings: Mocap) -> None:
        self.moving, self.settings = moving, settings
        self.points = moving.points[: min((frame for frame, *_ in moving.swapped), default=None)]
        self.apart = apart(self.points, np.nanmax)
        self.along = np.append(0.0, np.cumsum(np.diag(apart(self.points, np.nanmedian), 1)))

    def turned(self, span: int) -> tuple[float, float]:
        """The ratio of what turns the inner markers about the line of the ends, by their accelerations over `span` frames before
        and after, and of what gravity turns them with; and the correlation of the two over time. Forces at the ends turn nothing
        about that line."""
        places = self.points[span:-span]
        second = (self.points[2 * span :] - 2 * places + self.points[: -2 * span]) * (self.settings.rate / span) ** 2
        line = places[:, -1] - places[:, 0]
        arms = (places - places[:, :1])[:, 2:-2] * np.gradient(self.along)[2:-2, None]
        sums = np.cross(arms, second[:, 2:-2]).sum(axis=1), np.cross(arms.sum(axis=1), (0.0, 0.0, -STANDARD_GRAVITY))
        moved, pulled = (np.einsum("tc,tc->t", one, line) / np.linalg.norm(line, axis=1) for one in sums)
        # Single large accelerations are jumps.
        usual = np.abs(moved) <= np.quantile(np.abs(moved), 0.95)
        moved, pulled = moved[usual], pulled[usual]
        both, square = float(moved @ pulled), max(float(pulled @ pulled), 1e-12)
        return both / square, both / max(float(np.sqrt(square * (moved @ moved))), 1e-12)


def malformed(raw: Any) -> dict[str, Any] | None:
    """The first rule that the form breaks, and what was there."""
    if not isinstance(raw, (np.ndarray, list, tuple)):
        return {"rule": "positions [T, 3, n] are required", "value": type(raw).__name__}
    try:
        data = np.asarray(raw)
    except ValueError:
        return {"rule": "positions [T, 3, n] are required", "value": "nested lists of different lengths"}
    if data.ndim != 3 or data.shape[1] != 3 or len(data) == 1:
        form = ". Transposed by (0, 2, 1) they would be" if data.ndim == 3 and data.shape[2] == 3 else ""
        if data.ndim > 1 and data.size == 3 * data.shape[-1]:
            form = ". Rows of all x, y and z, as of DEFT: reshape to (3, T, n), transpose by (1, 0, 2)"
        return {"rule": "the shape must be [T, 3, n]", "value": f"{data.shape}{form}"}
    if data.dtype.kind != "f":
        return {"rule": "the dtype must be floating point", "value": data.dtype}
    if data.shape[2] < MIN_MARKERS:
        return {"rule": f"at least {MIN_MARKERS} markers are required (4 of them are controllers)", "value": data.shape[2]}
    if len(data) < MIN_FRAMES:
        return {"rule": f"at least {MIN_FRAMES} frames are required", "value": len(data)}
    if len(bad := np.argwhere(~np.isfinite(data))):
        t, _, marker = bad[0]
        place = f"{data[tuple(bad[0])]} at frame {t}, marker {marker} ({len(bad)} in all)"
        return {"rule": "every coordinate must be finite", "value": f"{place}. {CABLE_UNSEEN}", "frames": np.unique(bad[:, 0])}
    return None


def length(cable: Cable) -> dict[str, Any]:
    """The length, m, and the unit by which it would be nearest to one meter."""
    own = cable.along[-1]
    name = min(CABLE_UNITS, key=lambda name: abs(np.log(CABLE_UNITS[name] * own / cable.settings.unit)))
    return {"value": own, "unit": CABLE_UNITS[name], "name": name}


def too_near(cable: Cable) -> dict[str, Any] | None:
    """The first marker of frame 0 that lies on its neighbor."""
    short = np.flatnonzero(pieces(cable.points[0]) < MIN_DISTANCE)
    return {"value": int(short[0]), "next": int(short[0]) + 1} if len(short) else None


def disordered(cable: Cable) -> dict[str, Any]:
    """The distance of neighbors in the file as a multiple of the longest step of the way over others; and the order in space."""
    longest = cable.apart.copy()
    for over in range(len(longest)):
        longest = np.minimum(longest, np.maximum(longest[:, over, None], longest[over]))
    factors = np.diag(cable.apart, 1) / np.maximum(np.diag(longest, 1), MIN_DISTANCE)
    links, told = spanned(cable.apart), {"value": float(factors.max()), "one": factors.argmax(), "two": factors.argmax() + 1}
    ends = np.bincount(links.ravel())
    if (branches := np.flatnonzero(ends > 2)).size:
        form = f"their neighbors in space form branches at markers {listed(branches)}"
        return told | {"next": f"{form}: a branched cable is not read. Give one branch, from end to end"}
    order = depth_first_order(coo_array((links[:, 0], links.T), cable.apart.shape), int(ends.argmin()), directed=False)[0].tolist()
    return told | {"next": f"along the cable they are in the order {order}: write data[:, :, {order}]"}


def ends(cable: Cable) -> Iterator[dict[str, Any]]:
    """Frames in which the first or last three markers are not in their order: their outer two are not the farthest apart.

    A gripper holds a cable straight there. In DEFORM's other recordings these are at least 1.05 times as far apart as neighbors.
    """
    for end, three in {"first": cable.points[:, :3], "last": cable.points[:, -3:]}.items():
        frames = np.linalg.norm(three - np.roll(three, 1, axis=1), axis=2).argmax(axis=1).nonzero()[0]
        if len(frames):
            yield {"frames": frames, "detail": f"the {end} three in frames {spans(frames)}"}


def hangs(cable: Cable) -> dict[str, Any] | None:
    """The cosine of the angle between the way that the cable sags and down, and the axis of the file along which it sags."""
    points, part = cable.points, (cable.along / cable.along[-1])[:, None]
    # Mean place [3], m, of the inner markers from that on the line of the ends at their part of the length.
    sag = (points - (1 - part) * points[:, :1] - part * points[:, -1:])[:, 2:-2].mean(axis=(0, 1))
    deep = float(np.linalg.norm(sag))
    in_file = turn(cable.settings.up).T @ sag
    axis = int(np.abs(in_file).argmax())
    down, up = (f"{sign}{'xyz'[axis]}" for sign in ("+-" if in_file[axis] > 0 else "-+"))
    words = {"value": float(-sag[2] / deep), "cm": 100 * deep, "down": down, "up": up}
    return words if deep > LEAST_SAG * cable.along[-1] else None


def swings(cable: Cable) -> dict[str, Any] | None:
    """The ratio of what turns the cable and what gravity turns it with, and the rate at which it would be 1."""
    spans = [span for span in SPANS if len(cable.points) >= LEAST_SPANS * span]
    ratio = next((ratio for ratio, alike in map(cable.turned, spans) if alike > SWINGS), None)
    return {"value": ratio, "fits": float(f"{cable.settings.rate / np.sqrt(ratio):.2g}")} if ratio else None


# fmt: off
checks = (
    Check("form of a recording", "cable", malformed, None, "error", "{rule}; received {value}", title=""),
    Check("length of the cable", "cable in space", length, (SHORTEST, LONGEST), "error",
          "a cable must be {low:g} to {high:g} m long; received {value:.4g} m, with mocap.unit {0.settings.unit:g} m. "
          "Set mocap.unit: {unit:g}, if it is in {name}", title=""),
    Check("markers on one place", "cable in space", too_near, None, "error",
          f"neighboring markers must be {MIN_DISTANCE} m apart in frame 0; received markers {{value}} and {{next}}", title=""),
    Check("order along the cable", "cable in space", disordered, (0, DETOUR), "error",
          "markers must be in their order along one cable; received markers {one} and {two} {value:.1f} times as far apart as the "
          "longest step of the way over others; {next}", title=""),
    Check("order at the ends", "cable in motion", ends, None, "warning", "markers at an end are not in their order along the cable",
          "Exchange two columns there, or leave the frames out.", effect="a controller is in another's position"),
    Check("up of the recording", "cable in motion", hangs, (HANGS, np.inf), "warning",
          "a cable sags down; received one that sags by {cm:.0f} cm along {down}, with mocap.up {0.settings.up}. Set mocap.up: "
          "'{up}'", title=""),
    Check("rate of the recording", "cable in motion", swings, TURNED, "warning",
          "a cable should swing by gravity; received {value:.2f} times as much with mocap.rate {0.settings.rate:g} Hz. About "
          "{fits:g} Hz would fit: set mocap.rate, or look at mocap.unit", title=""),
)
