"""Interactive simulation of a twin, frame by frame, with controllers and a grabbed node that move while it runs.

A spring of rest length 0 pulls a grabbed node to its target:

    F = k (target - x) - c v_along

k is the sum of Y / l0 over the node's own springs, and c is critical for the node's mass. Both are limited by the stability bound
at the twin's substep. The target is an additional controller, which moves linearly within a frame.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
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
"""Rest length of the grab's spring, m, because the solver requires a positive length."""
MOST_SOLVERS = 8
"""Number of cached solvers of grabbed nodes."""


class Simulator:
    """State of a twin, from rest in frame 0. It runs on the CPU, so that equal controls give bitwise equal states."""

    def __init__(self, twin: Twin) -> None:
        body = self._body = body_of(twin)
        body.check(twin)
        self.twin = twin = body.for_prediction(twin)
        self._load = body.load(twin)
        self._free = body.solver(twin)
        self._held = lru_cache(MOST_SOLVERS)(lambda node: body.solver(self._with_grab(node)))
        self.reset()

    def reset(self) -> None:
        """Return to frame 0."""
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
        """Advance by one frame: controllers move to `hands` [C, 3], m, and a grabbed node is pulled to `target` [3], m.

        Returns the nodes [N, 3], m. A grab begins at the node's position. Raises Diverged, and then keeps the previous state.
        """
        hands = np.asarray(hands, np.float32)
        begin, end, solver, aim = self.hands, hands, self._free, self.target
        if grabbed >= 0:
            aim = np.asarray(target, np.float32)
            start = self.target if grabbed == self.grabbed else self.positions[grabbed]
            begin, end = np.concatenate([begin, start[None]]), np.concatenate([end, aim[None]])
            solver = self._held(grabbed)
        if self._last not in (None, solver):
            solver.follow(self._last)
        x, v = solver.forward(self._x, self._v, torch.tensor(begin), torch.tensor(end))
        # NaN also counts as diverged.
        if not bool((x.abs() < FAR_AWAY).all()):
            raise Diverged(self.frame + 1, f"a node left the scene in frame {self.frame + 1}")
        self._last = solver
        self._x, self._v, self.hands, self.grabbed, self.target = x, v, hands, grabbed, aim
        self.frame += 1
        return self.positions

    def grab_stiffness(self, node: int) -> tuple[float, float]:
        """k, N/m, and c, N s/m, of the spring that pulls a node."""
        topology, material, dt = self.twin.topology, self.twin.material, self.twin.simulation.substep
        own = (topology.springs == node).any(axis=1)
        mass = self._body.mass_at(self.twin, node)
        wanted = float((material.stiffness[own] / topology.rest_lengths[own]).sum())
        # k and c each get half of the remaining bound: dt^2 k / m + 2 dt c / m < 0.9 STABILITY_LIMIT - load.
        margin = max(0.9 * stability.STABILITY_LIMIT - self._load, 0.05) / 2
        k = min(wanted or margin * mass / dt**2, margin * mass / dt**2)
        return k, min(2 * np.sqrt(k * mass), margin * mass / (2 * dt))

    def _with_grab(self, node: int) -> Twin:
        """The twin with an additional controller and spring for the grab."""
        topology, material = self.twin.topology, self.twin.material
        k, c = self.grab_stiffness(node)
        target = len(topology.nodes) + len(topology.controllers)
        position = topology.nodes[node][None]
        rest = topology.rest_shape
        more = replace(
            topology,
            controllers=np.concatenate([topology.controllers, position]),
            springs=np.concatenate([topology.springs, np.array([[target, node]], np.int32)]),
            rest_lengths=np.append(topology.rest_lengths, np.float32(GRAB_REST_LENGTH)),
            rest_shape=np.concatenate([rest, position]) if len(rest) else rest,
            pushes=np.append(topology.pushes, False) if topology.pushes.size else topology.pushes,
        )
        stiffness = np.append(material.stiffness, np.float32(k * GRAB_REST_LENGTH))
        stronger = replace(material, stiffness=stiffness, dashpot=np.append(material.dashpot, np.float32(c)))
        return replace(self.twin, topology=more, material=stronger)


def hands_of(controllers: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Hand index [C] of each controller [C, 3], m, from observations (`given`).

    If `given` is empty, controllers within 0.15 m of each other, directly or through others, form one hand.
    """
    if len(given) == len(controllers):
        return np.unique(given, return_inverse=True)[1]
    return np.asarray(connected_components(cdist(controllers, controllers) < 0.15)[1])
