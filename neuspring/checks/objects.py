"""Object and hands of one camera, from masks and depth: size, height above the table, and contact."""

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
"""Number of evenly spaced frames per camera that are lifted to 3D."""
WITHIN = (0.01, 0.99)
"""Quantiles that bound an object; pixels of its outline with depths between object and background are outside of them."""
APART, SPARSE, PIECE = 0.2, 4.0, 0.02
"""A gap separates pieces if it exceeds APART of the object's size and SPARSE times the distance of its points. Pieces with less
than PIECE of the points do not count; pieces that occlusion by hands or folds separates are larger."""
HAND_REACH = 0.06
"""Distance, m, within which a hand may hold the object. It is not zero, because contacts are often occluded."""
HAND_RATIO = 12.0
"""Largest plausible ratio of hand pixels to object pixels."""
PLAUSIBLE = (0.02, 1.2)
"""Plausible range of an object's longest side, m."""
COMPARED_POINTS, FEWEST_POINTS = 1500, 20
"""Largest number of compared points, and smallest number that is reported."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame of one camera."""

    depth: np.ndarray
    """[H, W], m; 0: no measurement."""
    mask: np.ndarray
    """[H, W] labels."""
    color: np.ndarray | None = None
    """[H, W, 3] uint8 RGB; None if it was not read."""


Samples = Mapping[int, Sample]
"""Some frames of a camera, by number."""


def sampled(frames: int) -> set[int]:
    """Indices of the SAMPLED frames."""
    return set(np.linspace(0, frames - 1, SAMPLED).astype(int).tolist())


def of_body(points: np.ndarray) -> np.ndarray:
    """[n] bool: True for points [n, 3], m, of the object, False for small separate pieces (`APART`)."""
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
    """Lowest and highest coordinates [2, 3] of an object's points [n, 3], m, without small separate pieces."""
    return np.asarray(np.quantile(points[of_body(points)], WITHIN, axis=0))


def lifted(camera: Camera, sample: Sample, label: int) -> np.ndarray:
    """World points [n, 3], m, of pixels with this label and depth, at most COMPARED_POINTS; of the object without strays."""
    y, x = np.nonzero((sample.mask == label) & (sample.depth > 0))
    step = -(-len(x) // COMPARED_POINTS) or 1
    y, x = y[::step], x[::step]
    points = camera.lift(np.stack([x, y], axis=-1).astype(float), sample.depth[y, x])
    return points[of_body(points)] if label == OBJECT else points


def holes(camera: Camera, samples: Samples) -> float | None:
    """Mean fraction of object pixels without depth."""
    missing = [float((s.depth[s.mask == OBJECT] <= 0).mean()) for s in samples.values() if (s.mask == OBJECT).any()]
    return float(np.mean(missing)) if missing else None


def hand_area(camera: Camera, samples: Samples) -> dict[str, Any] | None:
    """Median area of the hands, m²; infinite if they have more than HAND_RATIO times the object's pixels."""
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
    """Smallest distance between hands and object, m, over the frames that show both."""
    gaps = []
    for sample in samples.values():
        body, hands = (lifted(camera, sample, label) for label in (OBJECT, HANDS))
        if min(len(body), len(hands)) >= FEWEST_POINTS:
            gaps.append(float(KDTree(body).query(hands)[0].min()))
    return min(gaps) if gaps else None


Place = Mapping[int, np.ndarray]
"""Frame -> lowest and highest coordinates of the object [2, 3], m; the third coordinate is the height above the table."""


def place_of(bodies: Mapping[int, np.ndarray], up: float) -> Place:
    """Extent of the object by frame, from its world points [n, 3], m; `up` is +1 or -1. Frames with few points are skipped."""
    return {frame: extents(points * (1, 1, up)) for frame, points in bodies.items() if len(points) >= FEWEST_POINTS}


def in_cm(sides: Iterable[float]) -> str:
    """Sides, m, as text in cm, for example `12 x 9`; sides below 1 cm get one decimal."""
    return " x ".join(f"{100 * side:.{0 if side >= 0.01 else 1}f}" for side in sides)


def size(place: Place) -> dict[str, Any] | None:
    """Sides and heights of the object in the first frame that shows it; a warning if the longest side is not PLAUSIBLE."""
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
    """Number of hands within HAND_REACH of the object in a frame; pieces closer than 4 % of the image width are one hand."""
    body, own = lifted(camera, sample, OBJECT), sample.mask == HANDS
    reach = max(int(0.02 * camera.width), 1)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    count, pieces = cv2.connectedComponents(cv2.dilate(own.astype(np.uint8), disk))
    if len(body) < FEWEST_POINTS:
        return 0
    tree = KDTree(body)
    hands = [lifted(camera, Sample(sample.depth, np.where(own & (pieces == k), HANDS, 0)), HANDS) for k in range(1, count)]
    return sum((tree.query(hand)[0] <= HAND_REACH).sum() >= FEWEST_POINTS for hand in hands)


def constant_grips(counts: np.ndarray, rate: float, folder: Path) -> dict[str, Any] | None:
    """Spans of frames with a constant number of hands at the object, `counts` [T] over all cameras, and the longest of them."""
    steady = median_filter(counts, 5, mode="nearest")
    edges = [0, *(np.flatnonzero(np.diff(steady)) + 1).tolist(), len(steady)]
    spans = [(first, end - 1, int(steady[first])) for first, end in pairwise(edges)]
    if len(spans) < 2:
        return None
    grasps = [span for span in spans if span[2] and span[1] - span[0] + 1 >= rate]
    ranked = sorted(grasps, key=lambda span: span[0] - span[1])[:3]
    commands = " or ".join(f"--frames {first}-{last}" for first, last, _ in ranked)
    cut = f": neuspring cut-capture {folder} {commands} --output ..." if ranked else ", but none lasts 1 s"
    return {"text": ", ".join(f"{first}-{last}: {count}" for first, last, count in spans), "cut": cut}
