"""Shape prior: the surface that no camera sees in frame 0, as a visual hull, a given mesh, or none.

**Visual hull.** A voxel above the table belongs to the hull if no camera with the object in view contradicts it, and at least one
camera shows the object there. A camera contradicts a voxel if its mask shows neither the object nor an occluding hand, or if it
measured depth behind the voxel. The second condition excludes hands that all cameras see.

**One camera.** If only one camera shows the object, mask pixels without depth carve with the nearest depth in the mask, and the
back is guessed. All depths are along the optical axis, m. The local width of a silhouette at a pixel is the diameter 2 r of the
largest inscribed disc that covers the pixel. At a distance d from the edge, a round body of that width has the thickness

    c(d) = 2 sqrt(r^2 - (r - d)^2)

The back is 2 middle - seen. `middle` is a harmonic surface over the silhouette with the values seen + c / 2 on the rim. A plane
perpendicular to the view is worse, because objects are oblique to it.

**Mesh.** A mesh of the object in any pose and size is aligned with frame 0. Initial poses cover all rotations; the best few are
refined by ICP with scale against the observed cloud, which is only part of the surface. Then a smooth deformation moves the
visible part of the mesh onto the cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
import warp as wp
from scipy import ndimage
from scipy.sparse import coo_matrix, diags, identity
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from warp.geometry import IsoSurfaceMarchingCubes

from neuspring.config.perception import ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, NOTHING, OBJECT, THIN, Capture
from neuspring.data.results import Masks, ShapePrior
from neuspring.perception.backends import TRACKERS
from neuspring.perception.sample import on_surface

CARVED_MARGIN = 0.02
"""m: margin of the carved volume around the cloud of frame 0."""
CARVING_TOLERANCE = 0.004
"""m: a voxel is carved if measured depth is more than this behind it."""
HULL_VOXEL = 0.003
"""Voxel size of the visual hull, m: a few depth pixels at a typical distance."""
HULL_SMOOTHING = 1.0
"""Width of the smoothing of the hull, voxels."""
SEEN_WITHIN = 4.0
"""Voxels: a vertex within this distance of measured depth counts as seen. Carving and smoothing move a surface by less."""
MASK_BORDER = 3
"""Width of a silhouette's rim, pixels; depth is unreliable at its outermost pixel."""
LEAST_THICKNESS = 0.006
"""m: smallest thickness of the object."""
POSES = 24 * 8
REFINED = 24
"""Number of best poses that are refined. With 6, one in 16 rotations of a flat object ends in a wrong pose."""
ITERATIONS = 40
COMPARED_SURFACE = 1500
"""Largest number of points of cloud and of mesh in ICP."""
INLIERS = 0.85
"""Fraction of the nearest pairs that an ICP step uses; the rest are outliers."""
BEND_REACH = 0.02
"""m: visible vertices farther than this from the cloud are not moved onto it."""
MISFIT, LEAST_MISFIT = 0.03, 0.008
"""Largest accepted RMS distance of the cloud from an aligned mesh, as a fraction of the cloud's length, and at least this, m.
The true surface of the demo's sloth has 0.018, in a wrong pose 0.034; a box, the sloth with a floor or with a ball 0.048 to
0.065."""
LARGEST_RATIO, LOWEST_VERTEX = 1.35, -0.03
"""Largest accepted ratio of the lengths of mesh and cloud, and lowest accepted vertex, m above the table."""
SEAM = 2e-5
"""Vertices closer than this fraction of a mesh's length are merged."""
STIFFNESS = 5.0
"""Weight of smoothness against data in the last, non-rigid step."""

Fit = tuple[float, Rotation, float, np.ndarray]
"""RMS distance, m, and the similarity: rotation, scale, translation."""


