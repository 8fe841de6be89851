"""Observations that every method reads: nodes, motion of the object, and controllers. Errors are what no method can work with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuspring.checks.masks import OFTEN
from neuspring.core.artifacts import Observations
from neuspring.core.checks import Check

GRIP = 0.04
"""m from the object within which a controller can hold it."""
NO_INTERACTION = 0.15
"""m between hand and object, at their nearest, from which there is no interaction to learn from."""
LOST_SHARE = 0.1
"""Share of the object's points that are lost in a training frame, from which the others do not tell that it stands still."""
STILL = 0.005
"""m: motions smaller than this are noise."""
FASTEST_HAND = 5.0
"""m/s: no hand that manipulates is faster."""
NODE_RANGE = (30, 5000)
"""Structure points that can deform, and that a search can pay for."""
OF_CONTROLLERS: dict[str, Any] = {"where": "controllers"}
MASKS = "Masks may take something else for a hand: look at masks.png; perception.lift has grip."


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations, and the share of training frames in which the picture of the object changes, as masks know it."""

    observations: Observations
    moves: float = 0.0

    @cached_property
    def motion(self) -> tuple[float, float]:
        """Farthest motion of the object in a training frame, m, which a tenth of its points exceed; largest share that is lost."""
        end, image, seen_of = self.observations.scenario.train_end, self.observations.image, self.observations
        if image is None:
            seen, points = seen_of.object_visibility[:end], seen_of.object_points
            moved = np.linalg.norm(points[:end] - points[0], axis=2)
        else:
            seen, moved = image.visible[:end], image.pixel_size * np.linalg.norm(image.pixels[:end] - image.pixels[0], axis=2)
        tenths = (float(np.quantile(row[shown], 0.9)) for row, shown in zip(moved, seen, strict=True) if shown.any())
        return max(tenths, default=0.0), 1 - min((float(shown.mean()) for shown in seen), default=1.0)

    @property
    def unfollowed(self) -> bool:
        """True where it seems to stand still, and is not known to: what is lost may have moved."""
        return self.motion[0] < STILL and (self.moves >= OFTEN or self.motion[1] > LOST_SHARE)

    @cached_property
    def apart(self) -> np.ndarray:
        """[T, C], m: controllers from the nearest point of the object that is seen; in frame 0 from all nodes."""
        seen = self.observations
        apart = np.full(seen.controller_points.shape[:2], np.inf)
        for frame, own in enumerate(seen.controller_points):
            points = seen.nodes if frame == 0 else seen.object_points[frame, seen.object_visibility[frame]]
            if len(points):
                apart[frame] = cKDTree(points).query(own)[0]
        return apart

    @property
    def meets(self) -> bool:
        """True where hands come near the object: only then is more said of them."""
        return bool(self.apart.min() <= NO_INTERACTION)


def hold(seen: Observed) -> dict[str, Any] | None:
    """Controllers that hold in frame 0, of how many, and the nearest."""
    holding, count = int((seen.apart[0] <= GRIP).sum()), seen.apart.shape[1]
    told = OF_CONTROLLERS | {"value": holding, "count": count, "without": count - holding, "cm": 100 * seen.apart[0].min()}
    return told if seen.meets else None


def let_go(seen: Observed) -> dict[str, Any] | None:
    """Controllers that let go, and when some take hold again."""
    holds = seen.observations.controller_valid
    if not seen.meets or not len(holds) or not (gone := int((~holds).any(axis=0).sum())):
        return None
    first, again = int(np.flatnonzero(~holds.all(axis=1))[0]), (holds[1:] & ~holds[:-1]).any(axis=1)
    later = f", and some take hold again, first in frame {int(again.argmax()) + 1}" if again.any() else ""
    return OF_CONTROLLERS | {"value": gone, "count": seen.apart.shape[1], "first": first, "again": later}


def motion_of_hands(seen: Observed) -> dict[str, Any] | None:
    """The farthest motion of controllers, m."""
    points = seen.observations.controller_points
    moved = float(np.linalg.norm(points - points[0], axis=2).max())
    return OF_CONTROLLERS | {"value": moved, "mm": 1e3 * moved} if seen.meets else None


def speed_of_hands(seen: Observed) -> dict[str, Any] | None:
    """The largest median speed of controllers between two frames, m/s."""
    rate = seen.observations.scenario.frame_rate
    speed = rate * np.median(np.linalg.norm(np.diff(seen.observations.controller_points, axis=0), axis=2), axis=1)
    if not seen.meets or not len(speed):
        return None
    return OF_CONTROLLERS | {
        "value": float(speed.max()),
        "frame": int(speed.argmax()),
        "next": int(speed.argmax()) + 1,
        "rate": rate,
    }


def first_hold(seen: Observed) -> dict[str, Any] | None:
    """Controllers of frame 0, of which none holds."""
    told = hold(seen)
    return None if not told or told["value"] else told


def partial_hold(seen: Observed) -> dict[str, Any] | None:
    """Controllers of frame 0, of which fewer than half hold."""
    told = hold(seen)
    return told if told and 0 < 2 * told["value"] < told["count"] else None


def node_count(seen: Observed) -> dict[str, Any]:
    """Structure points."""
    count = len(seen.observations.nodes)
    return {"value": count, "level": "error" if count < 4 else "warning"}


# fmt: off
checks = (
    Check("hand far from the object", "observations",
          lambda seen: OF_CONTROLLERS | {"value": float(seen.apart.min()), "cm": 100 * seen.apart.min()}, (0, NO_INTERACTION),
          "error",
          f"the hand is never nearer to the object than {{cm:.0f}} cm; it must come within {100 * NO_INTERACTION:g} cm to move "
          "it.", MASKS),
    Check("controllers hold nothing", "observations", first_hold, None, "warning",
          f"in frame 0 none of {{count}} has a point of the object within {100 * GRIP:g} cm; the nearest is {{cm:.0f}} cm away; "
          "springs of hands are made in frame 0, and would span the air.", "Begin the capture at the grip."),
    Check("most controllers hold nothing", "observations", partial_hold, None, "note",
          f"{{without}} of {{count}} have no point of the object within {100 * GRIP:g} cm in frame 0; only those that are near "
          "hold it.", "perception.lift.grip: patch takes near ones."),
    Check("hands let go", "observations", let_go, None, "note",
          "{value} of {count} let go, first in frame {first}{again}; while they do not hold, their springs do not act "
          "(perception.lift.release).", "Is that what was filmed?"),
    Check("controllers stand still", "observations", motion_of_hands, (STILL, np.inf), "warning",
          f"they move {{mm:.1f}} mm; at least {1e3 * STILL:g} mm are expected of hands that move an object.", MASKS),
    Check("controllers too fast", "observations", speed_of_hands, (0, FASTEST_HAND), "warning",
          "{value:.0f} m/s between frames {frame} and {next}; hands are slower than {high:g} m/s.",
          "frame_rate ({rate:g}/s) or depth_unit of capture.json may be wrong, or a hand's tracks jump."),
    Check("too few nodes", "observations", node_count, (NODE_RANGE[0], np.inf), "warning",
          "{value} structure points; at least {low} are needed to deform.",
          "Lower perception.sample.voxel, or give the object more pixels."),
    Check("many nodes", "observations", lambda seen: len(seen.observations.nodes), (0, NODE_RANGE[1]), "note",
          "{value:,} structure points; more than {high:,} make searches take hours.", "perception.sample.nodes limits them."),
    Check("object not followed", "observations",
          lambda seen: {"value": seen.motion[0], "mm": 1e3 * seen.motion[0]} if seen.unfollowed else None, None, "warning",
          "points of the object move {mm:.1f} mm in the training frames, its picture changes in {0.moves:.0%} of them, and up to "
          "{0.motion[1]:.0%} of the points are lost; where it moves it is not followed.",
          "Look at masks.png and tracks.png: mark what the masks lose, use more light or shorter exposures, or cotracker3."),
    Check("object stands still", "observations",
          lambda seen: None if seen.unfollowed else {"value": seen.motion[0], "mm": 1e3 * seen.motion[0]}, (STILL, np.inf),
          "warning",
          f"the object moves {{mm:.1f}} mm in the training frames; at least {1e3 * STILL:g} mm are needed to learn from; "
          "`static` cannot be beaten.", "Film an interaction, or move the split."),
)
