"""Points in space that a capture brings: units and axes, and hands that must reach the object."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import KDTree

from neuspring.checks.objects import HAND_REACH, extents
from neuspring.checks.rig import FAR_OFF

UNITS = {"millimeters": 1000.0, "tenths of a millimeter": 10000.0, "centimeters": 100.0}
"""Units that may have been meant, and how many are in 1 m."""
AWAY = 0.3
"""m. Hands that never come nearer to the nodes are of another scene."""
SAME = 1e-4
"""m: nodes nearer than this are one, and no spring is between them."""


def far(points: np.ndarray, *_: Any) -> dict[str, Any]:
    """The largest coordinate of points [n, 3] of a file, and the units in which it would be near."""
    most = float(np.abs(points).max())
    size = " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0))
    fitting = [f"divide by {by:g} if they are {unit}" for unit, by in UNITS.items() if 0.05 < most / by < 10]
    return {"value": most, "detail": f"a box of {size}", "next": f"Write meters: {' or '.join(fitting) or 'look at the unit'}."}


def travel(points: np.ndarray) -> np.ndarray:
    """The largest mean displacement [3], m, of points [T, K, 3] from their places in frame 0."""
    mean = np.nan_to_num(points - points[0]).sum(axis=1) / max(points.shape[1], 1)
    return np.asarray(mean[np.linalg.norm(mean, axis=1).argmax()])


def off_table(points: np.ndarray, up: float | None, moved: np.ndarray) -> dict[str, Any] | None:
    """Lowest height of points above the table, m; `up` is +1 or -1, None without a table. `moved` [3], m."""
    if up is None:
        return None
    low, high = extents(points * (1, 1, up))[:, 2].tolist()
    axis = "xyz"[int(np.abs(moved).argmax())]
    detail = f"z from {points[:, 2].min():.3g} to {points[:, 2].max() + 0.0:.3g} m; points move most along {axis}"
    return {"value": low, "detail": detail, "level": "error" if low < -FAR_OFF or high < -low or axis != "z" else "warning"}


def off_body(points: np.ndarray, nodes: np.ndarray) -> dict[str, Any] | None:
    """Largest distance of annotated points of frame 0 [K, 3], m, NaN where unseen, from the nodes [N, 3] of the object."""
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(known):
        return None
    away = KDTree(nodes).query(points[known])[0]
    detail = f"point {known[away.argmax()]}; {(away > HAND_REACH).sum()} of {len(away)} are too far"
    return {"value": float(away.max()), "detail": detail, "level": "error" if np.median(away) > HAND_REACH else "warning"}


def reach(held: np.ndarray, nodes: np.ndarray) -> dict[str, Any] | None:
    """Least distance of controllers that hold [n, 3] from the nodes [N, 3], m."""
    if not len(nodes) or not len(held):
        return None
    gap = float(KDTree(nodes).query(held)[0].min())
    return {"value": gap, "level": "error" if gap > AWAY else "warning"}
