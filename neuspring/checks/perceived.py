"""What the steps of perception notice about their own results: masks, tracks, lifted points, the shape and the observations.

Limits were chosen so that the synthetic scenes pass, whose perception is known to be good; lengths in m, of things that hands hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.followed import Tracked, few
from neuspring.checks.masks import OFTEN, Segmented, Shown
from neuspring.checks.observed import Observed
from neuspring.checks.things import Masked, ObjectPoints, Sample, Sheet, Silhouette, sampled
from neuspring.core.artifacts import ImageObservations, Observations
from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.data.capture import Capture
from neuspring.data.results import LiftedTracks, ShapePrior

WRONG = ("background in the mask", "mask flickers", "hands too large", "hands inside the object", "labels are noise")
"""Findings of masks that cannot be right, by name: `perception.segment.verdict` decides what happens."""
VOLUME = 0.012
"""m^3 of a hull: a large plush animal has 5 liters."""
INVENTED = 0.8
"""Share of the surface that no camera saw; of a body seen from one side it is about two thirds."""
RISES = 0.05
"""Part of a body that is not laid onto the table, because it would lie too far behind. Two sloths that lie have up to 0.03."""
TRUSTED = 0.5
"""Share of motions that agree with their neighbors, of points that are seen in both frames; points that are lost are said apart."""
SEEN = 0.05
"""Share of the object's points that are seen in a frame."""
RESIZED = 1.8
"""Change of a hand's apparent size."""


def look_at_masks(capture: Capture, camera: str, labels: np.ndarray, facts: Mapping[str, float]) -> list[Finding]:
    """Findings about labels [T, H, W] of one camera, with their `mask_facts`."""
    found, where = examine(Shown.of(capture, camera, labels)), f"camera {camera}"
    if capture.has_depth:
        frames = [frame for frame in sorted(sampled(capture.frame_count)) if capture.has(camera, frame)]
        samples = {frame: Sample(capture.depth(camera, frame), labels[frame]) for frame in frames}
        found += [one for one in examine(Masked(capture.cameras[camera], samples)) if one.level != "note"]
    else:
        found += examine(Silhouette(f"{where}, object", labels[0], capture.description.category))
    return found + examine(Segmented(where, facts, capture.has_depth))


