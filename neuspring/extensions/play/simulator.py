"""A twin that is pulled: one frame of simulation after another, under hands and a grab that are given as it goes.

A grabbed node follows its target by a spring without rest length, beside the twin's own springs: F = k (target - x) - c v_along,
with k the sum of the stiffnesses Y / l0 of the node's own springs, at most what the stability bound leaves at the twin's substep,
and c critical for the node's mass, bounded in the same way. The target is a controller more, and moves straight within a frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from neuspring.core.artifacts import Artifact, Observations, Twin, array
from neuspring.core.errors import InputError
from neuspring.physics import stability
from neuspring.physics.controllers import BEGINS, begins, waypoints
from neuspring.twin.body import body_of
from neuspring.twin.rollout import FAR_AWAY, Diverged, initial_velocity

if TYPE_CHECKING:
    from neuspring.report.shown import Run

GRAB_REST_LENGTH = 1e-6
"""Rest length of the spring of a grab, m: the solver has none of length 0."""
STABILITY_MARGIN = 0.9
"""Part of the stability bound that twin and grab may use together."""
MOST_SOLVERS = 8
"""Solvers of grabbed nodes that are kept."""
UNKNOWN_HANDS = np.zeros(0, np.int32)
"""Nothing says which hand a controller belongs to."""
CONTROLLER_GAP = 0.15
"""Controllers nearer than this, m, directly or through others, are one hand."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Start(Artifact):
    """The state that a twin begins in. What is empty is as in its frame 0: there, at rest, and all hands hold."""

    kind: ClassVar[str] = "start"
    positions: np.ndarray = array("N,3", np.float32, "m", "nodes", omitted=True)
    velocity: np.ndarray = array("N,3", np.float32, "m/s", "of the nodes", omitted=True)
    hands: np.ndarray = array("C,3", np.float32, "m", "controllers", omitted=True)
    holds: np.ndarray = array("C", np.float32, "1", "which hold; BEGINS where one takes hold in this moment", omitted=True)
    grip_rows: np.ndarray = array("G,C,4", np.float32, "m, 1", "controllers when some took hold earlier", omitted=True)
    grip_nodes: np.ndarray = array("G,N,3", np.float32, "m", "the nodes at these moments", omitted=True)


