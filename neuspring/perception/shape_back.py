"""Where one camera alone shows the object: its seen surface without holes, and a stated guess of where its back is.

Depths are along the optical axis, m, over the pixels of the object's mask. The local width of a silhouette at a pixel is the
diameter 2 r of the largest disc inside it that covers the pixel; at a distance d from the edge a round body of that width is
c(d) = 2 sqrt(r^2 - (r - d)^2) thick.

fraction: back = seen + f c. symmetry: back = 2 middle - seen, where `middle` is the surface that the silhouette's rim spans (a
harmonic one, held at seen + c / 2 on the rim). One plane perpendicular to the view is no substitute: bodies lie oblique to it.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from neuspring.data.capture import HANDS, OBJECT

RIM = 3
"""Pixels that a rim is wide; depth is doubtful at its first."""
LEAST = 0.006
"""m: a body is at least this thick."""


def front(mask: np.ndarray, depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth [H, W] of the seen surface: pixels of `mask` [H, W] without a depth between `near` and `far` get that of the nearest
    pixel of the mask that has one. Zero outside the mask, and everywhere if no pixel has one."""
    usable = mask & (depth > near) & (depth < far)
    if not usable.any():
        return np.zeros(depth.shape)
    nearest = ndimage.distance_transform_edt(~usable, return_distances=False, return_indices=True)
    return np.where(mask, depth[tuple(nearest)], 0.0)


def back(labels: np.ndarray, seen: np.ndarray, focal: float, how: Literal["symmetry", "fraction"], share: float) -> np.ndarray:
    """Depth [H, W] of the back, from labels [H, W], the `seen` surface [H, W] and the focal length in pixels; zero outside the
    object. `share` is f of `fraction`."""
    mask = labels == OBJECT
    chord = round_chord(mask) * seen / focal
    if how == "fraction":
        thickness = share * chord
    else:
        # Beyond the edge as at the edge, so that the median of a rim's pixel is one of the object.
        extended = front(np.ones_like(mask), np.where(mask, seen, 0.0), 0.0, np.inf)
        smooth = cv2.medianBlur(extended.astype(np.float32), 5).astype(float)
        open_side = (labels != OBJECT) & (labels != HANDS)
        rim = mask & _grown(open_side, RIM) & ~_grown(labels == HANDS, RIM + 1)
        if not rim.any():
            rim = mask & _grown(~mask, RIM)
        thickness = 2.0 * (_spanned(smooth + 0.5 * chord, rim, mask) - smooth)
    return np.where(mask, seen + np.maximum(thickness, LEAST), 0.0)


def round_chord(mask: np.ndarray) -> np.ndarray:
    """c(d) [H, W], pixels, of a silhouette `mask` [H, W]; zero outside it."""
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = mask & (distance >= ndimage.maximum_filter(distance, 3) - 0.5)
    y, x = np.nonzero(ridge)
    radius = np.ascontiguousarray(distance)
    # Larger discs are drawn over smaller ones.
    for k in np.argsort(distance[y, x], kind="stable"):
        cv2.circle(radius, (int(x[k]), int(y[k])), int(distance[y[k], x[k]]), float(distance[y[k], x[k]]), -1)
    radius = np.maximum(radius, distance)
    return np.where(mask, 2.0 * np.sqrt(np.maximum(distance * (2.0 * radius - distance), 0.0)), 0.0)


def _grown(mask: np.ndarray, reach: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0


def _spanned(values: np.ndarray, rim: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The harmonic surface [H, W] over `mask` that has `values` on its `rim`: each other pixel is the mean of its neighbors."""
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    down, right = ((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))
    pairs = np.concatenate([np.stack([a[(a >= 0) & (b >= 0)], b[(a >= 0) & (b >= 0)]]) for a, b in (down, right)], axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(int(mask.sum()),) * 2)
    graph = graph + graph.T
    held = rim[mask].astype(float)
    # A piece of the mask without a rim would be free; it is held, weakly, where it is.
    held = np.where(held > 0, 1.0, 1e-6)
    laplacian = diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
    result = np.zeros(mask.shape)
    result[mask] = spsolve((laplacian + diags(held)).tocsc(), held * values[mask])
    return result
