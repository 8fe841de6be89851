"""npz + JSON: every array and setting of a twin, described well enough to be read and simulated without this project."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring import __version__
from neuspring.core.artifacts import SCALARS, Artifact, Material, Topology
from neuspring.core.files import write_atomically, write_text
from neuspring.export.equations import EQUATIONS
from neuspring.export.source import Source
from neuspring.splats.model import Splats

FORMAT, VERSION = "neuspring-plain", 1
"""Of the description. A reader should refuse a version that it does not know."""
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
    "drag": ("1/s", "exponential decay of velocity"),
    "ground_elasticity": ("1", "part of the normal speed that is left"),
    "ground_friction": ("1", "Coulomb's coefficient"),
    "contact_elasticity": ("1", "as ground_elasticity, between nodes"),
    "contact_friction": ("1", "as ground_friction, between nodes"),
    "contact_distance": ("m", "distance below which approaching nodes collide"),
}
MOTION: dict[str, tuple[str, str, str]] = {
    "frame": ("F", "1", "number of the frame; frame 0 is where the motion starts"),
    "time": ("F", "s", "since frame 0"),
    "positions": ("F,N,3", "m", "predicted nodes; of a mean over seeds or a corrected prediction, not this twin's own rollout"),
    "hands": ("F,C,3", "m", "controllers"),
    "holds": ("F,C", "1", "whether each controller holds the object"),
    "velocity": ("N,3", "m/s", "of the nodes in frame 0"),
    "mass": ("N", "kg", "of each node"),
}


def write(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz and description.json of these frames to the folder `output`."""
    arrays, described = arrays_of(source, frames)
    values = settings_of(source)
    text = {
        "format": FORMAT,
        "version": VERSION,
        "made_by": f"neuspring {__version__}",
        "name": source.name,
        "made_from_sha256": source.made_from,
        "about": "A spring-mass twin: nodes that are joined by springs with dashpots, and moved by controllers.",
        "units": "SI: m, kg, s, N. Coordinates are right-handed; z is vertical.",
        "sizes": SIZES,
        "arrays": described,
        "settings": {name: {"value": values[name], "unit": unit, "about": about} for name, (unit, about) in SETTINGS.items()},
        "equations": EQUATIONS,
    }
    write_atomically(output / ARRAYS, lambda path: _save(path, arrays))
    write_text(output / DESCRIPTION, json.dumps(text, indent=1, allow_nan=False) + "\n")
    return [output / DESCRIPTION, output / ARRAYS]


def settings_of(source: Source) -> dict[str, Any]:
    """Settings and scalars of the material, by name."""
    simulation = source.twin.simulation
    values = dataclasses.asdict(simulation) | {"up_sign": int(simulation.up_sign)}
    return values | {name: float(getattr(source.twin.material, name)) for name in SCALARS}


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
            if "shape" in spec.metadata and value.size and spec.name not in MOTION:
                meta = spec.metadata
                # Splats declare their count as N, which is the nodes' here.
                sizes = ["G" if prefix and size == "N" else size for size in meta["shape"]]
                add(prefix + spec.name, ",".join(sizes), meta["unit"], meta["doc"], value)

    declared(Topology, source.twin.topology)
    declared(Material, source.twin.material)
    part = source.only(frames)
    moving = {"frame": part.frames, "time": part.times, "mass": source.masses}
    for name, (dimensions, unit, about) in MOTION.items():
        add(name, dimensions, unit, about, moving[name] if name in moving else getattr(part, name))
    if source.splats is not None:
        declared(Splats, source.splats, "splat_")
    return arrays, described


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
