"""A mesh of the object from any generator, in any pose and size -> the object as it lies in frame 0.

Poses over all directions are tried. The best few are refined by ICP with scale against the observed cloud, which is only a part of
the surface. Then the mesh is bent, as smoothly as possible, so that its visible part lies where the cameras saw it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse import diags, identity
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.results import Masks, ShapePrior
from neuspring.perception.sample import on_surface
from neuspring.perception.shape import seen

POSES = 24 * 8
REFINED = 6
"""Best poses that are refined to the end."""
ITERATIONS = 40
SAMPLES = 1500
"""Points of cloud and mesh that are compared."""
INLIERS = 0.85
"""Share of the nearest pairs that a step uses; the rest count as outliers."""
BEND_REACH = 0.02
"""Largest distance, m, of a visible vertex from the cloud that it is moved onto."""
STIFFNESS = 5.0
"""Weight of smoothness against data in the last, non-rigid step."""

Fit = tuple[float, Rotation, float, np.ndarray]
"""RMS distance, m, and the similarity: rotation, scale, shift."""


def align(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """The mesh `settings.mesh`, placed on the cloud [P, 3], m, of frame 0. Raises InputError for unreadable or open meshes."""
    if settings.mesh is None:
        raise InputError("perception.shape.mesh", "backend: mesh needs a file", "null", "Name a GLB, PLY or OBJ file.")
    vertices, faces = read_mesh(Path(settings.mesh))
    vertices, rms = place(vertices, faces, cloud)
    if settings.bend:
        vertices = bend(vertices, faces, capture, masks, cloud, settings)
    return ShapePrior(vertices=vertices, faces=faces, backend="mesh", facts={"alignment_rms": rms})


def place(vertices: np.ndarray, faces: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """Vertices [V, 3], m, after the similarity that brings the mesh to the cloud, and the RMS distance of the cloud to it, m."""
    rng = np.random.default_rng(0)
    target = cloud[rng.permutation(len(cloud))[:SAMPLES]].astype(float)
    source = on_surface(vertices, faces, SAMPLES, rng)
    center = source.mean(axis=0)
    spread = (source - center).std()
    unit = (source - center) / spread
    middle = target.mean(axis=0)
    # The cloud is a part of the surface, so its spread is a little less than the body's.
    scale = 1.05 * (target - middle).std()
    coarse = [_icp(unit, target, turn, scale, middle, ITERATIONS // 8) for turn in Rotation.random(POSES, rng=rng)]
    coarse.sort(key=lambda fit: fit[0])
    fits = [_icp(unit, target, turn, size, shift, ITERATIONS) for _, turn, size, shift in coarse[:REFINED]]
    rms, rotation, scale, shift = min(fits, key=lambda fit: fit[0])
    return scale * rotation.apply((vertices - center) / spread) + shift, rms


def _icp(source: np.ndarray, target: np.ndarray, rotation: Rotation, scale: float, shift: np.ndarray, iterations: int) -> Fit:
    """Trimmed ICP over similarities: every target point looks for its nearest source point."""
    rms = np.inf
    for _ in range(iterations):
        distance, nearest = cKDTree(scale * rotation.apply(source) + shift).query(target)
        inlier = distance <= np.quantile(distance, INLIERS)
        pairs, goals = source[nearest[inlier]], target[inlier]
        center, goal = pairs.mean(axis=0), goals.mean(axis=0)
        rotation, _ = Rotation.align_vectors(goals - goal, pairs - center)
        turned = rotation.apply(pairs - center)
        scale = float(((goals - goal) * turned).sum() / max((turned**2).sum(), 1e-12))
        shift = goal - scale * rotation.apply(center)
        rms = float(np.sqrt((distance**2).mean()))
    return rms, rotation, scale, shift


def bend(
    vertices: np.ndarray,
    faces: np.ndarray,
    capture: Capture,
    masks: Mapping[str, Masks],
    cloud: np.ndarray,
    settings: ShapePriorSettings,
) -> np.ndarray:
    """Vertices moved by displacements d [V, 3], m, with the least |S (d - t)|^2 + k |L d|^2.

    S selects the visible vertices: those whose pixel shows the object at about their depth in some camera. t points to the nearest
    point of the cloud, within BEND_REACH. L is the uniform graph Laplacian, k the stiffness. (`nricp_amberg` of trimesh
    is no substitute: it pulls hidden vertices as well and fails where no point of the cloud is near enough.)
    """
    visible = seen(vertices, capture, masks, BEND_REACH)
    distance, nearest = cKDTree(cloud).query(vertices)
    pulled = visible & (distance < BEND_REACH)
    target = np.where(pulled[:, None], cloud[nearest] - vertices, 0.0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    laplacian = identity(len(vertices)) - trimesh.smoothing.laplacian_calculation(mesh)
    data = diags(pulled.astype(float))
    system = (data + STIFFNESS * laplacian.T @ laplacian + 1e-6 * identity(len(vertices))).tocsc()
    return np.asarray(vertices + np.stack([spsolve(system, data @ target[:, k]) for k in range(3)], axis=1))


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and outward faces [F, 3] of the file's whole geometry as one closed surface.

    Raises InputError for a file that is missing, unreadable, empty, not finite or not closed.
    """
    if not Path(path).is_file():
        raise InputError(path, "this mesh must exist", "no such file")
    try:
        mesh = trimesh.load_mesh(path, process=True, maintain_order=False)
    except Exception as error:
        # trimesh's readers have no common exception for damaged bytes.
        raise InputError(
            path, "this file must be a readable mesh (GLB, PLY, OBJ, STL)", f"{type(error).__name__}: {error}"
        ) from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(path, "at least one triangle is required", "none")
    # Textured exports split vertices along seams.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not np.isfinite(mesh.vertices).all():
        raise InputError(path, "every vertex must be finite", "a vertex that is not")
    if not mesh.is_watertight:
        remedy = "Close it in a mesh editor; points are drawn inside it."
        raise InputError(path, "the surface must be closed", f"{len(mesh.faces)} triangles with open or branching edges", remedy)
    trimesh.repair.fix_normals(mesh)
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=int)
