"""Object and hands of one camera, by masks and depth: size, height above the table, what they stand on, and whether they meet."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import median_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from neuspring.checks.table import object_on_table
from neuspring.core.checks import Check
from neuspring.data.camera import FAR, FASTEST, NEAR, SLOWEST, Camera
from neuspring.data.capture import HANDS, OBJECT, THIN

SAMPLED = 5
"""Frames per camera, evenly spaced, that are compared with the world, or in which the table is looked for."""
SMALL, LARGE = 0.02, 1.2
"""m. Objects whose longest side is another are a wrong mask or a wrong unit of depth."""
SUNK, HIGHEST_OBJECT = 0.02, 1.2
"""m. An object lower than SUNK below the table, or higher than HIGHEST_OBJECT above it, stands in another world than the table."""
WITHIN = (0.01, 0.99)
"""Quantiles between which a body lies: beyond them are pixels of its outline whose depth is between it and what is behind it."""
APART, SPARSE, PIECE = 0.2, 4.0, 0.02
"""Gaps of this part of a body's size, and of so many distances between its points, part it into pieces; pieces with a smaller share
of its points are no part of it. Where hands or a fold hide a part, the others are larger."""
USUAL_HOLES, BAD_HOLES = 0.4, 0.8
"""Share of the object's pixels without depth from which twins suffer, and from which little is left to lift. Outlines have none: a
tenth of a cloth or a toy in the synthetic scenes, and a third of a rope."""
HAND_AREA, HAND_RATIO = 0.12, 12.0
"""m²: two hands and forearms seen from one side have less, sleeves and a torso more. Hands so many times as large as the object in
the image are another thing."""
HAND_LEAST = 0.002
"""m². Real hands with a part of the forearm have 0.015 to 0.05 in color alone; fewer are a wrong scale of the pose."""
HAND_REACH = 0.06
"""m. A hand that never comes nearer to the object does not hold it. Where they touch, depth may be hidden."""
COMPARED_POINTS = 1500
"""Points of each thing that are compared."""
FEWEST_POINTS = 20
"""Points below which nothing is said of a thing in a frame."""
TABLE = "Look at the mask of frame 0 and at depth_unit; make-capture --level puts the table at z = 0."
SCALE_REMEDY = (
    "Look at the mask of frame 0, and at the units of depth and poses: meters, with the table at z = 0. Poses of COLMAP have no "
    "scale: multiply their positions by a true length over the measured one."
)


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame of one camera."""

    depth: np.ndarray
    """[H, W], m, 0: none."""
    mask: np.ndarray
    """[H, W] labels."""
    color: np.ndarray | None = None
    """[H, W, 3] uint8 RGB, where it was read too."""


def sampled(frames: int) -> set[int]:
    """Numbers of the frames that are compared with the world."""
    return set(np.linspace(0, frames - 1, SAMPLED).astype(int).tolist())


def of_body(points: np.ndarray) -> np.ndarray:
    """True for points [n, 3], m, of a body [n]; not for strays, pieces that are small and apart: see `APART`."""
    if not len(points):
        return np.zeros(0, bool)
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    spacing = np.median(KDTree(points).query(points, k=min(2, len(points)))[0][..., -1])
    gap = max(APART * float(np.linalg.norm(high - low)), SPARSE * float(spacing), 1e-9)
    cells, cell = np.unique(np.floor(points / gap).astype(np.int64), axis=0, return_inverse=True)
    # Cells that touch at a corner are joined.
    pairs = KDTree(cells).query_pairs(1.8, output_type="ndarray")
    joined = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2)
    piece = connected_components(joined, directed=False)[1][cell.ravel()]
    sizes = np.bincount(piece)
    return np.asarray(sizes[piece] >= min(max(FEWEST_POINTS, PIECE * len(points)), sizes.max()))


def extents(points: np.ndarray) -> np.ndarray:
    """Lowest and highest coordinates [2, 3] of a body by its points [n, 3], m, without strays: what sizes and heights are of."""
    return np.asarray(np.quantile(points[of_body(points)], WITHIN, axis=0))


