"""npz and JSON: every array and setting of a twin, with a description that suffices to simulate it without NeuSpring."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.artifacts import SCALARS, Artifact, Material, kept
from neuspring.core.files import write_atomically, write_text
from neuspring.core.version import __version__
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.source import ExportSource
from neuspring.twin.body import body_of

ARRAYS_FILE, DESCRIPTION_FILE = "arrays.npz", "description.json"
SIZE_MEANINGS = {
    "N": "nodes",
    "C": "controllers: tracked points that move the object, for example on hands or grippers",
    "S": "springs",
    "R": "nodes, then controllers",
    "B": "springs",
    "F": "exported frames",
    "G": "splats",
    "A": "1 (isotropic) or 3",
    "K": "coefficients of spherical harmonics per channel: 1, 4, 9 or 16",
}
EXPORTED_SETTINGS = {
    "frame_time": ("s", "simulated time per frame"),
    "substeps": ("1", "steps per frame"),
    "gravity": ("m/s^2", "downward acceleration"),
    "up_sign": ("1", "1: +z is up; -1: -z is up"),
    "ground": ("1", "whether the plane z = 0 is the ground"),
    "self_collision": ("1", "whether nodes collide with each other"),
    "controller_velocity": ("1", "whether dashpots include the velocity of controllers"),
}
EXPORTED_SETTINGS |= {
    spec.name: (spec.metadata["unit"], spec.metadata["doc"]) for spec in dataclasses.fields(Material) if spec.name in SCALARS
}
MOTION = {
    "frame": ("F", "1", "frame number; the motion starts in frame 0"),
    "time": ("F", "s", "time since frame 0"),
    "positions": ("F,N,3", "m", "predicted positions of the nodes"),
    "hands": ("F,C,3", "m", "positions of the controllers"),
    "holds": ("F,C", "1", "whether each controller holds the object"),
    "velocity": ("N,3", "m/s", "velocities of the nodes in frame 0"),
    "mass": ("N", "kg", "mass of each node"),
}


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz and description.json of these frames to the folder `output`."""
    arrays, described = arrays_of(source, frames)
    twin, body = source.twin, body_of(source.twin)
    values = dataclasses.asdict(twin.simulation) | {"up_sign": int(twin.simulation.up_sign)}
    values |= {name: float(getattr(twin.material, name)) for name in SCALARS}
    settings = dict(EXPORTED_SETTINGS)
    for part in [twin.body] if twin.body else []:
        numbers = [
            spec for spec in dataclasses.fields(part) if "shape" not in spec.metadata and kept(spec, getattr(part, spec.name))
        ]
        settings |= {spec.name: (spec.metadata["unit"], spec.metadata["doc"]) for spec in numbers}
        values |= {spec.name: float(getattr(part, spec.name)) for spec in numbers}
    text = {
        # Each body has its own format, so that no reader simulates one body as another.
        "format": body.format,
        # Version 2 stops readers that would let springs pull that only push.
        "version": 2 if twin.topology.pushes.any() else body.version(twin),
        "made_by": f"neuspring {__version__}",
        "name": source.name,
        "made_from_sha256": source.made_from,
        "about": f"{body.about}, and moved by controllers.",
        "mass": {"value": source.total_mass, "unit": "kg", "about": source.weight},
        "units": "SI: m, kg, s, N. Coordinates are right-handed; z is vertical.",
        "sizes": SIZE_MEANINGS | dict(body.sizes),
        "arrays": described,
        "settings": {name: {"value": values[name], "unit": unit, "about": about} for name, (unit, about) in settings.items()},
        "equations": [" ".join(paragraph.split()) for paragraph in body.equations.strip().split("\n\n")],
    }

    save_arrays(output / ARRAYS_FILE, arrays)
    write_text(output / DESCRIPTION_FILE, json.dumps(text, indent=1, allow_nan=False) + "\n")
    return [output / DESCRIPTION_FILE, output / ARRAYS_FILE]


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays as a compressed npz, atomically."""

    def save(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]

    write_atomically(path, save)


def arrays_of(source: ExportSource, frames: Sequence[int]) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
    """The arrays, and the description of each: dimensions, shape, dtype, unit, meaning."""
    arrays = {}
    described = {}

    def add(name: str, dimensions: str, unit: str, about: str, value: np.ndarray) -> None:
        arrays[name] = value
        shape = {"dimensions": dimensions.split(","), "shape": list(value.shape), "dtype": value.dtype.name}
        described[name] = shape | {"unit": unit, "about": about}

    def declared(values: Artifact, prefix: str = "") -> None:
        for spec in dataclasses.fields(values):
            value = getattr(values, spec.name)
            if "shape" in spec.metadata and value.size and prefix + spec.name not in MOTION:
                meta = spec.metadata
                # Splats declare their count as N, but here N counts nodes.
                sizes = ["G" if prefix == "splat_" and size == "N" else size for size in meta["shape"]]
                add(prefix + spec.name, ",".join(sizes), meta["unit"], meta["doc"], value)

    declared(source.twin.topology)
    declared(source.twin.material)
    if source.twin.body:
        declared(source.twin.body, f"{source.twin.body.kind}_")
    part = source.only(frames)
    moving = {"frame": part.frames, "time": part.times, "mass": source.masses}
    for name, (dimensions, unit, about) in MOTION.items():
        if name == "mass" and not source.masses.any():
            continue  # Other points of the body have the mass.
        add(name, dimensions, unit, about, moving[name] if name in moving else getattr(part, name))
    if source.splats is not None:
        declared(source.splats, "splat_")
    return arrays, described


export = Export(write=write, name="{name}_npz", then="Next: read {output}/description.json")
