"""The least that a spring and a substep cost: bytes moved once through, and arithmetic.

Float32. Counted are the equations of a spring and their adjoint, not what a compiler makes of them: of the three divisions by a
length two count as products. A substep goes once through its springs and nodes, and keeps nothing of them for the next one. Springs
are rows at their lower ends, so that a spring names its other end alone. Arithmetic of nodes is left out. The least time is this
over the machine's limits; the table shows its share of the time measured.
"""

from __future__ import annotations

from dataclasses import dataclass

from tests.benchmarks.limits import Limits


@dataclass(frozen=True)
class Work:
    """Of a spring and a substep."""

    shared: int
    """Bytes of a spring that twins of one topology share: its upper end."""
    spring: int
    """Bytes of a spring of one twin: stiffness, rest length, dashpot and their adjoints."""
    node: int
    """Bytes of a node of one twin: state, force, velocity after it, and their adjoints."""
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
        """(bandwidth, arithmetic): the least time by either, over the seconds that a frame of `batch` twins took.

        Roots and multiply-adds may run at the same time: the longer of the two is the least.
        """
        count = springs * substeps * batch
        rate = limits.bandwidth_of(self.working_set(nodes, springs, substeps, batch))
        moving = count * self.bytes_per_spring(nodes, springs, batch) / rate
        counting = count * max(self.fused / limits.fused, self.roots / limits.roots)
        return moving / seconds, counting / seconds


FORWARD = Work(shared=4, spring=12, node=84, fused=28, roots=1, kept=0)
"""Node: x and v are read and written, the force is written and read, the velocity after it is written."""
FORWARD_BACKWARD = Work(shared=8, spring=48, node=240, fused=89, roots=2, kept=36)
"""Backward, the parameters of a spring are read, and their adjoints read and written. Of a node x, v and the velocity after the
forces are read, which were kept; their adjoints and those of the drag's factor and of the ground's elasticity and friction are read
and written, that of the force is written and read."""
