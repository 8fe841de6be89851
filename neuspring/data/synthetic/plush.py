"""Plush animals: smooth unions of simple parts, soft filling of known, uneven stiffness in a skin of fabric.

A sloth that lies on its belly, a zebra on its four legs, a dinosaur that sits on its legs and tail. x points to the head.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuspring.data.synthetic.body import Body, Surface
from neuspring.data.synthetic.implicit import Sdf, capsule, ellipsoid, smooth_union, sphere, surface
from neuspring.data.synthetic.tetrahedra import boundary, embed, fill

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
"""m, of the lowest node above the table; its contact radius is 4 mm."""
Paint = Callable[[np.ndarray, Mapping[str, Sdf]], np.ndarray]


def sloth(spacing: float, skin_spacing: float) -> Body:
    """0.3 m long, arms and legs spread. Stiff head, soft limbs."""
    parts: dict[str, Sdf] = {
        "body": ellipsoid((0, 0, 0.05), (0.085, 0.06, 0.045)),
        "head": ellipsoid((0.1, 0, 0.062), (0.045, 0.05, 0.042)),
        "snout": ellipsoid((0.138, 0, 0.055), (0.018, 0.022, 0.018)),
    }
    for name, side in (("left", 1), ("right", -1)):
        parts[f"arm_{name}"] = capsule((0.05, 0.045 * side, 0.035), (0.11, 0.125 * side, 0.022), 0.02)
        parts[f"leg_{name}"] = capsule((-0.055, 0.04 * side, 0.032), (-0.12, 0.1 * side, 0.022), 0.021)
    softness = {"head": 2.0, "snout": 3.0, "arm": 0.8, "leg": 0.7}
    return _animal(parts, softness, _paint_sloth, spacing, skin_spacing)


def zebra(spacing: float, skin_spacing: float) -> Body:
    """0.28 m long, 0.19 m tall. Stiff head and legs, soft belly and tail."""
    parts: dict[str, Sdf] = {
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


def dinosaur(spacing: float, skin_spacing: float) -> Body:
    """0.32 m long with its tail, 0.2 m tall. Stiff head and tail, soft arms and legs."""
    parts: dict[str, Sdf] = {
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


def _animal(parts: Mapping[str, Sdf], factors: Mapping[str, float], paint: Paint, spacing: float, skin_spacing: float) -> Body:
    """`factors` multiply the filling's modulus in parts whose names begin so; the nearest part of a tetrahedron decides."""
    shape = smooth_union(parts, BLEND)
    low, high = (-0.24, -0.18, -0.02), (0.2, 0.18, 0.26)
    nodes, tetrahedra = fill(shape, low, high, spacing)
    vertices, faces = surface(shape, low, high, skin_spacing)
    element, weights = embed(vertices, nodes, tetrahedra)
    centers = nodes[tetrahedra].mean(axis=1)
    nearest = np.stack([part(centers) for part in parts.values()]).argmin(axis=0)
    of_part = [next((f for start, f in factors.items() if name.startswith(start)), 1.0) for name in parts]
    lift = np.array([0.0, 0.0, CLEARANCE - nodes[:, 2].min()])
    skin = boundary(tetrahedra)
    return Body(
        nodes=nodes + lift,
        surface=Surface(
            rest=vertices + lift,
            faces=faces,
            nodes=tetrahedra[element],
            weights=weights,
            colors=paint(vertices, parts),
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


def _paint_sloth(points: np.ndarray, parts: Mapping[str, Sdf]) -> np.ndarray:
    colors = np.tile([0.38, 0.26, 0.15], (len(points), 1))
    face = np.linalg.norm((points - [0.135, 0, 0.068]) / [0.03, 0.04, 0.032], axis=1) < 1.0
    colors[face] = [0.8, 0.68, 0.48]
    colors[parts["snout"](points) < 0.002] = [0.12, 0.07, 0.05]
    for side in (1, -1):
        eye = np.linalg.norm(points - [0.132, 0.022 * side, 0.08], axis=1)
        colors[eye < 0.012] = [0.2, 0.12, 0.08]
        colors[eye < 0.006] = [0.01, 0.01, 0.01]
    tips = (np.abs(points[:, 1]) > 0.115) | ((points[:, 0] < -0.1) & (np.abs(points[:, 1]) > 0.075))
    colors[tips] = [0.62, 0.5, 0.36]
    # Rings of darker fur on the limbs and a stripe along the back give trackers something to hold.
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
        colors[np.linalg.norm(points - [0.128, 0.026 * side, 0.172], axis=1) < 0.007] = [0.3, 0.16, 0.05]
    return colors


def _paint_dinosaur(points: np.ndarray, parts: Mapping[str, Sdf]) -> np.ndarray:
    colors = np.tile([0.16, 0.42, 0.2], (len(points), 1))
    belly = np.linalg.norm((points - [0.05, 0, 0.075]) / [0.03, 0.036, 0.055], axis=1) < 1.0
    colors[belly] = [0.75, 0.72, 0.42]
    cell = np.floor(points / 0.018).astype(int)
    speckled = ((cell * [7, 13, 29]).sum(axis=1) % 5 == 0) & ~belly
    colors[speckled] = [0.08, 0.24, 0.12]
    for name in parts:
        if name.startswith("spike"):
            colors[parts[name](points) < 0.003] = [0.75, 0.35, 0.08]
    for side in (1, -1):
        eye = np.linalg.norm(points - [0.095, 0.024 * side, 0.19], axis=1)
        colors[eye < 0.01] = [0.85, 0.85, 0.8]
        colors[eye < 0.006] = [0.01, 0.01, 0.01]
    return colors
