"""What masks and tracks of one camera say about themselves: findings after segmentation and tracking.

Limits were chosen so that the synthetic scenes pass, whose perception is known to be good.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from neuspring.core.findings import Finding, Level, finding
from neuspring.data.capture import OBJECT, Capture
from neuspring.data.plausible_masks import REMEDY, mask_findings
from neuspring.data.plausible_world import Sample, depth_findings, hand_findings, sampled
from neuspring.perception.mask_facts import shown_by

HANDS_INSIDE = 0.25
"""Part of the hands' pixels that lie in pieces enclosed by the object, from which they are its print."""
FLICKER = 0.08
"""Pixels that change their label and not their color, as part of object and hands, from which labels are noise."""
WRONG = ("background in the mask", "mask flickers", "hands too large", "hands inside the object", "labels are noise")
"""Findings of masks that cannot be right, by name: `perception.segment.verdict` decides what happens."""
TRACKS = 50
"""Points on the object in frame 0."""
ALIVE = 0.1
"""Share of the points of frame 0 that are still followed."""
OFTEN = 0.1
"""Share of the frames with fewer, from which that is a warning: a rope that turns away from one camera for two frames is none."""


def look_at_masks(capture: Capture, camera: str, labels: np.ndarray, facts: Mapping[str, float]) -> list[Finding]:
    """Findings about labels [T, H, W] of one camera, with their `mask_facts`."""
    view, where = capture.cameras[camera], f"camera {camera}"
    found = mask_findings(camera, shown_by(capture, camera, labels))
    if capture.has_depth:
        samples = {
            frame: Sample(capture.depth(camera, frame), labels[frame])
            for frame in sorted(sampled(capture.frame_count))
            if capture.has(camera, frame)
        }
        found += [one for one in depth_findings(view, samples) if one.level != "note"]
        found += hand_findings(view, samples)
    if facts["hands_inside"] > HANDS_INSIDE:
        value = f"{facts['hands_inside']:.0%} of the hands' pixels lie inside of the object"
        rule = f"at most {HANDS_INSIDE:.0%} are expected; its own colors are taken for hands"
        found.append(finding("hands inside the object", "warning", where, value, rule, REMEDY))
    if facts["flicker"] > FLICKER:
        value = f"{facts['flicker']:.0%} of the masks changes its label where the image does not change"
        found.append(finding("labels are noise", "warning", where, value, f"at most {FLICKER:.0%} is expected", REMEDY))
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
        level: Level = "warning" if len(low) >= OFTEN * len(visible) else "note"
        remedy = f"Look at tracks.png; end the capture before frame {low[0]}, use more light or shorter exposures, or cotracker3."
        found.append(finding("tracks lost", level, where, value, f"at least {ALIVE:.0%} are expected in every frame", remedy))
    return found
