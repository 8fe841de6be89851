"""Checks of one color camera: the unknown pose of the object, and badly tracked hands and points."""

from __future__ import annotations

from typing import Any

from neuspring.checks import examine
from neuspring.checks.objects import place_of
from neuspring.core.artifacts import ImageObservations
from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.data.results import LiftedTracks, ShapePrior

RISES = 0.05
"""Raised fraction of an object above which the pose is a warning. Two lying sloths have up to 0.03."""
RESIZED = 1.8
"""Largest credible change of a hand's apparent size, as a factor."""


def findings_of(lifted: LiftedTracks, prior: ShapePrior, up: float, image: ImageObservations) -> list[Finding]:
    """Findings about points, shape and image evidence; `up` is +1 or -1."""
    found = examine("object", "object of all cameras", place_of({0: lifted.cloud}, up))
    found += examine("pose", "shape", lifted) + examine("visible points", "tracks", image.visible[: len(image.inside)])
    return found + examine("hands in the image", "hands", image)


def supposed_pose(lifted: LiftedTracks) -> dict[str, Any] | None:
    """Raised fraction of an object of unknown pose; None if the pose is given, or for sheets and ropes."""
    if lifted.backend != "color alone, body":
        return None
    deep, across, raised = (lifted.facts[f"shape_{name}"] for name in ("longest", "across", "raised"))
    rises = f", so {raised:.0%} of it is assumed to rise" if raised > RISES else ""
    level = "warning" if raised > RISES else "note"
    return {"value": raised, "deep": 100 * deep, "across": 100 * across, "rises": rises, "level": level}


def hand_sizes(image: ImageObservations) -> dict[str, Any] | None:
    """Apparent sizes of hands relative to frame 0; None if they change by less than RESIZED."""
    if not image.hands:
        return None
    least, most = float(image.hand_sizes.min()), float(image.hand_sizes.max())
    return {"value": most, "least": least} if most > RESIZED or least < 1 / RESIZED else None


# fmt: off
checks = (
    Check("pose", "pose", supposed_pose, None, "note",
          "a lying object would be {deep:.0f} cm deep and {across:.0f} cm wide{rises}; one image does not show the pose.",
          'Set "pose": "lying" or "standing" in capture.json.'),
    Check("size of hands", "hands in the image", hand_sizes, None, "warning",
          f"a hand's size is {{least:.2f}} to {{value:.2f}} times that in frame 0 (limit: {RESIZED:g}); its track may be wrong.",
          "Look at hands.png, and annotate the hands again."),
)
