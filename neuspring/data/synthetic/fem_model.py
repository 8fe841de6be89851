"""A body in the terms of the finite-element engine: nodes with mass, elements with moduli, contacts with table and fists."""

from __future__ import annotations

from collections.abc import Callable

import newton
import numpy as np
import warp as wp

from neuspring.data.synthetic.body import Body
from neuspring.data.synthetic.hands import FIST_RADIUS
from neuspring.data.synthetic.tetrahedra import edges

GRAVITY = 9.81
"""m/s^2, towards -z."""
LEAST_MASS = 0.3
"""Nodes of a solid weigh at least this fraction of the median node; lighter ones alone would dictate the step."""
MAX_SPEED = 20.0
"""m/s; the engine clips faster nodes."""
Moduli = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def lame(youngs_modulus: np.ndarray, poisson_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lame parameters mu, lambda, Pa."""
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def stable_moduli(youngs_modulus: np.ndarray, poisson_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the semi-implicit engine's stable neo-Hookean energy (Smith et al. 2018) needs to have these small-strain moduli:
    4/3 mu and lambda + 5/6 mu."""
    mu, first = lame(youngs_modulus, poisson_ratio)
    return 4.0 / 3.0 * mu, first + 5.0 / 6.0 * mu


def build(body: Body, fists: int, moduli: Moduli = stable_moduli, dashpots: bool = True, colored: bool = False) -> newton.Model:
    """The engine's model of a body, a table and kinematic fists.

    `dashpots`: a spring of no stiffness on every edge of a solid, whose damping the caller sets. `colored`: nodes in groups that
    do not meet, for solvers that move one node after the other.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    shape = builder.default_shape_cfg.copy()
    shape.mu, shape.ke, shape.kd, shape.kf = body.friction, body.contact_stiffness, body.contact_damping, 0.0
    builder.add_ground_plane(cfg=shape)
    if body.is_sheet:
        _add_sheet(builder, body)
    else:
        _add_solid(builder, body, moduli, dashpots)
    for _ in range(fists):
        link = builder.add_body(is_kinematic=True, mass=1.0)
        builder.add_shape_sphere(link, radius=FIST_RADIUS, cfg=shape)
    if colored:
        builder.color(include_bending=body.is_sheet)
    model = builder.finalize(device="cpu")
    if body.self_contact:
        model.particle_ke, model.particle_kd = body.self_contact_stiffness, 0.01
        model.particle_kf, model.particle_mu = 0.0, 0.3
    else:
        model.particle_grid = None
    model.soft_contact_ke, model.soft_contact_kd = body.contact_stiffness, body.contact_damping
    model.soft_contact_kf, model.soft_contact_mu = 0.0, 0.0
    model.particle_max_velocity = MAX_SPEED
    return model


def _add_solid(builder: newton.ModelBuilder, body: Body, moduli: Moduli, dashpots: bool) -> None:
    for node in body.nodes:
        builder.add_particle(wp.vec3(*node), wp.vec3(), 0.0, body.radius)
    mass = np.zeros(len(body.nodes))
    elastic = zip(*moduli(body.youngs_modulus, body.poisson_ratio), strict=True)
    for corners, (mu, first), density in zip(body.tetrahedra.tolist(), elastic, body.density, strict=True):
        a, b, c, d = corners
        volume = builder.add_tetrahedron(a, b, c, d, float(mu), float(first), 0.0)
        mass[corners] += density * volume / 4.0
    builder.particle_mass[:] = np.maximum(mass, LEAST_MASS * np.median(mass)).tolist()
    for corners, stiffness in zip(body.triangles.tolist(), body.membrane, strict=True):
        ke = float(stiffness)
        builder.add_triangle(*corners, tri_ke=ke, tri_ka=ke / 2.0, tri_kd=0.0, tri_drag=body.air_drag, tri_lift=0.0)
    for i, j in edges(body.tetrahedra).tolist() if dashpots else ():
        builder.add_spring(i, j, 0.0, 0.0, 0.0)


def _add_sheet(builder: newton.ModelBuilder, body: Body) -> None:
    builder.add_cloth_mesh(
        pos=(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),  # type: ignore[arg-type]
        scale=1.0,
        vel=(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*node) for node in body.nodes],
        indices=body.triangles.ravel().tolist(),
        density=body.sheet_density,
        tri_ke=1.0,
        tri_ka=1.0,
        tri_kd=0.0,
        edge_ke=1.0,
        edge_kd=0.0,
        particle_radius=body.radius,
        tri_drag=body.air_drag,
    )
    materials = np.array(builder.tri_materials)
    materials[:, 0], materials[:, 1] = body.membrane, body.membrane / 2.0
    builder.tri_materials[:] = [tuple(row) for row in materials.tolist()]
    hinges = np.array(builder.edge_bending_properties)
    hinges[:, 0] = body.bending[np.array(builder.edge_indices)[:, 2:]].mean(axis=1)
    builder.edge_bending_properties[:] = [tuple(row) for row in hinges.tolist()]
