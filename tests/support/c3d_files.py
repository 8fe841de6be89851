"""C3D files."""

import ezc3d
import numpy as np


def write_c3d(path, points, labels, unit="mm", rate=30.0, lost=None):
    """Markers [T, K, 3] in a unit, empty: none said; `lost` [T, K] bool: whose residual is -1."""
    content = ezc3d.c3d()
    about = content["parameters"]["POINT"]
    about["RATE"]["value"], about["LABELS"]["value"], about["UNITS"]["value"] = [rate], list(labels), [unit]
    stored = np.ones((4, *points.shape[1::-1]))
    stored[:3] = np.moveaxis(points, 2, 0).swapaxes(1, 2)
    content["data"]["points"] = stored
    if lost is not None:
        content["data"]["meta_points"]["residuals"] = np.where(lost.T, -1.0, 0.0)[None]
    content.write(str(path))
    return path
