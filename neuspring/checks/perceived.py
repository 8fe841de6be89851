"""Checks by the steps of perception of their own results: masks, tracks, lifted points, the shape and the observations.

Limits were chosen so that the synthetic scenes pass, whose perception is known to be good; lengths in m, of things that hands hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.followed import Tracked, few
from neuspring.checks.masks import OFTEN, Shown
from neuspring.checks.observed import Observed
from neuspring.checks.things import Sample, place_of, sampled
from neuspring.core.artifacts import Observations
from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.data.capture import Capture
from neuspring.data.results import LiftedTracks, ShapePrior

WRONG = ("background in the mask", "mask flickers", "hands too large", "hands inside the object", "labels are noise")
"""Findings of masks that cannot be right, by name: `perception.segment.verdict` decides what happens."""
LARGEST_HULL = 0.012
"""m^3 of a hull: a large plush animal has 5 liters."""
INVENTED = 0.8
"""Share of the surface that no camera saw; of a body seen from one side it is about two thirds."""
TRUSTED = 0.5
"""Share of motions that agree with their neighbors, of points that are seen in both frames; points that are lost are said apart."""
SEEN_SHARE = 0.05
"""Share of the object's points that are seen in a frame."""


def look_at_masks(capture: Capture, camera: str, labels: np.ndarray, facts: Mapping[str, float]) -> list[Finding]:
    """Findings about labels [T, H, W] of one camera, with their `mask_facts`."""
    where = f"camera {camera}"
    found = examine("masks", where, Shown.of(capture, camera, labels))
    if capture.has_depth:
        frames = [frame for frame in sorted(sampled(capture.frame_count)) if capture.has(camera, frame)]
        samples = {frame: Sample(capture.depth(camera, frame), labels[frame]) for frame in frames}
        seen = examine("object and hands", where, capture.cameras[camera], samples, 0.0)
        found += [one for one in seen if one.level != "note"]
    else:
        found += examine("silhouette", f"{where}, object", labels[0], capture.description.category)
    return found + examine("segmentation", where, facts, capture.has_depth)


def look_at_tracks(capture: Capture, camera: str, labels: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> list[Finding]:
    """Findings about tracks: pixels [T, Q, 2] and visible [T, Q], with the masks' labels [T, H, W]."""
    return examine("tracks", f"camera {camera}", Tracked(capture, camera, labels, pixels, visible))


def look_at_observations(observations: Observations, moves: float = 0.0) -> list[Finding]:
    """Findings about what every method reads; `moves` as in `Observed`."""
    return examine("observations", "observations", Observed(observations, moves))


def look_at_lifted(lifted: LiftedTracks, prior: ShapePrior, up: float) -> list[Finding]:
    """Findings about points in the world and the shape; `up` is +1 or -1."""
    found = examine("object", "object of all cameras", place_of({0: lifted.cloud}, up))
    if prior.backend.startswith("visual_hull"):
        found += examine("sheet", "object in frame 0", lifted.cloud, up)
    return found + examine("shape", "shape", prior) + examine("lifted tracks", "lifted tracks", lifted)


def hull_volume(prior: ShapePrior) -> dict[str, Any]:
    """Volume of the shape, m^3."""
    volume = prior.facts.get("volume", 0.0)
    return {"value": volume, "liters": 1e3 * volume}


def invented(prior: ShapePrior) -> dict[str, Any] | None:
    """Share of the surface that no camera saw."""
    share = prior.facts.get("invented_share", 0.0)
    if share > INVENTED:
        return {"value": share, "level": "warning", "rule": f"at most {INVENTED:.0%} are expected"}
    return {"value": share, "rule": "the rest was measured"} if prior.facts.get("cameras") == 1 else None


def trusted(lifted: LiftedTracks) -> float | None:
    """Share of the object's motions that agree with their neighbors."""
    both = lifted.object_visibility[:-1] & lifted.object_visibility[1:]
    return float(lifted.object_motion_valid[:-1].sum() / max(int(both.sum()), 1)) if both.any() else None


def grip_elsewhere(lifted: LiftedTracks) -> dict[str, Any] | None:
    """The frame in which a hand comes back to another part of the object."""
    frame = lifted.facts.get("grip_elsewhere")
    return None if frame is None else {"where": "controllers", "value": int(frame), "frames": (int(frame),)}


def stray_hand(lifted: LiftedTracks) -> dict[str, Any] | None:
    """Training frames in which a hand is on the object that no controller follows."""
    if not (count := int(lifted.facts.get("stray_hand_frames", 0))):
        return None
    first, level = int(lifted.facts["stray_hand_first"]), "warning" if count >= OFTEN * len(lifted.object_points) else "note"
    return {"where": "controllers", "value": count, "first": first, "level": level, "frames": (first,)}


LOST_TEXT = (
    "{value:.0%} of the object's points are seen in frame {frame}; few in {count} frames; at least {least:.0%} are expected in "
)
# fmt: off
checks = (
    Check("volume of the hull", "shape", hull_volume, (-np.inf, LARGEST_HULL), "warning",
          f"{{liters:.1f}} liters; at most {1e3 * LARGEST_HULL:g} liters are expected of a thing that hands hold.",
          "Masks that show sleeves, table or other things make it large: look at masks.png and lifted.png."),
    Check("invented surface", "shape", invented, None, "note", "no camera saw {value:.0%} of the surface ({0.backend}); {rule}.",
          "Add a camera from the other side, or a mesh (perception.shape.backend: mesh)."),
    Check("motion not trusted", "lifted tracks", trusted, (TRUSTED, np.inf), "warning",
          "{value:.0%} of the object's motions are trusted; at least {low:.0%} are expected.",
          "Look at tracks.png and lifted.png; perception.lift has neighborhood."),
    Check("grip elsewhere", "lifted tracks", grip_elsewhere, None, "warning",
          "in frame {value} a hand comes back to another part of the object; springs of hands are made for their place in frame "
          "0, so nothing moves the twin there.", "End the capture before frame {value}."),
    Check("hand without controllers", "lifted tracks", stray_hand, None, "note",
          "in {value} training frames, first in frame {first}, a hand is on the object that no controller follows; what that "
          "hand does to the object reaches no twin: controllers are points of the hands of frame 0.",
          "End the capture before frame {first}, or begin it when all hands are in view (make-capture --frames)."),
    Check("points lost", "lifted tracks", lambda lifted: few(lifted.object_visibility, SEEN_SHARE), None, "warning",
          LOST_TEXT + "every frame.",
          "End the capture before frame {first}. Look at tracks.png and lifted.png; perception.lift has neighborhood."),
)
