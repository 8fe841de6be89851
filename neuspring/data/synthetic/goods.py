"""Cloths, ropes and a package with known, uneven materials: stiff hems and stripes, knots, a carton around a soft filling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from neuspring.data.synthetic.body import Body, Surface
from neuspring.data.synthetic.tetrahedra import block, boundary, rod

Pattern = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Fabric:
    """A rectangular cloth."""

    width: float
    """Along x, m."""
    height: float
    """Along y, m."""
    density: float
    """kg/m^2."""
    membrane: float
    """N/m."""
    bending: float
    """N m."""
    hem: float
    """Width of the border, m, in which membrane and bending are HEM times larger."""
    pattern: Pattern


HEM = (3.0, 10.0)
"""Factors of membrane and bending in the hem."""
SHEET_RADIUS = 0.4
"""Contact radius of a sheet's nodes in node spacings: below half a spacing neighbors do not repel each other, above 0.36 a
cell's diagonal is closed."""


def _checks(size: float, first: tuple[float, ...], second: tuple[float, ...]) -> Pattern:
    def paint(p: np.ndarray) -> np.ndarray:
        even = np.floor(p[:, :2] / size).astype(int).sum(axis=1) % 2 == 0
        return np.where(even[:, None], first, second)

    return paint


def _stripes(size: float, colors: tuple[tuple[float, ...], ...]) -> Pattern:
    return lambda p: np.array(colors)[np.floor(p[:, 1] / size).astype(int) % len(colors)]


def _dots(size: float, ground: tuple[float, ...], dot: tuple[float, ...]) -> Pattern:
    def paint(p: np.ndarray) -> np.ndarray:
        row = np.floor(p[:, 1] / size)
        inside = np.stack([p[:, 0] / size + 0.5 * (row % 2), p[:, 1] / size], axis=1) % 1.0 - 0.5
        return np.where(np.linalg.norm(inside, axis=1)[:, None] < 0.3, dot, ground)

    return paint


FABRICS = {
    "towel": Fabric(0.3, 0.3, 0.25, 100.0, 6e-5, 0.015, _checks(0.03, (0.2, 0.35, 0.6), (0.75, 0.75, 0.7))),
    "napkin": Fabric(0.26, 0.26, 0.18, 70.0, 3e-5, 0.012, _dots(0.032, (0.65, 0.15, 0.16), (0.85, 0.82, 0.75))),
    "scarf": Fabric(0.36, 0.22, 0.22, 80.0, 3e-5, 0.02, _stripes(0.022, ((0.7, 0.55, 0.1), (0.15, 0.3, 0.25), (0.8, 0.75, 0.6)))),
    "sheet": Fabric(0.34, 0.28, 0.16, 60.0, 2e-5, 0.014, _checks(0.02, (0.5, 0.3, 0.5), (0.8, 0.78, 0.8))),
}


def cloth(name: str, spacing: float, skin_spacing: float) -> Body:
    """A cloth of FABRICS flat on the table. `spacing` of nodes, `skin_spacing` of visible vertices, m."""
    fabric = FABRICS[name]
    counts = [round(size / spacing) + 1 for size in (fabric.width, fabric.height)]
    axes = [np.linspace(-size / 2, size / 2, n) for size, n in zip((fabric.width, fabric.height), counts, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    radius = SHEET_RADIUS * spacing
    nodes = np.stack([x.ravel(), y.ravel(), np.full(x.size, radius + 0.0005)], axis=1)
    # A perfectly flat sheet has no preferred side to buckle to; weave is never perfectly flat.
    nodes[:, 2] += 1e-4 * np.random.default_rng(0).normal(size=len(nodes))
    ids = np.arange(x.size).reshape(counts)
    a, b, c, d = ids[:-1, :-1].ravel(), ids[1:, :-1].ravel(), ids[1:, 1:].ravel(), ids[:-1, 1:].ravel()
    even = np.add.outer(np.arange(counts[0] - 1), np.arange(counts[1] - 1)).ravel() % 2 == 0
    one, two = np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)
    three, four = np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)
    triangles = np.concatenate([one[even], two[even], three[~even], four[~even]])
    edge = np.min([fabric.width / 2 - np.abs(nodes[:, 0]), fabric.height / 2 - np.abs(nodes[:, 1])], axis=0)
    in_hem = edge < fabric.hem
    membrane = np.where(in_hem[triangles].mean(axis=1) > 0.5, HEM[0], 1.0) * fabric.membrane
    return Body(
        nodes=nodes,
        surface=skin_of(nodes, triangles, skin_spacing, fabric.pattern),
        radius=radius,
        triangles=triangles,
        membrane=membrane,
        sheet_density=fabric.density,
        bending=np.where(in_hem, HEM[1], 1.0) * fabric.bending,
        air_drag=0.5,
        contact_stiffness=20.0,
        contact_damping=0.005,
        self_contact=True,
        friction=0.5,
    )


ROPES = {
    "twine": (0.5, (0.06,), (0.75, 0.68, 0.5)),
    "cord": (0.44, (-0.1, 0.12), (0.3, 0.45, 0.7)),
}
"""Length, m; places of knots along x, m; color."""
ROPE_RADIUS = 0.006
KNOT_RADIUS = 0.0095
KNOT_WIDTH = 0.012
ROPE_MODULUS = 1.5e5
"""Pa; knots are four times as stiff."""


