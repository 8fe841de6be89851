"""One shape laid onto another sampling of the same body: rigid ICP from a few starts, then a mild bend where that leaves a gap.

A body with limbs may lie so that a wrong limb is nearer. So every pose is bent, and the one wins that keeps the ways through the
body: paths between near points, whose lengths no pose of the limbs changes.

Both ways count: the residual is the root mean square of the distances from every point of either set to the nearest of the other.
Points of two samplings never coincide, so it does not fall below about half of the node spacing.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from neuspring.physics.topology import node_spacing

ICP_STEPS = 40
MOST_POINTS = 1500
"""Points of each set that ICP looks at; a pose needs no more."""
ALIKE_STARTS = 1.02
"""Starts whose residual is within this factor of the best fit alike; the earliest wins, so that a symmetric body does not turn."""
EXACT_FIT = 1e-6
"""Residuals below this part of the extent are an exact fit; their last digits, which differ by processor, decide nothing."""
RIGID_ENOUGH = 0.75
"""In spacings of the coarser set: a rigid fit this close needs no bending."""
BEND_WIDTHS = (0.3, 0.2, 0.12, 0.08)
"""Widths of the smooth displacement, one after the other, as fractions of the extent."""
STRETCH_NEIGHBORS = 6
"""Nearest points of a point, whose distances tell how much was stretched."""
BEND_STEPS = 8
"""Steps with each width."""
PATH_STARTS, PATH_STEP = 64, 1.3
"""Points from which ways to all others are measured, and the longest step of a way, in node spacings."""


@dataclass(frozen=True)
class Registration:
    """Points of a shape in another sampling's frame."""

    points: np.ndarray
    """Mapped points [M, 3], m."""
    others: np.ndarray
    """Mapped points that only follow [C, 3], m."""
    rigid_residual: float
    """After the rigid motion, m."""
    residual: float
    """After bending, m; the same where nothing was bent."""
    stretch: float
    """Change that bending made in distances between neighbors: mean of |log ratio|; 0 where nothing was bent."""
    extent: float
    """Diagonal of the source's bounding box along its principal axes, m."""

    @property
    def facts(self) -> dict[str, float]:
        """Residuals, m, stretch, and the extent, m."""
        return {name: getattr(self, name) for name in ("rigid_residual", "residual", "stretch", "extent")}


def register(source: np.ndarray, target: np.ndarray, others: np.ndarray) -> Registration:
    """Map target points [M, 3], m, onto source points [N, 3], m; `others` [C, 3] follow the nearest target point."""
    return _register(*(np.ascontiguousarray(points, np.float64).tobytes() for points in (source, target, others)))


