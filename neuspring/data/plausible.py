"""A capture against the world, before any cost.

- The table that each camera sees against z = 0 and `up`, and what explains a finding.
- Object and hands of one camera, by masks and depth: size, height above the table, depth, and whether they meet.
- Edges of depth against those of color.
- Color alone: the table is z = 0 as the camera's pose says, and what lies on it is measured there. The outline is
  one of its category.
- Cameras against each other: a point that camera A measured is projected into camera B. Where B measured more depth there, B looked
  through it: one of the poses is wrong. Less depth is no contradiction: something may hide the point from B. Only what stands out
  of the table counts, because a table that is moved along itself looks the same.
- The masks of one camera over the video: whether object and hands are there, whole, and change no faster than bodies do.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import median_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import up_sign
from neuspring.core.findings import Finding, broken, finding, note, unusual
from neuspring.core.geometry import Obstacle
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, THIN, Camera
from neuspring.data.intake.depth import FAR, NEAR, ROLL, Plane
from neuspring.data.intake.lenses import rigid_inverse

SMALLEST = 0.08
"""Share of the pixels with depth from which a plane may be the table."""
TILT, OFF = 2.0, 0.01
"""Degrees and m within which the table is level and at z = 0. Ground contact of the simulation is at z = 0."""
TILTED, FAR_OFF = 15.0, 0.15
"""Degrees and m beyond which the table is elsewhere, and no twin can rest on it."""
EXPLAINED = (4.0, 0.03)
"""Degrees and m within which the table lies after a change that explains a finding; m also as a part of the camera's height."""
FACTORS = (0.1, 10.0, 0.001, 1000.0)
"""Wrong units of depth make the scene so many times as large."""
HIGHEST = 3.0
"""m. Cameras higher above the table have too coarse a picture of what lies on it, or another unit of depth."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to OpenGL's, where y is up and z points backward."""

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From a world with y up to one with z up."""


@dataclass(frozen=True)
class Stand:
    """How a plane stands in the world."""

    tilt: float
    """Angle of its normal with up, degrees."""
    off: float
    """Height of its points above z = 0 along up, m."""

    def near(self, height: float) -> bool:
        """Whether it is z = 0 after a change that explains a finding; `height` is the camera's above the plane, m."""
        return self.tilt < EXPLAINED[0] and abs(self.off) < max(EXPLAINED[1], EXPLAINED[1] * height)


def stand(plane: Plane, pose: np.ndarray, up: float, factor: float = 1.0) -> Stand:
    """How `plane` stands in the world by `pose`, camera to world [4, 4], m, if depth is multiplied by `factor`."""
    cosine = up * (pose[:3, :3] @ plane.normal)[2]
    z = (factor * plane.points.mean(axis=0)) @ pose[2, :3] + pose[2, 3]
    return Stand(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(up * z))


def table_findings(path: Path, name: str, planes: Sequence[Plane], pose: np.ndarray, up: str, unit: float | None) -> list[Finding]:
    """Findings about one camera's table against z = 0. `unit`, m per count, is None where depth is in meters by its type."""
    sign = up_sign(up)
    where = f"cameras.{name}.camera_to_world"
    candidates = [plane for plane in planes if plane.share >= SMALLEST]
    if not candidates:
        return [note(path, f"camera {name} sees no plane in depth: z = 0 and up are not checked against the table")]
    stands = [stand(plane, pose, sign) for plane in candidates]
    standing = min(stands, key=lambda one: one.tilt / TILT + abs(one.off) / OFF)
    table = candidates[stands.index(standing)]
    side = "above" if standing.off > 0 else "below"
    where_it_is = f"{1e3 * abs(standing.off):.0f} mm {side} z = 0 and tilted by {standing.tilt:.1f} degrees; plane: {table.text()}"
    if standing.tilt < TILT and abs(standing.off) < OFF:
        found = [note(path, f"camera {name}: the table is {where_it_is}")]
        if table.height > HIGHEST:
            rule = f"{where}: a camera should be at most {HIGHEST:g} m above the table"
            next_move = f"{table.height:.2f} m. Check depth_unit: ten times too large makes all of the scene so"
            found.append(unusual(path, "", rule, next_move))
        return found
    for plane in candidates:
        explained = _explained(path, name, plane, pose, up, unit)
        if explained:
            return [explained]
    if standing.tilt > TILTED or abs(standing.off) > FAR_OFF:
        remedy = "Calibrate again, or let `neuspring make-capture --level` put it there"
        return [broken(path, where, "the table that the camera sees must be z = 0", f"{where_it_is}. {remedy}")]
    remedy = "`neuspring make-capture --level` puts the table at z = 0"
    return [unusual(path, where, "the table that the camera sees should be z = 0", f"{where_it_is}. {remedy}")]


def variants(pose: np.ndarray) -> dict[str, np.ndarray]:
    """What a pose [4, 4] may be instead, with the next move, and the pose that is meant then."""
    return {
        "a world-to-camera matrix. Invert it": rigid_inverse(pose),
        "a matrix for OpenGL's axes (y up, z backward). Change the signs of its second and third column": pose @ OPENGL,
        "a world-to-camera matrix for OpenGL's axes (y up, z backward). Invert it, then change the signs of its second and third "
        "column": rigid_inverse(pose) @ OPENGL,
        f"a pose in a world with y up. Multiply it from the left by {Y_UP.astype(int).tolist()}": Y_UP @ pose,
        "a pose in a world with y up, for OpenGL's axes. Change the signs of its second and third column, then multiply it from "
        f"the left by {Y_UP.astype(int).tolist()}": Y_UP @ pose @ OPENGL,
    }