def rope(name: str, spacing: float, skin_spacing: float) -> Body:
    """A rope along x on the table, with knots."""
    length, knots, color = ROPES[name]
    along = np.linspace(-length / 2, length / 2, round(length / spacing) + 1)
    knot = _knots(along, knots)
    nodes, tetrahedra = rod(length, ROPE_RADIUS + (KNOT_RADIUS - ROPE_RADIUS) * knot, 8)
    radius = 0.0035
    nodes[:, 2] += ROPE_RADIUS + radius
    stiffness = ROPE_MODULUS * (1.0 + 3.0 * _knots(nodes[tetrahedra].mean(axis=1)[:, 0], knots))

    def paint(p: np.ndarray) -> np.ndarray:
        turn = np.arctan2(p[:, 2] - ROPE_RADIUS - radius, p[:, 1]) / (2 * np.pi)
        strand = (p[:, 0] * 60.0 + turn) % 1.0 < 0.5
        # Every seventh turn carries a colored thread, so that one place differs from the next.
        thread = ((p[:, 0] * 60.0 + turn) // 1.0) % 7 == 0
        shade = np.where(strand[:, None], 0.55, 1.0) * np.array(color)
        return np.asarray(np.where(thread[:, None], shade * [0.9, 0.35, 0.3], shade))

    return Body(
        nodes=nodes,
        surface=skin_of(nodes, boundary(tetrahedra), skin_spacing, paint),
        radius=radius,
        tetrahedra=tetrahedra,
        youngs_modulus=stiffness,
        poisson_ratio=np.full(len(tetrahedra), 0.3),
        density=np.full(len(tetrahedra), 500.0),
        viscosity=(0.5, 0.05),
        contact_stiffness=60.0,
        contact_damping=0.01,
        friction=0.5,
    )


def _knots(x: np.ndarray, places: tuple[float, ...]) -> np.ndarray:
    return np.asarray(np.max([np.exp(-(((x - place) / KNOT_WIDTH) ** 2)) for place in places], axis=0))


PACKAGE = (0.18, 0.12, 0.08)
"""m."""


def package(spacing: float, skin_spacing: float) -> Body:
    """A carton of one cell's thickness around a soft filling, standing on the table."""
    size = np.array(PACKAGE)
    cells = np.maximum(np.round(size / spacing).astype(int), 4)
    nodes, tetrahedra = block(-size / 2, size / 2, cells.tolist())
    centers = nodes[tetrahedra].mean(axis=1)
    outer = (size / 2 - np.abs(centers) < size / cells).any(axis=1)
    nodes[:, 2] += size[2] / 2 + 0.0045

    def paint(p: np.ndarray) -> np.ndarray:
        colors = np.tile([0.55, 0.38, 0.2], (len(p), 1))
        colors[np.abs(p[:, 1]) < 0.009] = [0.7, 0.6, 0.42]
        label = (np.abs(p[:, 0] - 0.03) < 0.04) & (np.abs(p[:, 1]) < 0.04) & (p[:, 2] > size[2] / 2)
        colors[label] = [0.85, 0.85, 0.82]
        bars = label & (np.abs(p[:, 1]) < 0.022) & (np.floor(p[:, 0] / 0.004).astype(int) % 3 == 0)
        colors[bars] = [0.08, 0.08, 0.1]
        print_ = (np.abs(p[:, 0] + 0.05) < 0.022) & (np.abs(p[:, 2] - 0.05) < 0.022)
        colors[print_ & (np.abs(p[:, 1]) > 0.02)] = [0.5, 0.1, 0.08]
        return colors

    return Body(
        nodes=nodes,
        surface=skin_of(nodes, boundary(tetrahedra), skin_spacing, paint),
        radius=0.004,
        tetrahedra=tetrahedra,
        youngs_modulus=np.where(outer, 1e5, 5e3),
        poisson_ratio=np.where(outer, 0.3, 0.4),
        density=np.where(outer, 250.0, 120.0),
        viscosity=(0.5, 0.05),
        contact_stiffness=250.0,
        contact_damping=0.05,
        friction=0.5,
    )


def skin_of(nodes: np.ndarray, faces: np.ndarray, spacing: float, paint: Pattern) -> Surface:
    """The surface of mesh faces, each divided evenly until vertices lie about `spacing` apart."""
    longest = np.linalg.norm(nodes[faces[:, 0]] - nodes[faces[:, 1]], axis=1).max()
    parts = max(int(np.ceil(longest / spacing)), 1)
    inner = [(i, j, parts - i - j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    place = {point: k for k, point in enumerate(inner)}
    weights = np.array(inner) / parts
    own = [
        corners
        for i, j, k in inner
        for corners in (
            ((i, j, k), (i + 1, j, k - 1), (i, j + 1, k - 1)),
            ((i + 1, j, k - 1), (i + 1, j + 1, k - 2), (i, j + 1, k - 1)),
        )
        if all(corner in place for corner in corners)
    ]
    # Barycentric coordinates (i, j, k) belong to corners 0, 1, 2: this order keeps the face's orientation.
    small = np.array([[place[c] for c in (t[0], t[1], t[2])] for t in own])
    points = np.einsum("ws,fsc->fwc", weights, nodes[faces])
    all_faces = (small[None] + len(inner) * np.arange(len(faces))[:, None, None]).reshape(-1, 3)
    _, first, inverse = np.unique(points.reshape(-1, 3).round(7), axis=0, return_index=True, return_inverse=True)
    rest = points.reshape(-1, 3)[first]
    return Surface(
        rest=rest,
        faces=inverse.ravel()[all_faces],
        nodes=np.repeat(faces, len(inner), axis=0)[first],
        weights=np.tile(weights, (len(faces), 1))[first],
        colors=paint(rest).astype(float),
    )
