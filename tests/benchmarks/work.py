"""The least that a spring and a substep cost: bytes moved once through, and arithmetic.

Float32. Counted are the equations of a spring and their adjoint, not what a compiler makes of them. A substep reads its springs and
nodes once, and keeps nothing of them for the next substep. The least time is this over the machine's limits; the table shows its
share of the time measured.
"""

from __future__ import annotations

from dataclasses import dataclass

from tests.benchmarks.limits import Limits


@dataclass(frozen=True)
class Work:
    """Of a spring and a substep."""

    shared: int
    """Bytes of a spring that twins of one topology share: its two ends."""
    spring: int
    """Bytes of a spring of one twin: stiffness, rest length, dashpot and their adjoints."""
    node: int
    """Bytes of a node of one twin: state, force and their adjoints."""
    fused: int
    """Fused multiply-adds, or single additions and multiplications."""
    roots: int
    """Square roots with a division."""
    kept: int
    """Bytes of a node and substep that stay until the frame's end."""

    def bytes_per_spring(self, nodes: int, springs: int, batch: int) -> float:
        """Moved for a spring, substep and twin."""
        return self.shared / batch + self.spring + self.node * nodes / springs

    def working_set(self, nodes: int, springs: int, substeps: int, batch: int) -> float:
        """Bytes that a frame goes through again and again."""
        return self.shared * springs + batch * (self.spring * springs + (self.node + self.kept * substeps) * nodes)

    def shares(self, seconds: float, nodes: int, springs: int, substeps: int, batch: int, limits: Limits) -> tuple[float, float]:
        """(bandwidth, arithmetic): the least time by either, over the seconds that a frame of `batch` twins took."""
        count = springs * substeps * batch
        rate = limits.bandwidth_of(self.working_set(nodes, springs, substeps, batch))
        moving = count * self.bytes_per_spring(nodes, springs, batch) / rate
        counting = count * (self.fused / limits.fused + self.roots / limits.roots)
        return moving / seconds, counting / seconds


FORWARD = Work(shared=8, spring=12, node=72, fused=28, roots=1, kept=0)
"""Node: x and v read and written, the force added to and read."""
FORWARD_BACKWARD = Work(shared=16, spring=48, node=192, fused=89, roots=2, kept=36)
"""Backward, the adjoints of a spring and of a node's state and force are read and written. x, v and the velocity before the ground
are kept."""
