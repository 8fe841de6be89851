"""Nodes of frame 0 that a capture brings (intake/points.py) take the place of a supposed shape: they say how deep what the camera
sees is, and are the nodes of the twin."""

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
"""Front nodes around a pixel that say how deep it is."""
PLANE_RIDGE = 1e-3
"""Ridge of the planes through them, a share of their spread in the image squared: nodes in one line have no slope across it."""


HIDDEN_BESIDE, HIDDEN_BEHIND = 0.75, 2.0
"""Distances of neighboring nodes within which one hides another: less, and it is seen between them; how far behind it lies."""


@dataclass(frozen=True)
class GivenFrame(FirstFrame):
    """Place of the object in frame 0, by its nodes."""

    front: np.ndarray
    """Pixels (x, y) [F, 2] and depth, m, of the nodes that no other hides: [F, 3]."""
    apart: float
    """Distance between neighboring nodes, m (median)."""

    @classmethod
    def by(cls, capture: Capture, labels: np.ndarray, nodes: np.ndarray) -> GivenFrame:
        """From the labels [H, W] of frame 0 and nodes [N, 3], m. Raises InputError where none lies in front of the camera."""
        camera = next(iter(capture.cameras.values()))
        front, apart = facing(camera, nodes), spacing(nodes)
        if not len(front):
            raise InputError(f"{capture.folder}, nodes", "nodes of frame 0 must lie in front of the camera", "none")
        size = float(np.median(front[:, 2])) / camera.intrinsics[0, 0]
        filled = beneath_hands(labels, BENEATH / size)
        none = np.zeros(labels.shape)
        return cls(camera, capture.description.up_sign, "given nodes", filled, none, none, size, {}, front, apart)

    def _lifted(self, pixels: np.ndarray, share: float) -> np.ndarray:
        """On the surface (share 1), else half a distance of nodes beneath it.

        The surface is a plane through the nodes around, by least squares: 1 / depth is affine in the image, 1 / z = a + b . (u - m)
        with the mean pixel m of the nodes. Depth stays between theirs.
        """
        near = cKDTree(self.front[:, :2]).query(pixels, k=np.arange(1, min(PLANE_NODES, len(self.front)) + 1))[1]
        around, inverse = self.front[near, :2], 1.0 / self.front[near, 2]
        middle, mean = around.mean(axis=1), inverse.mean(axis=1)
        offsets = around - middle[:, None]
        squares = np.einsum("nki,nkj->nij", offsets, offsets)
        ridge = PLANE_RIDGE * np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-12 * np.eye(2)
        slope = np.linalg.solve(squares + ridge, np.einsum("nki,nk->ni", offsets, inverse - mean[:, None])[..., None])[..., 0]
        found = mean + (slope * (pixels - middle)).sum(axis=1)
        depth = 1.0 / np.clip(found, inverse.min(axis=1), inverse.max(axis=1))
        return self.camera.lift(pixels.astype(float), depth + (0.0 if share == 1.0 else 0.5 * self.apart))


def facing(camera: Camera, nodes: np.ndarray) -> np.ndarray:
    """Pixels (x, y) and depth, m, [F, 3] of the nodes [N, 3] that no other hides.

    A node is hidden by one that is HIDDEN_BEHIND distances of neighboring nodes nearer to the camera, and appears within
    HIDDEN_BESIDE of one: a surface hides itself where the camera sees it at less than 20 degrees, atan of their ratio.
    """
    apart = spacing(nodes)
    pixels, depth = camera.project(nodes)
    ahead = depth > 0
    pixels, depth = pixels[ahead], depth[ahead]
    # At one depth, a step of `apart` sideways is as many pixels.
    reach = HIDDEN_BESIDE * apart * camera.intrinsics[0, 0] / np.maximum(depth, 1e-9)
    near = cKDTree(pixels).query_ball_point(pixels, reach)
    hidden = [bool((depth[others] < z - HIDDEN_BEHIND * apart).any()) for others, z in zip(near, depth, strict=True)]
    seen: np.ndarray = np.column_stack([pixels, depth])[~np.array(hidden, bool)]
    return seen
