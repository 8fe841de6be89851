"""npz + JSON: every array and setting of a twin, described well enough to be read and simulated without this project."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.artifacts import SCALARS, Artifact, Material, Rod, Topology
from neuspring.core.files import write_atomically, write_text
from neuspring.core.version import __version__
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.source import Source
from neuspring.splats.model import Splats

FORMAT, VERSION = "neuspring-plain", 1
"""Of the description. A reader should refuse a version that it does not know."""
ROD_FORMAT = "neuspring-rod"
"""Of a twin that is a rod: a reader of the other would simulate its springs alone."""
ARRAYS, DESCRIPTION = "arrays.npz", "description.json"
SIZES = {
    "N": "nodes",
    "C": "controllers: points that are moved from outside, as hands or grippers",
    "S": "springs",
    "R": "nodes, then controllers",
    "B": "springs",
    "F": "exported frames",
    "G": "splats",
    "A": "1 (isotropic) or 3",
    "V": "vertices of a rod's center line",
    "E": "edges between them",
    "K": "coefficients of spherical harmonics per channel: 1, 4, 9 or 16",
}
SETTINGS: dict[str, tuple[str, str]] = {
    "frame_time": ("s", "simulated time per frame"),
    "substeps": ("1", "steps per frame"),
    "gravity": ("m/s^2", "acceleration downwards"),
    "up_sign": ("1", "1: +z is up; -1: -z is up"),
    "ground": ("1", "whether the plane z = 0 is the ground"),
    "self_collision": ("1", "whether nodes collide with each other"),
    "controller_velocity": ("1", "whether dashpots see the velocity of controllers"),
}
SETTINGS |= {
    spec.name: (spec.metadata["unit"], spec.metadata["doc"]) for spec in dataclasses.fields(Material) if spec.name in SCALARS
}
ROD_SETTINGS = {
    spec.name: (spec.metadata["unit"], spec.metadata["doc"]) for spec in dataclasses.fields(Rod) if "shape" not in spec.metadata
}
MOTION: dict[str, tuple[str, str, str]] = {
    "frame": ("F", "1", "number of the frame; frame 0 is where the motion starts"),
    "time": ("F", "s", "since frame 0"),
    "positions": ("F,N,3", "m", "predicted nodes"),
    "hands": ("F,C,3", "m", "controllers"),
    "holds": ("F,C", "1", "whether each controller holds the object"),
    "velocity": ("N,3", "m/s", "of the nodes in frame 0"),
    "mass": ("N", "kg", "of each node"),
}
EQUATIONS = """
Per frame there are `substeps` steps of dt = frame_time / substeps. Step k = 0, 1, ... of a frame does, in this order:

1. Controllers are at begin + (end - begin) u, u = (k + 1) / substeps, with begin and end the rows of `hands` of this frame and of
the next. Nodes are where the step before left them.

2. Spring (i, j): d = (x_j - x_i) / l, l = |x_j - x_i|; force on i: (stiffness (l / rest_length - 1) + dashpot (v_j - v_i) . d) d,
its negative on j. An index of N or more is controller index - N. Its velocity is 0; if controller_velocity is true, that of its
path. A spring with `pushes` has no force while l > rest_length.

3. A controller whose `holds` is false in this frame or in the next has springs without force in it.

4. w = v + dt (force / mass + (0, 0, -gravity up_sign)).

5. Drag: v' = w exp(-dt drag).

6. If self_collision: pairs of nodes that were closer than contact_distance at the begin of the frame, are so now, and approach
(dx . dv < 0) change their velocity. With n = dx / |dx|, u = v_j - v_i = u_n + u_t, u_n along n, a = max(0, 1 - contact_friction
(1 + contact_elasticity) |u_n| / |u_t|), node i loses the mean over its partners of mass_j / (mass_i + mass_j) (-(1 +
contact_elasticity) u_n + (a - 1) u_t).

7. x' = x + dt v'. If ground, and the step would take a node that moves down below z = 0 (z up_sign < 0): it moves to z = 0, its
velocity becomes (a v_x, a v_y, -ground_elasticity v_z), a = max(0, 1 - ground_friction (1 + ground_elasticity) |v_z| / |v_xy|),
and it goes on for the rest of dt.
"""
"""A step of the simulator, in its order, for readers who have only the exported files; a paragraph each."""
ROD_EQUATIONS = """
A discrete elastic rod (Bergou et al. 2008, 2010). Vertices x_0 .. x_E, edges e_j = x_(j+1) - x_j with tangents t_j and unit
directors m1_j, m2_j = t_j x m1_j. The curvature binormal of inner vertex i is kb = 2 t_(i-1) x t_i / (1 + t_(i-1) . t_i), its
curvatures are k1 = kb . (m2_(i-1) + m2_i) / 2 and k2 = -kb . (m1_(i-1) + m1_i) / 2, and l_i is half of the unloaded lengths of
its edges.