def lifted(camera: Camera, sample: Sample, label: int) -> np.ndarray:
    """World points [n, 3], m, of the pixels with a label and depth; at most COMPARED_POINTS, and no strays of the object."""
    y, x = np.nonzero((sample.mask == label) & (sample.depth > 0))
    step = -(-len(x) // COMPARED_POINTS) or 1
    y, x = y[::step], x[::step]
    points = camera.lift(np.stack([x, y], axis=-1).astype(float), sample.depth[y, x])
    return points[of_body(points)] if label == OBJECT else points


Samples = Mapping[int, Sample]
"""Object and hands in a few frames of a camera, by number."""


def hands_of(camera: Camera, samples: Samples) -> tuple[float, float] | None:
    """Area of the hands, m², and as a multiple of the object's pixels, medians; None without any."""
    areas, ratios = [], []
    for sample in samples.values():
        own = sample.mask == HANDS
        measured = own & (sample.depth > 0)
        if measured.sum() < FEWEST_POINTS or not (sample.mask == OBJECT).any():
            continue
        depth = np.where(sample.depth > 0, sample.depth, np.median(sample.depth[measured]))
        areas.append(float((depth[own] ** 2).sum() / np.prod(np.diag(camera.intrinsics)[:2])))
        ratios.append(float(own.sum() / (sample.mask == OBJECT).sum()))
    return (float(np.median(areas)), float(np.median(ratios))) if areas else None


def holes(camera: Camera, samples: Samples, least: float) -> dict[str, Any] | None:
    """Share of the object's pixels without depth."""
    missing = {frame: float((s.depth[s.mask == OBJECT] <= 0).mean()) for frame, s in samples.items() if (s.mask == OBJECT).any()}
    if not missing:
        return None
    worst, mean = max(missing, key=lambda frame: missing[frame]), float(np.mean(list(missing.values())))
    bad = mean > USUAL_HOLES or missing[worst] > BAD_HOLES
    rule = f"at most {USUAL_HOLES:.0%} are expected, and never {BAD_HOLES:.0%}" if bad else f"up to {USUAL_HOLES:.0%} are usual"
    next_move = "Film from farther than the sensor's least distance, without shine and direct sun; look whether depth is aligned."
    told = {"value": mean, "frames": (worst,), "frame": worst, "worst": missing[worst], "rule": rule}
    return told | ({"next": next_move} if bad else {"level": "note", "next": ""})


def large_hands(camera: Camera, samples: Samples, least: float) -> dict[str, Any] | None:
    """Area of hands that is none of hands, m²; hands have `least` m² or more."""
    area, ratio = hands_of(camera, samples) or (0.0, 0.0)
    wrong = area >= least and (area > HAND_AREA or ratio > HAND_RATIO)
    return {"value": area, "cm": 1e4 * area, "ratio": ratio} if wrong else None


def small_hands(camera: Camera, samples: Samples, least: float) -> dict[str, Any] | None:
    """Area of hands that are smaller than hands, m²."""
    area, _ = hands_of(camera, samples) or (np.inf, 0.0)
    return {"value": area, "cm": 1e4 * area} if area < least else None


def gap(camera: Camera, samples: Samples) -> dict[str, Any] | None:
    """Least distance of hands from the object, m, over the frames in which both are in view."""
    gaps = []
    for sample in samples.values():
        body, hands = (lifted(camera, sample, label) for label in (OBJECT, HANDS))
        if min(len(body), len(hands)) >= FEWEST_POINTS:
            gaps.append(float(KDTree(body).query(hands)[0].min()))
    return {"value": min(gaps), "cm": 100 * min(gaps), "count": len(gaps)} if gaps else None


def strays(camera: Camera, samples: Samples, least: float) -> dict[str, Any] | None:
    """Pixels of the object that are apart from it in space."""
    found, total = list[tuple[float, int, int, int]](), 0
    for frame, sample in samples.items():
        y, x = np.nonzero((sample.mask == OBJECT) & (sample.depth > 0))
        points = camera.lift(np.stack([x, y], axis=-1).astype(float), sample.depth[y, x])
        own, total = of_body(points), total + len(points)
        away = KDTree(points[own]).query(points[~own])[0] if not own.all() else np.zeros(0)
        found += zip(away.tolist(), [frame] * len(away), x[~own].tolist(), y[~own].tolist(), strict=True)
    if not found:
        return None
    most, first, column, row = max(found)
    told = {"value": len(found), "total": total, "cm": 100 * most, "x": column, "y": row, "frame": first}
    return told | {"frames": sorted({frame for _, frame, *_ in found})}


Place = Mapping[int, np.ndarray]
"""Lowest and highest coordinates of the object [2, 3], m, by frame; the third are heights above the table."""


def place_of(bodies: Mapping[int, np.ndarray], up: float) -> Place:
    """Place of the object by its points [n, 3], m, in the world, by frame; `up` is +1 or -1. Too few points are left out."""
    return {frame: extents(points * (1, 1, up)) for frame, points in bodies.items() if len(points) >= FEWEST_POINTS}


def in_cm(sides: Iterable[float]) -> str:
    """Sides, m, as `12 x 9`, cm; those of less than 1 cm with a digit more."""
    return " x ".join(f"{100 * side:.{0 if side >= 0.01 else 1}f}" for side in sides)


def size(place: Place) -> dict[str, Any] | None:
    """Sides of the object and its heights above the table, in the first frame that shows it."""
    for frame, (low, high) in place.items():
        text = in_cm(high - low)
        heights = f"from {100 * low[2]:.1f} to {100 * high[2]:.1f} cm above the table"
        return {"value": text, "text": f"{text} cm, {heights} in frame {frame}", "frames": (frame,)}
    return None


def height(place: Place, end: int) -> dict[str, Any] | None:
    """Lowest (`end` 0) or highest (1) height of the object above the table, m, and its frame."""
    if not place:
        return None
    frame = (min, max)[end](place, key=lambda frame: float(place[frame][end, 2]))
    value = float(place[frame][end, 2])
    return {"value": value, "cm": -100 * value, "frame": frame, "frames": (frame,)}


def outline(camera: Camera, mask: np.ndarray) -> list[float]:
    """Sides of the smallest rectangle around where the object of a mask [H, W] meets the table z = 0, m; none where little does.

    Parts that rise seem larger.
    """
    own = object_on_table(camera, mask)
    own = own[np.isfinite(own[:, 0])]
    own = own[of_body(own)]
    return [] if len(own) < FEWEST_POINTS else sorted(cv2.minAreaRect(own[:, :2].astype(np.float32))[1], reverse=True)


def longest(side: float) -> dict[str, Any] | None:
    """A longest side, m, that is that of nothing that hands hold on a table."""
    return None if SMALL < side < LARGE else {"value": side, "cm": 100 * side}


SLENDER = 6.0
"""Area of an outline over the square of its greatest width. Ropes of real films that lie have 8.9 and more; toys, cloths and
boxes, real and rendered from all sides, up to 4.1."""


def slenderness(mask: np.ndarray, category: str) -> dict[str, Any] | None:
    """Area of an outline over the square of its greatest width, where that is not its category's."""
    own = np.pad(mask == OBJECT, 1).astype(np.uint8)
    if own.sum() < FEWEST_POINTS:
        return None
    slender = float(own.sum() / (2 * cv2.distanceTransform(own, cv2.DIST_L2, 5).max()) ** 2)
    if (slender > SLENDER) == (category == "rope"):
        return None
    shape, other = ("a long thin thing", "rope") if slender > SLENDER else ("a compact thing", "cloth, or another word for a body,")
    return {"value": slender, "shape": shape, "other": other}


SHEET_HIGH, SHEET_SIDE = 0.015, 0.08
"""m: a sheet that lies on the table is lower, but for a tenth of it, and each of its sides is longer."""
SHEET_COVERED = 0.6
"""Part of its outline that a sheet covers; a rope in turns covers less."""


def flat(points: np.ndarray, up: float, category: str = "") -> dict[str, Any] | None:
    """Sides and height of a sheet on the table, by points [n, 3], m; none of a thin category. "" is a filled body."""
    if category in THIN or len(points) < FEWEST_POINTS or (high := float(np.quantile(up * points[:, 2], 0.9))) > SHEET_HIGH:
        return None
    level = points[:, :2].astype(np.float32)
    sides, outline = sorted(cv2.minAreaRect(level)[1], reverse=True), cv2.contourArea(cv2.convexHull(level))
    # Cells of which a sheet has 2.25 points each: one in ten is empty.
    cell = 1.5 * float(np.sqrt(outline / len(points)))
    if sides[1] < SHEET_SIDE or len(np.unique(level // cell, axis=0)) * cell**2 < SHEET_COVERED * outline:
        return None
    rule = f"the category {category!r} makes a filled body of it" if category else "a filled hull was made of it"
    return {
        "value": high,
        "text": f"{100 * sides[0]:.0f} x {100 * sides[1]:.0f} cm, nine tenths of it below {1e3 * high:.0f} mm",
        "rule": rule,
    }


RAISED, AIR = 0.025, (0.05, 0.3)
"""m that a support is high; and the height above the table, m and as part of its own height, from which an object that is seen from
the side is not on it. The lowest visible points of a ball on the table are a tenth of its height above it."""
SIDE_VIEW = 50.0
"""Degrees: a camera that looks down more steeply does not see where an object ends below."""
LEVEL, BY = 0.01, 0.1
"""m: how even a support is, and how far from the object it is looked for."""
OBJECT_RIM = 9
"""Pixels beside a mask may still be of its object."""


def height_in_air(camera: Camera, sample: Sample, up: float) -> dict[str, Any] | None:
    """Height of the object of frame 0 above the table, m: the twin would fall. None where the object is on the table or held."""
    own = lifted(camera, sample, OBJECT) * (1, 1, up)
    if len(own) < FEWEST_POINTS:
        return None
    low, high = extents(own)[:, 2]
    foot, away = own[own[:, 2] < low + LEVEL], max(AIR[0], AIR[1] * (high - low))
    if low < RAISED:
        return None
    around = cv2.dilate((sample.mask > 0).astype(np.uint8), np.ones((OBJECT_RIM, OBJECT_RIM), np.uint8))
    y, x = np.nonzero((around == 0) & (sample.depth > 0))
    seen = camera.lift(np.stack([x, y], axis=1).astype(float), sample.depth[y, x]) * (1, 1, up)
    near = ((seen[:, :2] > foot[:, :2].min(axis=0) - BY) & (seen[:, :2] < foot[:, :2].max(axis=0) + BY)).all(axis=1)
    top = seen[near & (seen[:, 2] > max(RAISED, low - away)) & (seen[:, 2] < low + LEVEL)]
    level = float(np.median(top[:, 2])) if len(top) > 2 * FEWEST_POINTS else 0.0
    if level and np.mean(np.abs(top[:, 2] - level) < LEVEL) > 0.8:
        return {"value": low, "cm": 100 * low, "on": f"on something {100 * level:.1f} cm high"}
    hands, steep = lifted(camera, sample, HANDS), -up * camera.camera_to_world[2, 2] > np.sin(np.radians(SIDE_VIEW))
    if low < away or steep or (len(hands) and KDTree(own).query(hands * (1, 1, up))[0].min() < HAND_REACH):
        return None
    return {"value": low, "cm": 100 * low, "on": "and no hand is near"}


BODY_WORDS = ("sloth", "plush", "toy", "ball")
"""Words for bodies that are near to those that mean another thing."""


def meant(category: str) -> dict[str, Any] | None:
    """The word that means something, where another one is nearly it."""
    close = difflib.get_close_matches(category.casefold(), (*THIN, "rope", *BODY_WORDS), n=1, cutoff=0.75)
    return None if not close or category == close[0] or close[0] in BODY_WORDS else {"value": close[0]}


HANDS_BESIDE = 0.04
"""Distance between two pieces of the hands' mask, as a part of the image, within which they are one hand."""
STEADY = 5
"""Frames over whose median hands are counted."""
SHORTEST_GRIP = 1.0
"""s. Shorter times with one constant grip are not proposed."""


def hands_on(camera: Camera, sample: Sample) -> int:
    """The number of hands within HAND_REACH of the object in a frame."""
    body, own = lifted(camera, sample, OBJECT), sample.mask == HANDS
    reach = max(int(0.5 * HANDS_BESIDE * camera.width), 1)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    count, pieces = cv2.connectedComponents(cv2.dilate(own.astype(np.uint8), disk))
    each = [lifted(camera, Sample(sample.depth, np.where(own & (pieces == k), HANDS, 0)), HANDS) for k in range(1, count)]
    return (
        sum((KDTree(body).query(hand)[0] <= HAND_REACH).sum() >= FEWEST_POINTS for hand in each)
        if len(body) >= FEWEST_POINTS
        else 0
    )


def constant_grips(counts: np.ndarray, rate: float, folder: Path) -> dict[str, Any] | None:
    """The times with a constant number of hands at the object [T], counted by all cameras of a capture, and the longest of them."""
    steady = median_filter(counts, STEADY, mode="nearest")
    edges = [0, *(np.flatnonzero(np.diff(steady)) + 1).tolist(), len(steady)]
    spans = [(first, end - 1, int(steady[first])) for first, end in pairwise(edges)]
    if len(spans) < 2:
        return None
    held = [span for span in spans if span[2] and span[1] - span[0] + 1 >= SHORTEST_GRIP * rate]
    ranked = sorted(held, key=lambda span: span[0] - span[1])[:3]
    commands = " or ".join(f"--frames {first}-{last}" for first, last, _ in ranked)
    cut = f": neuspring cut-capture {folder} {commands} --output ..." if ranked else f"; none lasts {SHORTEST_GRIP:g} s"
    return {"text": ", ".join(f"{first}-{last}: {count}" for first, last, count in spans), "cut": cut}


# fmt: off
checks = (
    Check("depth holes", "object and hands", holes, None, "warning",
          "{value:.0%} of the object's pixels have no depth (frame {frame}: {worst:.0%}); {rule}.", "{next}"),
    Check("stray pixels", "object and hands", strays, None, "note",
          "{value} of {total} pixels of the object are apart from it in space, by {cm:.1f} cm at x {x}, y {y} of frame "
          "{frame}; sizes and heights are without them.", "Is something else in the mask there?"),
    Check("hands too small", "object and hands", small_hands, None, "warning",
          f"hands (label {HANDS}) of {{cm:.2g}} cm²; at least {1e4 * HAND_LEAST:g} cm² are expected.", SCALE_REMEDY),
    Check("hands too large", "object and hands", large_hands, None, "warning",
          f"hands (label {HANDS}) of {{cm:.0f}} cm², {{ratio:.1f}} times the object's pixels; less than {1e4 * HAND_AREA:g} cm² "
          f"and {HAND_RATIO:g} times are expected.",
          "Sleeves, torso or table are no hands: mark them to be ignored (`neuspring mask`)."),
    Check("hand far from the object", "hands", gap, (0, HAND_REACH), "warning",
          f"the hand is never nearer to the object than {{cm:.1f}} cm, in {{count}} frames; within {100 * HAND_REACH:g} cm it "
          "can move it.", "Look at the masks for a hand that is something else, or for the wrong object."),
    Check("size of the object", "object", size, None, "note", "{text}; as its pixels with depth show it.",
          "Is that what was filmed?"),
    Check("implausible size", "object",
          lambda place: longest(float(np.median(np.ptp([*place.values()], axis=1), axis=0).max())) if place else None, None,
          "warning", f"{{cm:.3g}} cm long; {100 * SMALL:g} to {100 * LARGE:g} cm are expected.", SCALE_REMEDY),
    Check("object below the table", "object", lambda place: height(place, 0), (-SUNK, np.inf), "warning",
          f"it reaches {{cm:.1f}} cm below the table in frame {{frame}}; at most {100 * SUNK:g} cm are noise.", TABLE),
    Check("object high above the table", "object", lambda place: height(place, 1), (-np.inf, HIGHEST_OBJECT), "warning",
          "it is up to {value:.2f} m above it in frame {frame}; at most {high:g} m is expected; walls and people in the mask are "
          "no object.", TABLE),
    Check("size of the object", "outline", lambda sides: sides and {"text": in_cm(sides)}, None, "note",
          "color alone: table z = 0 as given, object size on the table {text} cm; by its mask of frame 0.",
          "Is that what was filmed?"),
    Check("implausible size", "outline", lambda sides: sides and longest(sides[0]), None, "warning",
          f"{{cm:.3g}} cm long; {100 * SMALL:g} to {100 * LARGE:g} cm are expected.", SCALE_REMEDY),
    Check("outline and category", "silhouette", slenderness, None, "warning",
          "the category is {1!r}, and the outline is that of {shape}: {value:.1f} squares of its greatest width; a rope has more "
          f"than {SLENDER:g}, all else less.", "Is {other} meant? Or look at the mask of frame 0."),
    Check("shape and category", "sheet", flat, None, "warning", "a flat thing of {text}; {rule}.",
          'If it is a sheet, write "category": "cloth" in capture.json: then no volume is made of it.'),
    Check("object above the table", "support", height_in_air, None, "warning",
          "what is seen of it in frame 0 begins {cm:.0f} cm above the table, {on}; there is nothing under the twin, and it falls.",
          "Film the object on the table, or annotate its support as object too."),
    # Speeds and forces of the twin scale with it.
    Check("frame rate", "frame rate", lambda rate: rate, (SLOWEST, FASTEST), "error",
          "frames per second at which it was filmed are required, {low:g} to {high:g}; received {value:g}", title="frame_rate"),
    Check("no depth", "depths", lambda camera, unit, typical: {} if typical is None else None, None, "error",
          "some depth is required; received 0 in every pixel of every frame", title="cameras.{0}"),
    Check("depth unit", "depths", lambda camera, unit, typical: typical, (NEAR, FAR), "error",
          "the median depth of camera {0} must lie between {low:g} and {high:g} m, with the unit of the images; received {1:g} m "
          "per count, which makes it {value:.4g} m", title="depth_unit"),
    Check("category", "category", meant, None, "warning",
          f"only {' and '.join(THIN)} mean a thin thing, and only rope a round one; any other word is a filled body; received "
          "{0!r}. Is {value} meant?", title="category"),
    Check("constant grips", "grips", constant_grips, None, "note",
          f"hands within {100 * HAND_REACH:g} cm of the object, by frames: {{text}}. A twin is best learned from one constant "
          "grip{cut}", title=""),
)
