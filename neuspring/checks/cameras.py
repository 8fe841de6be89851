"""Cameras against each other, and edges of depth against those of color.

A point that camera A measured is projected into camera B. Where B measured more depth there, B looked through it: one of the poses
is wrong. Less depth is no contradiction: something may hide the point from B. Only what stands out of the table counts, because a
table that is moved along itself looks the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.core.checks import Check
from neuspring.data.camera import Camera

ABOVE_TABLE = 0.015
"""m above z = 0 from which a point stands out of the table."""
ROOM_HEIGHT = 0.8
"""m; higher points are the room."""
FREE = 0.03
"""m. B looked through a point if it measured so much more."""
MOST_FLOATING = 0.12
"""Share of such points from which cameras disagree.

Synthetic scenes have up to 0.07 with exact poses, 0.17 to 0.6 with one that is 2 cm off.
"""
FEWEST_SHARED = 150
"""Points in the view of both from which cameras are compared."""
DEPTH_STRIDE = 2


def pairs(cameras: Mapping[str, Camera], depths: Mapping[str, np.ndarray], up: str) -> Iterator[dict[str, Any]]:
    """Share of the points of one camera that another one looked through, for every two; no value where they share too few.

    `depths` [H, W], m, were measured in one frame. Shares up to MOST_FLOATING are notes.
    """
    for one, two in combinations(depths, 2):
        both = [looked_through(cameras[a], depths[a], cameras[b], depths[b], up) for a, b in ((one, two), (two, one))]
        yield {"one": one, "two": two, "value": max((share for count, share in both if count >= FEWEST_SHARED), default=None)}


def looked_through(a: Camera, depth_a: np.ndarray, b: Camera, depth_b: np.ndarray, up: str) -> tuple[int, float]:
    """Points of A that B sees, and the share of them that B looked through."""
    sign = up_sign(up)
    y, x = np.nonzero(depth_a[::DEPTH_STRIDE, ::DEPTH_STRIDE] > 0)
    pixels = DEPTH_STRIDE * np.stack([x, y], axis=-1)
    points = a.lift(pixels.astype(float), depth_a[pixels[:, 1], pixels[:, 0]])
    points = points[(sign * points[:, 2] > ABOVE_TABLE) & (sign * points[:, 2] < ROOM_HEIGHT)]
    seen, distance = b.project(points)
    visible = (distance > 0.05) & b.sees(seen)
    column, row = np.round(seen[visible]).astype(int).T
    expected, valid = distance[visible], depth_b[row, column] > 0
    if valid.sum() < FEWEST_SHARED:
        return int(valid.sum()), 0.0
    # At the outline of a thing a pixel beside the point sees past it: B looked through the point if all pixels around it did.
    nearest = cv2.erode(np.where(depth_b > 0, depth_b, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))[row, column]
    return int(valid.sum()), float((nearest - expected > FREE)[valid].mean())


ALIGNED = 0.015
"""Part of the image's width by which edges of depth may lie beside those of color: sensors are registered to 1 %."""
MISPLACED = 0.12
"""Part of the width by which they are looked for elsewhere: 6 cm between two sensors, 0.4 m from them."""
BETTER = 1.4
"""A shift is believed if edges agree so many times as well with it as without. Right recordings have up to 0.9, depth of another
sensor 1.7 and more."""
FEWEST_EDGES = 200
"""Pixels at edges of depth, of all frames together."""
DEPTH_STEP = (0.03, 0.04)
"""m, and part of the depth: a larger step is an edge."""
SOFT = 0.3
"""Part of the strongest edge from which one counts in full, as do the strongest 5 % of the pixels."""
SQUARE = np.ones((3, 3), np.uint8)
DEPTH_SCALES = (1.0, 0.7, 0.8, 0.9, 1.1, 1.2, 1.3, 1.4)
"""Sizes of the picture of depth, to try: the lens of a depth sensor is another."""
WIDE = 400
"""Images are thinned until they are about as wide, pixels."""


Pictures = Sequence[tuple[np.ndarray, np.ndarray]]
"""Images of color [H, W, 3] or masks [H, W] of one camera, each with its depth [H, W], m."""


def misplaced(pictures: Pictures) -> dict[str, Any] | None:
    """Gain of agreement where edges of depth fit those of color once depth is moved and scaled: depth of another sensor."""
    right, down, scale, gain = edge_shift(pictures)
    if gain < BETTER:
        return None
    ways = [f"made {scale:g} times as large"] if scale != 1 else []
    ways += [f"moved {abs(right)} pixels to the {'right' if right > 0 else 'left'}"] if abs(right) > 1 else []
    ways += [f"moved {abs(down)} pixels {'down' if down > 0 else 'up'}"] if abs(down) > 1 else []
    return {"value": gain, "ways": " and ".join(ways)}


