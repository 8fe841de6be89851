"""Which part of a shape the cameras saw in frame 0; the rest is invented."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import trimesh

from neuspring.data.capture import OBJECT, Camera, Capture
from neuspring.perception.results import Masks


def seen(
    vertices: np.ndarray, capture: Capture, masks: Mapping[str, Masks], reach: float, faces: np.ndarray | None = None
) -> np.ndarray:
    """Whether some camera shows the object within `reach`, m, of each vertex [V] along its optical axis.

    With `faces` [F, 3], outward, a vertex must face that camera too: the back of a rope lies within any reach of its front.
    """
    result = np.zeros(len(vertices), dtype=bool)
    normals = None if faces is None else trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    for name, camera in capture.cameras.items():
        shown = visible(vertices, camera, masks[name].labels[0] == OBJECT, capture.depth(name, 0), reach)
        if normals is not None:
            shown &= ((camera.camera_to_world[:3, 3] - vertices) * normals).sum(axis=1) > 0
        result |= shown
    return result


def visible(vertices: np.ndarray, camera: Camera, mask: np.ndarray, depth: np.ndarray, reach: float) -> np.ndarray:
    """Whether the camera shows the object within `reach`, m, of each vertex [V]."""
    pixels, distance = camera.project(vertices)
    result = camera.sees(pixels) & (distance > 0)
    x, y = np.round(pixels[result]).astype(int).T
    result[result] = mask[y, x] & (np.abs(depth[y, x] - distance[result]) < reach)
    return np.asarray(result)


def invented_share(vertices: np.ndarray, faces: np.ndarray, was_seen: np.ndarray) -> float:
    """Share of the area of a mesh whose corners [F, 3] no camera saw; a face counts by the share of its corners."""
    corners = vertices[faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return float((area * (~was_seen[faces]).mean(axis=1)).sum() / area.sum())
