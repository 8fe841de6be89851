"""Lifted tracks and shape prior -> observations: the structure points of a twin, one per voxel, and tracks for scoring.

Observed points come first, then points on the prior's surface, then points inside it (section 2.9 of the released processing, here
with a seed).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from neuspring.checks.space import SAME
from neuspring.config import ScenarioRow
from neuspring.config.perception import Perception, Sampling
from neuspring.core.artifacts import ImageObservations, Observations
from neuspring.core.geometry import on_table
from neuspring.data.capture import Capture
from neuspring.data.results import LiftedTracks, ShapePrior
from neuspring.intake.points import in_both, read, scenario_of, standing, taught_by
from neuspring.perception.film import PERCEPTION_SEED

SURFACE, INTERIOR = 1024, 10000
"""Points drawn on the prior's surface, and in its bounding box, of which those inside are kept; as released."""
GROWTH = 1.01
"""Ratio of the voxel sizes that are tried one after the other."""


def assemble(
    row: ScenarioRow,
    capture: Capture,
    lifted: LiftedTracks,
    prior: ShapePrior,
    settings: Perception,
    image: ImageObservations | None = None,
) -> Observations:
    """Observations for every method. Points that are invisible are zero. `image` is the evidence of color alone, of all tracks.

    Nodes that the capture brings take the place of those that are sampled. Annotated points that teach (`tracks: train`) and are
    seen in frame 0 come first, are seen in training frames, and have no place in the image.
    """
    up, space = capture.description.up_sign, read(capture)
    # In the image every node should have a track that is followed for long.
    followed = None if image is None else image.visible[: capture.train_end].sum(axis=0)
    if given := len(space.nodes):
        nodes = standing(space.nodes, up)[0] if row.ground else space.nodes
        rank = lifted.object_visibility[: capture.train_end].sum(axis=0) if followed is None else followed
        indices, kept = among(on_table(lifted.object_points[0], up), rank, nodes)
        surface, interior, voxel = nodes[kept], nodes[:0], spacing(nodes)
    else:
        indices, surface, interior, voxel = structure(lifted, prior, settings.sample, up, PERCEPTION_SEED, followed)
    visible, valid = lifted.object_visibility[:, indices], lifted.object_motion_valid[:, indices]
    points = np.where(visible[..., None], on_table(lifted.object_points[:, indices], up), 0.0)
    if image is not None:
        image = replace(image, pixels=image.pixels[:, indices], visible=image.visible[:, indices])
    marked, seen = taught_by(space.tracks, capture.train_end)
    if marked.shape[1]:
        apart = np.flatnonzero(cKDTree(marked[0]).query(points[0])[0] > SAME)
        marked = on_table(marked, up) if row.ground else marked
        points = np.concatenate([np.where(seen[..., None], marked, 0.0), points[:, apart]], axis=1)
        visible = np.concatenate([seen, visible[:, apart]], axis=1)
        valid = np.concatenate([in_both(seen), valid[:, apart]], axis=1)
        surface = surface[cKDTree(marked[0]).query(surface)[0] > SAME] if len(surface) else surface
        if image is not None:
            nowhere = np.zeros((*seen.shape, 2), np.float32)
            image = replace(
                image,
                pixels=np.concatenate([nowhere, image.pixels[:, apart]], axis=1),
                visible=np.concatenate([nowhere[..., 0] > 0, image.visible[:, apart]], axis=1),
            )
    origin = {"lift": lifted.backend, "shape prior": "given nodes" if given else prior.backend}
    if given or settings.sample.nodes is not None:
        origin["node spacing"] = f"{voxel:.6g} m"
    return Observations(
        scenario=scenario_of(row, capture, origin),
        object_points=points,
        object_visibility=visible,
        object_motion_valid=valid,
        controller_points=lifted.controller_points,
        controller_valid=lifted.controller_valid,
        controller_hand=space.hands.hand if space.hands else np.zeros(0, int),
        surface_points=surface,
        interior_points=interior,
        tracks=capture.tracks(),
        image=image,
    )


