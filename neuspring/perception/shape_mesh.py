"""A mesh of the object from any generator, in any pose and size -> the object as it lies in frame 0.

Poses are tried over all directions; the best few are refined by ICP with scale against the observed cloud, which is only a part of
the surface. Then the mesh is bent so that what the cameras see of it lies where it was seen, as smoothly as possible.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix, diags, identity
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import OBJECT, Camera, Capture
from neuspring.data.mesh_file import read_mesh
from neuspring.perception.results import Masks, ShapePrior

POSES = 24 * 8
REFINED = 6
"""Best poses that are refined to the end."""
ITERATIONS = 40
SAMPLES = 1500
"""Points of cloud and mesh that are compared."""
KEPT = 0.85
"""Share of the nearest pairs that a step uses; the rest are taken for outliers."""
STIFFNESS = 5.0
"""Weight of smoothness against data in the last, non-rigid step."""


def align(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """The mesh `settings.mesh`, placed on the cloud [P, 3], m, of frame 0. Raises InputError for unreadable or open meshes."""
    if settings.mesh is None:
        raise InputError("perception.shape.mesh", "backend: mesh needs a file", "null", "Name a GLB, PLY or OBJ file.")
    vertices, faces = read_mesh(Path(settings.mesh))
    placed, rms = place(vertices, faces, cloud)
    bent = bend(placed, faces, capture, masks, cloud, settings) if settings.bend else placed
    return ShapePrior(vertices=bent, faces=faces, backend="mesh", facts={"alignment_rms": rms})


def place(vertices: np.ndarray, faces: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """Vertices [V, 3], m, after the similarity that brings the mesh to the cloud, and the RMS distance of the cloud to it, m."""
    rng = np.random.default_rng(0)
    target = cloud[rng.permutation(len(cloud))[:SAMPLES]].astype(float)
    source = _sample(vertices, faces, SAMPLES, rng)
    centre = source.mean(axis=0)
    spread = (source - centre).std()
    unit = (source - centre) / spread
    tried = []
    # The cloud is a part of the surface, so its spread is a little less than the body's.
    scale = 1.05 * (target - target.mean(axis=0)).std()
    for rotation in Rotation.random(POSES, rng=rng):
        tried.append(_icp(unit, target, rotation, scale, target.mean(axis=0), ITERATIONS // 8))
    tried.sort(key=lambda fit: fit[0])
    fits = [_icp(unit, target, rotation, scale, shift, ITERATIONS) for _, rotation, scale, shift in tried[:REFINED]]
    rms, rotation, scale, shift = min(fits, key=lambda fit: fit[0])
    return scale * rotation.apply((vertices - centre) / spread) + shift, rms


def _icp(
    source: np.ndarray, target: np.ndarray, rotation: Rotation, scale: float, shift: np.ndarray, iterations: int
) -> tuple[float, Rotation, float, np.ndarray]:
    """Trimmed ICP over similarities: every target point looks for its nearest source point."""
    rms = np.inf
    for _ in range(iterations):
        moved = scale * rotation.apply(source) + shift
        distance, nearest = cKDTree(moved).query(target)
        kept = distance <= np.quantile(distance, KEPT)
        pairs, goals = source[nearest[kept]], target[kept]
        centre, goal = pairs.mean(axis=0), goals.mean(axis=0)
        rotation, _ = Rotation.align_vectors(goals - goal, pairs - centre)
        turned = rotation.apply(pairs - centre)
        scale = float(((goals - goal) * turned).sum() / max((turned**2).sum(), 1e-12))
        shift = goal - scale * rotation.apply(centre)
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
    """Vertices moved so that visible ones lie on the cloud and displacements are smooth: min |S (d - t)|^2 + k |L d|^2.

    Visible are the vertices whose pixel shows the object at about their depth in some camera; t points to the nearest of the cloud
    within `settings.bend_reach`.
    """
    seen = np.zeros(len(vertices), dtype=bool)
    for name, camera in capture.cameras.items():
        seen |= _visible(vertices, camera, masks[name].labels[0] == OBJECT, capture.depth(name, 0), settings.bend_reach)
    distance, nearest = cKDTree(cloud).query(vertices)
    held = seen & (distance < settings.bend_reach)
    wanted = np.where(held[:, None], cloud[nearest] - vertices, 0.0)
    laplacian = _laplacian(faces, len(vertices))
    data = diags(held.astype(float))
    system = (data + STIFFNESS * laplacian.T @ laplacian + 1e-6 * identity(len(vertices))).tocsc()
    return np.asarray(vertices + np.stack([spsolve(system, data @ wanted[:, k]) for k in range(3)], axis=1))


def _visible(vertices: np.ndarray, camera: Camera, mask: np.ndarray, depth: np.ndarray, reach: float) -> np.ndarray:
    pixels, distance = camera.project(vertices)
    found = camera.sees(pixels) & (distance > 0)
    x, y = np.round(pixels[found]).astype(int).T
    found[found] = mask[y, x] & (np.abs(depth[y, x] - distance[found]) < reach)
    return found


def _laplacian(faces: np.ndarray, count: int) -> coo_matrix:
    """Uniform graph Laplacian: identity minus the mean of the neighbours."""
    pairs = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    graph = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1.0)
    return identity(count) - diags(1.0 / degree) @ graph


def _sample(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Area-uniform points [count, 3] of the surface."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    return np.asarray(np.einsum("ns,nsc->nc", rng.dirichlet((1.0, 1.0, 1.0), count), corners[chosen]))