def shape_prior(
    capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings, end: np.ndarray | None = None
) -> ShapePrior:
    """Compute the prior by the backend of `settings`, with the fraction of its surface that no camera saw.

    `cloud` [P, 3], m: visible points of the object in frame 0. `end` [H, W], m: depth of the back for one camera, in place of
    `settings.back`.
    """
    backend = settings.backend
    if backend == "auto":
        backend = "none" if capture.description.category in THIN else "visual_hull"
    if backend == "mesh":
        prior = align(capture, masks, cloud, settings)
    elif backend == "truth":
        prior = TRACKERS["truth"].surface(capture)
    else:
        prior = visual_hull(capture, masks, cloud, settings, end) if backend == "visual_hull" else no_prior()
    if not len(prior.faces):
        return prior
    was_seen = seen(prior.vertices, capture, masks, SEEN_WITHIN * HULL_VOXEL, prior.faces)
    # The invented area of a face is the fraction of its unseen corners.
    corners = prior.vertices[prior.faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = float((area * (~was_seen[prior.faces]).mean(axis=1)).sum() / area.sum())
    return replace(prior, seen=was_seen, facts={**prior.facts, "invented_share": share})


def no_prior() -> ShapePrior:
    """The empty prior: the twin has only observed points."""
    return ShapePrior(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), dtype=int), backend="none")


def visual_hull(
    capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings, end: np.ndarray | None = None
) -> ShapePrior:
    """Carve the visual hull around the object's `cloud` [P, 3], m, in frame 0; `end` as in `shape_prior`.

    Raises InputError if no voxel remains.
    """
    # A camera without the object in view gives no evidence.
    showing = [name for name in capture.cameras if (masks[name].labels[0] == OBJECT).any()]
    # Measured depth by camera, and the depth of a guessed back.
    sides: dict[str, tuple[np.ndarray, np.ndarray | None]] = {name: (capture.depth(name, 0), None) for name in showing}
    space, facts = cloud, dict[str, float]()
    if len(showing) == 1:
        camera, labels = capture.cameras[showing[0]], masks[showing[0]].labels[0]
        filled, guessed = one_sided(camera, labels, sides[camera.name][0], cloud, settings)
        end = guessed if end is None else end
        facts["depth_filled"] = float((filled != sides[camera.name][0])[labels == OBJECT].mean())
        sides[camera.name] = (filled, end)
        if end is not None:
            y, x = np.nonzero(labels == OBJECT)
            space = np.concatenate([cloud, camera.lift(np.stack([x, y], axis=1).astype(float), end[y, x])])
    low, high = space.min(axis=0) - CARVED_MARGIN, space.max(axis=0) + CARVED_MARGIN
    counts = np.ceil((high - low) / HULL_VOXEL).astype(int) + 1
    # Voxel centers [nx, ny, nz, 3].
    grid = low + HULL_VOXEL * np.moveaxis(np.indices(counts), 0, -1)
    hull = capture.description.up_sign * grid[..., 2] > 0
    shown = np.zeros_like(hull)
    for name in showing:
        admitted, shows = _consistent(grid, capture.cameras[name], masks[name].labels[0], *sides[name], CARVING_TOLERANCE)
        hull, shown = hull & admitted, shown | shows
    hull = _largest_piece(hull & shown)
    vertices, faces = _surface(hull, low, HULL_VOXEL, HULL_SMOOTHING)
    if not len(faces):
        rule = f"some voxels of {1e3 * HULL_VOXEL:g} mm must be consistent with all cameras"
        remedy = "Check masks, depth and calibration of frame 0, which disagree, or set perception.shape.backend: none."
        raise InputError(f"{capture.folder}, visual hull", rule, f"{hull.sum()} voxels", remedy)
    facts |= {"volume": float(hull.sum() * HULL_VOXEL**3), "cameras": len(showing)}
    backend = "visual_hull" if len(showing) > 1 else f"visual_hull, back: {settings.back}"
    return ShapePrior(vertices=vertices, faces=faces, backend=backend, facts=facts)


def one_sided(
    camera: Camera, labels: np.ndarray, depth: np.ndarray, cloud: np.ndarray, settings: ShapePriorSettings
) -> tuple[np.ndarray, np.ndarray | None]:
    """Depth of the visible surface without holes and of the back, [H, W], m; None if the back is not guessed."""
    distance = camera.project(cloud)[1]
    # Depth far in front of or behind all usable points is background or noise.
    near, far = float(distance.min()) - CARVED_MARGIN, float(distance.max()) + CARVED_MARGIN
    filled = np.where(labels == OBJECT, front(labels == OBJECT, depth, near, far), depth)
    if settings.back == "none":
        return filled, None
    return filled, back(labels, filled, camera.intrinsics[0, 0])


