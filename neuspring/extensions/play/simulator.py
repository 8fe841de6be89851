"""A twin that is pulled: one frame of simulation after another, under hands and a grab that are given as it goes.

A grabbed node follows its target by a spring without rest length, beside the twin's own springs: F = k (target - x) - c v_along,
with k the sum of the stiffnesses Y / l0 of the node's own springs, at most what the stability bound leaves at the twin's substep,
and c critical for the node's mass, bounded in the same way. The target is a controller more, which moves straight within a frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from neuspring.core.artifacts import Twin
from neuspring.physics import stability
from neuspring.twin.body import body_of
from neuspring.twin.rollout import FAR_AWAY, Diverged

GRAB_REST_LENGTH = 1e-6
"""Rest length of the spring of a grab, m: the solver has none of length 0."""
MOST_SOLVERS = 8
"""Solvers of grabbed nodes that are kept."""


class Simulator:
    """A twin's state, frame by frame, from frame 0 at rest. Equal controls give equal states, bit for bit: it runs on the CPU."""

    def __init__(self, twin: Twin) -> None:
        body = self._body = body_of(twin)
        body.check(twin)
        self.twin = twin = body.for_prediction(twin)
        self._load = body.load(twin)
        self._free = body.solver(twin)
        self._held: dict[int, Any] = {}
        self.reset()

    def reset(self) -> None:
        """Back to the start."""
        self.frame, self.grabbed = 0, -1
        self._last: Any = None
        self._x = torch.tensor(self.twin.topology.nodes)
        self._v = torch.zeros_like(self._x)
        self.hands = self.twin.topology.controllers.astype(np.float32)
        self.target = np.zeros(3, np.float32)

    @property
    def positions(self) -> np.ndarray:
        """Nodes [N, 3], m."""
        return self._x.numpy()

    def step(self, hands: np.ndarray, grabbed: int = -1, target: np.ndarray | None = None) -> np.ndarray:
        """Nodes [N, 3], m, a frame later: hands move to [C, 3], m, and a grabbed node is pulled to `target` [3], m.

        A grab begins where the node is. Raises Diverged, and stays as it was before.
        """
        hands = np.asarray(hands, np.float32)
        begin, end, solver, aim = self.hands, hands, self._free, self.target
        if grabbed >= 0:
            aim = np.asarray(target, np.float32)
            start = self.target if grabbed == self.grabbed else self.positions[grabbed]
            begin, end = np.concatenate([begin, start[None]]), np.concatenate([end, aim[None]])
            if grabbed not in self._held:
                if len(self._held) >= MOST_SOLVERS:
                    self._held.pop(next(iter(self._held)))
                self._held[grabbed] = self._body.solver(self._with_grab(grabbed))
            solver = self._held[grabbed]
        if self._last not in (None, solver):
            solver.follow(self._last)
        x, v = solver.forward(self._x, self._v, torch.tensor(begin), torch.tensor(end))
        # NaN compares false.
        if not bool((x.abs() < FAR_AWAY).all()):
            raise Diverged(self.frame + 1, f"a node left the scene in frame {self.frame + 1}")
        self._last = solver
        self._x, self._v, self.hands, self.grabbed, self.target = x, v, hands, grabbed, aim
        self.frame += 1
        return self.positions

    def grab_stiffness(self, node: int) -> tuple[float, float]:
        """k [N/m] and c [N s/m] of the spring that pulls a node."""
        topology, material, dt = self.twin.topology, self.twin.material, self.twin.simulation.substep
        own = (topology.springs == node).any(axis=1)
        mass = self._body.mass_at(self.twin, node)
        wanted = float((material.stiffness[own] / topology.rest_lengths[own]).sum())
        # Half of what is left is for k, half for c: dt^2 k / m + 2 dt c / m < 0.9 STABILITY_LIMIT - load.
        room = max(0.9 * stability.STABILITY_LIMIT - self._load, 0.05) / 2
        k = min(wanted or room * mass / dt**2, room * mass / dt**2)
        return k, min(2 * np.sqrt(k * mass), room * mass / (2 * dt))

    def _with_grab(self, node: int) -> Twin:
        """The twin with one controller and one spring more."""
        topology, material = self.twin.topology, self.twin.material
        k, c = self.grab_stiffness(node)
        own = len(topology.nodes) + len(topology.controllers)
        place = topology.nodes[node][None]
        rest = topology.rest_shape
        more = replace(
            topology,
            controllers=np.concatenate([topology.controllers, place]),
            springs=np.concatenate([topology.springs, np.array([[own, node]], np.int32)]),
            rest_lengths=np.append(topology.rest_lengths, np.float32(GRAB_REST_LENGTH)),
            rest_shape=np.concatenate([rest, place]) if len(rest) else rest,
            pushes=np.append(topology.pushes, False) if topology.pushes.size else topology.pushes,
        )
        stiffness = np.append(material.stiffness, np.float32(k * GRAB_REST_LENGTH))
        stronger = replace(material, stiffness=stiffness, dashpot=np.append(material.dashpot, np.float32(c)))
        return replace(self.twin, topology=more, material=stronger)


def hands_of(controllers: np.ndarray, given: np.ndarray) -> np.ndarray:
    """The hand [C] of each controller [C, 3], m: those that move together, as observations know it (`given`).

    Where they do not, controllers nearer than 0.15 m to each other, directly or through others, are one hand.
    """
    if len(given) == len(controllers):
        return np.unique(given, return_inverse=True)[1]
    return np.asarray(connected_components(cdist(controllers, controllers) < 0.15)[1])
