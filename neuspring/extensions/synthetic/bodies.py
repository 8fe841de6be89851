"""Bodies at rest with known, nonuniform materials and a textured skin: cloths, ropes, a package, plush animals.

Cloths have hems, ropes have knots, and the package is a carton around a soft filling. The animals are smooth unions of simple
parts: a soft filling of nonuniform stiffness in a skin of fabric. The sloth lies on its belly, the zebra stands on its four legs,
and the dinosaur sits on its legs and tail; x points to the head.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neuspring.extensions.synthetic.meshes import block, boundary, embed, fill, stick
from neuspring.scenes.shapes import Sdf, capsule, ellipsoid, smooth_union, sphere, surface


def _empty(*shape: int) -> Any:
    """A field whose default is an empty array, of indices if it has columns."""
    return field(default_factory=lambda: np.zeros(shape, int if len(shape) > 1 else float))


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The visible skin: triangles whose vertices are bound to mesh nodes, with exact correspondences in every frame."""

    rest: np.ndarray
    """Vertices at rest [V, 3], m; the texture is a function of these."""
    faces: np.ndarray
    """[F, 3] indices of vertices, outward."""
    nodes: np.ndarray
    """[V, k] nodes that each vertex follows."""
    weights: np.ndarray
    """[V, k] weights of the nodes, with sum 1."""
    colors: np.ndarray
    """[V, 3] linear RGB in [0, 1], before the fine texture."""

    def follow(self, positions: np.ndarray) -> np.ndarray:
        """Vertices [..., V, 3] for node positions [..., N, 3]."""
        return np.asarray(np.einsum("...vkc,vk->...vc", positions[..., self.nodes, :], self.weights))


@dataclass(frozen=True, kw_only=True)
class SoftBody:
    """Geometry and true material. Solids have tetrahedra, some with a fabric skin; sheets have triangles with bending."""

    nodes: np.ndarray
    """Rest positions [N, 3], m, resting on or above the table z = 0."""
    surface: Surface
    radius: float
    """Contact radius of a node, m."""
    tetrahedra: np.ndarray = _empty(0, 4)
    """[E, 4]."""
    youngs_modulus: np.ndarray = _empty(0)
    """[E], Pa."""
    poisson_ratio: np.ndarray = _empty(0)
    """[E]."""
    density: np.ndarray = _empty(0)
    """[E], kg/m^3."""
    triangles: np.ndarray = _empty(0, 3)
    """[M, 3]: the sheet, or the fabric skin of a solid."""
    membrane: np.ndarray = _empty(0)
    """[M], N/m: in-plane stiffness of triangles."""
    sheet_density: float = 0.0
    """kg/m^2; zero for skins, whose mass belongs to the solid."""
    bending: np.ndarray = _empty(0)
    """[N], N m: bending stiffness of a sheet at each node; edges have the mean of their ends."""
    air_drag: float = 0.0
    """Aerodynamic drag of triangles."""
    viscosity: tuple[float, float] = (0.0, 0.1)
    """Maxwell branch: modulus as a fraction of Young's modulus, and relaxation time, s."""
    contact_stiffness: float = 150.0
    """Contact stiffness of nodes against table and hands, N/m."""
    contact_damping: float = 0.02
    """Contact damping of nodes against table and hands, N s/m."""
    self_contact: bool = False
    self_contact_stiffness: float = 40.0
    """N/m; nodes repel each other within two radii."""
    friction: float = 0.6
    """Coulomb coefficient on table and hands."""

    @property
    def is_sheet(self) -> bool:
        return len(self.tetrahedra) == 0


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
    """Width of the border, m, in which membrane and bending are multiplied by HEM."""
    pattern: Pattern


HEM = (3.0, 10.0)
"""Factors of membrane and bending in the hem."""
SHEET_RADIUS = 0.4
"""Contact radius of a sheet's nodes, in node spacings. Below 0.5, neighbors do not repel each other; above 0.36, nothing fits
through the diagonal of a cell."""


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


