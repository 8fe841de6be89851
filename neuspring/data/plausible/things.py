"""Object and hands in the masks of one camera: size, height above the table, depth, image border, and whether they meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from neuspring.data.capture import HANDS, OBJECT, Camera
from neuspring.data.departure import Departure, note, unusual

SMALL, LARGE = 0.02, 1.5
"""m. Objects of another size are a wrong mask or a wrong unit of depth."""
SUNK, HIGH = 0.02, 1.2
"""m. An object lower than SUNK below the table, or higher than HIGH above it, stands in another world than the table."""
HOLES, BAD_HOLES = 0.25, 0.8
"""Share of the object's pixels without depth from which twins suffer, and from which little is left to lift."""
BORDER = 0.1
"""Share of the frames from which an object that touches the image's border counts as cut off."""
HAND_AREA = 0.12
"""m². Two hands and forearms seen from one side have less; sleeves and a torso have more."""
HAND_RATIO = 12.0
"""Hands this many times as large as the object in the image are another thing."""
REACH = 0.06
"""m. A hand that never comes nearer to the object does not hold it. Where they touch, depth may be hidden."""
POINTS = 1500
"""Points of each thing that are compared."""
EDGE = 1
"""Pixels from the border that count as touching it."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame of one camera."""

    depth: np.ndarray
    """[H, W], m, 0: none."""
    mask: np.ndarray
    """[H, W] labels."""


def at_border(mask: np.ndarray) -> bool:
    """Whether the object reaches the border of the image."""
    own = mask == OBJECT
    return bool(own[:EDGE].any() or own[-EDGE:].any() or own[:, :EDGE].any() or own[:, -EDGE:].any())