def edge_shift(pairs: Pictures) -> tuple[int, int, float, float]:
    """The shift and scale of depth with which its edges agree best with those of color, and how many times as well as they do
    within ALIGNED: pixels to the right and down, after a scaling about the center of the image. 0 times with too few edges.

    The agreement is the mean strength of color's edges over depth's edge pixels, above its median over all shifts.
    """
    width = pairs[0][1].shape[1] if pairs else 1
    stride = max(round(width / WIDE), 1)
    reach, near = round(MISPLACED * width / stride), max(round(ALIGNED * width / stride), 4)
    pictures = []
    for picture, depth in pairs:
        thin = np.ascontiguousarray(picture[::stride, ::stride])
        shades = cv2.cvtColor(thin, cv2.COLOR_RGB2LAB) if thin.ndim == 3 else np.repeat(255 * (thin[..., None] > 0), 3, axis=2)
        shades = cv2.GaussianBlur(shades.astype(np.float32), (0, 0), 1)
        steps = np.hypot(cv2.Sobel(shades, cv2.CV_32F, 1, 0), cv2.Sobel(shades, cv2.CV_32F, 0, 1)).max(axis=2)
        strength = np.minimum(steps / max(float(np.quantile(steps, 0.95)), SOFT * float(steps.max()), 1.0), 1.0)
        thin = depth[::stride, ::stride].astype(np.float32)
        # A step beside a pixel and none on its other side: a slope has both.
        low, high = cv2.erode(np.where(thin > 0, thin, np.inf).astype(np.float32), SQUARE), cv2.dilate(thin, SQUARE)
        edges = (thin > 0) & (high + low - 2 * thin > np.maximum(DEPTH_STEP[0], DEPTH_STEP[1] * thin))
        pictures.append((strength, np.argwhere(edges)))
    if sum(len(edges) for _, edges in pictures) < FEWEST_EDGES:
        return 0, 0, 1.0, 0.0
    shape = np.array(pictures[0][0].shape)
    inside, best, found = 0.05, 0.0, (0, 0, 1.0)
    for scale in DEPTH_SCALES:
        sums = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
        for strength, edges in pictures:
            placed = np.round((edges - shape / 2) * scale + shape / 2).astype(int)
            row, column = placed[((placed >= 0) & (placed < shape)).all(axis=1)].T
            drawn = np.zeros(shape, np.float32)
            drawn[row, column] = 1.0
            for k, table in enumerate((strength, np.ones_like(strength))):
                wide = cv2.copyMakeBorder(table, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
                sums[k] += cv2.matchTemplate(wide, drawn, cv2.TM_CCORR)
        agreement = np.where(sums[1] > 0.5 * sums[1].max(), sums[0] / np.maximum(sums[1], 1.0), 0.0)
        agreement -= np.median(agreement)
        if scale == 1:
            inside = max(float(agreement[reach - near : reach + near + 1, reach - near : reach + near + 1].max()), inside)
        if agreement.max() > best:
            best = float(agreement.max())
            down, right = (stride * (int(k) - reach) for k in np.unravel_index(agreement.argmax(), agreement.shape))
            found = (right, down, scale)
    return *found, best / inside


# fmt: off
checks = (
    Check("views not compared", "views", lambda views: [one for one in views if one["value"] is None], None, "note",
          "cameras {one} and {two} see too little in common above the table: not compared", title=""),
    Check("views agree", "views",
          lambda views: [one for one in views if one["value"] is not None and one["value"] <= MOST_FLOATING], None, "note",
          "cameras {one} and {two} agree: {value:.0%} of the points of one float before what the other saw", title=""),
    Check("views disagree", "views", lambda views: [one for one in views if one["value"] is not None], (0, MOST_FLOATING),
          "warning",
          "cameras {one} and {two} should see the same surfaces above the table in the same place; received {value:.0%} of the "
          "points of one float before what the other saw: a pose, an order of cameras, a lens or a moment is wrong",
          title="cameras"),
    Check("depth not aligned to color", "edges", misplaced, None, "warning",
          f"edges of depth fit those of color when depth is {{ways}}; as it is they must fit within {ALIGNED:.1%} of the width.",
          "Let the camera's software align depth to color (RealSense: rs.align; ROS: aligned_depth_to_color)."),
)
