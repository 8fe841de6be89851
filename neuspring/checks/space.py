"""Points in space of a capture's files: units, axes, and contact between hands and object."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import KDTree

from neuspring.checks.objects import HAND_REACH, extents
from neuspring.checks.rig import FAR_OFF

UNITS = {"millimeters": 1000.0, "tenths of a millimeter": 10000.0, "centimeters": 100.0}
"""Possible wrong units, and their number per m."""
AWAY = 0.3
"""Distance from the nodes, m, above which hands belong to another scene."""
SAME = 1e-4
"""Distance, m, below which two points are the same; no spring can connect them."""


def far(points: np.ndarray, *_: Any) -> dict[str, Any]:
    """The largest coordinate of points [n, 3] of a file, and the units in which it would be plausible."""
    most = float(np.abs(points).max())
    size = " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0))
    fitting = [f"divide by {by:g} if they are {unit}" for unit, by in UNITS.items() if 0.05 < most / by < 10]
    return {"value": most, "detail": f"bounding box {size}", "next": f"Write meters: {' or '.join(fitting) or 'check the unit'}."}


def travel(points: np.ndarray) -> np.ndarray:
    """The largest mean displacement [3], m, of points [T, K, 3] from frame 0."""
    mean = np.nan_to_num(points - points[0]).sum(axis=1) / max(points.shape[1], 1)
    return np.asarray(mean[np.linalg.norm(mean, axis=1).argmax()])


def off_table(points: np.ndarray, up: float | None, moved: np.ndarray) -> dict[str, Any] | None:
    """Lowest height above the table, m, of points [n, 3], m; `up` is +1, -1, or None without a table; `moved` [3] is `travel`."""
    if up is None:
        return None
    low, high = extents(points * (1, 1, up))[:, 2].tolist()
    axis = "xyz"[int(np.abs(moved).argmax())]
    detail = f"z from {points[:, 2].min():.3g} to {points[:, 2].max() + 0.0:.3g} m; points move most along {axis}"
    return {"value": low, "detail": detail, "level": "error" if low < -FAR_OFF or high < -low or axis != "z" else "warning"}


def off_body(points: np.ndarray, nodes: np.ndarray) -> dict[str, Any] | None:
    """Largest distance, m, between annotated points of frame 0 [K, 3] (NaN: not annotated) and the nodes [N, 3]."""
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(known):
        return None
    away = KDTree(nodes).query(points[known])[0]
    detail = f"point {known[away.argmax()]}; {(away > HAND_REACH).sum()} of {len(away)} are too far"
    return {"value": float(away.max()), "detail": detail, "level": "error" if np.median(away) > HAND_REACH else "warning"}


def reach(held: np.ndarray, nodes: np.ndarray) -> dict[str, Any] | None:
    """Smallest distance between grasping controllers [n, 3] and nodes [N, 3], m."""
    if not len(nodes) or not len(held):
        return None
    gap = float(KDTree(nodes).query(held)[0].min())
    return {"value": gap, "level": "error" if gap > AWAY else "warning"}