@dataclass(frozen=True, eq=False)
class StartState:
    """State in which a live twin begins, and recorded hands from there in E frames, none where they stay."""

    frame: int = 0
    """Frame of the recording."""
    start: Start = field(default_factory=Start)
    hands: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    """[E, C, 3], m."""
    holds: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))
    """[E, C]."""

    def script(self, frame: int) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Hands [C, 3] and which hold [C] after `frame` frames more; they stay after their end. None without recorded hands."""
        last = min(frame, len(self.hands) - 1)
        return (self.hands[last], self.holds[last]) if len(self.hands) else (None, None)


def start_state(run: Run, seen: Observations, frame: int, repeat: bool) -> StartState:
    """The state of a run's prediction in a frame; with `repeat`, the hands go on as recorded.

    Its velocity is half of what the nodes move from the frame before to the frame after, per frame; in frame 0 it is none, or with
    `repeat` that of the rollout. Raises InputError for a frame that the prediction does not have.
    """
    twin = run.twin
    if twin is None:
        raise InputError(run.folder, "a run with a twin is required", "none", "Choose a method that makes a twin.")
    count, hands = len(twin.topology.controllers), seen.controller_points
    if frame == 0 and not repeat:
        return StartState()
    if frame and not body_of(twin).starts_anywhere:
        rule = "begins in frame 0: nodes of a later frame do not say how it is twisted"
        raise InputError(f"{run.name}, frame {frame}", rule, frame, "Begin at frame 0.")
    if hands.shape[1] != count:
        raise InputError(run.folder, f"its twin has {count} controllers, the observations must too", hands.shape[1])
    holds = seen.controller_valid if seen.controller_valid.size else np.ones(hands.shape[:2], bool)
    rest = slice(frame + 1, None) if repeat else slice(0, 0)
    script = hands[rest], holds[rest]
    if frame == 0:
        velocity = initial_velocity(seen, twin.simulation.initial_velocity)
        return StartState(0, Start(velocity=velocity, hands=hands[0], holds=holds[0].astype(np.float32)), *script)
    x = None if run.trajectory is None else run.trajectory.positions
    if x is None or x.shape[1:] != twin.topology.nodes.shape or not 0 <= frame < len(x):
        known = 0 if x is None else len(x)
        raise InputError(f"{run.name}, frame {frame}", f"its prediction has {known} frames", frame, "Begin at frame 0.")
    before, after = max(frame - 1, 0), min(frame + 1, len(x) - 1)
    velocity = (x[after].astype(float) - x[before]) / max((after - before) * twin.simulation.frame_time, 1e-9)
    rows = waypoints(torch.tensor(hands[: frame + 1]), holds).numpy()
    earlier = np.flatnonzero(begins(torch.tensor(rows[:frame])).any(dim=-1).numpy())
    flags = rows[frame, :, 3] if rows.shape[2] == 4 else np.ones(count)
    grips = {"grip_rows": rows[earlier], "grip_nodes": x[earlier]} if len(earlier) else {}
    return StartState(frame, Start(positions=x[frame], velocity=velocity, hands=hands[frame], holds=flags, **grips), *script)


class Simulator:
    """A twin's state, frame by frame. Equal controls give equal states, bit for bit: it runs on the CPU."""

    def __init__(self, twin: Twin, start: Start | None = None) -> None:
        body = self._body = body_of(twin)
        body.check(twin)
        self.twin = twin = body.for_prediction(twin)
        self._start = start or Start()
        self._load = body.load(twin)
        self._free = body.solver(twin)
        self._held: dict[int, Any] = {}
        self.reset()

    def reset(self) -> None:
        """Back to the start."""
        topology, start = self.twin.topology, self._start
        self.frame, self.grabbed = 0, -1
        self._last: Any = None
        x = start.positions if start.positions.size else topology.nodes
        v = start.velocity if start.velocity.size else np.zeros_like(x)
        self._x, self._v = (torch.tensor(np.asarray(values, np.float32)) for values in (x, v))
        self.hands = (start.hands if start.hands.size else topology.controllers).astype(np.float32)
        self._holds = start.holds if start.holds.size else np.ones(len(topology.controllers), np.float32)
        self._grips = list(zip(start.grip_rows, start.grip_nodes, strict=True))
        self.target = np.zeros(3, np.float32)

    @property
    def holds(self) -> np.ndarray:
        """True for controllers that hold [C]."""
        return self._holds > 0

    @property
    def positions(self) -> np.ndarray:
        """Nodes [N, 3], m."""
        return np.asarray(self._x.numpy())

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
            if grabbed not in self._held:
                if len(self._held) >= MOST_SOLVERS:
                    self._held.pop(next(iter(self._held)))
                self._held[grabbed] = self._body.solver(self._with_grab(grabbed))
            solver = self._held[grabbed]
        if begin.shape[1] == 4:
            # Each solver knows the grips of its own frames alone.
            rows = [_with_row(row, aim) if grabbed >= 0 else row for row, _ in grips]
            solver.resume(torch.tensor(np.array(rows).reshape(len(rows), *begin.shape)), [nodes for _, nodes in grips])
        if self._last not in (None, solver):
            solver.follow(self._last)
        ends = (torch.tensor(np.asarray(values, np.float32)) for values in (begin, end))
        x, v = solver.forward(self._x, self._v, *ends)
        # NaN compares false.
        if not bool((x.abs() < FAR_AWAY).all()):
            raise Diverged(self.frame + 1, f"a node left the scene in frame {self.frame + 1}")
        if (now == BEGINS).any():
            grips.append((np.column_stack([self.hands, now]), self.positions.copy()))
        self._last = solver
        self._x, self._v, self.hands, self.grabbed, self.target, self._holds = x, v, hands, grabbed, aim, after
        self.frame += 1
        return self.positions

    def grab_stiffness(self, node: int) -> tuple[float, float]:
        """k [N/m] and c [N s/m] of the spring that pulls a node."""
        topology, material, dt = self.twin.topology, self.twin.material, self.twin.simulation.substep
        own = (topology.springs == node).any(axis=1)
        mass = self._body.mass_at(self.twin, node)
        wanted = float((material.stiffness[own] / topology.rest_lengths[own]).sum())
        # Half of what is left is for k, half for c: dt^2 k / m + 2 dt c / m < STABILITY_MARGIN STABILITY_LIMIT - load.
        room = max(STABILITY_MARGIN * stability.STABILITY_LIMIT - self._load, 0.05) / 2
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


def _with_row(rows: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Controllers [C, 3 or 4] and one more at a place [3], which holds."""
    return np.concatenate([rows, np.append(place, np.ones(rows.shape[1] - 3))[None]]).astype(np.float32)


def hands_of(controllers: np.ndarray, given: np.ndarray = UNKNOWN_HANDS) -> np.ndarray:
    """The hand [C] of each controller [C, 3], m: those that move together. `given` is what observations know of it."""
    if len(given) == len(controllers):
        return np.unique(given, return_inverse=True)[1]
    return np.asarray(connected_components(cdist(controllers, controllers) < CONTROLLER_GAP)[1])
