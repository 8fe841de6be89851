"""Tetrahedral meshes: implicit shapes (body-centered lattice, boundary snapped to the surface), boxes and sticks.

A mesh is (nodes [N, 3], m, tetrahedra [E, 4] with positive volume).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from neuspring.scenes.shapes import Sdf, gradient, grid

LATTICE_ALTITUDE = np.sqrt(0.5)
"""Altitude of a tetrahedron of the body-centered lattice, in lattice constants."""
LEAST_ALTITUDE = 0.4
"""Snapping keeps every tetrahedron above this fraction of the lattice's altitude."""
SNAPPING_STEPS = 40
EMBEDDING_CANDIDATES = 12

FACES = ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])
"""Corners of the faces of a tetrahedron."""

Mesh = tuple[np.ndarray, np.ndarray]


def volumes(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Signed volumes [E], m^3."""
    a, b, c, d = (nodes[tetrahedra[:, k]] for k in range(4))
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0)


def altitudes(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Smallest altitude of each tetrahedron [E], m: 3 V / largest face; negative where inverted."""
    areas = []
    for i, j, k in FACES:
        a, b, c = nodes[tetrahedra[:, i]], nodes[tetrahedra[:, j]], nodes[tetrahedra[:, k]]
        areas.append(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0)
    return np.asarray(3.0 * volumes(nodes, tetrahedra) / np.max(areas, axis=0))


def oriented(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """The tetrahedra, with two corners swapped where the volume is negative."""
    tetrahedra = tetrahedra.copy()
    inverted = volumes(nodes, tetrahedra) < 0
    tetrahedra[inverted] = tetrahedra[inverted][:, [0, 1, 3, 2]]
    return tetrahedra


def boundary(tetrahedra: np.ndarray) -> np.ndarray:
    """Faces [F, 3] that belong to only one tetrahedron, oriented outward."""
    corners = [[0, 2, 1], [1, 2, 3], [0, 1, 3], [0, 3, 2]]
    faces = np.concatenate([tetrahedra[:, c] for c in corners])
    _, inverse, counts = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(faces[counts[inverse.ravel()] == 1])


def edges(elements: np.ndarray) -> np.ndarray:
    """Unique edges [M, 2] of elements of any size."""
    size = elements.shape[1]
    pairs = np.concatenate([elements[:, [i, j]] for i in range(size) for j in range(i)])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def lattice(low: Sequence[float], high: Sequence[float], spacing: float) -> Mesh:
    """Tetrahedra of the body-centered cubic lattice over a box: two cell centers, and an edge of the face between them."""
    first = np.asarray(low, float) - spacing
    corners = np.ceil((np.asarray(high, float) + spacing - first) / spacing).astype(int) + 1
    cells = corners - 1
    corner_grid, cell_grid = grid(corners), grid(cells)
    nodes = np.concatenate([first + spacing * corner_grid.reshape(-1, 3), first + spacing * (cell_grid.reshape(-1, 3) + 0.5)])

    centers = int(np.prod(corners))
    """Number of the first node that is a cell's center."""
    elements = []
    for axis in range(3):
        step, right, up = np.roll(np.eye(3, dtype=int), axis, axis=1)
        inner = tuple(slice(0, -1) if k == axis else slice(None) for k in range(3))
        cell = cell_grid[inner].reshape(-1, 3)
        base = cell + step
        ring = [_flat_index(at, corners) for at in (base, base + right, base + right + up, base + up)]
        two = [centers + _flat_index(at, cells) for at in (cell, cell + step)]
        elements += [np.stack([*two, ring[k], ring[(k + 1) % 4]], axis=1) for k in range(4)]
    return nodes, oriented(nodes, np.concatenate(elements))


def fill(sdf: Sdf, low: Sequence[float], high: Sequence[float], spacing: float) -> Mesh:
    """Tetrahedra inside `sdf`: lattice cells whose centroid is inside, largest piece, boundary moved to the surface.

    The boundary follows -grad(sdf) with smoothing. A move is shortened if it would reduce a tetrahedron's altitude below
    LEAST_ALTITUDE times that of the lattice. A scale-free quality would not suffice: cells that shrink evenly keep it, but they
    require a small time step.
    """
    nodes, tetrahedra = lattice(low, high, spacing)
    tetrahedra = tetrahedra[sdf(nodes[tetrahedra].mean(axis=1)) < -0.05 * spacing]
    labels = pieces(tetrahedra)
    used, renumbered = np.unique(tetrahedra[labels == np.bincount(labels).argmax()], return_inverse=True)
    nodes, tetrahedra = nodes[used], renumbered.reshape(-1, 4)
    skin = boundary(tetrahedra)
    outer = np.unique(skin)
    inner = np.setdiff1d(np.arange(len(nodes)), outer)
    everywhere, along = _averaging(tetrahedra, len(nodes)), _averaging(skin, len(nodes))
    nominal = LATTICE_ALTITUDE * spacing
    for _ in range(SNAPPING_STEPS):
        move = np.zeros_like(nodes)
        move[inner] = 0.3 * (everywhere @ nodes - nodes)[inner]
        normal, distance = gradient(sdf, nodes[outer]), sdf(nodes[outer])
        drift = (along @ nodes - nodes)[outer]
        tangential = drift - (drift * normal).sum(axis=1, keepdims=True) * normal
        move[outer] = 0.3 * tangential - 0.6 * np.clip(distance, -0.3 * spacing, 0.3 * spacing)[:, None] * normal
        nodes = nodes + _admissible(nodes, tetrahedra, move, nominal)[:, None] * move
    return nodes, tetrahedra


def _admissible(nodes: np.ndarray, tetrahedra: np.ndarray, move: np.ndarray, nominal: float) -> np.ndarray:
    """Admissible fraction [N] of each node's move."""
    allowed = np.minimum(LEAST_ALTITUDE, altitudes(nodes, tetrahedra) / nominal)
    fraction = np.ones(len(nodes))
    for attempt in range(10):
        bad = altitudes(nodes + fraction[:, None] * move, tetrahedra) / nominal < allowed - 1e-12
        if not bad.any():
            return fraction
        fraction[np.unique(tetrahedra[bad])] *= 0.4 if attempt < 7 else 0.0
    return np.zeros(len(nodes))


def pieces(tetrahedra: np.ndarray) -> np.ndarray:
    """Connected piece of each tetrahedron [E]; neighbors share a face."""
    faces = np.sort(np.concatenate([tetrahedra[:, c] for c in FACES]), axis=1)
    owner = np.tile(np.arange(len(tetrahedra)), 4)
    order = np.lexsort(faces.T)
    same = (np.diff(faces[order], axis=0) == 0).all(axis=1)
    pairs = np.stack([owner[order][:-1][same], owner[order][1:][same]], axis=1)
    return np.asarray(connected_components(_adjacency(pairs, len(tetrahedra)), directed=False)[1])


def _adjacency(pairs: np.ndarray, count: int) -> csr_matrix:
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()


def _averaging(elements: np.ndarray, count: int) -> csr_matrix:
    """Matrix [N, N] that replaces each node by the mean of its neighbors."""
    graph = _adjacency(edges(elements), count)
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1.0)
    return coo_matrix(graph.multiply(1.0 / degree[:, None])).tocsr()


def block(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray, cells: Sequence[int]) -> Mesh:
    """A box of regular cells with five tetrahedra each, mirrored from cell to cell so that faces match."""
    counts = np.asarray(cells)
    first, last = np.asarray(low, float), np.asarray(high, float)
    nodes = (first + grid(counts + 1) * (last - first) / counts).reshape(-1, 3)
    cell = grid(counts).reshape(-1, 3)
    odd = cell.sum(axis=1) % 2 == 1
    five = (
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((1, 1, 0), (1, 0, 0), (0, 1, 0), (1, 1, 1)),
        ((1, 0, 1), (1, 0, 0), (0, 0, 1), (1, 1, 1)),
        ((0, 1, 1), (0, 1, 0), (0, 0, 1), (1, 1, 1)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)),
    )
    elements = []
    for corners in five:
        offsets = np.array(corners)
        mirrored = offsets * [-1, 1, 1] + [1, 0, 0]
        for parity, shift in ((~odd, offsets), (odd, mirrored)):
            elements.append(_flat_index(cell[parity][:, None] + shift, counts + 1))
    return nodes, oriented(nodes, np.concatenate(elements))