def _explained(path: Path, name: str, plane: Plane, pose: np.ndarray, up: str, unit: float | None) -> Finding | None:
    """The one change that puts the table at z = 0, as an error; None if there is none."""
    sign = up_sign(up)
    where = f"cameras.{name}.camera_to_world"
    other = "-z" if up == "+z" else "+z"
    flipped = stand(plane, pose, -sign)
    if flipped.tilt < TILTED and abs(flipped.off) < FAR_OFF:
        height = 1e3 * sign * pose[2, 3]
        rule = f"must be the side of the table on which the cameras are: {other}"
        return broken(path, "up", rule, f"{up}, by which camera {name} is {abs(height):.0f} mm below the table")
    for factor in FACTORS:
        if stand(plane, pose, sign, 1 / factor).near(pose[2, 3]):
            rule = f"the table must be as far from camera {name} as its pose says"
            if unit is None:
                return broken(path, f"depth of camera {name}", rule, f"{factor:g} times")
            plausible = f"Plausible would be {unit / factor:g}"
            return broken(path, "depth_unit", rule, f"{unit:g}, which makes it {factor:g} times as far. {plausible}")
    for what, variant in variants(pose).items():
        for direction in (sign, -sign):
            if stand(plane, variant, direction).near(plane.height):
                rule = "camera-to-world is required (x right, y down, z forward): with it the table is z = 0"
                also = "" if direction == sign else f", and set up to {other}"
                return broken(path, where, rule, f"what looks like {what}{also}")
    return None


