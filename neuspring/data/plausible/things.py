"""Object and hands of one camera in the world, by masks and depth: size, height above the table, depth, and whether they meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from neuspring.core.findings import Finding, finding
from neuspring.data.capture import HANDS, OBJECT, Camera

SAMPLED = 5
"""Frames per camera, evenly spaced, that are compared with the world."""
SMALL, LARGE = 0.02, 1.2
"""m. Objects whose longest side is another are a wrong mask or a wrong unit of depth."""
SUNK, HIGH = 0.02, 1.2
"""m. An object lower than SUNK below the table, or higher than HIGH above it, stands in another world than the table."""
WITHIN = (0.05, 0.95)
"""Quantiles between which a body lies: beyond them are pixels of its outline with the depth of something else."""
HOLES, BAD_HOLES = 0.4, 0.8
"""Share of the object's pixels without depth from which twins suffer, and from which little is left to lift. Outlines have none: a
tenth of a cloth or a toy in the synthetic scenes, and a third of a rope."""
HAND_AREA = 0.12
"""m². Two hands and forearms seen from one side have less; sleeves and a torso have more."""
HAND_RATIO = 12.0
"""Hands this many times as large as the object in the image are another thing."""
REACH = 0.06
"""m. A hand that never comes nearer to the object does not hold it. Where they touch, depth may be hidden."""
POINTS = 1500
"""Points of each thing that are compared."""
FEW = 20
"""Points below which nothing is said of a thing in a frame."""
TABLE = "Look at the mask of frame 0 and at depth_unit; make-capture --level puts the table at z = 0."
SCALE = "Look at the mask of frame 0, and at the units of depth and poses: meters, with the table at z = 0."


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame of one camera."""

    depth: np.ndarray
    """[H, W], m, 0: none."""
    mask: np.ndarray
    """[H, W] labels."""


def sampled(frames: int) -> set[int]:
    """Numbers of the frames that are compared with the world."""
    return set(np.linspace(0, frames - 1, SAMPLED).astype(int).tolist())


def lifted(camera: Camera, sample: Sample, label: int) -> np.ndarray:
    """World points [n, 3], m, of the pixels with a label and depth; at most POINTS."""
    y, x = np.nonzero((sample.mask == label) & (sample.depth > 0))
    step = -(-len(x) // POINTS) or 1
    y, x = y[::step], x[::step]
    return camera.lift(np.stack([x, y], axis=-1).astype(float), sample.depth[y, x])


def depth_findings(camera: Camera, samples: Mapping[int, Sample]) -> list[Finding]:
    """The share of the object without depth in a few frames, by number: a note, or a warning."""
    missing = {frame: float((s.depth[s.mask == OBJECT] <= 0).mean()) for frame, s in samples.items() if (s.mask == OBJECT).any()}
    if not missing:
        return []
    worst = max(missing, key=lambda frame: missing[frame])
    mean = float(np.mean(list(missing.values())))
    value = f"{mean:.0%} of the object's pixels have no depth (frame {worst}: {missing[worst]:.0%})"
    bad = mean > HOLES or missing[worst] > BAD_HOLES
    if not bad:
        return [finding("depth holes", "note", f"camera {camera.name}", value, f"up to {HOLES:.0%} are usual")]
    rule = f"at most {HOLES:.0%} are expected, and never {BAD_HOLES:.0%}"
    remedy = "Film from farther than the sensor's least distance, without shine and direct sun; look whether depth is aligned."
    return [finding("depth holes", "warning", f"camera {camera.name}", value, rule, remedy)]


def hand_findings(camera: Camera, samples: Mapping[int, Sample]) -> list[Finding]:
    """Hands that are too large to be hands, in a few frames by number."""
    areas, ratios = [], []
    for sample in samples.values():
        own = sample.mask == HANDS
        measured = own & (sample.depth > 0)
        if measured.sum() < FEW or not (sample.mask == OBJECT).any():
            continue
        depth = np.where(sample.depth > 0, sample.depth, np.median(sample.depth[measured]))
        areas.append(float((depth[own] ** 2).sum() / np.prod(np.diag(camera.intrinsics)[:2])))
        ratios.append(float(own.sum() / (sample.mask == OBJECT).sum()))
    if not areas:
        return []
    area, ratio = float(np.median(areas)), float(np.median(ratios))
    if area <= HAND_AREA and ratio <= HAND_RATIO:
        return []
    value = f"hands (label {HANDS}) of {1e4 * area:.0f} cm², {ratio:.1f} times the object's pixels"
    rule = f"less than {1e4 * HAND_AREA:g} cm² and {HAND_RATIO:g} times are expected"
    remedy = "Sleeves, torso or table are no hands: mark them to be ignored (`neuspring mask`)."
    return [finding("hands too large", "warning", f"camera {camera.name}", value, rule, remedy)]


def place_findings(where: str, bodies: Sequence[np.ndarray], up: float) -> list[Finding]:
    """Size of the object and its height above the table: a note, and a warning for each that is no object's on a table.

    `bodies` are its points [n, 3], m, in the world in some frames; `up` is +1 or -1.
    """
    ranges = np.array([np.quantile(points * (1, 1, up), WITHIN, axis=0) for points in bodies if len(points) >= FEW])
    if not len(ranges):
        return []
    sides, low, high = np.median(np.ptp(ranges, axis=1), axis=0), float(ranges[:, 0, 2].min()), float(ranges[:, 1, 2].max())
    text = " x ".join(f"{100 * side:.0f}" for side in sides)
    value = f"{text} cm, from {100 * low:.1f} to {100 * high:.1f} cm above the table"
    found = [finding("size of the object", "note", where, value, "as its pixels with depth show it", "Is that what was filmed?")]
    found += implausible(where, float(sides.max()))
    if low < -SUNK:
        value, rule = f"it reaches {-100 * low:.1f} cm below the table", f"at most {100 * SUNK:g} cm are noise"
        found.append(finding("object below the table", "warning", where, value, rule, TABLE))
    if high > HIGH:
        rule = f"at most {HIGH:g} m is expected; walls and people in the mask are no object"
        found.append(finding("object high above the table", "warning", where, f"it is up to {high:.2f} m above it", rule, TABLE))
    return found


def implausible(where: str, longest: float) -> list[Finding]:
    """A warning where the longest side, m, is that of nothing that hands hold on a table."""
    if SMALL < longest < LARGE:
        return []
    rule = f"{100 * SMALL:g} to {100 * LARGE:g} cm are expected"
    return [finding("implausible size", "warning", where, f"{100 * longest:.3g} cm long", rule, SCALE)]


def reach_findings(camera: Camera, samples: Mapping[int, Sample]) -> list[Finding]:
    """A hand that is in view in some frames and near the object in none."""
    gaps = []
    for sample in samples.values():
        body, hands = (lifted(camera, sample, label) for label in (OBJECT, HANDS))
        if min(len(body), len(hands)) >= FEW:
            gaps.append(float(KDTree(body).query(hands)[0].min()))
    if not gaps or min(gaps) <= REACH:
        return []
    value = f"the hand is never nearer to the object than {100 * min(gaps):.1f} cm, in {len(gaps)} frames"
    rule = f"within {100 * REACH:g} cm it can move it"
    remedy = "Look at the masks for a hand that is something else, or for the wrong object."
    return [finding("hand far from the object", "warning", f"camera {camera.name}", value, rule, remedy)]