def cloth(name: str, spacing: float, skin_spacing: float) -> SoftBody:
    """A cloth of FABRICS, flat on the table, with `spacing` of nodes and `skin_spacing` of visible vertices, m."""
    fabric = FABRICS[name]
    counts = [round(size / spacing) + 1 for size in (fabric.width, fabric.height)]
    axes = [np.linspace(-size / 2, size / 2, n) for size, n in zip((fabric.width, fabric.height), counts, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    radius = SHEET_RADIUS * spacing
    nodes = np.stack([x.ravel(), y.ravel(), np.full(x.size, radius + 0.0005)], axis=1)
    # A perfectly flat sheet would have no direction to buckle.
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
    return SoftBody(
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


ROPES = {"twine": (0.5, (0.06,), (0.75, 0.68, 0.5)), "cord": (0.44, (-0.1, 0.12), (0.3, 0.45, 0.7))}
"""Length, m; positions of knots along x, m; color."""
ROPE_RADIUS = 0.006
KNOT_RADIUS = 0.0095
KNOT_WIDTH = 0.012
ROPE_MODULUS = 1.5e5
"""Pa; knots are four times as stiff."""


def rope(name: str, spacing: float, skin_spacing: float) -> SoftBody:
    """A rope along x on the table, with knots."""
    length, knots, color = ROPES[name]
    along = np.linspace(-length / 2, length / 2, round(length / spacing) + 1)
    knot = _knots(along, knots)
    nodes, tetrahedra = stick(length, ROPE_RADIUS + (KNOT_RADIUS - ROPE_RADIUS) * knot, 8)
    radius = 0.0035
    nodes[:, 2] += ROPE_RADIUS + radius
    stiffness = ROPE_MODULUS * (1.0 + 3.0 * _knots(nodes[tetrahedra].mean(axis=1)[:, 0], knots))

    def paint(p: np.ndarray) -> np.ndarray:
        turn = np.arctan2(p[:, 2] - ROPE_RADIUS - radius, p[:, 1]) / (2 * np.pi)
        strand = (p[:, 0] * 60.0 + turn) % 1.0 < 0.5
        # A colored thread on every seventh turn distinguishes positions along the rope.
        thread = ((p[:, 0] * 60.0 + turn) // 1.0) % 7 == 0
        shade = np.where(strand[:, None], 0.55, 1.0) * np.array(color)
        return np.asarray(np.where(thread[:, None], shade * [0.9, 0.35, 0.3], shade))

    return SoftBody(
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


def package(spacing: float, skin_spacing: float) -> SoftBody:
    """A carton of one cell's thickness around a soft filling, standing on the table."""
    size = np.array(PACKAGE)
    cells = np.maximum(np.round(size / spacing).astype(int), 4)
    nodes, tetrahedra = block(-size / 2, size / 2, cells.tolist())
    outer = (size / 2 - np.abs(nodes[tetrahedra].mean(axis=1)) < size / cells).any(axis=1)
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

    return SoftBody(
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
    """The surface of mesh faces, each divided evenly until vertices are about `spacing`, m, apart."""
    longest = np.linalg.norm(nodes[faces[:, 0]] - nodes[faces[:, 1]], axis=1).max()
    parts = max(int(np.ceil(longest / spacing)), 1)
    inner = [(i, j, parts - i - j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    index_of = {point: k for k, point in enumerate(inner)}
    weights = np.array(inner) / parts
    triangles = [
        corners
        for i, j, k in inner
        for corners in (
            ((i, j, k), (i + 1, j, k - 1), (i, j + 1, k - 1)),
            ((i + 1, j, k - 1), (i + 1, j + 1, k - 2), (i, j + 1, k - 1)),
        )
        if all(corner in index_of for corner in corners)
    ]
    # Barycentric coordinates (i, j, k) belong to corners 0, 1, 2: this order keeps the face's orientation.
    small = np.array([[index_of[c] for c in (t[0], t[1], t[2])] for t in triangles])
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


BLEND = 0.01
"""m."""
FILLING = 1e4
"""Young's modulus of the body, Pa."""
DENSITY = 90.0
"""kg/m^3: about 0.15 kg for an animal."""
SKIN = 60.0
"""N/m."""
RADIUS = 0.004
CLEARANCE = 0.0045
"""Height of the lowest node above the table, m; the contact radius is 4 mm."""
Paint = Callable[[np.ndarray, Mapping[str, Sdf]], np.ndarray]


def sloth(spacing: float, skin_spacing: float) -> SoftBody:
    """A sloth of 0.3 m length with spread arms and legs, a stiff head and soft limbs."""
    parts = {
        "body": ellipsoid((0, 0, 0.05), (0.085, 0.06, 0.045)),
        "head": ellipsoid((0.1, 0, 0.062), (0.045, 0.05, 0.042)),
        "snout": ellipsoid((0.138, 0, 0.055), (0.018, 0.022, 0.018)),
    }
    for name, side in (("left", 1), ("right", -1)):
        parts[f"arm_{name}"] = capsule((0.05, 0.045 * side, 0.035), (0.11, 0.125 * side, 0.022), 0.02)
        parts[f"leg_{name}"] = capsule((-0.055, 0.04 * side, 0.032), (-0.12, 0.1 * side, 0.022), 0.021)
    softness = {"head": 2.0, "snout": 3.0, "arm": 0.8, "leg": 0.7}
    return _animal(parts, softness, _paint_sloth, spacing, skin_spacing)


def zebra(spacing: float, skin_spacing: float) -> SoftBody:
    """A zebra of 0.28 m length and 0.19 m height, with stiff head and legs and soft belly and tail."""
    parts = {
        "body": capsule((-0.055, 0, 0.1), (0.055, 0, 0.104), 0.045),
        "neck": capsule((0.055, 0, 0.11), (0.1, 0, 0.155), 0.03),
        "head": ellipsoid((0.112, 0, 0.163), (0.035, 0.032, 0.03)),
        "snout": capsule((0.125, 0, 0.153), (0.155, 0, 0.145), 0.02),
        "tail": capsule((-0.095, 0, 0.115), (-0.135, 0, 0.085), 0.014),
    }
    for name, side in (("left", 1), ("right", -1)):
        parts[f"ear_{name}"] = ellipsoid((0.1, 0.025 * side, 0.195), (0.012, 0.014, 0.018))
        parts[f"leg_front_{name}"] = capsule((0.055, 0.03 * side, 0.08), (0.062, 0.036 * side, 0.021), 0.021)
        parts[f"leg_back_{name}"] = capsule((-0.055, 0.03 * side, 0.08), (-0.062, 0.036 * side, 0.021), 0.021)
    softness = {"head": 2.0, "snout": 2.5, "leg": 1.8, "tail": 0.6, "body": 0.8}
    return _animal(parts, softness, _paint_zebra, spacing, skin_spacing)


def dinosaur(spacing: float, skin_spacing: float) -> SoftBody:
    """A dinosaur of 0.32 m length with its tail and 0.2 m height, with stiff head and tail and soft arms and legs."""
    parts = {
        "body": ellipsoid((0, 0, 0.08), (0.06, 0.052, 0.065)),
        "neck": capsule((0.03, 0, 0.12), (0.05, 0, 0.165), 0.032),
        "head": ellipsoid((0.07, 0, 0.175), (0.045, 0.035, 0.032)),
        "tail_root": capsule((-0.04, 0, 0.06), (-0.11, 0, 0.038), 0.034),
        "tail_tip": capsule((-0.11, 0, 0.038), (-0.18, 0, 0.024), 0.021),
    }
    for name, side in (("left", 1), ("right", -1)):
        parts[f"arm_{name}"] = capsule((0.045, 0.04 * side, 0.105), (0.075, 0.055 * side, 0.085), 0.015)
        parts[f"leg_{name}"] = capsule((0.01, 0.042 * side, 0.04), (0.06, 0.06 * side, 0.026), 0.026)
    for k, x in enumerate((-0.14, -0.1, -0.06, -0.03)):
        parts[f"spike_{k}"] = sphere((x, 0, 0.07 + 0.42 * (x + 0.14) + 0.012 * k), 0.014)
    softness = {"head": 2.0, "tail": 1.5, "arm": 0.7, "leg": 0.8, "spike": 3.0}
    return _animal(parts, softness, _paint_dinosaur, spacing, skin_spacing)


def _animal(parts: Mapping[str, Sdf], factors: Mapping[str, float], paint: Paint, spacing: float, skin_spacing: float) -> SoftBody:
    """An animal of `parts`. `factors` multiply the modulus of tetrahedra whose nearest part has a name with this prefix."""
    shape = smooth_union(parts.values(), BLEND)
    low, high = (-0.24, -0.18, -0.02), (0.2, 0.18, 0.26)
    nodes, tetrahedra = fill(shape, low, high, spacing)
    vertices, faces = surface(shape, low, high, skin_spacing)
    element, weights = embed(vertices, nodes, tetrahedra)
    centers = nodes[tetrahedra].mean(axis=1)
    nearest = np.stack([part(centers) for part in parts.values()]).argmin(axis=0)
    of_part = [next((f for start, f in factors.items() if name.startswith(start)), 1.0) for name in parts]
    lift = np.array([0.0, 0.0, CLEARANCE - nodes[:, 2].min()])
    skin = boundary(tetrahedra)
    return SoftBody(
        nodes=nodes + lift,
        surface=Surface(
            rest=vertices + lift, faces=faces, nodes=tetrahedra[element], weights=weights, colors=paint(vertices, parts)
        ),
        radius=RADIUS,
        tetrahedra=tetrahedra,
        youngs_modulus=FILLING * np.array(of_part)[nearest],
        poisson_ratio=np.full(len(tetrahedra), 0.3),
        density=np.full(len(tetrahedra), DENSITY),
        triangles=skin,
        membrane=np.full(len(skin), SKIN),
        viscosity=(1.0, 0.08),
        friction=0.7,
    )


def _level(points: np.ndarray, center: Sequence[float], radii: float | Sequence[float] = 1.0) -> np.ndarray:
    """Distances [n] of points from a center, in radii of an ellipsoid."""
    return np.asarray(np.linalg.norm((points - np.array(center)) / radii, axis=1))


def _paint_sloth(points: np.ndarray, parts: Mapping[str, Sdf]) -> np.ndarray:
    colors = np.tile([0.38, 0.26, 0.15], (len(points), 1))
    face = _level(points, [0.135, 0, 0.068], [0.03, 0.04, 0.032]) < 1.0
    colors[face] = [0.8, 0.68, 0.48]
    colors[parts["snout"](points) < 0.002] = [0.12, 0.07, 0.05]
    for side in (1, -1):
        eye = _level(points, [0.132, 0.022 * side, 0.08])
        colors[eye < 0.012] = [0.2, 0.12, 0.08]
        colors[eye < 0.006] = [0.01, 0.01, 0.01]
    tips = (np.abs(points[:, 1]) > 0.115) | ((points[:, 0] < -0.1) & (np.abs(points[:, 1]) > 0.075))
    colors[tips] = [0.62, 0.5, 0.36]
    # Dark rings on the limbs and a stripe along the back add texture for trackers.
    rings = (np.sin(points @ np.array([90.0, 130.0, 40.0])) > 0.55) & ~face
    colors[rings] *= 0.55
    return colors


def _paint_zebra(points: np.ndarray, parts: Mapping[str, Sdf]) -> np.ndarray:
    wave = points[:, 0] * 230.0 + 3.0 * np.sin(points[:, 2] * 60.0) + 1.5 * np.sin(points[:, 1] * 70.0)
    legs = np.min([parts[name](points) for name in parts if name.startswith("leg")], axis=0) < 0.004
    wave = np.where(legs & (points[:, 2] < 0.07), points[:, 2] * 260.0, wave)
    colors = np.where(np.sin(wave)[:, None] > 0.1, [0.85, 0.83, 0.78], [0.05, 0.05, 0.06])
    colors[parts["snout"](points) < 0.0] = [0.1, 0.09, 0.1]
    mane = (np.abs(points[:, 1]) < 0.008) & (points[:, 2] > 0.13) & (points[:, 0] < 0.1)
    colors[mane] = [0.03, 0.03, 0.03]
    for side in (1, -1):
        colors[_level(points, [0.128, 0.026 * side, 0.172]) < 0.007] = [0.3, 0.16, 0.05]
    return colors


def _paint_dinosaur(points: np.ndarray, parts: Mapping[str, Sdf]) -> np.ndarray:
    colors = np.tile([0.16, 0.42, 0.2], (len(points), 1))
    belly = _level(points, [0.05, 0, 0.075], [0.03, 0.036, 0.055]) < 1.0
    colors[belly] = [0.75, 0.72, 0.42]
    cell = np.floor(points / 0.018).astype(int)
    speckled = ((cell * [7, 13, 29]).sum(axis=1) % 5 == 0) & ~belly
    colors[speckled] = [0.08, 0.24, 0.12]
    for name in parts:
        if name.startswith("spike"):
            colors[parts[name](points) < 0.003] = [0.75, 0.35, 0.08]
    for side in (1, -1):
        eye = _level(points, [0.095, 0.024 * side, 0.19])
        colors[eye < 0.01] = [0.85, 0.85, 0.8]
        colors[eye < 0.006] = [0.01, 0.01, 0.01]
    return colors
