"""Random points within the alpha shape of a point cloud."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError

from neuspring.core.errors import NumericalFailure

LEAST_VOLUME = 1e-15
"""m^3: flatter tetrahedra have no circumscribed sphere worth naming."""


def points_within(cloud: np.ndarray, alpha: float, count: int, seed: int) -> np.ndarray:
    """`count` points [count, 3], m, uniform in the tetrahedra of the cloud [P, 3] whose circumscribed spheres have a
    radius below `alpha`, m.

    Raises NumericalFailure where there are none: a cloud that is flat, or sparser than alpha.
    """
    failure = NumericalFailure(f"appearance: the {len(cloud)} points seen in frame 0 enclose no volume at alpha = {alpha} m")
    try:
        corners = cloud[Delaunay(cloud).simplices]
    except (QhullError, ValueError) as error:
        raise failure from error
    edges = corners[:, 1:] - corners[:, :1]
    volumes = np.abs(np.linalg.det(edges)) / 6
    solid = volumes > LEAST_VOLUME
    corners, edges, volumes = corners[solid], edges[solid], volumes[solid]
    # The center c of the sphere has e . c = |e|^2 / 2 for the three edges e from one corner.
    centers = np.linalg.solve(edges, 0.5 * (edges**2).sum(axis=2)[..., None])[..., 0]
    inside = np.linalg.norm(centers, axis=1) < alpha
    if not inside.any():
        raise failure
    rng = np.random.default_rng(seed)
    tetrahedra = rng.choice(int(inside.sum()), count, p=volumes[inside] / volumes[inside].sum())
    weights = rng.dirichlet(np.ones(4), count)
    return np.asarray(np.einsum("pc,pcd->pd", weights, corners[inside][tetrahedra]))
