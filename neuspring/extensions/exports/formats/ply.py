"""PLY: the spring graph as vertices and edges, and splats in the layout of splat viewers, a file of each per frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuspring.core.files import write_atomically
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.source import Source
from neuspring.report.draw.twin import Lines

VERTEX = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("mass", "<f4"), ("region", "<i4"), ("controller", "u1"), ("stiffness", "<f4")]
EDGE = [
    *(("vertex1", "<i4"), ("vertex2", "<i4"), ("stiffness", "<f4"), ("dashpot", "<f4"), ("rest_length", "<f4")),
    ("strain", "<f4"),
]
WORDS = {"<f4": "float", "<i4": "int", "u1": "uchar"}
COMMENT = "units m, N, N s/m, kg; stiffness of a vertex: mean of its springs"


def write(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write springs_<frame>.ply and, where there are splats, splats_<frame>.ply to the folder `output`."""
    made = []
    for frame in frames:
        made.append(output / f"springs_{frame:05d}.ply")
        _write_elements(made[-1], {"vertex": vertices(source, frame), "edge": edges(source, frame)})
    if source.splats is not None:
        for frame, splats in source.moved_splats(frames):
            made.append(output / f"splats_{frame:05d}.ply")
            splats.save(made[-1])
    return made


def points(source: Source, frame: int) -> np.ndarray:
    """Nodes, then controllers, then, of a rod, the vertices of its center line [P, 3], m."""
    return Lines.of(source.twin).points(source.positions[frame], source.hands[frame])


def vertices(source: Source, frame: int) -> np.ndarray:
    """A row per point; a controller has no mass and region -1. Stiffness is 0 where there are no springs.

    Of a rod, vertices of the line have the mass, and nodes none.
    """
    nodes, placed, lines = len(source.positions[frame]), points(source, frame), Lines.of(source.twin)
    moved, rod = nodes + len(source.hands[frame]), source.twin.rod
    table = np.zeros(len(placed), VERTEX)
    table["x"], table["y"], table["z"] = placed.T
    if rod is None:
        table["mass"][:nodes] = source.masses
    else:
        table["mass"][moved:] = rod.mass
    table["region"] = -1
    table["region"][:nodes] = source.twin.topology.labels
    table["controller"][nodes:moved] = 1
    springs, count = lines.pairs, len(placed)
    total = np.bincount(springs.ravel(), np.repeat(lines.stiffness, 2), count)
    table["stiffness"] = total / np.maximum(np.bincount(springs.ravel(), minlength=count), 1)
    return table


def edges(source: Source, frame: int) -> np.ndarray:
    """A row per spring; of a rod, per edge of the line, whose stiffness is EI / l^2, and then per spring."""
    lines, dashpot = Lines.of(source.twin), source.twin.material.dashpot
    table = np.zeros(len(lines.pairs), EDGE)
    table["vertex1"], table["vertex2"] = lines.pairs.T
    table["stiffness"], table["rest_length"] = lines.stiffness, lines.rest_lengths
    table["dashpot"][len(table) - len(dashpot) :] = dashpot
    ends = points(source, frame)[lines.pairs]
    table["strain"] = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / lines.rest_lengths - 1
    return table


def _write_elements(path: Path, elements: dict[str, np.ndarray]) -> None:
    lines = ["ply", "format binary_little_endian 1.0", f"comment {COMMENT}"]
    for name, table in elements.items():
        lines.append(f"element {name} {len(table)}")
        lines += [f"property {WORDS[table.dtype[field].str.lstrip('|')]} {field}" for field in table.dtype.names or ()]
    head = "\n".join([*lines, "end_header", ""]).encode()
    content = head + b"".join(table.tobytes() for table in elements.values())
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


export = Export(write=write, frames="0")
