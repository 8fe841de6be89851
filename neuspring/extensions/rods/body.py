"""The rod: a body whose nodes follow an elastic center line (Bergou et al. 2008, 2010)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neuspring.config import Config
from neuspring.config.simulation import RestLengths
from neuspring.core.artifacts import Observations, Twin
from neuspring.extensions.rods.rod import Rod, rod_of
from neuspring.extensions.rods.settings import RodFit
from neuspring.twin.body import Body, Lines, SearchOptions

if TYPE_CHECKING:
    from neuspring.extensions.rods.fit import RodResult
    from neuspring.extensions.rods.nodes import RodFrames
    from neuspring.twin.fit import FitProblem


class RodBody(Body):
    """A discrete elastic rod in `Twin.body`; only controllers have springs."""

    name = "rod"
    fits = ("rod",)
    reads = ("rod", "fit.rod")
    format = "neuspring-rod"
    about = "A rod: nodes that follow an elastic center line"
    convention = "1 kg per m of a cable between clamps, 1 kg per node of a rope"
    sizes = {
        "V": "vertices of the center line",
        "E": "edges between them",
        "M": "observed points of the line",
        "P": "branches that slip inside",
    }
    equations = """
A discrete elastic rod (Bergou et al. 2008, 2010) has vertices x_0 .. x_E, edges e_j = x_(j+1) - x_j with tangents t_j, and unit
directors m1_j, m2_j = t_j x m1_j. Inner vertex i has the curvature binormal kb = 2 t_(i-1) x t_i / (1 + t_(i-1) . t_i) and the
curvatures k1 = kb . (m2_(i-1) + m2_i) / 2 and k2 = -kb . (m1_(i-1) + m1_i) / 2. l_i is half of the unloaded lengths of its edges.
With by_angle = 1 the length of kb is the angle between the edges.

The energy is sum_i bending_i |k_i - curvature_i|^2 / (2 l_i) + sum_i twisting_i m_i^2 / (2 l_i) + sum_j stretching (|e_j| /
length_j - 1)^2 length_j / 2. The twist m_i is the angle from m1_(i-1), parallel-transported to t_i, to m1_i. With inner damping,
k_i + damping dk_i/dt replaces k_i in the moments of bending.

Each row (s, y) of rod_slip is a branch that slips. It adds s bending_i / l_i (k_i - z) to the moments of bending. z is k_i in
frame 0 and then follows k_i, so that |k_i - z| <= y l_i: at the limit, d(k - z) is dk without an outward component along k - z.
Twist has the same branches, s twisting_i / l_i (m_i - z) with |m_i - z| <= slip_twist y l_i.

An end is clamped if its two outer vertices are held. m1 of the first edge is then the projection of rod_axis; m1 of the last edge
is the same, rotated by roll about its tangent. At all other edges the moments about the tangent, including inner damping, are in
balance.

mass_i dv_i/dt = force - mass_i (gravity up_sign (0, 0, 1) + (drag + drag_quadratic |v_i|) v_i). A vertex with rod_held >= 0 has
the position of that controller. With rod_clamps, the inner held vertex of an end is at these distances from its controller along
t, m1 (without roll) and m2, with t along the two controllers; the outer vertex is at the controllers' distance along -t or t.
With rod_tilts (a, b), this position is that of the middle of the held edge, which keeps its length along t + a m1 + b m2. With
rod_rolls >= 0 the axis is the current direction from the outer held controller to this one. Integration is implicit, BDF2 with
`substeps` steps per frame.

A node n is at x_j + f e_j + a m1_j + b m2_j with j = rod_edge and (f, a, b) = rod_place. A spring (controller, node) pulls it
with stiffness (l / rest_length - 1) + dashpot dl/dt; it acts if `holds` is true in this frame and the next. The ground reflects a
vertex that passes its height (the nodes' 0.9 quantile of (a^2 + b^2)^(1/2), or its height in frame 0, above z = 0): (c v_x, c
v_y, -ground_elasticity v_z), c = max(0, 1 - ground_friction (1 + ground_elasticity) |v_z| / |v_xy|).
"""

    def describes(self, twin: Twin) -> bool:
        return isinstance(twin.body, Rod)

    def search(
        self, observations: Observations, pool: Sequence[Observations], settings: Config, options: SearchOptions
    ) -> RodResult:
        """The constants of a rod; see `fit.search_rod`. It has no regions and no randomness, and does not resume."""
        from neuspring.extensions.rods.fit import search_rod

        return search_rod(observations, pool, settings, device=options.device, threads=options.threads, record=options.record)

    def fit(self, problem: FitProblem, *, partial: Path | None = None, key: str = "", threads: int = 1) -> RodResult:
        """All variables of a rod; see `fit.fit_rod`. It does not resume."""
        from neuspring.extensions.rods.fit import fit_rod

        return fit_rod(
            problem.observations,
            problem.pool,
            problem.twin,
            problem.fit.section(RodFit),
            oracle=problem.oracle,
            device=problem.device,
            threads=threads,
        )

    def require_pool(self, here: Observations, pool: Sequence[Observations]) -> None:
        """Require recordings with one center line; see `fit.require_pool`. Nodes around the line may differ."""
        from neuspring.extensions.rods.fit import require_pool

        require_pool(here, pool)

    def on_recording(self, twin: Twin, observations: Observations, rest_lengths: RestLengths) -> Twin:
        """The rod on the line of frame 0; see `made.on_recording`."""
        from neuspring.extensions.rods.made import on_recording

        return on_recording(twin, observations)

    def solver(self, twin: Twin, device: str = "cpu") -> RodFrames:
        from neuspring.extensions.rods.nodes import RodFrames

        return RodFrames(twin, device)

    def lines(self, twin: Twin) -> Lines:
        """The edges of the center line, then the springs of controllers."""
        from neuspring.extensions.rods.nodes import at_vertices

        topology, rod = twin.topology, rod_of(twin)
        points = len(topology.nodes) + len(topology.controllers)
        edges = points + np.arange(len(rod.lengths))
        return Lines(
            pairs=np.concatenate([np.stack([edges, edges + 1], axis=1), topology.springs]),
            rest_lengths=np.concatenate([rod.lengths, topology.rest_lengths]),
            stiffness=np.concatenate([_edge_stiffness(rod), twin.material.stiffness]),
            inner=len(edges),
            kind="edges",
            about="edges, EI / l²",
            labels=np.full(points + len(rod.mass), topology.labels.min()),
            masses=np.concatenate([np.zeros(points), rod.mass]),
            points=lambda x, held: np.concatenate([x, held, at_vertices(rod, x, held)]),
        )

    def node_stiffness(self, twin: Twin) -> np.ndarray:
        """EI / l^2 of each node's edge [N], N."""
        return np.asarray(_edge_stiffness(rod_of(twin))[rod_of(twin).edge])

    def mass_at(self, twin: Twin, node: int) -> float:
        """Mass of the two vertices of the node's edge, kg."""
        edge = rod_of(twin).edge[node]
        return float(rod_of(twin).mass[edge : edge + 2].sum())

    def version(self, twin: Twin) -> int:
        """2 for a rod that slips inside or has `by_angle`; readers of version 1 would ignore both."""
        return 2 if len(rod_of(twin).slip) or rod_of(twin).by_angle else 1


def _edge_stiffness(rod: Rod) -> np.ndarray:
    """EI / l^2 of each edge [E], N."""
    return np.asarray((rod.bending[:-1] + rod.bending[1:]) / 2 / rod.lengths**2)


body = RodBody()
