"""Meshes of other programs (GLB, PLY, OBJ, STL), read by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from neuspring.core.errors import InputError


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and outward faces [F, 3] of the file's whole geometry as one closed surface.

    Raises InputError for a file that is missing, unreadable, empty, not finite or not closed.
    """
    if not Path(path).is_file():
        raise InputError(path, "this mesh must exist", "no such file")
    try:
        mesh = trimesh.load_mesh(path, process=True, maintain_order=False)
    except Exception as error:
        # trimesh's readers have no common exception for damaged bytes.
        raise InputError(
            path, "this file must be a readable mesh (GLB, PLY, OBJ, STL)", f"{type(error).__name__}: {error}"
        ) from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(path, "at least one triangle is required", "none")
    # Textured exports split vertices along seams.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not np.isfinite(mesh.vertices).all():
        raise InputError(path, "every vertex must be finite", "a vertex that is not")
    if not mesh.is_watertight:
        remedy = "Close it in a mesh editor; points are drawn inside it."
        raise InputError(path, "the surface must be closed", f"{len(mesh.faces)} triangles with open or branching edges", remedy)
    trimesh.repair.fix_normals(mesh)
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=int)
