"""A synthetic depth camera: a ray caster on Warp meshes, and a model of the sensor.

The ray caster renders color, depth along the optical axis, and labels: 0 table, 1 object, 2 hand. The sensor adds noise that grows
with distance and is correlated between neighboring pixels, dropouts at edges and on grazing surfaces, holes, and quantization.

Texture is a function of rest coordinates, so it moves with the material. Pixel centers have integer coordinates: x right, y down, z
forward (OpenCV). The table is the plane z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp
from scipy.sparse import coo_matrix

from neuspring.data.camera import Camera
from neuspring.scenes.rays import cast, on_cpu, shade_table

LIGHT = np.array([0.35, -0.45, 0.85]) / np.linalg.norm([0.35, -0.45, 0.85])
"""Unit vector towards the light."""
FARTHEST_HIT = 8.0
"""m. Surfaces farther away are background without depth."""
SUBPIXELS = np.array([[0.0, 0.0], [0.25, 0.25], [-0.25, 0.25], [0.25, -0.25]])
"""Positions within a pixel at which color is sampled; the first one also gives depth and label."""
GAMMA = 1.0 / 2.2
SKIN_COLOR = (0.75, 0.5, 0.4)
"""Linear RGB."""


@dataclass(frozen=True)
class Part:
    """One rendered mesh, its texture coordinates and its colors."""

    rest: np.ndarray
    """[V, 3], m: vertices at rest, the coordinates of the texture."""
    faces: np.ndarray
    """[F, 3]."""
    colors: np.ndarray
    """[V, 3] linear RGB."""
    label: int
    grain: tuple[float, float]
    """Spatial frequency, 1/m, and contrast of the fine texture."""


@dataclass(frozen=True)
class RenderedView:
    """The view of one camera in one frame."""

    color: np.ndarray
    """[H, W, 3] uint8 RGB."""
    depth: np.ndarray
    """[H, W] m along the optical axis; 0 where nothing is seen."""
    label: np.ndarray
    """[H, W] uint8."""
    slope: np.ndarray
    """[H, W] cosine between the surface normal and the ray."""


class Renderer:
    """Renders moving meshes on the CPU."""

    def __init__(self, parts: Sequence[Part]) -> None:
        counts = np.cumsum([0, *(len(part.rest) for part in parts)])
        self._faces = np.concatenate([part.faces + first for part, first in zip(parts, counts, strict=False)]).astype(np.int32)
        labels = np.concatenate([np.full(len(part.faces), part.label) for part in parts])
        grains = np.zeros((max(part.label for part in parts) + 1, 2))
        for part in parts:
            grains[part.label] = part.grain
        self._rest = on_cpu(np.concatenate([part.rest for part in parts]), wp.vec3)
        self._colors = on_cpu(np.concatenate([part.colors for part in parts]), wp.vec3)
        self._indices = on_cpu(self._faces.ravel(), wp.int32)
        self._labels = on_cpu(labels, wp.int32)
        self._grains = on_cpu(grains, wp.vec2)
        self._points = wp.zeros(int(counts[-1]), dtype=wp.vec3, device="cpu")
        self._normals = wp.zeros_like(self._points)
        self._offsets = on_cpu(SUBPIXELS, wp.vec2)
        self._mesh: wp.Mesh | None = None
        self._tables: dict[tuple[object, ...], wp.array] = {}
        corners = self._faces.T.ravel()
        owners = np.tile(np.arange(len(self._faces)), 3)
        self._sum_faces = coo_matrix((np.ones(len(corners)), (corners, owners)), shape=(int(counts[-1]), len(self._faces))).tocsr()

    def move(self, vertices: Sequence[np.ndarray]) -> None:
        """Set the vertices of every part, m."""
        points = np.concatenate(vertices).astype(np.float32)
        corners = points[self._faces]
        normals = self._sum_faces @ np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        self._points.assign(points)
        self._normals.assign(normals.astype(np.float32))
        if self._mesh is None:
            self._mesh = wp.Mesh(self._points, self._indices)
        else:
            self._mesh.refit()

    def render(self, camera: Camera) -> RenderedView:
        """Render the current view of `camera`."""
        assert self._mesh is not None, "call move() first"
        size = (camera.height, camera.width)
        color = wp.zeros((*size, 3), dtype=wp.uint8, device="cpu")
        depth, slope = (wp.zeros(size, dtype=wp.float32, device="cpu") for _ in range(2))
        label = wp.zeros(size, dtype=wp.uint8, device="cpu")
        k, pose = camera.intrinsics, wp.transform_from_matrix(wp.mat44(camera.camera_to_world))
        view = [pose, wp.vec2(k[0, 0], k[1, 1]), wp.vec2(k[0, 2], k[1, 2]), self._offsets]
        key = (camera.camera_to_world.tobytes(), k.tobytes(), size)
        if key not in self._tables:
            shades = wp.zeros((*size, len(SUBPIXELS)), dtype=wp.vec3, device="cpu")
            wp.launch(shade_table, shades.shape, [*view, FARTHEST_HIT, shades], device="cpu")
            self._tables[key] = shades
        arguments = [
            *(self._mesh.id, self._normals, self._rest, self._colors, self._indices, self._labels, self._grains),
            *(*view, self._tables[key], wp.vec3(*LIGHT), GAMMA, FARTHEST_HIT, color, depth, label, slope),
        ]
        wp.launch(cast, size, arguments, device="cpu")
        return RenderedView(color.numpy(), depth.numpy(), label.numpy(), slope.numpy())


NOISE_NEAR, NOISE_FAR = 0.0008, 0.0019
"""Standard deviation of depth, m: near + far (z - 0.4)^2, z in m (the form of Nguyen et al. 2012 for structured light)."""
CORRELATION = 1.2
"""Standard deviation of the blur that correlates the noise, pixels."""
EDGE_STEP = 0.02
"""m. Neighboring pixels whose depths differ by more are an edge."""
EDGE_LOSS = 0.6
"""Fraction of edge pixels without depth."""
GRAZING = 0.18
"""Cosine between normal and ray below which depth is lost."""
HOLES = 0.004
"""Fraction of the image in random holes."""
HOLE_SIZE = 2.5
"""Standard deviation of the blur that shapes the holes, pixels."""


def measured(depth: np.ndarray, slope: np.ndarray, unit: float, rng: np.random.Generator) -> np.ndarray:
    """Depth [H, W] as a sensor measures it: uint16 in units of `unit` m, 0 without a measurement.

    `depth` [H, W] is the truth, m, 0 for background; `slope` [H, W] is the cosine between surface normal and ray.
    """
    grain = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), CORRELATION)
    noise = grain / grain.std() * (NOISE_NEAR + NOISE_FAR * (depth - 0.4) ** 2)
    near, far = (operation(depth.astype(np.float32), np.ones((3, 3))) for operation in (cv2.erode, cv2.dilate))
    lost = (far - near > EDGE_STEP) & (rng.random(depth.shape) < EDGE_LOSS)
    lost |= slope < GRAZING
    blobs = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), HOLE_SIZE)
    lost |= blobs > np.quantile(blobs, 1.0 - HOLES)
    return quantized(np.where(lost | (depth <= 0), 0.0, depth + noise), unit)


def quantized(depth: np.ndarray, unit: float) -> np.ndarray:
    """Depth, m, as uint16 in units of `unit` m."""
    return np.clip(np.round(depth / unit), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera-to-world pose [4, 4], m: z towards the target, y down."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return pose
