"""Where the material under a pixel of frame 0 goes: exact correspondences of a synthetic capture, to judge perception by."""

from __future__ import annotations

import numpy as np
import warp as wp

from neuspring.data.capture import Camera
from neuspring.data.synthetic.render_kernels import first_hit
from neuspring.data.synthetic.truth import Truth

FARTHEST = 8.0
"""m."""


def follow_pixels(truth: Truth, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [T, Q, 3], m, that lie under the `pixels` (x, y) [Q, 2] in frame 0, and whether there is one [Q] bool.

    Hands are not looked at: a pixel that shows a hand gets the object behind it. Choose pixels by the capture's masks.
    """
    face, weights = _hits(truth, camera, pixels)
    hit = face >= 0
    corners = truth.surface_faces[np.maximum(face, 0)]
    points = np.stack([np.einsum("qk,qkc->qc", weights, truth.surface(frame)[corners]) for frame in range(len(truth.nodes))])
    return points, hit


def _hits(truth: Truth, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first triangle [Q] that each pixel's ray meets in frame 0, -1 where none, and barycentric weights [Q, 3]."""
    count, faces = len(pixels), truth.surface_faces.astype(np.int32)
    mesh = wp.Mesh(wp.array(truth.surface(0), dtype=wp.vec3, device="cpu"), wp.array(faces.ravel(), dtype=wp.int32, device="cpu"))
    origin = camera.camera_to_world[:3, 3]
    rays = camera.lift(np.asarray(pixels, dtype=float), np.ones(count)) - origin
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    face = wp.empty(count, dtype=wp.int32, device="cpu")
    weights = wp.zeros(count, dtype=wp.vec3, device="cpu")
    arguments = [mesh.id, wp.vec3(*origin), wp.array(rays, dtype=wp.vec3, device="cpu"), FARTHEST, face, weights]
    wp.launch(first_hit, count, arguments, device="cpu")
    return np.asarray(face.numpy()), np.asarray(weights.numpy(), dtype=float)
