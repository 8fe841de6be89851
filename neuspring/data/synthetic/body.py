"""A body at rest, with its true materials and its textured skin."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

NO_TETRAHEDRA = np.zeros((0, 4), dtype=int)
NO_TRIANGLES = np.zeros((0, 3), dtype=int)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The visible skin: triangles whose vertices are bound to mesh nodes once, hence exact correspondences in every frame."""

    rest: np.ndarray
    """Vertices at rest [V, 3], m; the texture is a function of these."""
    faces: np.ndarray
    """[F, 3] indices of vertices, outward."""
    nodes: np.ndarray
    """[V, k] nodes that a vertex follows."""
    weights: np.ndarray
    """[V, k] their weights, sum 1."""
    colors: np.ndarray
    """[V, 3] linear RGB in [0, 1], before the fine texture."""

    def follow(self, positions: np.ndarray) -> np.ndarray:
        """Vertices [..., V, 3] for node positions [..., N, 3]."""
        return np.asarray(np.einsum("...vkc,vk->...vc", positions[..., self.nodes, :], self.weights))


@dataclass(frozen=True, kw_only=True)
class Body:
    """Geometry and true material. Solids are tetrahedra (some with a fabric skin), sheets are triangles with bending."""

    nodes: np.ndarray
    """Rest positions [N, 3], m, resting on or above the table z = 0."""
    surface: Surface
    radius: float
    """Contact radius of a node, m."""
    tetrahedra: np.ndarray = field(default_factory=lambda: NO_TETRAHEDRA)
    """[E, 4]."""
    youngs_modulus: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[E], Pa."""
    poisson_ratio: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[E]."""
    density: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[E], kg/m^3."""
    triangles: np.ndarray = field(default_factory=lambda: NO_TRIANGLES)
    """[M, 3]: the sheet, or the fabric skin of a solid."""
    membrane: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[M], N/m: in-plane stiffness of triangles."""
    sheet_density: float = 0.0
    """kg/m^2; zero for skins, whose mass is in the solid."""
    bending: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[N], N m: bending stiffness of a sheet around each node (its edges take the mean of their ends)."""
    air_drag: float = 0.0
    """Aerodynamic drag of triangles."""
    viscosity: tuple[float, float] = (0.0, 0.1)
    """Maxwell branch: its modulus in parts of Young's modulus, and its relaxation time, s."""
    contact_stiffness: float = 150.0
    """Contact stiffness of nodes against table and hands, N/m."""
    contact_damping: float = 0.02
    """Contact damping of nodes against table and hands, N s/m."""
    self_contact: bool = False
    self_contact_stiffness: float = 40.0
    """N/m; nodes repel each other within two radii."""
    friction: float = 0.6
    """Coulomb coefficient on table and hands."""

    @property
    def is_sheet(self) -> bool:
        return len(self.tetrahedra) == 0
