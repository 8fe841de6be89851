"""Object and hands of one camera, by masks and depth: size, height above the table, and whether they meet."""

from __future__ import annotations

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

from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, OBJECT

SAMPLED = 5
"""Frames per camera, evenly spaced, that are compared with the world."""
WITHIN = (0.01, 0.99)
"""Quantiles between which an object lies: beyond them are pixels of its outline whose depth is between it and the background."""
APART, SPARSE, PIECE = 0.2, 4.0, 0.02
"""Gaps of this fraction of an object's size, and of so many distances between its points, part it into pieces; pieces with a
smaller share of its points are no part of it. Where hands or a fold hide a part, the others are larger."""
HAND_REACH = 0.06
"""m. A hand that never comes nearer to the object does not hold it. Where they touch, depth may be hidden."""
HAND_RATIO = 12.0
"""Hands so many times as large as the object in the image are something else."""
PLAUSIBLE = (0.02, 1.2)
"""Longest side of an object, m."""
COMPARED_POINTS, FEWEST_POINTS = 1500, 20
"""Points of object and hands that are compared, and points below which nothing is reported."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame of one camera."""

    depth: np.ndarray
    """[H, W], m, 0: none."""
    mask: np.ndarray
    """[H, W] labels."""
    color: np.ndarray | None = None
    """[H, W, 3] uint8 RGB, where it was read too."""


Samples = Mapping[int, Sample]
"""Some frames of a camera, by number."""


def sampled(frames: int) -> set[int]:
    """Numbers of the frames that are compared with the world."""
    return set(np.linspace(0, frames - 1, SAMPLED).astype(int).tolist())


def of_body(points: np.ndarray) -> np.ndarray:
    """True for points [n, 3], m, of an object [n]; False for strays, pieces that are small and apart: see `APART`."""
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
    """Lowest and highest coordinates [2, 3] of an object by its points [n, 3], m, without strays."""
    return np.asarray(np.quantile(points[of_body(points)], WITHIN, axis=0))


def lifted(camera: Camera, sample: Sample, label: int) -> np.ndarray:
    """World points [n, 3], m, of the pixels with a label and depth; at most COMPARED_POINTS, and no strays of the object."""
    y, x = np.nonzero((sample.mask == label) & (sample.depth > 0))
    step = -(-len(x) // COMPARED_POINTS) or 1
    y, x = y[::step], x[::step]
    points = camera.lift(np.stack([x, y], axis=-1).astype(float), sample.depth[y, x])
    return points[of_body(points)] if label == OBJECT else points


def holes(camera: Camera, samples: Samples) -> float | None:
    """Mean share of the object's pixels without depth."""
    missing = [float((s.depth[s.mask == OBJECT] <= 0).mean()) for s in samples.values() if (s.mask == OBJECT).any()]
    return float(np.mean(missing)) if missing else None


def hand_area(camera: Camera, samples: Samples) -> dict[str, Any] | None:
    """Median area of the hands, m²; infinite where they are HAND_RATIO times as large as the object in the image."""
    areas, ratios = [], []
    for sample in samples.values():
        own = sample.mask == HANDS
        measured = own & (sample.depth > 0)
        if measured.sum() < FEWEST_POINTS or not (sample.mask == OBJECT).any():
            continue
        depth = np.where(sample.depth > 0, sample.depth, np.median(sample.depth[measured]))
        areas.append(float((depth[own] ** 2).sum() / np.prod(np.diag(camera.intrinsics)[:2])))
        ratios.append(float(own.sum() / (sample.mask == OBJECT).sum()))
    if not areas:
        return None
    area, ratio = float(np.median(areas)), float(np.median(ratios))
    return {"value": np.inf if ratio > HAND_RATIO else area, "detail": f"{area:.3f} m², {ratio:.1f} times the object's pixels"}


def hand_gap(camera: Camera, samples: Samples) -> float | None:
    """Least distance of hands from the object, m, over the frames in which both are in view."""
    gaps = []
    for sample in samples.values():
        body, hands = (lifted(camera, sample, label) for label in (OBJECT, HANDS))
        if min(len(body), len(hands)) >= FEWEST_POINTS:
            gaps.append(float(KDTree(body).query(hands)[0].min()))
    return min(gaps) if gaps else None


Place = Mapping[int, np.ndarray]
"""Lowest and highest coordinates of the object [2, 3], m, by frame; the third are heights above the table."""


def place_of(bodies: Mapping[int, np.ndarray], up: float) -> Place:
    """Place of the object by its points [n, 3], m, in the world, by frame; `up` is +1 or -1. Too few points are left out."""
    return {frame: extents(points * (1, 1, up)) for frame, points in bodies.items() if len(points) >= FEWEST_POINTS}


def in_cm(sides: Iterable[float]) -> str:
    """Sides, m, as `12 x 9`, cm; those of less than 1 cm with a digit more."""
    return " x ".join(f"{100 * side:.{0 if side >= 0.01 else 1}f}" for side in sides)


def size(place: Place) -> dict[str, Any] | None:
    """Sides of the object and its heights above the table, in the first frame that shows it; a warning beyond PLAUSIBLE."""
    longest = np.median(np.ptp([*place.values()], axis=1), axis=0).max() if place else 0.0
    level = "note" if PLAUSIBLE[0] <= longest <= PLAUSIBLE[1] else "warning"
    for frame, (low, high) in place.items():
        text = f"{in_cm(high - low)} cm, from {100 * low[2]:.1f} to {100 * high[2]:.1f} cm above the table in frame {frame}"
        return {"value": in_cm(high - low), "text": text, "frames": (frame,), "level": level}
    return None


def lowest(place: Place) -> dict[str, Any] | None:
    """Lowest height of the object above the table, m."""
    if not place:
        return None
    frame = min(place, key=lambda frame: float(place[frame][0, 2]))
    return {"value": float(place[frame][0, 2]), "detail": f"in frame {frame}", "frames": (frame,)}


def hands_on(camera: Camera, sample: Sample) -> int:
    """The number of hands within HAND_REACH of the object in a frame; pieces within 4 % of the image are one hand."""
    body, own = lifted(camera, sample, OBJECT), sample.mask == HANDS
    reach = max(int(0.02 * camera.width), 1)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    count, pieces = cv2.connectedComponents(cv2.dilate(own.astype(np.uint8), disk))
    if len(body) < FEWEST_POINTS:
        return 0
    tree = KDTree(body)
    each = [lifted(camera, Sample(sample.depth, np.where(own & (pieces == k), HANDS, 0)), HANDS) for k in range(1, count)]
    return sum((tree.query(hand)[0] <= HAND_REACH).sum() >= FEWEST_POINTS for hand in each)


def constant_grips(counts: np.ndarray, rate: float, folder: Path) -> dict[str, Any] | None:
    """The times with a constant number of hands at the object [T], by all cameras of a capture, and the longest of them."""
    steady = median_filter(counts, 5, mode="nearest")
    edges = [0, *(np.flatnonzero(np.diff(steady)) + 1).tolist(), len(steady)]
    spans = [(first, end - 1, int(steady[first])) for first, end in pairwise(edges)]
    if len(spans) < 2:
        return None
    held = [span for span in spans if span[2] and span[1] - span[0] + 1 >= rate]
    ranked = sorted(held, key=lambda span: span[0] - span[1])[:3]
    commands = " or ".join(f"--frames {first}-{last}" for first, last, _ in ranked)
    cut = f": neuspring cut-capture {folder} {commands} --output ..." if ranked else "; none lasts 1 s"
    return {"text": ", ".join(f"{first}-{last}: {count}" for first, last, count in spans), "cut": cut}
