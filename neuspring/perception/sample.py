"""Lifted tracks and shape prior -> observations: the nodes of a twin, one per voxel, and tracks for scores.

Observed points come first, then points on the prior's surface, then points inside it, as in section 2.9 of PhysTwin's released
processing; here with a seed.
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
"""Numbers of points sampled on the prior's surface and in its bounding box, as released; only inner points are kept."""
GROWTH = 1.01
"""Ratio of successive voxel sizes in `voxel_for`."""


def assemble(
    row: ScenarioRow,
    capture: Capture,
    lifted: LiftedTracks,
    prior: ShapePrior,
    settings: Perception,
    image: ImageObservations | None = None,
) -> Observations:
    """Observations for all methods; invisible points are zero. `image`: evidence of a color camera without depth, for all tracks.

    Nodes of the capture replace sampled ones. Annotated points for training (`tracks: train`) that are visible in frame 0 come
    first; they are visible only in training frames, and have no position in the image.
    """
    up, space = capture.description.up_sign, read(capture)
    # Without depth, nodes should have long tracks.
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
    """Indices of the kept object tracks [No], surface points [Ns, 3] and interior points [Ni, 3], m, and the voxel size, m.

    Each voxel keeps one point: object before surface before interior. Tracks with the same position in frame 0 count once. They
    are in lexicographic order of their positions, or by decreasing `rank` [Q]. The voxel size is `settings.voxel`, or follows
    from `settings.nodes`. Points below the table are lifted to it.
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
    """Median distance of the nodes [N, 3] to their nearest neighbors, m."""
    return float(np.median(cKDTree(nodes).query(nodes, k=2)[0][:, 1]))


def among(points: np.ndarray, rank: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the tracked points [n, 3] that become nodes, and [N] bool for the given nodes [N, 3] that stay.

    Chosen points are at least the node spacing apart; points of higher `rank` [n] are chosen first. A node closer to a chosen
    point than half the spacing is removed, so that the density stays the same.
    """
    apart, chosen = spacing(nodes), np.zeros(0, int)
    for number in np.argsort(-rank, kind="stable"):
        if not len(chosen) or np.linalg.norm(points[chosen] - points[number], axis=1).min() >= apart:
            chosen = np.append(chosen, number)
    away = cKDTree(points[chosen]).query(nodes)[0] if len(chosen) else np.full(len(nodes), np.inf)
    return chosen, away >= 0.5 * apart


def cells_of(points: np.ndarray, voxel: float) -> np.ndarray:
    """Integer voxel indices [n, 3] of points, counted from the lowest corner."""
    cells: np.ndarray = np.floor((points - points.min(axis=0)) / voxel).astype(int)
    return cells


def voxel_for(points: np.ndarray, most: int, least: float) -> float:
    """Smallest voxel size `least` GROWTH^k, k = 0, 1, 2, ..., m, at which points [n, 3] occupy at most `most` voxels.

    The number of voxels is not monotone in their size. Testing the sizes in order guarantees that a larger `most` never gives a
    larger size.
    """
    for step in count():
        voxel = least * GROWTH**step
        cells = cells_of(points, voxel)
        size = cells.max(axis=0) + 1
        if len(np.unique(np.ravel_multi_index(tuple(cells.T), tuple(size)))) <= most:
            break
    return voxel


def on_surface(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Sample points [count, 3] on a mesh, uniform by area."""
    corners = vertices[faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    return np.asarray(np.einsum("ns,nsc->nc", rng.dirichlet((1.0, 1.0, 1.0), count), corners[face]))


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def winding(mesh: wp.uint64, points: wp.array[wp.vec3], reach: float, inside: wp.array[bool]):  # type: ignore[no-untyped-def]
    """True for points inside the closed mesh; `reach` bounds the search, m."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    inside[i] = query.result and query.sign < 0.0  # type: ignore[index,attr-defined]


def inside(prior: ShapePrior, points: np.ndarray) -> np.ndarray:
    """True for points [n, 3] inside the closed surface, by its winding number."""
    indices: wp.array = wp.array(prior.faces.ravel(), dtype=wp.int32, device="cpu")
    mesh = wp.Mesh(wp.array(prior.vertices, dtype=wp.vec3, device="cpu"), indices, support_winding_number=True)
    result = wp.zeros(len(points), dtype=wp.bool, device="cpu")
    reach = float(np.ptp(prior.vertices, axis=0).max()) * 2.0
    wp.launch(winding, len(points), [mesh.id, wp.array(points, dtype=wp.vec3, device="cpu"), reach, result], device="cpu")
    return np.asarray(result.numpy())
