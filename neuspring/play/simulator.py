"""A twin that is pulled: one frame of simulation after another, under hands and a grab that are given as it goes.

A grabbed node follows its target by a spring without rest length, beside the twin's own springs: F = k (target - x) - c v_along,
with k the sum of the stiffnesses Y / l0 of the node's own springs, at most what the stability bound leaves at the twin's substep,
and c critical for the node's mass, bounded in the same way. The target is a controller more, and moves straight within a frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from neuspring.core.artifacts import Twin
from neuspring.physics import stability
from neuspring.physics.controllers import BEGINS
from neuspring.physics.solver import FrameSolver, solver_for
from neuspring.twin.rollout import FAR, Diverged

REST = 1e-6
"""Rest length of the spring of a grab, m: the solver has none of length 0."""
MARGIN = 0.9
"""Part of the stability bound that twin and grab may use together."""


@dataclass(frozen=True, eq=False)
class Start:
    """The state that a twin begins in. What is None is as in its frame 0: there, at rest, and all hands hold."""

    positions: np.ndarray | None = None
    """[N, 3], m."""
    velocity: np.ndarray | None = None
    """[N, 3], m/s."""
    hands: np.ndarray | None = None
    """[C, 3], m."""
    holds: np.ndarray | None = None
    """Which hands hold [C], and 2 where one takes hold in this moment (physics/controllers.py)."""
    grips: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    """Of hands that took hold earlier: rows [C, 4] of their moments (physics/controllers.py), and the nodes [N, 3] then."""


class Simulator:
    """A twin's state, frame by frame. Equal controls give equal states, bit for bit, on a CPU."""

    def __init__(self, twin: Twin, device: str = "cpu", start: Start | None = None) -> None:
        stability.check(twin)
        self.twin = twin
        self._start = start or Start()
        self._device, self._load = device, stability.twin_spectrum(twin).load(twin.simulation.substep)
        self._free = solver_for(self.twin, device, differentiable=False)
        self._held: dict[int, FrameSolver] = {}
        self.reset()

    def reset(self) -> None:
        """Back to the start."""
        topology, start = self.twin.topology, self._start
        self.frame, self.grabbed = 0, -1
        x = topology.nodes if start.positions is None else start.positions
        v = np.zeros_like(x) if start.velocity is None else start.velocity
        self._x, self._v = (torch.tensor(np.asarray(values, np.float32), device=self._device) for values in (x, v))
        self.hands = (topology.controllers if start.hands is None else start.hands).astype(np.float32)
        count = len(topology.controllers)
        self._holds = np.ones(count, np.float32) if start.holds is None else start.holds.astype(np.float32)
        self._grips = [(np.asarray(row, np.float32), nodes) for row, nodes in start.grips]
        self.target = np.zeros(3, np.float32)

    @property
    def holds(self) -> np.ndarray:
        """Which hands hold [C]."""
        return self._holds > 0

    @property
    def positions(self) -> np.ndarray:
        """Nodes [N, 3], m."""
        return np.asarray(self._x.cpu().numpy())

    def step(
        self, hands: np.ndarray, grabbed: int = -1, target: np.ndarray | None = None, holds: np.ndarray | None = None
    ) -> np.ndarray:
        """Nodes [N, 3], m, a frame later: hands move to [C, 3], m, and a grabbed node is pulled to `target` [3], m.

        A grab begins where the node is. `holds` [C]: which hands hold at the end; none: those that do now. Raises Diverged, and
        stays as it was before.
        """
        hands = np.asarray(hands, np.float32)
        now, grips = self._holds, self._grips
        after = np.minimum(now, 1.0) if holds is None else np.where(holds, np.where(now > 0, 1.0, BEGINS), 0.0).astype(np.float32)
        begin, end = self.hands, hands
        if grips or (now != 1).any() or (after != 1).any():
            begin, end = np.column_stack([begin, now]), np.column_stack([end, after])
        solver, aim = self._free, self.target
        if grabbed >= 0:
            aim = np.asarray(target, np.float32)
            start = self.target if grabbed == self.grabbed else self.positions[grabbed]
            begin, end = (_with_row(rows, place) for rows, place in ((begin, start), (end, aim)))
            solver = self._solver(grabbed)
        if begin.shape[1] == 4:
            # Each solver knows the grips of its own frames alone.
            rows = [_with_row(row, aim) if grabbed >= 0 else row for row, _ in grips]
            solver.resume(torch.tensor(np.array(rows).reshape(len(rows), *begin.shape)), [nodes for _, nodes in grips])
        ends = (torch.tensor(np.asarray(values, np.float32), device=self._device) for values in (begin, end))
        x, v = solver.forward(self._x, self._v, *ends)
        # NaN compares false.
        if not bool((x.abs() < FAR).all()):
            raise Diverged(self.frame + 1, f"a node left the scene in frame {self.frame + 1}")
        if (now == BEGINS).any():
            grips.append((np.column_stack([self.hands, now]), self.positions.copy()))
        self._x, self._v, self.hands, self.grabbed, self.target, self._holds = x, v, hands, grabbed, aim, after
        self.frame += 1
        return self.positions

    def grab_stiffness(self, node: int) -> tuple[float, float]:
        """k [N/m] and c [N s/m] of the spring that pulls a node."""
        topology, material, dt = self.twin.topology, self.twin.material, self.twin.simulation.substep
        own = (topology.springs == node).any(axis=1)
        mass = float(material.mass[node]) if len(material.mass) else 1.0
        wanted = float((material.stiffness[own] / topology.rest_lengths[own]).sum())
        # Half of what is left is for k, half for c: dt^2 k / m + 2 dt c / m < MARGIN LIMIT - load.
        room = max(MARGIN * stability.LIMIT - self._load, 0.05) / 2
        k = min(wanted or room * mass / dt**2, room * mass / dt**2)
        return k, min(2 * np.sqrt(k * mass), room * mass / (2 * dt))

    def _solver(self, node: int) -> FrameSolver:
        """The twin with one controller and one spring more. The last ones are kept."""
        if node not in self._held:
            if len(self._held) >= 8:
                self._held.pop(next(iter(self._held)))
            self._held[node] = solver_for(self._with_grab(node), self._device, differentiable=False)
        return self._held[node]

    def _with_grab(self, node: int) -> Twin:
        topology, material = self.twin.topology, self.twin.material
        k, c = self.grab_stiffness(node)
        own = len(topology.nodes) + len(topology.controllers)
        place = topology.nodes[node][None]
        rest = topology.rest_shape
        more = replace(
            topology,
            controllers=np.concatenate([topology.controllers, place]),
            springs=np.concatenate([topology.springs, np.array([[own, node]], np.int32)]),
            rest_lengths=np.append(topology.rest_lengths, np.float32(REST)),
            rest_shape=np.concatenate([rest, place]) if len(rest) else rest,
        )
        stiffness = np.append(material.stiffness, np.float32(k * REST))
        stronger = replace(material, stiffness=stiffness, dashpot=np.append(material.dashpot, np.float32(c)))
        return replace(self.twin, topology=more, material=stronger)


def _with_row(rows: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Controllers [C, 3 or 4] and one more at a place [3], which holds."""
    return np.concatenate([rows, np.append(place, np.ones(rows.shape[1] - 3))[None]]).astype(np.float32)


def hands_of(controllers: np.ndarray, apart: float = 0.15) -> np.ndarray:
    """The hand [C] of each controller [C, 3]: controllers nearer than `apart` m, directly or through others, move together."""
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial.distance import cdist

    return np.asarray(connected_components(cdist(controllers, controllers) < apart)[1])
