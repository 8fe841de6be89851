"""Cameras against each other: what one measured must not float in front of what another saw.

A point that camera A measured is projected into camera B. Where B measured more depth there, B looked through it: one of the poses
is wrong. Less depth is no contradiction: something may hide the point from B. Only what stands out of the table counts, because a
table that is moved along itself looks the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.data.capture import Camera
from neuspring.data.departure import Departure, note, unusual

RISEN = 0.015
"""m above z = 0 from which a point stands out of the table."""
TALLEST = 0.8
"""m; higher points are the room."""
FREE = 0.03
"""m. B looked through a point if it measured so much more."""
MOST = 0.12
"""Share of such points from which cameras disagree.

Synthetic scenes have up to 0.07 with exact poses, 0.17 to 0.6 with one that is 2 cm off.
"""
FEWEST = 150
"""Points in the view of both from which cameras are compared."""
STRIDE = 2


def view_departures(path: Path, cameras: Mapping[str, Camera], depths: Mapping[str, np.ndarray], up: str) -> list[Departure]:
    """Departures of pairs of cameras by their depth images [H, W], m, of one frame."""
    found = []
    for one, two in combinations(depths, 2):
        pairs = [_compare(cameras[a], depths[a], cameras[b], depths[b], up) for a, b in ((one, two), (two, one))]
        if max(count for count, _ in pairs) < FEWEST:
            found.append(note(path, f"cameras {one} and {two} see too little in common above the table: not compared"))
            continue
        through = max(share for count, share in pairs if count >= FEWEST)
        text = f"{through:.0%} of the points of one float before what the other saw"
        if through > MOST:
            rule = f"cameras {one} and {two} should see the same surfaces above the table in the same place"
            next_move = "Calibrate again with one board that both see, and check that their frames are of the same moment"
            found.append(unusual(path, "cameras", rule, f"{text}. {next_move}"))
        else:
            found.append(note(path, f"cameras {one} and {two} agree: {text}"))
    return found


def _compare(a: Camera, depth_a: np.ndarray, b: Camera, depth_b: np.ndarray, up: str) -> tuple[int, float]:
    """Points of A that B sees, and the share of them that B looked through."""
    sign = up_sign(up)
    y, x = np.nonzero(depth_a[::STRIDE, ::STRIDE] > 0)
    pixels = STRIDE * np.stack([x, y], axis=-1)
    points = a.lift(pixels.astype(float), depth_a[pixels[:, 1], pixels[:, 0]])
    height = sign * points[:, 2]
    points = points[(height > RISEN) & (height < TALLEST)]
    seen, distance = b.project(points)
    visible = (distance > 0.05) & b.sees(seen)
    column, row = np.round(seen[visible]).astype(int).T
    expected, valid = distance[visible], depth_b[row, column] > 0
    if valid.sum() < FEWEST:
        return int(valid.sum()), 0.0
    # At the outline of a thing a pixel beside the point sees past it: B looked through the point if all pixels around it did.
    nearest = cv2.erode(np.where(depth_b > 0, depth_b, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))[row, column]
    return int(valid.sum()), float((nearest - expected > FREE)[valid].mean())