def structure(
    lifted: LiftedTracks, prior: ShapePrior, settings: Sampling, up: float, seed: int, rank: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Indices of the object tracks to keep [No], surface points [Ns, 3] and interior points [Ni, 3], m, and the voxel's side, m.

    Tracks with the same place in frame 0 count once, in lexicographic order of their places, those of the highest `rank` [Q] first
    where one is given. Every voxel holds one point; object
    before surface before interior. Its side is `settings.voxel`, or what `settings.nodes` needs. Points below the table are lifted
    to it.
    """
    start = on_table(lifted.object_points[0], up)
    _, unique = np.unique(start, axis=0, return_index=True)
    if rank is not None:
        unique = unique[np.argsort(-rank[unique], kind="stable")]
    surface, interior = np.zeros((0, 3)), np.zeros((0, 3))
    if len(prior.faces):
        rng = np.random.default_rng(seed)
        surface = on_table(on_surface(prior.vertices, prior.faces, SURFACE, rng), up)
        box = rng.uniform(prior.vertices.min(axis=0), prior.vertices.max(axis=0), (INTERIOR, 3))
        interior = on_table(box[inside(prior, box)], up)
    everything = np.concatenate([start[unique], surface, interior])
    voxel = settings.voxel if settings.nodes is None else voxel_for(everything, settings.nodes, settings.voxel)
    first_of_cell = np.zeros(len(everything), dtype=bool)
    first_of_cell[np.unique(cells_of(everything, voxel), axis=0, return_index=True)[1]] = True
    own, outer, inner = np.split(first_of_cell, np.cumsum([len(unique), len(surface)]))
    return unique[own], surface[outer], interior[inner], voxel


def spacing(nodes: np.ndarray) -> float:
    """Distance from a node [N, 3] to the next, m (median)."""
    return float(np.median(cKDTree(nodes).query(nodes, k=2)[0][:, 1]))


def among(points: np.ndarray, rank: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which tracked points [n, 3] become nodes, and which of the given nodes [N, 3] stay: indices, and [N] bool.

    Of points nearer to each other than nodes are, that of the highest `rank` [n] stays. A node gives way to a point within half of
    that distance: together they are as dense as the nodes alone.
    """
    apart, chosen = spacing(nodes), np.zeros(0, int)
    for number in np.argsort(-rank, kind="stable"):
        if not len(chosen) or np.linalg.norm(points[chosen] - points[number], axis=1).min() >= apart:
            chosen = np.append(chosen, number)
    away = cKDTree(points[chosen]).query(nodes)[0] if len(chosen) else np.full(len(nodes), np.inf)
    return chosen, away >= 0.5 * apart


def cells_of(points: np.ndarray, voxel: float) -> np.ndarray:
    """The voxel of each point, [n, 3] whole numbers from the lowest corner on."""
    cells: np.ndarray = np.floor((points - points.min(axis=0)) / voxel).astype(int)
    return cells


def voxel_for(points: np.ndarray, most: int, least: float) -> float:
    """The smallest of the sides `least` GROWTH^k, k = 0, 1, 2, ..., m, at which points [n, 3] lie in at most `most` voxels.

    The number of voxels does not quite fall with their side. Trying one after the other, more voxels never make a larger side.
    """
    for step in count():
        voxel = least * GROWTH**step
        cells = cells_of(points, voxel)
        size = cells.max(axis=0) + 1
        if len(np.unique(np.ravel_multi_index(tuple(cells.T), tuple(size)))) <= most:
            break
    return voxel


def on_surface(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [count, 3] of a mesh, uniform by area."""
    corners = vertices[faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    return np.asarray(np.einsum("ns,nsc->nc", rng.dirichlet((1.0, 1.0, 1.0), count), corners[face]))


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def winding(mesh: wp.uint64, points: wp.array[wp.vec3], reach: float, inside: wp.array[bool]):  # type: ignore[no-untyped-def]
    """True where each point lies inside the closed mesh; `reach` bounds the search, m."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    inside[i] = query.result and query.sign < 0.0  # type: ignore[index,attr-defined]


def inside(prior: ShapePrior, points: np.ndarray) -> np.ndarray:
    """True where points [n, 3] lie inside the closed surface [n], by its winding number."""
    indices: wp.array = wp.array(prior.faces.ravel(), dtype=wp.int32, device="cpu")
    mesh = wp.Mesh(wp.array(prior.vertices, dtype=wp.vec3, device="cpu"), indices, support_winding_number=True)
    result = wp.zeros(len(points), dtype=wp.bool, device="cpu")
    reach = float(np.ptp(prior.vertices, axis=0).max()) * 2.0
    wp.launch(winding, len(points), [mesh.id, wp.array(points, dtype=wp.vec3, device="cpu"), reach, result], device="cpu")
    return np.asarray(result.numpy())