def lifted(camera: Camera, sample: Sample, label: int) -> np.ndarray:
    """World points [n, 3], m, of the pixels with a label and depth; at most POINTS."""
    y, x = np.nonzero((sample.mask == label) & (sample.depth > 0))
    step = max(len(x) // POINTS, 1)
    y, x = y[::step], x[::step]
    return camera.lift(np.stack([x, y], axis=-1).astype(float), sample.depth[y, x])


def thing_departures(path: Path, camera: Camera, samples: Mapping[int, Sample], up: str, touching: np.ndarray) -> list[Departure]:
    """Departures of one camera's masks from what hands that move an object on a table look like.

    `samples` are a few frames by number, `touching` [T] says where the object reaches the border (NaN: no frame).
    """
    samples = {frame: sample for frame, sample in samples.items() if (sample.mask == OBJECT).any()}
    if not samples:
        return []
    found = _border(path, camera, touching)
    found += _depth(path, camera, samples)
    bodies = {frame: lifted(camera, sample, OBJECT) for frame, sample in samples.items()}
    bodies = {frame: points for frame, points in bodies.items() if len(points) >= 20}
    if bodies:
        found += _size(path, camera, bodies, 1.0 if up == "+z" else -1.0)
        found += _hands(path, camera, samples, bodies)
    return found


def _border(path: Path, camera: Camera, touching: np.ndarray) -> list[Departure]:
    frames = np.flatnonzero(np.nan_to_num(touching) > 0)
    if not len(frames) or (len(frames) < BORDER * np.isfinite(touching).sum() and frames[0] != 0):
        return []
    rule = f"camera {camera.name} should see the whole object, away from the border of the image"
    next_move = "What is outside is not seen; move the camera back, or keep other frames with make-capture --frames"
    return [unusual(path, "", rule, f"an object at the border in {len(frames)} frames, first in frame {frames[0]}. {next_move}")]


def _depth(path: Path, camera: Camera, samples: Mapping[int, Sample]) -> list[Departure]:
    missing = {frame: float((sample.depth[sample.mask == OBJECT] <= 0).mean()) for frame, sample in samples.items()}
    worst = max(missing, key=lambda frame: missing[frame])
    mean = float(np.mean(list(missing.values())))
    text = f"{mean:.0%} of the object's pixels without depth (frame {worst}: {missing[worst]:.0%})"
    if mean <= HOLES and missing[worst] <= BAD_HOLES:
        return [note(path, f"camera {camera.name}: {text}")]
    rule = f"camera {camera.name} should have depth on at least {1 - HOLES:.0%} of the object"
    next_move = "Film from farther than the sensor's least distance, without shine and direct sun; look whether depth is aligned"
    return [unusual(path, "", rule, f"{text}. {next_move}")]


def _size(path: Path, camera: Camera, bodies: Mapping[int, np.ndarray], up: float) -> list[Departure]:
    found = []
    spans = [np.ptp(np.quantile(points, [0.05, 0.95], axis=0), axis=0) for points in bodies.values()]
    size = float(np.median([np.linalg.norm(span) for span in spans]))
    heights = {frame: np.quantile(up * points[:, 2], [0.05, 0.95]) for frame, points in bodies.items()}
    lowest = float(min(pair[0] for pair in heights.values()))
    highest = float(max(pair[1] for pair in heights.values()))
    where = f"camera {camera.name}: the object"
    found.append(note(path, f"{where} is {100 * size:.0f} cm long, {100 * lowest:.1f} to {100 * highest:.1f} cm above the table"))
    if not SMALL < size < LARGE:
        next_move = "Look at the mask of frame 0, and at depth_unit"
        received = f"{100 * size:.3g} cm from corner to corner. {next_move}"
        found.append(unusual(path, "", f"{where} should be between {100 * SMALL:g} cm and {LARGE:g} m long", received))
    if lowest < -SUNK:
        next_move = "Put the table at z = 0 (make-capture --level), or remove what is not the object from the mask"
        received = f"{-100 * lowest:.1f} cm below it. {next_move}"
        found.append(unusual(path, "", f"{where} should lie on the table or above it", received))
    if highest > HIGH:
        next_move = "Look at depth_unit, and for walls and people in the mask"
        found.append(unusual(path, "", f"{where} should stay within {HIGH:g} m above the table", f"{highest:.2f} m. {next_move}"))
    return found


def _hands(path: Path, camera: Camera, samples: Mapping[int, Sample], bodies: Mapping[int, np.ndarray]) -> list[Departure]:
    found, areas, ratios, gaps = [], [], [], []
    for frame, body in bodies.items():
        sample = samples[frame]
        hands = lifted(camera, sample, HANDS)
        if len(hands) < 20:
            continue
        own = sample.mask == HANDS
        depth = np.where(sample.depth > 0, sample.depth, np.median(sample.depth[own & (sample.depth > 0)]))
        areas.append(float((depth[own] ** 2).sum() / np.prod(np.diag(camera.intrinsics)[:2])))
        ratios.append(float(own.sum() / (sample.mask == OBJECT).sum()))
        gaps.append(float(KDTree(body).query(hands)[0].min()))
    if not gaps:
        return []
    area, ratio = float(np.median(areas)), float(np.median(ratios))
    if area > HAND_AREA or ratio > HAND_RATIO:
        rule = f"hands of camera {camera.name} (label {HANDS}) should be smaller than {1e4 * HAND_AREA:g} cm²"
        next_move = "Sleeves, torso or table are no hands: mark them to be ignored (neuspring mask)"
        received = f"{1e4 * area:.0f} cm², {ratio:.1f} times the object's pixels. {next_move}"
        found.append(unusual(path, "", rule, received))
    if min(gaps) > REACH:
        rule = f"a hand of camera {camera.name} should come within {100 * REACH:g} cm of the object"
        next_move = "Nothing would move the twin: look at the masks for a hand that is something else, or for the wrong object"
        found.append(unusual(path, "", rule, f"{100 * min(gaps):.1f} cm at least, in {len(gaps)} frames. {next_move}"))
    return found
