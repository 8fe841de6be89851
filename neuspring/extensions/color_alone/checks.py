"""What one picture cannot say of a body, and hands and points that are followed badly in it."""

from __future__ import annotations

from typing import Any

from neuspring.checks import examine
from neuspring.checks.objects import place_of
from neuspring.core.artifacts import ImageObservations
from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.data.results import LiftedTracks, ShapePrior

RISES = 0.05
"""Part of a body that is not laid onto the table, because it would lie too far behind. Two sloths that lie have up to 0.03."""
RESIZED = 1.8
"""Change of a hand's apparent size."""


def findings_of(lifted: LiftedTracks, prior: ShapePrior, up: float, image: ImageObservations) -> list[Finding]:
    """Findings about points in the world, the shape and the evidence in the image; `up` is +1 or -1."""
    found = examine("object", "object of all cameras", place_of({0: lifted.cloud}, up))
    found += examine("pose", "shape", lifted) + examine("visible points", "tracks", image.visible[: len(image.inside)])
    return found + examine("hands in the image", "hands", image)


def supposed_pose(lifted: LiftedTracks) -> dict[str, Any] | None:
    """Share of a body that is supposed to rise, where color alone shows it and nothing says whether it lies or stands."""
    if lifted.backend != "color alone, body":
        return None
    deep, across, raised = (lifted.facts[f"shape_{name}"] for name in ("longest", "across", "raised"))
    rises = f", so {raised:.0%} of it is supposed to rise" if raised > RISES else ""
    level = "warning" if raised > RISES else "note"
    return {"value": raised, "deep": 100 * deep, "across": 100 * across, "rises": rises, "level": level}


def hand_sizes(image: ImageObservations) -> dict[str, Any] | None:
    """Apparent sizes of hands, as multiples of those in frame 0, that change more than at arm's length."""
    if not image.hands:
        return None
    least, most = float(image.hand_sizes.min()), float(image.hand_sizes.max())
    return {"value": most, "least": least} if most > RESIZED or least < 1 / RESIZED else None


# fmt: off
checks = (
    Check("pose", "pose", supposed_pose, None, "note",
          "if it lies, it reaches {deep:.0f} cm behind its nearest point and is {across:.0f} cm wide{rises}; one picture cannot "
          "say whether it lies or stands.", 'Write "pose": "lying" or "standing" in capture.json.'),
    Check("size of hands", "hands in the image", hand_sizes, None, "warning",
          "a hand appears {least:.2f} to {value:.2f} times as large as in frame 0; a hand at arm's length changes by less than "
          f"{RESIZED:g} times; it was not followed well.", "Look at hands.png, and mark the hands anew."),
)
