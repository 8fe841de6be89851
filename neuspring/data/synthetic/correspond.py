"""Where the material at a place of frame 0 goes: exact correspondences of a synthetic capture, to judge perception by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from neuspring.data.capture import Camera
from neuspring.data.synthetic.correspond_kernels import first_hit, nearest
from neuspring.data.synthetic.truth import Truth

FARTHEST = 8.0
"""m."""


@dataclass(frozen=True, eq=False)
class Material:
    """Points of the visible surface, each in a triangle."""

    truth: Truth
    face: np.ndarray
    """[Q], -1 where there is none."""
    weights: np.ndarray
    """[Q, 3] of the triangle's corners."""

    @cached_property
    def places(self) -> np.ndarray:
        """[T, Q, 3], m, over time."""
        corners = self.truth.surface_faces[np.maximum(self.face, 0)]
        frames = range(len(self.truth.nodes))
        return np.stack([np.einsum("qk,qkc->qc", self.weights, self.truth.surface(frame)[corners]) for frame in frames])


def under_pixels(truth: Truth, camera: Camera, pixels: np.ndarray) -> Material:
    """What lies under the `pixels` (x, y) [Q, 2] in frame 0.

    Hands are not looked at: a pixel that shows a hand gets the object behind it. Choose pixels by the capture's masks.
    """
    origin = camera.camera_to_world[:3, 3]
    rays = camera.lift(np.asarray(pixels, dtype=float), np.ones(len(pixels))) - origin
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return _ask(truth, first_hit, len(rays), wp.vec3(*origin), wp.array(rays, dtype=wp.vec3, device="cpu"))


def at_points(truth: Truth, points: np.ndarray) -> Material:
    """The material nearest to `points` [Q, 3], m, in frame 0."""
    return _ask(truth, nearest, len(points), wp.array(points, dtype=wp.vec3, device="cpu"))


def _ask(truth: Truth, kernel: wp.Kernel, count: int, *where: object) -> Material:
    indices: wp.array = wp.array(truth.surface_faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
    mesh = wp.Mesh(wp.array(truth.surface(0), dtype=wp.vec3, device="cpu"), indices)
    face: wp.array = wp.empty(count, dtype=wp.int32, device="cpu")
    weights: wp.array = wp.zeros(count, dtype=wp.vec3, device="cpu")
    wp.launch(kernel, count, [mesh.id, *where, FARTHEST, face, weights], device="cpu")
    return Material(truth, np.asarray(face.numpy()), np.asarray(weights.numpy(), dtype=float))
