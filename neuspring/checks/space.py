"""Points in space that a capture brings: units and axes, the body, and hands that must reach it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from neuspring.checks.table import FAR_OFF
from neuspring.checks.things import HAND_REACH, HIGHEST_OBJECT, LARGE, SCALE_REMEDY, SMALL, SUNK, extents, longest
from neuspring.core.checks import Check
from neuspring.data.camera import FAR
from neuspring.data.capture import CAPTURE

UNITS = {"millimeters": 1000.0, "tenths of a millimeter": 10000.0, "centimeters": 100.0}
"""Units that may have been meant, and how many are in 1 m."""
AWAY = 0.3
"""m. Hands that never come nearer to the nodes, and nodes that are farther from annotated points, are of another scene."""
MOST_NODES = 5000
"""Nodes beyond which a warning says that a twin is slow."""
STEEP = 3.0
"""A motion that is so many times as large along y as along x and z may be a lift."""
SAME = 1e-4
"""m: nodes nearer than this are one, and no spring is between them."""


def far(points: np.ndarray) -> dict[str, Any]:
    """The largest coordinate of points [n, 3] of a file, and the units in which it would be near."""
    most = float(np.abs(points).max())
    size = " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0))
    fitting = [f"divide by {by:g} if they are {unit}" for unit, by in UNITS.items() if most / by < FAR]
    return {"value": most, "size": size, "next": f"Likely: {', or '.join(fitting)}" if fitting else "Look at its unit"}


def travel(points: np.ndarray) -> np.ndarray:
    """The largest mean displacement [3], m, of points [T, K, 3] from their places in frame 0."""
    mean = np.nan_to_num(points - points[0]).sum(axis=1) / max(points.shape[1], 1)
    return np.asarray(mean[np.linalg.norm(mean, axis=1).argmax()])


def off_table(points: np.ndarray, up: float | None, is_body: bool, moved: np.ndarray) -> dict[str, Any] | None:
    """Heights of points that are not on or above the table, and what explains them; `up` is +1 or -1, None without a table.

    `moved` [3], m, is how far the points of the scene go: hands lift more than they push.
    """
    if up is None or np.abs(points).max() > FAR:
        return None
    low, high = extents(points * (1, 1, up))[:, 2]
    # A body may hang in the air, and need not.
    if low >= -SUNK and high <= HIGHEST_OBJECT and not (is_body and low > FAR_OFF):
        return None
    sign = "+-" if up > 0 else "-+"
    told = {"value": float(low), "z": "z from {:.3g} to {:.3g} m".format(*np.quantile(points[:, 2], (0, 1)) + 0.0), "sign": sign[0]}
    other = f"Is up {sign[1]}z? Then write so in {CAPTURE} (make-capture: --up). Without a table: ground: false (--no-table)"
    rests = is_body and abs(high) > SUNK and next((turn for turn in (1, -1) if abs((turn * points[:, 1]).min()) < SUNK), 0)
    lifted = low < -SUNK and abs(moved[1]) > max(SUNK, STEEP * np.linalg.norm(moved[[0, 2]])) and np.sign(moved[1])
    if rises := rests or lifted:
        words = "(x, -z, y)" if rises == up else "(x, z, -y)"
        why = "It rests at y = 0" if rests else f"What moves goes along {'+' if rises > 0 else '-'}y"
        also = f". {other}" if high <= SUNK and not rests else ""
        level = "warning" if low > FAR_OFF else "error"
        return told | {"level": level, "next": f". {why}: if y is up, write {words} in place of (x, y, z){also}"}
    if high <= SUNK:
        return told | {"next": f". {other}"}
    if low > FAR_OFF and high <= HIGHEST_OBJECT:
        remedy = "If it stands on a table, the table must be z = 0; or is another axis up? If it hangs, this is right"
        return told | {"level": "warning", "next": f": {100 * low:.0f} cm above the table. {remedy}"}
    remedy = f"Move the world so that the table is z = 0, or write ground: false in {CAPTURE} (make-capture: --no-table)"
    return told | {"level": "error" if low < -FAR_OFF else "warning", "next": f". {remedy}"}


def y_upward(points: np.ndarray, up: float | None, is_body: bool, moved: np.ndarray) -> dict[str, Any] | None:
    """Way along y, m, of a scene without a table whose body rests at y = 0 and is lifted along y."""
    lifted = abs(moved[1]) > max(SUNK, STEEP * np.linalg.norm(moved[[0, 2]]))
    if up is not None or not is_body or not lifted or abs((np.sign(moved[1]) * points[:, 1]).min()) > SUNK:
        return None
    return {"value": float(moved[1]), "words": "(x, -z, y)" if moved[1] > 0 else "(x, z, -y)"}


def too_long(points: np.ndarray, up: float | None, is_body: bool, moved: np.ndarray) -> dict[str, Any] | None:
    """Longest side of a body, m, that is that of nothing that hands hold."""
    return longest(float(np.ptp(points, axis=0).max())) if is_body and np.abs(points).max() <= FAR else None


def far_from_nodes(points: np.ndarray, nodes: np.ndarray) -> dict[str, Any] | None:
    """Annotated points of frame 0 [K, 3], m, NaN where unseen, that are far from the nodes [N, 3] of the body."""
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    away = KDTree(nodes).query(points[known])[0] if len(known) else np.zeros(0)
    if not (away > HAND_REACH).any():
        return None
    text = f"point {known[away.argmax()]} is {100 * away.max():.1f} cm away, {(away > HAND_REACH).sum()} of {len(away)} are farther"
    return {"value": float(away.max()), "text": text, "level": "error" if np.median(away) > HAND_REACH else "warning"}


@dataclass(frozen=True, eq=False)
class Holding:
    """Hands of a file that hold a body."""

    hand: np.ndarray
    """[C]: the hand of each controller."""
    held: np.ndarray
    """Places [n, 3], m, of controllers that hold in training frames."""
    start: np.ndarray
    """[C, 3], m, of frame 0."""
    nodes: np.ndarray
    """[N, 3], m; none where they are not given."""
    body: np.ndarray
    """[n, 3], m: nodes and annotated points of frame 0."""
    places: np.ndarray
    """[T, C, 3], m, NaN while they do not hold."""
    tracks: np.ndarray
    """Annotated points [T, K, 3], m, NaN where not seen."""


def fewest_points(hands: Holding) -> int:
    """Points of the hand that has fewest."""
    return int(np.unique(hands.hand, return_counts=True)[1].min())


def reach(hands: Holding) -> dict[str, Any] | None:
    """Least distance of a hand that holds from the nodes, m."""
    if not len(hands.nodes) or not len(hands.held):
        return None
    gap = float(KDTree(hands.nodes).query(hands.held)[0].min())
    return {"value": gap, "cm": 100 * gap, "level": "error" if gap > AWAY else "warning"}


def doubled(hands: Holding) -> dict[str, Any] | None:
    """Controllers of frame 0 that lie on a node or annotated point."""
    near = KDTree(hands.body).query(hands.start)[0] if len(hands.body) else np.full(1, np.inf)
    return {"value": int(near.argmin()), "count": (near < SAME).sum()} if (near < SAME).any() else None


def never_moves(hands: Holding) -> dict[str, Any] | None:
    """Controllers that are in one place in all frames, and how far the annotated point leaves them that was in reach, m."""
    still = [k for k, path in enumerate(np.swapaxes(hands.places, 0, 1)) if (path == path[0]).all()]
    near = np.flatnonzero(np.isfinite(hands.tracks[0]).all(axis=1))
    gaps = np.linalg.norm(hands.tracks[:, near, None] - hands.places[0, still], axis=3)
    if not gaps.size:
        return None
    first = gaps[0].argmin(axis=0)
    left = np.nanmax(gaps[:, first, np.arange(len(still))], axis=0)
    gone = np.flatnonzero((gaps[0].min(axis=0) < HAND_REACH) & (left > 2 * HAND_REACH))
    most = left[gone].max(initial=0.0)
    return {"value": float(most), "cm": 100 * most, "which": [still[k] for k in gone]} if len(gone) else None


# fmt: off
checks = (
    Check("unit", "points", lambda points, *_: far(points), (0, FAR), "error",
          "coordinates must be meters, at most {high:g} from the origin; received {value:.4g}, in {size}. {next}", title="points"),
    Check("implausible size", "points", too_long, None, "warning",
          f"{{cm:.3g}} cm long; {100 * SMALL:g} to {100 * LARGE:g} cm are expected.", SCALE_REMEDY),
    Check("off the table", "points", off_table, None, "error",
          f"with up {{sign}}z points must lie between the table, z = 0, and {HIGHEST_OBJECT:g} m above it; received {{z}}{{next}}",
          title="points"),
    Check("y up", "points", y_upward, None, "warning",
          "the body rests at y = 0 and is lifted along y by {value:.2f} m, and gravity is along z: if y is up, write {words} in "
          "place of (x, y, z) in all files", title="points"),
    Check("many nodes", "nodes", len, (0, MOST_NODES), "warning",
          "some hundred nodes are enough, more than {high} are slow; received {value}. Each of them costs time in every substep",
          title="points"),
    Check("points off the body", "points on nodes", far_from_nodes, None, "error",
          f"annotated points must lie on the body: within {100 * HAND_REACH:g} cm of a node in frame 0; received {{text}}. Are "
          "points and nodes of one recording, in one world?", title=""),
    Check("hand of one point", "holding", fewest_points, (2, np.inf), "warning",
          "three points of a hand, or of a jaw, turn what it holds; received one of some hand. It holds like a string: is that "
          "so?", title="points"),
    Check("nothing holds", "holding", lambda hands: None if len(hands.held) or not len(hands.nodes) else {}, None, "error",
          "some controller must hold in some training frame; received none. A twin learns from training frames: see train_end",
          title="holds"),
    Check("hand far from the nodes", "holding", reach, (0, HAND_REACH), "error",
          f"in some training frame a controller must come within {100 * HAND_REACH:g} cm of a node of frame 0 to move it; "
          "received {cm:.1f} cm at the nearest. Are hands and nodes of one recording, in one world?", title="points"),
    Check("hand never moves", "holding", never_moves, None, "warning",
          "controllers that hold should go where the body goes; {which} are in one place in all frames, and the annotated point "
          f"beside them goes {{cm:.0f}} cm away; {200 * HAND_REACH:g} cm are much. Was the pose of the hand read?", title="points"),
    Check("controllers on nodes", "holding", doubled, None, "error",
          f"controllers must lie {1e3 * SAME:g} mm from nodes and annotated points in frame 0: a spring needs a length; received "
          "controller {value}, {count} in all. Move them off the body, or leave out the nodes below them", title="points"),
)
