"""PLY: the spring graph as vertices and edges, and splats in the layout of splat viewers; one file of each per frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neuspring.core.files import write_atomically
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.source import ExportSource
from neuspring.splats.model import Splats
from neuspring.twin.body import lines_of

VERTEX = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("mass", "<f4"), ("region", "<i4"), ("controller", "u1"), ("stiffness", "<f4")]
EDGE_DTYPE = [("vertex1", "<i4"), ("vertex2", "<i4")]
EDGE_DTYPE += [(name, "<f4") for name in ("stiffness", "dashpot", "rest_length", "strain")]
PLY_TYPE_NAMES = {"<f4": "float", "<i4": "int", "u1": "uchar"}
COMMENT = "units m, N, N s/m, kg; stiffness of a vertex: mean of its springs"


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write springs_<frame>.ply and, if the source has splats, splats_<frame>.ply to the folder `output`."""
    made = []
    for frame in frames:
        made.append(output / f"springs_{frame:05d}.ply")
        _write_elements(made[-1], {"vertex": vertices(source, frame), "edge": edges(source, frame)})
    if source.splats is not None:
        for frame, splats in source.moved_splats(frames):
            made.append(output / f"splats_{frame:05d}.ply")
            replace(splats, quaternions=unit_quaternions(splats)).save(made[-1])
    return made


def unit_quaternions(splats: Splats) -> np.ndarray:
    """Normalized orientations [N, 4], w first, because not every reader normalizes them."""
    return np.asarray(splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True))


def points(source: ExportSource, frame: int) -> np.ndarray:
    """Nodes, then controllers, then, of a rod, the vertices of its center line [P, 3], m."""
    return lines_of(source.twin).points(source.positions[frame], source.hands[frame])


def vertices(source: ExportSource, frame: int) -> np.ndarray:
    """One row per point, in the order of `Lines`. Controllers have region -1 and no mass. Without springs the stiffness is 0."""
    nodes, placed, lines = len(source.positions[frame]), points(source, frame), lines_of(source.twin)
    moved = nodes + len(source.hands[frame])
    table = np.zeros(len(placed), VERTEX)
    table["x"], table["y"], table["z"] = placed.T
    table["mass"] = lines.masses
    table["region"] = -1
    table["region"][:nodes] = source.twin.topology.labels
    table["controller"][nodes:moved] = 1
    springs, count = lines.pairs, len(placed)
    total = np.bincount(springs.ravel(), np.repeat(lines.stiffness, 2), count)
    table["stiffness"] = total / np.maximum(np.bincount(springs.ravel(), minlength=count), 1)
    return table


def edges(source: ExportSource, frame: int) -> np.ndarray:
    """One row per spring. For a rod, first one row per edge of its center line, with the stiffness EI / l^2."""
    lines, dashpot = lines_of(source.twin), source.twin.material.dashpot
    table = np.zeros(len(lines.pairs), EDGE_DTYPE)
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
        lines += [f"property {PLY_TYPE_NAMES[table.dtype[field].str.lstrip('|')]} {field}" for field in table.dtype.names or ()]
    head = "\n".join([*lines, "end_header", ""]).encode()
    content = head + b"".join(table.tobytes() for table in elements.values())
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


export = Export(write=write, frames="0", then="Next: open the files in {output}, for example in MeshLab")