SAMPLED = 5
"""Frames per camera, evenly spaced, that are compared with the world, or in which the table is looked for."""
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
HAND_LEAST = 0.002
"""m². Real hands with a part of the forearm have 0.015 to 0.05 in color alone; fewer are a wrong scale of the pose."""
HAND_RATIO = 12.0
"""Hands this many times as large as the object in the image are another thing."""
REACH = 0.06
"""m. A hand that never comes nearer to the object does not hold it. Where they touch, depth may be hidden."""
POINTS = 1500
"""Points of each thing that are compared."""
FEW = 20
"""Points below which nothing is said of a thing in a frame."""
TABLE = "Look at the mask of frame 0 and at depth_unit; make-capture --level puts the table at z = 0."
SCALE = (
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


def hand_findings(camera: Camera, samples: Mapping[int, Sample], least: float = 0.0) -> list[Finding]:
    """Hands that are too large to be hands, or smaller than `least`, m², in a few frames by number."""
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
    if area < least:
        value, rule = f"hands (label {HANDS}) of {1e4 * area:.2g} cm²", f"at least {1e4 * least:g} cm² are expected"
        return [finding("hands too small", "warning", f"camera {camera.name}", value, rule, SCALE)]
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


UNITS = {"millimeters": 1000.0, "tenths of a millimeter": 10000.0, "centimeters": 100.0}
"""What meters may be instead."""
AWAY = 0.3
"""m. Hands that never come nearer to the nodes, and nodes that are farther from annotated points, are of another scene."""


def space_findings(file: Path, points: np.ndarray, up: float | None, *, is_body: bool) -> list[Finding]:
    """Unit and axes of points [n, 3] of a file, m; of a body in frame 0 also its size. `up` is +1 or -1; None: no table."""
    most, sides = float(np.abs(points).max()), np.ptp(points, axis=0)
    size = " x ".join(f"{side:.3g}" for side in sides)
    if most > FAR:
        fitting = [f"divide by {by:g} if they are {unit}" for unit, by in UNITS.items() if most / by < FAR]
        remedy = f"Likely: {', or '.join(fitting)}" if fitting else "Look at its unit"
        rule = f"coordinates must be meters, at most {FAR:g} from the origin"
        return [broken(file, "points", rule, f"{most:.4g}, in {size}. {remedy}")]
    found = implausible(str(file), float(sides.max())) if is_body else []
    if up is None:
        return found
    height, sign = up * points[:, 2], "+-" if up > 0 else "-+"
    low, high = np.quantile(height, WITHIN)
    # A body may hang in the air, and need not.
    if low >= -SUNK and high <= HIGH and not (is_body and low > FAR_OFF):
        return found
    where = "z from {:.3g} to {:.3g} m".format(*np.quantile(points[:, 2], (0, 1)) + 0.0)
    rule = f"with up {sign[0]}z points must lie between the table, z = 0, and {HIGH:g} m above it"
    rests = [turn for turn in (1, -1) if abs((turn * points[:, 1]).min()) < SUNK]
    if is_body and rests and abs(high) > SUNK:
        words = "(x, -z, y)" if rests[0] == up else "(x, z, -y)"
        text = f"{where}. It rests at y = 0: if y is up, write {words} in place of (x, y, z)"
        return [*found, (unusual if low > FAR_OFF else broken)(file, "points", rule, text)]
    if high <= SUNK:
        remedy = f"Is up {sign[1]}z? Then write so in {CAPTURE} (make-capture: --up). Without a table: ground: false (--no-table)"
        return [*found, broken(file, "points", rule, f"{where}. {remedy}")]
    if low > FAR_OFF and high <= HIGH:
        remedy = "If it stands on a table, the table must be z = 0; or is another axis up? If it hangs, this is right"
        return [*found, unusual(file, "points", rule, f"{where}: {100 * low:.0f} cm above the table. {remedy}")]
    remedy = f"Move the world so that the table is z = 0, or write ground: false in {CAPTURE} (make-capture: --no-table)"
    return [*found, (broken if low < -FAR_OFF else unusual)(file, "points", rule, f"{where}. {remedy}")]


MOST_NODES = 5000
"""Nodes beyond which a warning says that a twin is slow."""


def node_findings(file: Path, count: int) -> list[Finding]:
    """Nodes of a body that are too many."""
    if count <= MOST_NODES:
        return []
    value = f"{count}. Each of them costs time in every substep"
    return [unusual(file, "points", f"some hundred nodes are enough, more than {MOST_NODES} are slow", value)]


def holding_findings(file: Path, hand: np.ndarray) -> list[Finding]:
    """Hands of one point, from the hand [C] of each controller."""
    if np.unique(hand, return_counts=True)[1].min() > 1:
        return []
    rule = "three points of a hand, or of a jaw, turn what it holds"
    return [unusual(file, "points", rule, "one of some hand. It holds like a string: is that so?")]


def annotated_findings(file: Path, points: np.ndarray, nodes: np.ndarray) -> list[Finding]:
    """Annotated points of frame 0 [K, 3], m, NaN where unseen, that are far from the nodes [N, 3] of the body that they are on."""
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    away = KDTree(nodes).query(points[known])[0] if len(known) else np.zeros(0)
    if not (away > REACH).any():
        return []
    rule = f"annotated points must lie on the body: within {100 * REACH:g} cm of a node in frame 0"
    value = f"point {known[away.argmax()]} is {100 * away.max():.1f} cm away, {(away > REACH).sum()} of {len(away)} are farther"
    level = broken if np.median(away) > REACH else unusual
    return [level(file, "", rule, f"{value}. Are points and nodes of one recording, in one world?")]


def contact_findings(file: Path, hands: np.ndarray, nodes: np.ndarray) -> list[Finding]:
    """Places [n, 3], m, of controllers that hold in training frames, near to none of the nodes [N, 3] of frame 0."""
    if not len(hands):
        rule = "some controller must hold in some training frame"
        return [broken(file, "holds", rule, "none. A twin learns from training frames: see train_end")]
    gap = float(KDTree(nodes).query(hands)[0].min())
    if gap <= REACH:
        return []
    rule = f"in some training frame a controller must come within {100 * REACH:g} cm of a node of frame 0 to move it"
    value = f"{100 * gap:.1f} cm at the nearest. Are hands and nodes of one recording, in one world?"
    return [(broken if gap > AWAY else unusual)(file, "points", rule, value)]


def doubled_findings(file: Path, controllers: np.ndarray, body: np.ndarray, same: float) -> list[Finding]:
    """Controllers [C, 3], m, of frame 0 that lie on a node or annotated point [n, 3], nearer than `same`."""
    near = KDTree(body).query(controllers)[0]
    if not (near < same).any():
        return []
    rule = f"controllers must lie {1e3 * same:g} mm from nodes and annotated points in frame 0: a spring needs a length"
    value = f"controller {near.argmin()}, {(near < same).sum()} in all. Move them off the body, or leave out the nodes below them"
    return [broken(file, "points", rule, value)]


BESIDE = 0.04
"""Distance between two pieces of the hands' mask, as a part of the image, within which they are one hand."""
STEADY = 5
"""Frames over whose median hands are counted."""
SHORTEST = 1.0
"""s. Shorter times with one constant grip are not proposed."""


def hands_on(camera: Camera, sample: Sample) -> int:
    """How many hands are within REACH of the object in a frame."""
    body, own = lifted(camera, sample, OBJECT), sample.mask == HANDS
    reach = max(int(0.5 * BESIDE * camera.width), 1)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    count, pieces = cv2.connectedComponents(cv2.dilate(own.astype(np.uint8), disk))
    each = [lifted(camera, Sample(sample.depth, np.where(own & (pieces == k), HANDS, 0)), HANDS) for k in range(1, count)]
    return sum((KDTree(body).query(hand)[0] <= REACH).sum() >= FEW for hand in each) if len(body) >= FEW else 0


def grip_findings(folder: Path, grips: np.ndarray, rate: float) -> list[Finding]:
    """A note on the hands at the object [T], counted by all cameras, and the longest times in which their number is constant."""
    steady = median_filter(grips, STEADY, mode="nearest")
    edges = [0, *(np.flatnonzero(np.diff(steady)) + 1).tolist(), len(steady)]
    spans = [(first, end - 1, int(steady[first])) for first, end in pairwise(edges)]
    if len(spans) < 2:
        return []
    told = ", ".join(f"{first}-{last}: {count}" for first, last, count in spans)
    held = [span for span in spans if span[2] and span[1] - span[0] + 1 >= SHORTEST * rate]
    longest = sorted(held, key=lambda span: span[0] - span[1])[:3]
    text = f"hands within {100 * REACH:g} cm of the object, by frames: {told}. A twin is best learned from one constant grip"
    commands = " or ".join(f"--frames {first}-{last}" for first, last, _ in longest)
    text += f": neuspring cut-capture {folder} {commands} --output ..." if longest else f"; none lasts {SHORTEST:g} s"
    return [note(folder / CAPTURE, text)]


SHEET_HIGH, SHEET_SIDE = 0.015, 0.08
"""m: a sheet that lies on the table is lower, but for a tenth of it, and each of its sides is longer."""
COVERED = 0.6
"""Part of its outline that a sheet covers; a rope in turns covers less."""
BODIES = ("sloth", "plush", "toy", "ball", "cable", "rod")
"""Words for bodies that are near to those that mean another thing."""
THINNER = 'If it is a sheet, write "category": "cloth" in capture.json: then no volume is made of it.'


def category_findings(path: Path, category: str) -> list[Finding]:
    """A warning about a word that is nearly one of those that mean something."""
    close = difflib.get_close_matches(category.casefold(), (*THIN, "rope", *BODIES), n=1, cutoff=0.75)
    if not close or category == close[0] or close[0] in BODIES:
        return []
    rule = f"only {' and '.join(THIN)} mean a thin thing, and only rope a round one; any other word is a filled body"
    return [unusual(path, "category", rule, f"{category!r}. Is {close[0]} meant?")]


def sheet_findings(where: str, points: np.ndarray, up: float, category: str = "") -> list[Finding]:
    """A warning where points [n, 3], m, of the object in frame 0 are those of a sheet on the table whose category is not thin."""
    flat = points[:, :2].astype(np.float32)
    if category in THIN or len(points) < FEW or (high := float(np.quantile(up * points[:, 2], 0.9))) > SHEET_HIGH:
        return []
    sides, outline = sorted(cv2.minAreaRect(flat)[1], reverse=True), cv2.contourArea(cv2.convexHull(flat))
    # Cells of which a sheet has 2.25 points each: one in ten is empty.
    cell = 1.5 * float(np.sqrt(outline / len(points)))
    if sides[1] < SHEET_SIDE or len(np.unique(flat // cell, axis=0)) * cell**2 < COVERED * outline:
        return []
    value = f"a flat thing of {100 * sides[0]:.0f} x {100 * sides[1]:.0f} cm, {1e3 * high:.0f} mm high"
    rule = f"the category {category!r} makes a filled body of it" if category else "a filled hull was made of it"
    return [finding("shape and category", "warning", where, value, rule, THINNER)]


SLENDER = 6.0
"""Area of an outline over the square of its greatest width. Ropes of real films that lie have 8.9 and more; toys, cloths, rods and
boxes, real and rendered from all sides, up to 4.1."""


def outline_findings(where: str, mask: np.ndarray, category: str) -> list[Finding]:
    """A warning where the outline of the object in a mask [H, W] of frame 0 is not one of its category; of color alone."""
    own = np.pad(mask == OBJECT, 1).astype(np.uint8)
    if own.sum() < FEW:
        return []
    slender = float(own.sum() / (2 * cv2.distanceTransform(own, cv2.DIST_L2, 5).max()) ** 2)
    if (slender > SLENDER) == (category == "rope"):
        return []
    shape = "a long thin thing" if slender > SLENDER else "a compact thing"
    value = f"the category is {category!r}, and the outline is that of {shape}: {slender:.1f} squares of its greatest width"
    rule = f"a rope has more than {SLENDER:g}, all else less"
    other = "rope" if slender > SLENDER else "cloth, or another word for a body,"
    return [finding("outline and category", "warning", where, value, rule, f"Is {other} meant? Or look at the mask of frame 0.")]


RAISED, AIR = 0.025, (0.05, 0.3)
"""m that a support is high; and the height above the table, m and as part of its own height, from which an object that is seen from
the side is not on it. The lowest visible points of a ball on the table are a tenth of its height above it."""
SIDE = 50.0
"""Degrees: a camera that looks down more steeply does not see where an object ends below."""
LEVEL, BY = 0.01, 0.1
"""m: how even a support is, and how far from the object it is looked for."""
RIM = 9
"""Pixels beside a mask may still be of its object."""


def support_findings(camera: Camera, sample: Sample, up: float, obstacles: Sequence[Obstacle]) -> list[Finding]:
    """A warning where the object of frame 0 begins above the table and no obstacle is under it: the twin would fall.

    Where a level surface is seen around its foot, the finding has the box that stands for it.
    """
    own = lifted(camera, sample, OBJECT) * (1, 1, up)
    if len(own) < FEW:
        return []
    low, high = np.quantile(own[:, 2], WITHIN)
    foot, away = own[own[:, 2] < low + LEVEL], max(AIR[0], AIR[1] * (high - low))
    if low < RAISED or any((one.depth((foot - (0, 0, away)) * (1, 1, up)) > 0).any() for one in obstacles):
        return []
    y, x = np.nonzero((cv2.dilate((sample.mask > 0).astype(np.uint8), np.ones((RIM, RIM), np.uint8)) == 0) & (sample.depth > 0))
    seen = camera.lift(np.stack([x, y], axis=1).astype(float), sample.depth[y, x]) * (1, 1, up)
    near = ((seen[:, :2] > foot[:, :2].min(axis=0) - BY) & (seen[:, :2] < foot[:, :2].max(axis=0) + BY)).all(axis=1)
    top = seen[near & (seen[:, 2] > max(RAISED, low - away)) & (seen[:, 2] < low + LEVEL)]
    level = float(np.median(top[:, 2])) if len(top) > 2 * FEW else 0.0
    where, text = f"camera {camera.name}, object", f"what is seen of it in frame 0 begins {100 * low:.0f} cm above the table"
    if level and np.mean(np.abs(top[:, 2] - level) < LEVEL) > 0.8:
        (x0, y0), sides, angle = cv2.minAreaRect(np.concatenate([top, foot])[:, :2].astype(np.float32))
        turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        center, half = np.round([[x0, y0, up * level / 2], [*np.divide(sides, 2), level / 2]], 3).tolist()
        value = f"{text}, on something {100 * level:.1f} cm high"
        box = json.dumps({"shape": "box", "center": center, "half_sizes": half, "rotation": (turn.round(4) + 0.0).tolist()})
        remedy = f'Add to capture.json, as measured here: "obstacles": [{box}]. Or mark it as the object too, if both move.'
    else:
        hands, steep = lifted(camera, sample, HANDS), -up * camera.camera_to_world[2, 2] > np.sin(np.radians(SIDE))
        if low < away or steep or (len(hands) and KDTree(own).query(hands * (1, 1, up))[0].min() < REACH):
            return []
        value = f"{text}, and no hand is near"
        remedy = "Measure what it stands on, and add it to obstacles of capture.json; or mark it as the object too."
    return [finding("object above the table", "warning", where, value, "there is nothing under the twin, and it falls", remedy)]


POSE = "Look at camera_to_world: the table must be z = 0 in meters, and the camera's z points forward."


STEEP = 20.0
"""Degrees from straight above, within which a camera has no upper side."""


def on_table(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """World points [n, 3], m, at which the rays of pixels (x, y) [n, 2] meet z = 0; NaN for rays that never do."""
    eye = camera.camera_to_world[:3, 3]
    rays = camera.lift(pixels.astype(float), np.ones(len(pixels))) - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -eye[2] / rays[:, 2]
    return np.asarray(eye + np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)[:, None] * rays)


def color_alone_findings(path: Path, camera: Camera, up: str, source: str = "") -> list[Finding]:
    """Findings about a camera that is not above the table z = 0, does not look at it, or is turned; else a note on how far it is.

    `source` says where the pose is from.
    """
    where, sign = f"cameras.{camera.name}.camera_to_world{f' ({source})' if source else ''}", up_sign(up)
    if wrong := _wrong_view(camera, sign):
        alike = [
            f"{what}{'' if direction == sign else ', and set up to ' + ('-z' if up == '+z' else '+z')}"
            for what, pose in variants(camera.camera_to_world).items()
            for direction in (sign, -sign)
            if not _wrong_view(replace(camera, camera_to_world=pose), direction)
        ]
        rule, received, possible = wrong
        meant = f"This looks like {'. Or like '.join(alike)}" if alike else POSE.rstrip(".")
        if possible:
            return [unusual(path, "", f"{where}: {rule}", f"{received}. {meant}. If the camera is mounted so, go on")]
        return [broken(path, "", f"{where}: {rule}", f"{received}. {meant}")]
    height = abs(float(camera.camera_to_world[2, 3]))
    text = f"the table is z = 0 as given, {_away(camera):.2f} m away in the center of the image"
    found = [note(path, f"camera {camera.name}: color alone: {text}, {height:.2f} m below the camera")]
    if height > HIGHEST:
        rule = f"{where}: a camera should be at most {HIGHEST:g} m above the table"
        found.append(unusual(path, "", rule, f"{height:.2f} m. Is camera_to_world in meters?"))
    return found


def _away(camera: Camera) -> float:
    """Distance, m, of the table z = 0 in the center of the image; NaN where it is not there."""
    center = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    return float(np.linalg.norm(on_table(camera, center)[0] - camera.camera_to_world[:3, 3]))


def _wrong_view(camera: Camera, sign: float) -> tuple[str, str, bool] | None:
    """What is wrong with the view of the table z = 0, the value, and whether a camera may be so all the same; None: nothing."""
    height, away = float(camera.camera_to_world[2, 3]), _away(camera)
    if height * sign <= 0:
        rule = "the camera must be above the table z = 0, on the side of it that is up"
        return rule, f"its center at z = {height:.3f} m, and up {'+z' if sign > 0 else '-z'}", False
    if not NEAR <= away <= FAR:
        rule = f"the table z = 0 must be {NEAR:g} to {FAR:g} m away in the center of the image"
        return rule, f"{away:.3g} m" if np.isfinite(away) else "a view past it", False
    x, y, _ = sign * camera.camera_to_world[2, :3]
    roll = float(np.degrees(np.arctan2(abs(x), -y)))
    if roll > ROLL and np.hypot(x, y) > np.sin(np.radians(STEEP)):
        return "up should point up in the image", f"a camera that is turned by {roll:.0f} degrees about its axis", True
    return None


def horizon_findings(path: Path, camera: Camera, mask: np.ndarray) -> list[Finding]:
    """A finding of the object's mask [H, W] of frame 0 that reaches beyond the horizon, where no table is."""
    own = object_on_table(camera, mask)
    beyond = int(np.isnan(own[:, 0]).sum())
    if not beyond:
        return []
    rule = f"camera {camera.name}: every pixel of the object in frame 0 must look at the table z = 0"
    received = f"{beyond} of {len(own)} pixels at or above its horizon"
    return [broken(path, "", rule, f"{received}. {POSE} Or correct the mask")]


def size_findings(camera: Camera, mask: np.ndarray) -> list[Finding]:
    """The object's size where its mask [H, W] of frame 0 meets the table: a note, and a warning for what is no object's.

    The sides are those of the smallest rectangle around it. What rises above the table seems larger by its height.
    """
    own = object_on_table(camera, mask)
    own = own[np.isfinite(own[:, 0])]
    if len(own) < FEW:
        return []
    where = f"camera {camera.name}, object"
    sides = sorted(cv2.minAreaRect(own[:, :2].astype(np.float32))[1], reverse=True)
    text = " x ".join(f"{100 * side:.0f}" for side in sides)
    value = f"color alone: table z = 0 as given, object size on the table {text} cm"
    return [
        finding("size of the object", "note", where, value, "by its mask of frame 0", "Is that what was filmed?"),
        *implausible(where, sides[0]),
    ]


def object_on_table(camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Where the object's pixels of a mask [H, W] meet the table [n, 3], m; NaN beyond the horizon."""
    y, x = np.nonzero(mask == OBJECT)
    return on_table(camera, np.stack([x, y], axis=1))


RISEN = 0.015
"""m above z = 0 from which a point stands out of the table."""
TALLEST = 0.8
"""m; higher points are the room."""
FREE = 0.03
"""m. B looked through a point if it measured so much more."""
MOST = 0.12
"""Share of such points from which cameras disagree.

Synthetic scenes have up to 0.07 with exact poses, 0.17 to 0.6 with one that is 2 cm off.
"""
FEWEST = 150
"""Points in the view of both from which cameras are compared."""
STRIDE = 2


def view_findings(path: Path, cameras: Mapping[str, Camera], depths: Mapping[str, np.ndarray], up: str) -> list[Finding]:
    """Findings about pairs of cameras by their depth images [H, W], m, of one frame."""
    found = []
    for one, two in combinations(depths, 2):
        pairs = [_compare(cameras[a], depths[a], cameras[b], depths[b], up) for a, b in ((one, two), (two, one))]
        if max(count for count, _ in pairs) < FEWEST:
            found.append(note(path, f"cameras {one} and {two} see too little in common above the table: not compared"))
            continue
        through = max(share for count, share in pairs if count >= FEWEST)
        text = f"{through:.0%} of the points of one float before what the other saw"
        if through > MOST:
            rule = f"cameras {one} and {two} should see the same surfaces above the table in the same place"
            next_move = "Calibrate again with one board that both see, and check that their frames are of the same moment"
            found.append(unusual(path, "cameras", rule, f"{text}. {next_move}"))
        else:
            found.append(note(path, f"cameras {one} and {two} agree: {text}"))
    return found


def _compare(a: Camera, depth_a: np.ndarray, b: Camera, depth_b: np.ndarray, up: str) -> tuple[int, float]:
    """Points of A that B sees, and the share of them that B looked through."""
    sign = up_sign(up)
    y, x = np.nonzero(depth_a[::STRIDE, ::STRIDE] > 0)
    pixels = STRIDE * np.stack([x, y], axis=-1)
    points = a.lift(pixels.astype(float), depth_a[pixels[:, 1], pixels[:, 0]])
    points = points[(sign * points[:, 2] > RISEN) & (sign * points[:, 2] < TALLEST)]
    seen, distance = b.project(points)
    visible = (distance > 0.05) & b.sees(seen)
    column, row = np.round(seen[visible]).astype(int).T
    expected, valid = distance[visible], depth_b[row, column] > 0
    if valid.sum() < FEWEST:
        return int(valid.sum()), 0.0
    # At the outline of a thing a pixel beside the point sees past it: B looked through the point if all pixels around it did.
    nearest = cv2.erode(np.where(depth_b > 0, depth_b, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))[row, column]
    return int(valid.sum()), float((nearest - expected > FREE)[valid].mean())


APART = 0.1
"""Distance between two pieces of one label, as a fraction of the image, from which they count as two objects."""
SECOND = 0.3
"""A piece with at least this fraction of the largest piece's area counts as an object."""
LEAVES = 0.1
"""Fraction of its area in frame 0 below which an object has left the view."""
SMALL_MASK = 200
"""Pixels of the object in frame 0."""
EDGE = 3
"""Pixels of the object on the image border from which it may go on outside."""
CUT = 0.1
"""Share of the frames from which an object at the border counts as cut off; frame 0 alone does, where its shape is taken."""
BORDERED = 0.1
"""Part of the image's border that is object, median over frames, from which the mask shows the background or a person."""
JUMP = 2.0
"""Ratio of the object's areas in neighboring frames: no body grows that fast."""
STEP, STEPS, FEWEST_STEPS = 1.5, 0.1, 3
"""A smaller such ratio, and the part and number of frames with it from which a mask flickers: what is hidden once and comes back
jumps twice."""
FLOOR = 1e-4
"""Part of the image by which areas are enlarged before they are divided: a few pixels of a hidden object are no jump."""
REMEDY = "Mark object and hands in a few frames (`neuspring mask`), or choose another perception.segment.backend."


class Shown:
    """What the masks of one camera show, counted frame by frame."""

    def __init__(self, frames: int, size: tuple[int, int]) -> None:
        """Nothing so far, of images of `size` (width, height)."""
        self.size = size
        self.objects = 0
        """Objects in frame 0."""
        self.areas = np.full((3, frames), np.nan)
        """Pixels of each label [3, T]; NaN without a mask."""
        self.rims = np.full(frames, np.nan)
        """Pixels of the object on the image border [T]."""

    def see(self, frame: int, labels: np.ndarray) -> None:
        """Count the mask [H, W] of a frame."""
        self.areas[:, frame] = np.bincount(labels.ravel(), minlength=3)[:3]
        own = labels == OBJECT
        self.rims[frame] = own[0].sum() + own[-1].sum() + own[1:-1, 0].sum() + own[1:-1, -1].sum()
        if frame == 0:
            # Pieces count as one object if they meet when they are grown by half of APART.
            reach = max(int(0.5 * APART * max(labels.shape)), 1)
            disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
            count, pieces = cv2.connectedComponents(cv2.dilate(own.astype(np.uint8), disk))
            sizes = np.bincount(pieces[own], minlength=count)[1:]
            self.objects = int((sizes >= SECOND * sizes.max()).sum()) if len(sizes) else 0

    @property
    def frames(self) -> np.ndarray:
        """Frames with a mask."""
        return np.flatnonzero(np.isfinite(self.rims))

    @property
    def bordered(self) -> float:
        """Part of the image's border that is object, median over frames."""
        return float(np.median(self.rims[self.frames])) / (2 * sum(self.size) - 4) if len(self.frames) else 0.0

    def ratios(self) -> dict[int, float]:
        """Ratio of the object's areas, 1 or more, in a frame and the one before it; of frames that follow each other."""
        grown = self.areas[OBJECT] + FLOOR * self.size[0] * self.size[1]
        return {b: float(max(grown[a] / grown[b], grown[b] / grown[a])) for a, b in pairwise(self.frames.tolist()) if b == a + 1}

    @property
    def steps(self) -> float:
        """Part of the frames with a ratio above STEP; 0 where there are fewer than FEWEST_STEPS."""
        ratios = self.ratios().values()
        count = sum(ratio > STEP for ratio in ratios)
        return count / len(ratios) if count >= FEWEST_STEPS else 0.0


def mask_findings(camera: str, shown: Shown) -> list[Finding]:
    """Findings about the masks of one camera. Without a mask of frame 0 nothing is said of it."""
    area, hands, found = shown.areas[OBJECT], shown.areas[HANDS], list[Finding]()
    if not len(shown.frames):
        return found

    def say(name: str, value: str, rule: str, remedy: str = REMEDY) -> None:
        found.append(finding(name, "warning", f"camera {camera}", value, rule, remedy))

    if area[0] == 0:
        say("no object in frame 0", "no pixel with label 1 in frame 0", "shape and points begin there")
    if hands[0] == 0:
        rule = "controllers begin in frame 0, with what some camera shows of the hands there"
        say("no hand in frame 0", "no pixel with label 2 in frame 0", rule, "Begin the capture when a hand is in view, or mark it.")
    if shown.objects > 1:
        value = f"the object's mask of frame 0 has {shown.objects} pieces far apart"
        say("two objects", value, "one object is expected, whose pieces lie together; two become one twin")
    if 0 < area[0] < SMALL_MASK:
        say(
            "small object",
            f"{area[0]:.0f} pixels of object in frame 0",
            f"at least {SMALL_MASK} are expected",
            "Film from nearer by.",
        )
    gone = shown.frames[area[shown.frames] < np.fmax(LEAVES * np.nan_to_num(area[0]), 1)]
    if len(gone) and area[0] != 0:
        value = f"almost nothing of the object in {len(gone)} frames, first in frame {gone[0]}"
        say("object missing", value, "each frame should show it; its points are invisible there")
    cut = shown.frames[shown.rims[shown.frames] >= EDGE]
    if shown.bordered > BORDERED:
        value = f"{shown.bordered:.0%} of the image's border is object"
        rule = f"at most {BORDERED:.0%} is expected; the mask holds the table, a sleeve or a person"
        say("background in the mask", value, rule)
    elif len(cut) and (cut[0] == 0 or len(cut) >= CUT * len(shown.frames)):
        value = f"the object touches the image border in {len(cut)} frames, first in frame {cut[0]}"
        back = "move the camera back, or keep other frames (make-capture --frames)"
        say(
            "object at the border",
            value,
            "what is outside is neither seen nor carved",
            f"Is it the object? Then {back}. If not, mark what it is.",
        )
    if shown.steps > STEPS:
        value = f"the object's area changes {STEP:g}-fold or more in {shown.steps:.0%} of the frames"
        say("mask flickers", value, f"at most {STEPS:.0%} are expected")
    elif wild := {frame: ratio for frame, ratio in shown.ratios().items() if ratio > JUMP}:
        frame, ratio = next(iter(wild.items()))
        value = f"the object's area changes {ratio:.1f}-fold from frame {frame - 1} to {frame} (so in {len(wild)} frames)"
        say("mask jumps", value, f"less than {JUMP:g}-fold is expected")
    return found


ALIGNED = 0.015
"""Part of the image's width by which edges of depth may lie beside those of color: sensors are registered to 1 %."""
MISPLACED = 0.12
"""Part of the width by which they are looked for elsewhere: 6 cm between two sensors, 0.4 m from them."""
BETTER = 1.4
"""A shift is believed if edges agree so many times as well with it as without. Right recordings have up to 0.9, depth of another
sensor 1.7 and more."""
FEWEST_EDGES = 200
"""Pixels at edges of depth, of all frames together."""
EDGE_STEP = (0.03, 0.04)
"""m, and part of the depth: a larger step is an edge."""
SOFT = 0.3
"""Part of the strongest edge from which one counts in full, as do the strongest 5 % of the pixels."""
SQUARE = np.ones((3, 3), np.uint8)
SCALES = (1.0, 0.7, 0.8, 0.9, 1.1, 1.2, 1.3, 1.4)
"""Sizes of the picture of depth, to try: the lens of a depth sensor is another."""
WIDE = 400
"""Images are thinned until they are about as wide, pixels."""


def edge_findings(where: str, pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> list[Finding]:
    """A warning where edges of depth [H, W], m, lie beside those of color [H, W, 3] or of masks [H, W]: depth of another sensor."""
    right, down, scale, gain = edge_shift(list(pairs))
    if gain < BETTER:
        return []
    ways = [f"made {scale:g} times as large"] if scale != 1 else []
    ways += [f"moved {abs(right)} pixels to the {'right' if right > 0 else 'left'}"] if abs(right) > 1 else []
    ways += [f"moved {abs(down)} pixels {'down' if down > 0 else 'up'}"] if abs(down) > 1 else []
    value = f"edges of depth fit those of color when depth is {' and '.join(ways)}"
    rule = f"as it is they must fit within {ALIGNED:.1%} of the width"
    remedy = "Let the camera's software align depth to color (RealSense: rs.align; ROS: aligned_depth_to_color)."
    return [finding("depth not aligned to color", "warning", where, value, rule, remedy)]


def edge_shift(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[int, int, float, float]:
    """What must be done to depth so that its edges agree best with those of color, and how many times as well as they do within
    ALIGNED: pixels to the right and down, after a scaling about the center of the image. 0 times where there are too few edges.

    The agreement is the mean strength of color's edges over depth's edge pixels, above its median over all shifts.
    """
    width = pairs[0][1].shape[1] if pairs else 1
    stride = max(round(width / WIDE), 1)
    reach, near = round(MISPLACED * width / stride), max(round(ALIGNED * width / stride), 4)
    pictures = []
    for picture, depth in pairs:
        thin = np.ascontiguousarray(picture[::stride, ::stride])
        shades = cv2.cvtColor(thin, cv2.COLOR_RGB2LAB) if thin.ndim == 3 else np.repeat(255 * (thin[..., None] > 0), 3, axis=2)
        shades = cv2.GaussianBlur(shades.astype(np.float32), (0, 0), 1)
        steps = np.hypot(cv2.Sobel(shades, cv2.CV_32F, 1, 0), cv2.Sobel(shades, cv2.CV_32F, 0, 1)).max(axis=2)
        strength = np.minimum(steps / max(float(np.quantile(steps, 0.95)), SOFT * float(steps.max()), 1.0), 1.0)
        thin = depth[::stride, ::stride].astype(np.float32)
        # A step beside a pixel and none on its other side: a slope has both.
        low, high = cv2.erode(np.where(thin > 0, thin, np.inf).astype(np.float32), SQUARE), cv2.dilate(thin, SQUARE)
        edges = (thin > 0) & (high + low - 2 * thin > np.maximum(EDGE_STEP[0], EDGE_STEP[1] * thin))
        pictures.append((strength, np.argwhere(edges)))
    if sum(len(edges) for _, edges in pictures) < FEWEST_EDGES:
        return 0, 0, 1.0, 0.0
    shape = np.array(pictures[0][0].shape)
    size = [next_fast_len(int(side) + 2 * reach, real=True) for side in shape]
    inside, best, found = 0.05, 0.0, (0, 0, 1.0)
    tables = [[rfft2(table, size) for table in (strength, np.ones_like(strength))] for strength, _ in pictures]
    for scale in SCALES:
        sums = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
        for (_, edges), spectra in zip(pictures, tables, strict=True):
            placed = np.round((edges - shape / 2) * scale + shape / 2).astype(int)
            row, column = placed[((placed >= 0) & (placed < shape)).all(axis=1)].T
            drawn = np.zeros(shape, np.float32)
            drawn[row, column] = 1.0
            own = np.conj(rfft2(drawn, size))
            for k, spectrum in enumerate(spectra):
                sums[k] += np.roll(irfft2(own * spectrum, size), (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
        agreement = np.where(sums[1] > 0.5 * sums[1].max(), sums[0] / np.maximum(sums[1], 1.0), 0.0)
        agreement -= np.median(agreement)
        if scale == 1:
            inside = max(float(agreement[reach - near : reach + near + 1, reach - near : reach + near + 1].max()), inside)
        if agreement.max() > best:
            best = float(agreement.max())
            down, right = (stride * (int(k) - reach) for k in np.unravel_index(agreement.argmax(), agreement.shape))
            found = (right, down, scale)
    return *found, best / inside