Energy: sum_i bending_i |k_i - curvature_i|^2 / (2 l_i) + sum_i twisting_i m_i^2 / (2 l_i) + sum_j stretching (|e_j| / length_j
- 1)^2 length_j / 2. The twist m_i is the angle from m1_(i-1), parallel-transported to t_i, to m1_i. Inner damping: k_i +
damping dk_i/dt takes the place of k_i in the moments of bending.

Directors of an end are held where its two outer vertices are: m1 of the first edge is rod_axis projected, that of the last the
same turned by roll about its tangent. All others are where moments about the tangents, inner damping among them, are in
balance.

mass_i dv_i/dt = force - mass_i (gravity up_sign (0, 0, 1) + (drag + drag_quadratic |v_i|) v_i). A vertex with rod_held >= 0 is
where that controller is. With rod_clamps, the inner held vertex of an end is beside its controller by these distances along t,
m1 (without roll) and m2, with t along the two controllers, and the outer one follows at the controllers' distance along -t or
t. The implicit integration is BDF2 with `substeps` steps per frame.

A node n is at x_j + f e_j + a m1_j + b m2_j with j = rod_edge and (f, a, b) = rod_place. A spring (controller, node) pulls
there with stiffness (l / rest_length - 1) + dashpot dl/dt; it acts where `holds` is true in this frame and the next. A vertex
that passes the ground (the nodes' 0.9 quantile of (a^2 + b^2)^(1/2), or its height in frame 0, above z = 0) is reflected: (c
v_x, c v_y, -ground_elasticity v_z), c = max(0, 1 - ground_friction (1 + ground_elasticity) |v_z| / |v_xy|).
"""
"""The same of a rod."""


def write(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz and description.json of these frames to the folder `output`."""
    arrays, described = arrays_of(source, frames)
    simulation, rod = source.twin.simulation, source.twin.rod
    values = dataclasses.asdict(simulation) | {"up_sign": int(simulation.up_sign)}
    values |= {name: float(getattr(source.twin.material, name)) for name in SCALARS}
    settings, equations, about = SETTINGS, EQUATIONS, "A spring-mass twin: nodes that are joined by springs with dashpots"
    if rod is not None:
        settings, equations, about = SETTINGS | ROD_SETTINGS, ROD_EQUATIONS, "A rod: nodes that follow an elastic center line"
        values |= {name: float(getattr(rod, name)) for name in ROD_SETTINGS}
    text = {
        "format": FORMAT if rod is None else ROD_FORMAT,
        # Who does not know springs that only push would let them pull.
        "version": 2 if source.twin.topology.pushes.any() else VERSION,
        "made_by": f"neuspring {__version__}",
        "name": source.name,
        "made_from_sha256": source.made_from,
        "about": f"{about}, and moved by controllers.",
        "units": "SI: m, kg, s, N. Coordinates are right-handed; z is vertical.",
        "sizes": SIZES,
        "arrays": described,
        "settings": {name: {"value": values[name], "unit": unit, "about": about} for name, (unit, about) in settings.items()},
        "equations": [" ".join(paragraph.split()) for paragraph in equations.strip().split("\n\n")],
    }

    def save(path: Path) -> None:
        with path.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]

    write_atomically(output / ARRAYS, save)
    write_text(output / DESCRIPTION, json.dumps(text, indent=1, allow_nan=False) + "\n")
    return [output / DESCRIPTION, output / ARRAYS]


def arrays_of(source: Source, frames: Sequence[int]) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
    """Arrays, and what is said of each: dimensions, shape, dtype, unit, meaning."""
    arrays: dict[str, np.ndarray] = {}
    described: dict[str, dict[str, Any]] = {}

    def add(name: str, dimensions: str, unit: str, about: str, value: np.ndarray) -> None:
        arrays[name] = value
        shape = {"dimensions": dimensions.split(","), "shape": list(value.shape), "dtype": value.dtype.name}
        described[name] = shape | {"unit": unit, "about": about}

    def declared(kind: type[Artifact], values: Artifact, prefix: str = "") -> None:
        for spec in dataclasses.fields(kind):
            value = getattr(values, spec.name)
            if "shape" in spec.metadata and value.size and prefix + spec.name not in MOTION:
                meta = spec.metadata
                # Splats declare their count as N, which is the nodes' here.
                sizes = ["G" if prefix == "splat_" and size == "N" else size for size in meta["shape"]]
                add(prefix + spec.name, ",".join(sizes), meta["unit"], meta["doc"], value)

    declared(Topology, source.twin.topology)
    declared(Material, source.twin.material)
    if source.twin.rod is not None:
        declared(Rod, source.twin.rod, "rod_")
    part = source.only(frames)
    moving = {"frame": part.frames, "time": part.times, "mass": source.masses}
    for name, (dimensions, unit, about) in MOTION.items():
        if name == "mass" and source.twin.rod is not None:
            continue  # its vertices have the mass
        add(name, dimensions, unit, about, moving[name] if name in moving else getattr(part, name))
    if source.splats is not None:
        declared(Splats, source.splats, "splat_")
    return arrays, described


export = Export(write=write, name="{name}_npz")