def look_at_tracks(capture: Capture, camera: str, labels: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> list[Finding]:
    """Findings about tracks: pixels [T, Q, 2] and visible [T, Q], with the masks' labels [T, H, W]."""
    return examine(Tracked(capture, camera, labels, pixels, visible))


def look_at_observations(observations: Observations, moves: float = 0.0) -> list[Finding]:
    """Findings about what every method reads; `moves` as in `Observed`."""
    return examine(Observed(observations, moves))


@dataclass(frozen=True, eq=False)
class Lifted:
    """Points in the world and the shape of one scenario; `image` is the evidence of color alone."""

    lifted: LiftedTracks
    prior: ShapePrior
    image: ImageObservations | None = None

    @property
    def where(self) -> str:
        """For messages."""
        return "lifted tracks"


def look_at_lifted(lifted: LiftedTracks, prior: ShapePrior, up: float, image: ImageObservations | None = None) -> list[Finding]:
    """Findings about points in the world and the shape; `up` is +1 or -1. `image`: the evidence of color alone."""
    found = examine(ObjectPoints("object in frame 0", [lifted.cloud], up))
    if image is None and prior.backend.startswith("visual_hull"):
        found += examine(Sheet("object in frame 0", lifted.cloud, up))
    return found + examine(Lifted(lifted, prior, image))


SHAPE: dict[str, Any] = {"where": "shape"}
CONTROLLERS: dict[str, Any] = {"where": "controllers"}


def given_pose(of: Lifted) -> dict[str, Any] | None:
    """Share of a body that rises from what touches the table, where the capture says how it lies or stands."""
    backend = of.lifted.backend
    if not backend.startswith("color alone, body") or backend == "color alone, body":
        return None
    return SHAPE | {"value": of.lifted.facts["shape_raised"], "pose": backend.rsplit(", ", 1)[1]}


def supposed_pose(of: Lifted) -> dict[str, Any] | None:
    """Share of a body that is supposed to rise, where color alone shows it and nothing says whether it lies or stands."""
    if of.lifted.backend != "color alone, body":
        return None
    deep, across, raised = (of.lifted.facts[f"shape_{name}"] for name in ("longest", "across", "raised"))
    rises = f", so {raised:.0%} of it is supposed to rise" if raised > RISES else ""
    level = "warning" if raised > RISES else "note"
    return SHAPE | {"value": raised, "deep": 100 * deep, "across": 100 * across, "rises": rises, "level": level}


def hull_volume(of: Lifted) -> dict[str, Any]:
    """Volume of the shape, m^3."""
    volume = of.prior.facts.get("volume", 0.0)
    return SHAPE | {"value": volume, "liters": 1e3 * volume}


def invented(of: Lifted) -> dict[str, Any] | None:
    """Share of the surface that no camera saw."""
    share = of.prior.facts.get("invented_share", 0.0)
    if share > INVENTED:
        return SHAPE | {"value": share, "level": "warning", "rule": f"at most {INVENTED:.0%} are expected"}
    return SHAPE | {"value": share, "rule": "the rest was measured"} if of.prior.facts.get("cameras") == 1 else None


def trusted(of: Lifted) -> float | None:
    """Share of the object's motions that agree with their neighbors."""
    both = of.lifted.object_visibility[:-1] & of.lifted.object_visibility[1:]
    if of.image is not None or not both.any():
        return None
    return float(of.lifted.object_motion_valid[:-1].sum() / max(int(both.sum()), 1))


def grip_elsewhere(of: Lifted) -> dict[str, Any] | None:
    """The frame in which a hand comes back to another part of the object."""
    frame = None if of.image is not None else of.lifted.facts.get("grip_elsewhere")
    return None if frame is None else CONTROLLERS | {"value": int(frame), "frames": (int(frame),)}


def stray_hand(of: Lifted) -> dict[str, Any] | None:
    """Training frames in which a hand is on the object that no controller follows."""
    count = 0 if of.image is not None else int(of.lifted.facts.get("stray_hand_frames", 0))
    if not count:
        return None
    first, often = int(of.lifted.facts["stray_hand_first"]), count >= OFTEN * len(of.lifted.object_points)
    return CONTROLLERS | {"value": count, "first": first, "level": "warning" if often else "note", "frames": (first,)}


def lost_points(of: Lifted) -> dict[str, Any] | None:
    """Frames in which few of the object's points are seen in space."""
    return few(of.lifted.object_visibility, SEEN) if of.image is None else None


def lost_pixels(of: Lifted) -> dict[str, Any] | None:
    """Training frames in which few of the object's points are seen in the image."""
    told = few(of.image.visible[: len(of.image.inside)], SEEN) if of.image is not None else None
    return told and told | {"where": "tracks"}


def hand_sizes(of: Lifted) -> dict[str, Any] | None:
    """Apparent sizes of hands, as multiples of those in frame 0, that change more than at arm's length."""
    if of.image is None or not of.image.hands:
        return None
    least, most = float(of.image.hand_sizes.min()), float(of.image.hand_sizes.max())
    return {"where": "hands", "value": most, "least": least} if most > RESIZED or least < 1 / RESIZED else None


LOST = "{value:.0%} of the object's points are seen in frame {frame}; few in {count} frames; at least {least:.0%} are expected in "
# fmt: off
CHECKS = (
    Check("pose", Lifted, given_pose, None, "note",
          "{pose}, as capture.json says; {value:.0%} of it rises from what touches the table; thickness follows the width of "
          "the outline."),
    Check("pose", Lifted, supposed_pose, None, "note",
          "if it lies, it reaches {deep:.0f} cm behind its nearest point and is {across:.0f} cm wide{rises}; one picture cannot "
          "say whether "
          "it lies or stands.", 'Write "pose": "lying" or "standing" in capture.json.'),
    Check("volume of the hull", Lifted, hull_volume, (-np.inf, VOLUME), "warning",
          f"{{liters:.1f}} liters; at most {1e3 * VOLUME:g} liters are expected of a thing that hands hold.",
          "Masks that show sleeves, table or other things make it large: look at masks.png and lifted.png."),
    Check("invented surface", Lifted, invented, None, "note",
          "no camera saw {value:.0%} of the surface ({subject.prior.backend}); {rule}.",
          "Add a camera from the other side, or a mesh (perception.shape.backend: mesh)."),
    Check("motion not trusted", Lifted, trusted, (TRUSTED, np.inf), "warning",
          "{value:.0%} of the object's motions are trusted; at least {low:.0%} are expected.",
          "Look at tracks.png and lifted.png; perception.lift has neighborhood."),
    Check("grip elsewhere", Lifted, grip_elsewhere, None, "warning",
          "in frame {value} a hand comes back to another part of the object; springs of hands are made for their place in frame "
          "0, so "
          "nothing moves the twin there.", "End the capture before frame {value}."),
    Check("hand without controllers", Lifted, stray_hand, None, "note",
          "in {value} training frames, first in frame {first}, a hand is on the object that no controller follows; what that "
          "hand does to "
          "the object reaches no twin: controllers are points of the hands of frame 0.",
          "End the capture before frame {first}, or begin it when all hands are in view (make-capture --frames)."),
    Check("points lost", Lifted, lost_points, None, "warning", LOST + "every frame.",
          "End the capture before frame {first}. Look at tracks.png and lifted.png; perception.lift has neighborhood."),
    Check("points lost", Lifted, lost_pixels, None, "warning",
          LOST + "every training frame; silhouettes alone say where the object is in the others.", "Look at tracks.png."),
    Check("size of hands", Lifted, hand_sizes, None, "warning",
          "a hand appears {least:.2f} to {value:.2f} times as large as in frame 0; "
          f"a hand at arm's length changes by less than {RESIZED:g} times; it was not followed well.",
          "Look at hands.png, and mark the hands anew."),
)