@functools.lru_cache(maxsize=32)
def _register(*shapes: bytes) -> Registration:
    """As `register`; candidates of a search on a pool ask for the same shapes hundreds of times."""
    source, target, others = (np.frombuffer(points).reshape(-1, 3) for points in shapes)
    poses = _poses(*(points[:: -(-len(points) // MOST_POINTS)] for points in (source, target)))
    rotation, shift = poses[0]
    points = target @ rotation.T + shift
    rigid, extent, bent = residual(source, points), extent_of(source), points
    if rigid > RIGID_ENOUGH * max(spacing(source), spacing(target)):
        laid = [target @ rotation.T + shift for rotation, shift in poses]
        ends = [_bent(source, mapped, extent) for mapped in laid]
        changes = _changes_of_ways(source, target, ends)
        best = next(k for k, change in enumerate(changes) if change <= ALIKE_STARTS * min(changes))
        (rotation, shift), points, bent = poses[best], laid[best], ends[best]
        rigid = residual(source, points)
    following = others @ rotation.T + shift
    _, nearest = cKDTree(points).query(following)
    end = residual(source, bent)
    if end > rigid:
        bent, end = points, rigid
    return Registration(bent, following + (bent - points)[nearest], rigid, end, _stretch(points, bent), extent)


def residual(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square distance, m, from the points of either set to the nearest of the other."""
    squares = np.concatenate([cKDTree(b).query(a)[0] ** 2, cKDTree(a).query(b)[0] ** 2])
    return float(np.sqrt(squares.mean()))


def spacing(points: np.ndarray, neighbors: int = 1) -> float:
    """Median distance, m, of the points [N, 3] to their neighbor of that rank; of the farthest where there are fewer."""
    rank = min(neighbors, len(points) - 1)
    return float(np.median(cKDTree(points).query(points, k=rank + 1)[0].reshape(len(points), -1)[:, -1]))


def extent_of(points: np.ndarray) -> float:
    """Diagonal of the bounding box along the principal axes, m."""
    return float(np.linalg.norm(np.ptp((points - points.mean(axis=0)) @ _axes(points), axis=0)))


def _stretch(points: np.ndarray, bent: np.ndarray) -> float:
    """Mean of |log(distance after / before)| over pairs of near neighbors."""
    _, near = cKDTree(points).query(points, k=min(STRETCH_NEIGHBORS + 1, len(points)))
    pairs = np.stack([np.repeat(near[:, :1], near.shape[1] - 1, axis=1), near[:, 1:]], axis=-1).reshape(-1, 2)
    before, after = (np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) for x in (points, bent))
    apart = before > 0
    return float(np.abs(np.log(np.maximum(after[apart], 1e-9) / before[apart])).mean()) if apart.any() else 0.0


def _axes(points: np.ndarray) -> np.ndarray:
    """Principal axes as columns [3, 3], a right-handed frame."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)[2].T if len(points) > 2 else np.eye(3)
    axes[:, 2] *= np.sign(np.linalg.det(axes)) or 1.0
    return axes


def _starts(source: np.ndarray, target: np.ndarray) -> Iterator[np.ndarray]:
    """Rotations that ICP starts from: none, quarter turns about the vertical, principal axes onto principal axes."""
    for cos, sin in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        yield np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    onto, of = _axes(source), _axes(target)
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        yield onto @ np.diag([a, b, a * b]) @ of.T


def _poses(source: np.ndarray, target: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations [3, 3] and shifts [3], m, that lay the target onto the source; the first fits best."""
    tree, poses = cKDTree(source), []
    for start in _starts(source, target):
        rotation, shift = start, source.mean(axis=0) - start @ target.mean(axis=0)
        for _ in range(ICP_STEPS):
            mapped = target @ rotation.T + shift
            ahead, back = tree.query(mapped)[1], cKDTree(mapped).query(source)[1]
            before = rotation, shift
            rotation, shift = _kabsch(np.concatenate([target, target[back]]), np.concatenate([source[ahead], source]))
            if np.allclose(rotation, before[0], atol=1e-7) and np.allclose(shift, before[1], atol=1e-9):
                break
        poses.append((residual(source, target @ rotation.T + shift), rotation, shift))
    least = max(min(error for error, _, _ in poses), EXACT_FIT * extent_of(source))
    best = next(k for k, (error, _, _) in enumerate(poses) if error <= ALIKE_STARTS * least)
    return [(rotation, shift) for _, rotation, shift in [poses[best], *poses[:best], *poses[best + 1 :]]]


def _changes_of_ways(source: np.ndarray, target: np.ndarray, ends: Sequence[np.ndarray]) -> list[float]:
    """Mean change, m, of the ways through the target [M, 3] for each end [M, 3], where a point becomes the source's nearest."""
    tree = cKDTree(source)
    starts = np.arange(0, len(target), -(-len(target) // PATH_STARTS))
    ways, changes = dijkstra(_steps(target), indices=starts), []
    for end in ends:
        image = tree.query(end)[1]
        there = dijkstra(_steps(source), indices=image[starts])[:, image]
        known = np.isfinite(ways) & np.isfinite(there)
        changes.append(float(np.abs(there[known] - ways[known]).mean()))
    return changes


def _steps(points: np.ndarray) -> csr_array:
    """Lengths, m, of the steps between near points of a body [N, 3]."""
    tree = cKDTree(points)
    return csr_array(tree.sparse_distance_matrix(tree, PATH_STEP * node_spacing(points), output_type="coo_matrix"))


def _kabsch(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion that takes points [P, 3] to `onto` [P, 3] with the least squares."""
    a, b = points.mean(axis=0), onto.mean(axis=0)
    u, _, vt = np.linalg.svd((points - a).T @ (onto - b))
    rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return rotation, b - rotation @ a


def _bent(source: np.ndarray, points: np.ndarray, extent: float) -> np.ndarray:
    """Points moved towards the source by displacements that are smooth over ever smaller widths."""
    tree, bent = cKDTree(source), points.copy()
    squares = cdist(points, points, "sqeuclidean")
    for width in BEND_WIDTHS:
        weights = np.exp(-squares / (2 * (width * extent) ** 2))
        for _ in range(BEND_STEPS):
            ahead, back = tree.query(bent)[1], cKDTree(bent).query(source)[1]
            pull, count = source[ahead] - bent, np.ones(len(bent))
            np.add.at(pull, back, source - bent[back])
            np.add.at(count, back, 1.0)
            bent = bent + (weights @ pull) / (weights @ count)[:, None]
    return bent