def _consistent(
    grid: np.ndarray, camera: Camera, labels: np.ndarray, depth: np.ndarray, end: np.ndarray | None, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Voxels [nx, ny, nz] bool that do not contradict one camera, and voxels where it shows the object itself.

    Voxels behind the object's `end` [H, W], m, contradict the camera.
    """
    pixels, distance = camera.project(grid.reshape(-1, 3))
    admitted, shows = np.ones(len(distance), dtype=bool), np.zeros(len(distance), dtype=bool)
    ahead = np.flatnonzero(camera.sees(pixels) & (distance > 0))
    x, y = np.round(pixels[ahead]).astype(int).T
    label, measured = labels[y, x], depth[y, x]
    behind = (measured <= 0) | (distance[ahead] >= measured - tolerance)
    if end is not None:
        behind &= (label != OBJECT) | (distance[ahead] <= end[y, x])
    admitted[ahead] = behind & (label != NOTHING)
    shows[ahead] = behind & (label == OBJECT)
    return admitted.reshape(grid.shape[:-1]), shows.reshape(grid.shape[:-1])


def _largest_piece(voxels: np.ndarray) -> np.ndarray:
    labels, count = ndimage.label(voxels)
    return voxels if count < 2 else np.asarray(labels == np.bincount(labels[voxels]).argmax())


def _surface(voxels: np.ndarray, low: np.ndarray, voxel: float, smoothing: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface by marching cubes of the padded occupancy, blurred over `smoothing` voxels."""
    level = 0.5 - ndimage.gaussian_filter(np.pad(voxels.astype(np.float32), 2), smoothing)
    values: wp.array = wp.array(level, dtype=wp.float32, device="cpu")
    vertices, indices = IsoSurfaceMarchingCubes.extract_surface_marching_cubes(values, 0.0)  # type: ignore[arg-type]
    faces = indices.numpy().reshape(-1, 3)
    points = low + voxel * (vertices.numpy().astype(float) - 2.0)
    corners = points[faces]
    volume = (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum()
    return points, faces if volume > 0 else faces[:, ::-1].copy()


def front(mask: np.ndarray, depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth of the visible surface [H, W]; zero outside `mask` [H, W], and everywhere without usable depth.

    A mask pixel whose depth is not between `near` and `far` gets the depth of the nearest usable mask pixel.
    """
    usable = mask & (depth > near) & (depth < far)
    if not usable.any():
        return np.zeros(depth.shape)
    nearest = ndimage.distance_transform_edt(~usable, return_distances=False, return_indices=True)
    return np.where(mask, depth[tuple(nearest)], 0.0)


def back(labels: np.ndarray, seen: np.ndarray, focal: float) -> np.ndarray:
    """Depth of the back [H, W] from labels [H, W], the `seen` surface [H, W] and the focal length, pixels; zero outside."""
    mask = labels == OBJECT
    chord = round_chord(mask) * seen / focal
    # Continues the object outside the mask, so that the median filter at the rim reads only its depth.
    extended = front(np.ones_like(mask), np.where(mask, seen, 0.0), 0.0, np.inf)
    smooth = cv2.medianBlur(extended.astype(np.float32), 5).astype(float)
    rim = mask & _grown(labels == NOTHING, MASK_BORDER) & ~_grown(labels >= HANDS, MASK_BORDER + 1)
    if not rim.any():
        rim = mask & _grown(~mask, MASK_BORDER)
    thickness = 2.0 * (_spanned(smooth + 0.5 * chord, rim, mask) - smooth)
    return np.where(mask, seen + np.maximum(thickness, LEAST_THICKNESS), 0.0)


def round_chord(mask: np.ndarray) -> np.ndarray:
    """Thickness c(d) of a round object [H, W], pixels, from its silhouette `mask` [H, W]; zero outside it."""
    centers, radii, distance = discs(mask)
    radius = np.ascontiguousarray(distance)
    # Larger discs are drawn over smaller ones.
    for (x, y), own in zip(centers.tolist(), radii.tolist(), strict=True):
        cv2.circle(radius, (x, y), int(own), own, -1)
    radius = np.maximum(radius, distance)
    return np.where(mask, 2.0 * np.sqrt(np.maximum(distance * (2.0 * radius - distance), 0.0)), 0.0)


def discs(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Largest discs inside a silhouette `mask` [H, W]: centers (x, y) [n, 2], radii [n], and the distance transform [H, W],
    pixels.

    Centers are on the ridges of the distance from the edge, which is the radius. Radii increase.
    """
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.nonzero(mask & (distance >= ndimage.maximum_filter(distance, 3) - 0.5))
    order = np.argsort(distance[y, x], kind="stable")
    return np.stack([x, y], axis=1)[order], distance[y, x][order], distance


def _grown(mask: np.ndarray, reach: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0


def _spanned(values: np.ndarray, rim: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Harmonic surface [H, W] over `mask` with `values` on its `rim`: each other pixel is the mean of its neighbors."""
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    down, right = ((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))
    pairs = np.concatenate([np.stack([a[(a >= 0) & (b >= 0)], b[(a >= 0) & (b >= 0)]]) for a, b in (down, right)], axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(int(mask.sum()),) * 2)
    graph = graph + graph.T
    held = rim[mask].astype(float)
    # The weak weight keeps a component without a rim at its values.
    held = np.where(held > 0, 1.0, 1e-6)
    laplacian = diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
    result = np.zeros(mask.shape)
    result[mask] = spsolve((laplacian + diags(held)).tocsc(), held * values[mask])
    return result


def seen(
    vertices: np.ndarray, capture: Capture, masks: Mapping[str, Masks], reach: float, faces: np.ndarray | None = None
) -> np.ndarray:
    """True for vertices [V] at which some camera measures the object within `reach`, m, along its optical axis.

    With outward `faces` [F, 3], a vertex must also face that camera, because the back of a thin rope is within reach of its
    front.
    """
    result = np.zeros(len(vertices), dtype=bool)
    normals = None if faces is None else trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    for name, camera in capture.cameras.items():
        pixels, distance = camera.project(vertices)
        shown = camera.sees(pixels) & (distance > 0)
        x, y = np.round(pixels[shown]).astype(int).T
        shown[shown] = (masks[name].labels[0, y, x] == OBJECT) & (np.abs(capture.depth(name, 0)[y, x] - distance[shown]) < reach)
        if normals is not None:
            shown &= ((camera.camera_to_world[:3, 3] - vertices) * normals).sum(axis=1) > 0
        result |= shown
    return result


def align(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """Align the mesh `settings.mesh` with the cloud [P, 3], m, of frame 0. Raises InputError if it is unreadable or misfits."""
    if settings.mesh is None:
        raise InputError("perception.shape.mesh", "backend: mesh requires a file", "null", "Name a GLB, PLY or OBJ file.")
    vertices, faces = read_mesh(Path(settings.mesh))
    vertices, rms = place(vertices, faces, cloud)
    require_fit(Path(settings.mesh), vertices, rms, cloud, capture.description.up_sign)
    vertices = bend(vertices, faces, capture, masks, cloud)
    return ShapePrior(vertices=vertices, faces=faces, backend="mesh", facts={"alignment_rms": rms})


def require_fit(path: Path, vertices: np.ndarray, rms: float, cloud: np.ndarray, up: float) -> None:
    """Raise InputError if an aligned mesh with this RMS distance does not match the cloud [P, 3], m."""
    size = float(np.ptp(cloud, axis=0).max())
    ratio, lowest = float(np.ptp(vertices, axis=0).max()) / size, float((up * vertices[:, 2]).min())
    if rms > max(LEAST_MISFIT, MISFIT * size) or ratio > LARGEST_RATIO or lowest < LOWEST_VERTEX:
        rule = f"the mesh must fit the observed points: RMS distance at most {1e3 * max(LEAST_MISFIT, MISFIT * size):.0f} mm, "
        rule += f"at most {LARGEST_RATIO:g} times as long, at most {-1e3 * LOWEST_VERTEX:.0f} mm below the table"
        received = f"{1e3 * rms:.0f} mm, {ratio:.2f} times, {max(0.0, -1e3 * lowest):.0f} mm"
        raise InputError(
            path, rule, received, "Remove other objects and floors from the file, or set perception.shape.backend: auto."
        )


def place(vertices: np.ndarray, faces: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """Align a mesh with the cloud by a similarity; returns vertices [V, 3], m, and the RMS distance of the cloud from it, m."""
    rng = np.random.default_rng(0)
    target = cloud[rng.permutation(len(cloud))[:COMPARED_SURFACE]].astype(float)
    source = on_surface(vertices, faces, COMPARED_SURFACE, rng)
    center = source.mean(axis=0)
    spread = (source - center).std()
    unit = (source - center) / spread
    middle = target.mean(axis=0)
    # The cloud is part of the surface, so its spread is slightly smaller than that of the object.
    scale = 1.05 * (target - middle).std()
    coarse = [_icp(unit, target, turn, scale, middle, ITERATIONS // 8) for turn in Rotation.random(POSES, rng=rng)]
    coarse.sort(key=lambda fit: fit[0])
    fits = [_icp(unit, target, turn, size, shift, ITERATIONS) for _, turn, size, shift in coarse[:REFINED]]
    rms, rotation, scale, shift = min(fits, key=lambda fit: fit[0])
    return scale * rotation.apply((vertices - center) / spread) + shift, rms


def _icp(source: np.ndarray, target: np.ndarray, rotation: Rotation, scale: float, shift: np.ndarray, iterations: int) -> Fit:
    """Trimmed ICP over similarities, from each target point to its nearest source point."""
    rms = np.inf
    for _ in range(iterations):
        distance, nearest = cKDTree(scale * rotation.apply(source) + shift).query(target)
        inlier = distance <= np.quantile(distance, INLIERS)
        pairs, goals = source[nearest[inlier]], target[inlier]
        center, goal = pairs.mean(axis=0), goals.mean(axis=0)
        rotation, _ = Rotation.align_vectors(goals - goal, pairs - center)
        rotated = rotation.apply(pairs - center)
        scale = float(((goals - goal) * rotated).sum() / max((rotated**2).sum(), 1e-12))
        shift = goal - scale * rotation.apply(center)
        rms = float(np.sqrt((distance**2).mean()))
    return rms, rotation, scale, shift


def bend(vertices: np.ndarray, faces: np.ndarray, capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray) -> np.ndarray:
    """Move vertices by displacements d [V, 3], m, that minimize |S (d - t)|^2 + k |L d|^2.

    S selects the visible vertices (`seen`) within BEND_REACH of the cloud, t points to the nearest point of the cloud, L is the
    uniform graph Laplacian, and k is STIFFNESS. `nricp_amberg` of trimesh does not replace it: it also pulls hidden vertices, and
    fails if no point of the cloud is near.
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
    """Read all geometry of a file as one closed surface: vertices [V, 3] and outward faces [F, 3].

    Raises InputError if the file is missing, unreadable or empty, or if the mesh is not finite or not closed.
    """
    if not Path(path).is_file():
        raise InputError(path, "the mesh file must exist", "no such file")
    if b"KHR_draco_mesh_compression" in path.read_bytes():
        remedy = f"Unpack it: npx @gltf-transform/cli copy {path.name} unpacked.glb"
        raise InputError(path, "the mesh must not be compressed", "KHR_draco_mesh_compression", remedy)
    try:
        mesh = trimesh.load_mesh(path, process=True, maintain_order=False)
    except Exception as error:
        # trimesh raises no common exception for damaged files.
        reason = f"{type(error).__name__}: {error}"
        raise InputError(path, "the file must be a readable mesh (GLB, PLY, OBJ, STL)", reason) from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(path, "the mesh must have at least one triangle", "none")
    # Textured exports split vertices along seams.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not np.isfinite(mesh.vertices).all():
        raise InputError(path, "all vertices must be finite", "NaN or infinity")
    if not mesh.is_watertight:
        mesh = _without_seams(mesh)
    if len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) < len(mesh.faces):
        raise InputError(path, "each triangle must occur once", "double-sided triangles", "Export one side.")
    if not mesh.is_watertight:
        remedy = "Close it in a mesh editor; nodes are sampled inside it."
        raise InputError(path, "the surface must be closed", f"{len(mesh.faces)} triangles with open or branching edges", remedy)
    trimesh.repair.fix_normals(mesh)
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=int)


def _without_seams(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with vertices within SEAM of each other merged."""
    pairs = cKDTree(mesh.vertices).query_pairs(SEAM * float(mesh.extents.max()), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(mesh.vertices),) * 2)
    _, first, group = np.unique(connected_components(graph, directed=False)[1], return_index=True, return_inverse=True)
    joined = trimesh.Trimesh(mesh.vertices[first], group[mesh.faces], process=False)
    joined.update_faces(joined.nondegenerate_faces())
    return joined
