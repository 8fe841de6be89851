"""The truth of a synthetic capture, which methods must not read: motion of every node, correspondences, materials, contact.

`under_pixels` and `at_points` give the motion of material points, with which perception is measured. The file is next to the
capture's folder, and the capture's provenance contains its digest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
import warp as wp

from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data.camera import Camera
from neuspring.data.capture import CAPTURE, Capture
from neuspring.extensions.synthetic.kernels import first_hit, nearest
from neuspring.scenes.rays import on_cpu


@dataclass(frozen=True, kw_only=True)
class Truth(Artifact):
    """The truth of one capture."""

    kind: ClassVar[str] = "truth"
    nodes: np.ndarray = array("T,N,3", np.float32, "m", "positions of the finite-element nodes")
    tetrahedra: np.ndarray = array("E,4", np.int32, "1", "elements of a solid; none for a sheet")
    triangles: np.ndarray = array("M,3", np.int32, "1", "elements of a sheet, or the fabric skin of a solid")
    youngs_modulus: np.ndarray = array("E", np.float32, "Pa", "of tetrahedra")
    membrane: np.ndarray = array("M", np.float32, "N/m", "in-plane stiffness of triangles")
    surface_nodes: np.ndarray = array("V,k", np.int32, "1", "nodes that each visible vertex follows")
    surface_weights: np.ndarray = array("V,k", np.float32, "1", "their weights")
    surface_faces: np.ndarray = array("F,3", np.int32, "1", "visible triangles")
    hand_poses: np.ndarray = array("T,H,7", np.float32, "m, 1", "position and quaternion (x, y, z, w) of each hand")
    held: np.ndarray = array("N", np.int32, "1", "the hand that holds each node; -1: none")
    touches: np.ndarray = array("T,N", np.bool_, "1", "whether a node touches the table")
    kinetic: np.ndarray = array("T", np.float32, "J", "kinetic energy")
    potential: np.ndarray = array("T", np.float32, "J", "potential energy")
    least_jacobian: np.ndarray = array("T", np.float32, "1", "smallest det F of an element")
    substeps: int
    """Substeps per frame."""
    certificate: float
    """Mean distance of nodes from the same clip with twice the substeps, m, in the worst frame."""
    sensitivity: float
    """Mean distance of nodes from the same clip with a start that is 1 um off, m, in the worst frame.

    No time step can predict the motion better."""

    def surface(self, frame: int) -> np.ndarray:
        """Visible vertices [V, 3], m, in one frame."""
        return np.asarray(np.einsum("vkc,vk->vc", self.nodes[frame][self.surface_nodes], self.surface_weights))


def truth_path(folder: Path) -> Path:
    """The path of the truth of the capture in `folder`."""
    folder = Path(folder).resolve()
    return folder.with_name(f"{folder.name}_truth.npz")


def truth_of(capture: Capture) -> Truth:
    """Load the truth of a synthetic capture. Raises InputError if there is none, or if it belongs to another capture."""
    path = truth_path(capture.folder)
    if not path.is_file():
        remedy = "Only synthetic scenes have a truth: choose other backends of perception.track and perception.shape."
        raise InputError(path, "the truth of a synthetic scene is required", "no such file", remedy)
    if capture.description.provenance.get("truth") != f"sha256:{digest_file(path)}":
        rule = f"must be the truth that {capture.folder / CAPTURE} names"
        raise InputError(path, rule, "that of another capture", "Delete both, and make the capture again.")
    return Truth.load(path)


FARTHEST_TRUTH = 8.0
"""m. Largest distance of a queried point from the mesh, or along a ray."""


@dataclass(frozen=True, eq=False)
class MaterialPoints:
    """Points of the visible surface, each bound to a triangle."""

    truth: Truth
    face: np.ndarray
    """[Q] index of the triangle, -1 for none."""
    weights: np.ndarray
    """[Q, 3] weights of the triangle's corners."""

    @cached_property
    def places(self) -> np.ndarray:
        """Positions [T, Q, 3], m, over time."""
        corners = self.truth.surface_faces[np.maximum(self.face, 0)]
        frames = range(len(self.truth.nodes))
        return np.stack([np.einsum("qk,qkc->qc", self.weights, self.truth.surface(frame)[corners]) for frame in frames])


def under_pixels(truth: Truth, camera: Camera, pixels: np.ndarray) -> MaterialPoints:
    """Surface points under the `pixels` (x, y) [Q, 2] in frame 0.

    Hands are ignored: a pixel that shows a hand gets the object behind it. Use the capture's masks to choose pixels.
    """
    origin = camera.camera_to_world[:3, 3]
    rays = camera.rays(pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return _ask(truth, first_hit, len(rays), wp.vec3(*origin), on_cpu(rays, wp.vec3))


def at_points(truth: Truth, points: np.ndarray) -> MaterialPoints:
    """The material nearest to `points` [Q, 3], m, in frame 0."""
    return _ask(truth, nearest, len(points), on_cpu(points, wp.vec3))


def _ask(truth: Truth, kernel: wp.Kernel, count: int, *where: object) -> MaterialPoints:
    indices = on_cpu(truth.surface_faces.astype(np.int32).ravel(), wp.int32)
    mesh = wp.Mesh(on_cpu(truth.surface(0), wp.vec3), indices)
    face = wp.empty(count, dtype=wp.int32, device="cpu")
    weights = wp.zeros(count, dtype=wp.vec3, device="cpu")
    wp.launch(kernel, count, [mesh.id, *where, FARTHEST_TRUTH, face, weights], device="cpu")
    return MaterialPoints(truth, np.asarray(face.numpy()), np.asarray(weights.numpy(), dtype=float))
