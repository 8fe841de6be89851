"""What masks and tracks of one camera say about themselves: findings after segmentation and tracking.

Limits were chosen so that the synthetic scenes pass, whose perception is known to be good.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from neuspring.core.findings import Finding, finding
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.plausible.pieces import objects

HOLES = 0.2
"""Share of the object's pixels without depth, median over frames, from which shape and motion suffer."""
BORDER = 0.02
"""Share of the object's pixels of a frame that lie on the image border, from which it is cut off."""
HAND_AREA = 3.0
"""A hand, in areas of the object."""
JUMP = 2.0
"""Ratio of the object's areas in neighboring frames: no body grows that fast."""
SMALL = 200
"""Pixels of the object in frame 0."""
TRACKS = 50
"""Points on the object in frame 0."""
ALIVE = 0.1
"""Share of the points of frame 0 that are still followed."""


def look_at_masks(capture: Capture, camera: str, labels: np.ndarray) -> list[Finding]:
    """Findings about labels [T, H, W] of one camera."""
    where, own, hands = f"camera {camera}", labels == OBJECT, labels == HANDS
    frames = [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]
    area, hand_area = own.sum(axis=(1, 2)), hands.sum(axis=(1, 2))
    shown = [frame for frame in frames if area[frame]]
    found = []

    def warn(name: str, value: str, rule: str, remedy: str) -> None:
        found.append(finding(name, "warning", where, value, rule, remedy))

    remedy = "Look at masks.png; correct the masks, or choose another perception.segment.backend."
    if (count := objects(labels[0])) > 1:
        value = f"the object's mask of frame 0 has {count} pieces far apart; two objects become one twin"
        warn("two objects", value, "one object is expected, whose pieces lie together", remedy)
    if absent := [frame for frame in frames if not area[frame]]:
        value = f"no object in {len(absent)} frames, first in frame {absent[0]}; its points are invisible there"
        warn("object missing", value, "each frame should show the object", remedy)
    if not hand_area[0] and area[0]:
        rule = "controllers begin in frame 0, with what some camera shows of the hands there"
        warn("no hand", "no hand in frame 0", rule, "Begin the capture when a hand is in view, or correct the masks.")
    if not shown:
        return found
    if 0 < area[0] < SMALL:
        warn("small object", f"{area[0]} pixels of object in frame 0", f"at least {SMALL} are expected", "Film from nearer by.")
    cut = [frame for frame in shown if _on_border(own[frame]) > BORDER * area[frame]]
    if cut:
        rule = f"at most {BORDER:.0%} of its pixels should lie there; what leaves the view is neither seen nor carved"
        value = f"the object lies on the image border in {len(cut)} frames, first in frame {cut[0]}"
        warn("object at the border", value, rule, "Leave such frames out, or film from farther away.")
    share = float(np.median([1.0 - (capture.depth(camera, frame)[own[frame]] > 0).mean() for frame in shown]))
    if share > HOLES:
        value, rule = f"{share:.0%} of the object's pixels have no depth", f"at most {HOLES:.0%} are expected"
        warn("depth holes", value, rule, "Shiny, black and near things have none: film from elsewhere, or paint the object dull.")
    both = [frame for frame in shown if hand_area[frame]]
    ratio = float(np.median(hand_area[both] / area[both])) if both else 0.0
    if ratio > HAND_AREA:
        value, rule = f"the hands are {ratio:.1f} times as large as the object", f"at most {HAND_AREA:g} times is expected"
        warn("hand larger than the object", value, rule, f"Are sleeves or parts of the object taken for hands? {remedy}")
    pairs = [(a, b) for a, b in pairwise(shown) if b == a + 1]
    jumps = [(b, max(area[a], area[b]) / min(area[a], area[b])) for a, b in pairs]
    if wild := [(frame, ratio) for frame, ratio in jumps if ratio > JUMP]:
        frame, ratio = wild[0]
        value = f"the object's area changes {ratio:.1f}-fold from frame {frame - 1} to {frame} (so in {len(wild)} frames)"
        warn("mask jumps", value, f"less than {JUMP:g}-fold is expected", remedy)
    return found


def look_at_tracks(camera: str, labels: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> list[Finding]:
    """Findings about tracks: pixels [T, Q, 2] and visible [T, Q], with the masks' labels [T, H, W]."""
    if not pixels.shape[1]:
        return []
    x, y = np.round(pixels[0]).astype(int).T
    own = labels[0][y, x] == OBJECT
    if not own.any():
        return []
    where, found = f"camera {camera}", []
    if own.sum() < TRACKS:
        value, rule = f"{own.sum()} points are followed on the object", f"at least {TRACKS} are expected"
        remedy = "Film from nearer by, or raise points of perception.track."
        found.append(finding("few tracks", "warning", where, value, rule, remedy))
    alive = visible[:, own].mean(axis=1)
    if low := np.flatnonzero(alive < ALIVE).tolist():
        value = f"{alive.min():.0%} of the object's points are followed in frame {int(alive.argmin())}; few in {len(low)} frames"
        remedy = f"Look at tracks.png; end the capture before frame {low[0]}, use more light or shorter exposures, or cotracker3."
        found.append(finding("tracks lost", "warning", where, value, f"at least {ALIVE:.0%} are expected in every frame", remedy))
    return found


def _on_border(mask: np.ndarray) -> int:
    """How many pixels of a mask [H, W] lie on the image border."""
    return int(mask[0].sum() + mask[-1].sum() + mask[1:-1, 0].sum() + mask[1:-1, -1].sum())
