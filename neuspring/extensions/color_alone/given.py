"""Nodes of frame 0 that a capture contains (intake/points.py). They replace an assumed shape, give the depth of visible pixels,
and become the nodes of the twin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.errors import InputError
from neuspring.data.camera import Camera
from neuspring.data.capture import Capture
from neuspring.extensions.color_alone.first_frame import BENEATH, FirstFrame, beneath_hands
from neuspring.perception.sample import spacing

PLANE_NODES = 6
"""Number of front nodes that determine the depth of a pixel."""
PLANE_RIDGE = 1e-3
"""Ridge of the planes through them, as a fraction of their squared spread: collinear nodes give no slope across their line."""


HIDDEN_BESIDE, HIDDEN_BEHIND = 0.75, 2.0
"""Node spacings: a node hides others within the first in the image that are more than the second behind it."""


@dataclass(frozen=True)
class GivenFrame(FirstFrame):
    """Shape of the object in frame 0, from its nodes."""

    front: np.ndarray
    """Pixel (x, y) and depth, m, of each visible node [F, 3]."""
    apart: float
    """Median node spacing, m."""

    @classmethod
    def by(cls, capture: Capture, labels: np.ndarray, nodes: np.ndarray) -> GivenFrame:
        """Make it from labels [H, W] of frame 0 and nodes [N, 3], m. Raises InputError if no node is in front of the camera."""
        camera = next(iter(capture.cameras.values()))
        front, apart = facing(camera, nodes), spacing(nodes)
        if not len(front):
            raise InputError(f"{capture.folder}, nodes", "some nodes of frame 0 must be in front of the camera", "none")
        size = float(np.median(front[:, 2])) / camera.intrinsics[0, 0]
        filled = beneath_hands(labels, BENEATH / size)
        none = np.zeros(labels.shape)
        return cls(camera, capture.description.up_sign, "given nodes", filled, none, none, size, {}, front, apart)

    def _lifted(self, pixels: np.ndarray, share: float) -> np.ndarray:
        """World points of pixels, on the surface (share 1) or half a node spacing beneath it.

        The surface at a pixel u is the least-squares plane through the nearest front nodes. Inverse depth is affine in the image:

            1 / z = a + b . (u - m)

        m is the mean pixel of these nodes. The depth is clipped to their range.
        """
        near = cKDTree(self.front[:, :2]).query(pixels, k=np.arange(1, min(PLANE_NODES, len(self.front)) + 1))[1]
        around, inverse = self.front[near, :2], 1.0 / self.front[near, 2]
        middle, mean = around.mean(axis=1), inverse.mean(axis=1)
        offsets = around - middle[:, None]
        squares = np.einsum("nki,nkj->nij", offsets, offsets)
        ridge = PLANE_RIDGE * np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-12 * np.eye(2)
        slope = np.linalg.solve(squares + ridge, np.einsum("nki,nk->ni", offsets, inverse - mean[:, None])[..., None])[..., 0]
        fitted = mean + (slope * (pixels - middle)).sum(axis=1)
        depth = 1.0 / np.clip(fitted, inverse.min(axis=1), inverse.max(axis=1))
        return self.camera.lift(pixels.astype(float), depth + (0.0 if share == 1.0 else 0.5 * self.apart))


def facing(camera: Camera, nodes: np.ndarray) -> np.ndarray:
    """Pixel (x, y) and depth, m, [F, 3] of the visible nodes [N, 3].

    A node hides another within HIDDEN_BESIDE node spacings in the image that is HIDDEN_BEHIND spacings farther from the camera. A
    surface therefore hides itself at viewing angles below 20 degrees, atan of their ratio.
    """
    apart = spacing(nodes)
    pixels, depth = camera.project(nodes)
    ahead = depth > 0
    pixels, depth = pixels[ahead], depth[ahead]
    # HIDDEN_BESIDE node spacings at the depth of each node, pixels.
    reach = HIDDEN_BESIDE * apart * camera.intrinsics[0, 0] / np.maximum(depth, 1e-9)
    near = cKDTree(pixels).query_ball_point(pixels, reach)
    hidden = [bool((depth[others] < z - HIDDEN_BEHIND * apart).any()) for others, z in zip(near, depth, strict=True)]
    seen: np.ndarray = np.column_stack([pixels, depth])[~np.array(hidden, bool)]
    return seen