def stick(length: float, radii: np.ndarray, around: int) -> Mesh:
    """A stick along x, centered at the origin, with `radii` [n + 1], m, at equal steps.

    Each cross section has a node on the axis and `around` nodes on a ring. Each prism has three tetrahedra; the node order
    determines the split, so that neighbors match.
    """
    along = np.linspace(-length / 2, length / 2, len(radii))
    angles = 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.zeros(around), np.cos(angles), np.sin(angles)], axis=1)
    offsets = np.concatenate([np.zeros((1, 3)), ring])
    nodes = (radii[:, None, None] * offsets + along[:, None, None] * [1.0, 0.0, 0.0]).reshape(-1, 3)
    ids = np.arange(len(nodes)).reshape(len(radii), around + 1)
    elements = []
    for k in range(around):
        bottom = np.sort(np.stack([ids[:-1, 0], ids[:-1, 1 + k], ids[:-1, 1 + (k + 1) % around]], axis=1), axis=1)
        top = bottom + around + 1
        a, b, c = bottom.T
        d, e, f = top.T
        elements += [np.stack(t, axis=1) for t in ((a, b, c, f), (a, b, e, f), (a, d, e, f))]
    return nodes, oriented(nodes, np.concatenate(elements))


def embed(points: np.ndarray, nodes: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each point's tetrahedron [V] and barycentric weights [V, 4]; weights are slightly negative for points outside the mesh."""
    candidates = cKDTree(nodes[tetrahedra].mean(axis=1)).query(points, k=EMBEDDING_CANDIDATES)[1]
    best = np.full(len(points), -np.inf)
    element, weights = np.zeros(len(points), dtype=int), np.zeros((len(points), 4))
    for candidate in candidates.T:
        corners = nodes[tetrahedra[candidate]]
        basis = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        inner = np.linalg.solve(basis, (points - corners[:, 0])[..., None])[..., 0]
        trial = np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)
        better = trial.min(axis=1) > best
        best[better], element[better], weights[better] = trial.min(axis=1)[better], candidate[better], trial[better]
    return element, weights


def _flat_index(index: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return np.asarray((index[..., 0] * counts[1] + index[..., 1]) * counts[2] + index[..., 2])
