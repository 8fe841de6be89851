"""The elastic rod as data of a twin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from neuspring.core.artifacts import BodyData, Topology, Twin, array, number
from neuspring.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Rod(BodyData):
    """A long thin object as a discrete elastic rod (Bergou 2008, 2010): V vertices of a center line, and a frame per edge.

    Edge j joins vertices j and j + 1. Its frame is the unit tangent t and two directors m1, m2 = t x m1. A clamp holds the two
    outer vertices of an end. m1 of edge 0 is the projection of `axis`; m1 of the last edge is the same, rotated by `roll` about
    its tangent. Between clamps the twist is in equilibrium. With kb = 2 t_(i-1) x t_i / (1 + t_(i-1) t_i) the curvatures of joint
    i are k1 = kb (m2_(i-1) + m2_i) / 2 and k2 = -kb (m1_(i-1) + m1_i) / 2. With `by_angle` the length of kb is the angle between
    the edges, instead of 2 tan of half the angle. Nodes of the topology follow the line (`edge`, `place`).
    """

    kind: ClassVar[str] = "rod"
    vertices: np.ndarray = array("V,3", np.float64, "m", "center line in frame 0")
    held: np.ndarray = array("V", np.int32, "1", "controller that sets each vertex; -1: free")
    lengths: np.ndarray = array("E", np.float64, "m", "unloaded length of each edge", sign="positive")
    mass: np.ndarray = array("V", np.float64, "kg", "mass of each vertex", sign="positive")
    bending: np.ndarray = array("V", np.float64, "N m^2", "EI at each vertex; the ends are not used", sign="not negative")
    twisting: np.ndarray = array("V", np.float64, "N m^2", "GJ at each vertex; the ends are not used", sign="not negative")
    curvature: np.ndarray = array("V,2", np.float64, "1", "unloaded curvatures k1, k2 of each joint; the ends are not used")
    edge: np.ndarray = array("N", np.int32, "1", "edge that each node of the topology follows")
    place: np.ndarray = array("N,3", np.float64, "1, m, m", "each node's fraction along its edge, and distances along m1 and m2")
    line: np.ndarray = array(
        "M", np.int32, "1", "the observed line, see `Observations.line`; empty: found among nodes", omitted=True
    )
    axis: np.ndarray = array("3", np.float64, "1", "direction in the world whose projection is m1 of the first edge")
    clamps: np.ndarray = array(
        "2,3",
        np.float64,
        "m",
        "inner held vertex of each end from its controller: along t, m1 (without `roll`), m2",
        omitted=True,
    )
    """Markers are beside the center line of a cable. The direction between the two controllers gives the outer held vertex. With
    `tilts` the position is that of the middle of the held edge."""
    tilts: np.ndarray = array(
        "K,2",
        np.float64,
        "1",
        "direction t + a m1 + b m2 of the held edge of each end (K = 2), which keeps its length; see `clamps`",
        omitted=True,
    )
    """Present if the vertices are along the unloaded shape (rods/made.py)."""
    rolls: np.ndarray = array(
        "K",
        np.int32,
        "1",
        "controller towards which m1 of each end's edge points, from the outer held controller; -1: `axis`",
        omitted=True,
    )
    offsets: np.ndarray = array(
        "V,2", np.float64, "m", "point of the observed line from each free vertex: along m1, m2 of the edge after it", omitted=True
    )
    slip: np.ndarray = array(
        "P,2",
        np.float64,
        "1, 1/m",
        "branches that slip: share of EI and GJ, curvature at which each slips",
        sign="not negative",
        omitted=True,
    )
    """Friction inside the rod (Prandtl 1928, Iwan 1966). Moments are EI / l (k - k0 + damping dk/dt + sum share (k - z)), where z
    follows k, so that |k - z| is at most l times the second number. In frame 0 z = k. Twist has the same branches."""
    slip_twist: float = number("1", "twist slips at this times the curvatures of `slip`, rad/m; 0: no branches", default=0.0)
    by_angle: float = number("1", "1: the curvature of a joint is its angle; 0: 2 tan of half the angle", default=0.0)
    """A moment is EI times the angle per length. 2 tan of half the angle is stiffer by angle^2 / 3, so the error grows with fewer
    vertices. Rods of markers use it, like their authors."""
    stretching: float = number("N", "EA")
    damping: float = number("s", "time of inner damping: moments are EI / l (k - k0 + damping dk/dt)")
    drag_quadratic: float = number("1/m", "deceleration by air is this times speed squared; the material has the linear drag")
    roll: float = number("rad", "rotation of the last edge's directors from the projection of `axis`")

    def check(self) -> None:
        edges = len(self.vertices) - 1
        if edges < 2 or len(self.lengths) != edges:
            raise InputError(
                "rod.lengths", "at least 3 vertices, and one length per edge, are required", (edges + 1, len(self.lengths))
            )
        if not (
            self.stretching > 0
            and self.damping >= 0
            and self.drag_quadratic >= 0
            and self.slip_twist >= 0
            and np.isfinite(self.roll)
        ):
            rule = "stretching > 0, damping, drag_quadratic, slip_twist >= 0 and a finite roll are required"
            raise InputError("rod", rule, (self.stretching, self.damping, self.drag_quadratic, self.slip_twist, self.roll))
        if self.laid and len(self.tilts) != 2:
            raise InputError("rod.tilts", "one row per end, or none, is required", len(self.tilts))
        if len(self.edge) and not 0 <= self.edge.min() <= self.edge.max() < edges:
            raise InputError("rod.edge", f"indices must be in [0, {edges})", [int(self.edge.min()), int(self.edge.max())])

    def check_with(self, topology: Topology) -> None:
        if len(self.edge) != len(topology.nodes):
            raise InputError("twin.body", f"one edge per node ({len(topology.nodes)}) is required", len(self.edge))
        if topology.object_spring_count:
            raise InputError("twin.body", "a rod must not have springs between nodes", topology.object_spring_count)
        if self.held.max() >= len(topology.controllers):
            raise InputError("twin.body.held", f"controllers must be in [0, {len(topology.controllers)})", int(self.held.max()))

    @property
    def counts(self) -> dict[str, int]:
        return {"vertices": len(self.vertices)}

    @property
    def laid(self) -> bool:
        """Whether the vertices are along the unloaded shape: they are not observed, and nodes keep their positions on the line."""
        return bool(self.tilts.size)

    @property
    def spans(self) -> np.ndarray:
        """Unloaded length of each vertex [V], m: half of its edges."""
        return np.convolve(self.lengths, [0.5, 0.5])


def pieces(line: np.ndarray) -> np.ndarray:
    """Distances from each point of a line [n, 3] to the next [n - 1], m."""
    return np.asarray(np.linalg.norm(np.diff(line, axis=0), axis=1))


def arc_of(lengths: np.ndarray) -> np.ndarray:
    """Arc lengths of the points of a line [n + 1], m, from the distances between them [n]."""
    return np.concatenate([[0.0], np.cumsum(lengths)])


def rod_of(twin: Twin) -> Rod:
    """The rod of a twin."""
    assert isinstance(twin.body, Rod)
    return twin.body
