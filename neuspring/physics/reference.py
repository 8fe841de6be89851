"""The specification: a slow, readable float64 NumPy simulation, in the order of the released code. The Warp solver must agree
with it.

Each line is one equation. The simulation is forward only; tests compare gradients with its central differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_matrix

from neuspring.core.artifacts import Simulation, Twin
from neuspring.physics.lanes import MIN_SPRING_LENGTH
from neuspring.physics.motion import APPROACH, MIN_TANGENT


@dataclass(frozen=True)
class ReferenceTwin:
    """The values of a twin in float64. `of` converts the stored float32 arrays; other values are not rounded to float32."""

    nodes: int
    springs: np.ndarray
    rest_lengths: np.ndarray
    stiffness: np.ndarray
    dashpot: np.ndarray
    drag: float
    ground: tuple[float, float]
    contact: tuple[float, float]
    contact_distance: float
    simulation: Simulation
    mass: np.ndarray | float = 1.0
    """Mass of each node [N], or of every node, kg."""

    @classmethod
    def of(cls, twin: Twin) -> ReferenceTwin:
        """Convert a twin."""
        t, m = twin.topology, twin.material
        return cls(
            nodes=len(t.nodes),
            springs=t.springs,
            rest_lengths=t.rest_lengths.astype(np.float64),
            stiffness=m.stiffness.astype(np.float64),
            dashpot=m.dashpot.astype(np.float64),
            drag=m.drag,
            ground=(m.ground_elasticity, m.ground_friction),
            contact=(m.contact_elasticity, m.contact_friction),
            contact_distance=m.contact_distance,
            simulation=twin.simulation,
            mass=m.mass.astype(np.float64) if len(m.mass) else 1.0,
        )


def rollout(scene: ReferenceTwin, x: np.ndarray, v: np.ndarray, controllers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States x and v at the ends of F frames, each [F, N, 3]. Frame 0 is the given state; controllers [F, C, 3]."""
    xs, vs = [np.asarray(x, np.float64)], [np.asarray(v, np.float64)]
    for begin, end in pairwise(controllers.astype(np.float64)):
        x, v = frame(scene, xs[-1], vs[-1], begin, end)
        xs.append(x)
        vs.append(v)
    return np.stack(xs), np.stack(vs)


def frame(scene: ReferenceTwin, x: np.ndarray, v: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a frame of `substeps` substeps. Controllers move on a line from begin to end [C, 3]."""
    sim = scene.simulation
    spread = incidence(scene)
    hands_velocity = (end - begin) / sim.frame_time if sim.controller_velocity else np.zeros_like(begin)
    pairs = candidates(x, scene.contact_distance) if sim.self_collision else None
    for step in range(sim.substeps):
        hands = begin + (end - begin) * ((step + 1) / sim.substeps)
        x, v = substep(scene, x, v, hands, hands_velocity, spread, pairs)
    return x, v


def incidence(scene: ReferenceTwin) -> csr_matrix:
    """Incidence matrix [N, S]: +1 if a node is the first end of a spring, -1 if it is the second; without controllers."""
    count = len(scene.springs)
    total = int(max(scene.nodes, scene.springs.max(initial=0) + 1))
    values = np.concatenate([np.ones(count), -np.ones(count)])
    index = (np.concatenate([scene.springs[:, 0], scene.springs[:, 1]]), np.tile(np.arange(count), 2))
    return csr_matrix((values, index), shape=(total, count))[: scene.nodes]


def substep(
    scene: ReferenceTwin,
    x: np.ndarray,
    v: np.ndarray,
    hands: np.ndarray,
    hands_velocity: np.ndarray,
    spread: csr_matrix,
    pairs: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Symplectic Euler: forces at (x, v), velocity, self-collision, ground, position."""
    sim = scene.simulation
    dt = sim.substep
    force = spread @ spring_forces(scene, np.concatenate([x, hands]), np.concatenate([v, hands_velocity]))
    gravity = np.array([0.0, 0.0, -sim.gravity * sim.up_sign])
    mass = np.broadcast_to(scene.mass, len(v))
    v = (v + dt * (force / mass[:, None] + gravity)) * np.exp(-dt * scene.drag)
    if pairs is not None:
        v = collide(x, v, mass, pairs, scene.contact_distance, *scene.contact)
    if sim.ground:
        return bounce(x, v, dt, sim.up_sign, *scene.ground)
    return x + dt * v, v


def spring_forces(scene: ReferenceTwin, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Force [S, 3] on the first end of each spring: (Y (l / l0 - 1) + gamma (v_j - v_i) . d) d."""
    i, j = scene.springs[:, 0], scene.springs[:, 1]
    offset = x[j] - x[i]
    length = np.linalg.norm(offset, axis=1)
    d = offset / np.maximum(length, MIN_SPRING_LENGTH)[:, None]
    closing = np.einsum("ek,ek->e", v[j] - v[i], d)
    magnitude = scene.stiffness * (length / scene.rest_lengths - 1.0) + scene.dashpot * closing
    forces: np.ndarray = magnitude[:, None] * d
    return forces


def response(normal_speed: np.ndarray, tangent_speed: np.ndarray, e: float, mu: float) -> np.ndarray:
    """Factor of the tangential velocity: a = max(0, 1 - mu (1 + e) |u_n| / |u_t|)."""
    factor: np.ndarray = np.maximum(0.0, 1.0 - mu * (1.0 + e) * np.abs(normal_speed) / np.maximum(tangent_speed, MIN_TANGENT))
    return factor


def candidates(x: np.ndarray, distance: float) -> np.ndarray:
    """All ordered pairs [P, 2] of different nodes closer than `distance`, found once per frame."""
    gap = np.linalg.norm(x[:, None] - x[None], axis=2)
    np.fill_diagonal(gap, np.inf)
    return np.argwhere(gap < distance)


def collide(x: np.ndarray, v: np.ndarray, mass: np.ndarray, pairs: np.ndarray, distance: float, e: float, mu: float) -> np.ndarray:
    """Jacobi impulses: each node receives the mean impulse of its partners that are near and approach."""
    i, j = pairs[:, 0], pairs[:, 1]
    dx, u = x[j] - x[i], v[j] - v[i]
    length = np.linalg.norm(dx, axis=1)
    hit = (length < distance) & (np.einsum("pk,pk->p", dx, u) < -APPROACH)
    i, j, dx, u, length = i[hit], j[hit], dx[hit], u[hit], length[hit]
    n = dx / np.maximum(length, MIN_TANGENT)[:, None]
    speed = np.einsum("pk,pk->p", u, n)
    un = speed[:, None] * n
    ut = u - un
    a = response(speed, np.linalg.norm(ut, axis=1), e, mu)
    share = mass[j] / (mass[i] + mass[j])
    impulse = share[:, None] * (-(1.0 + e) * un + (a - 1.0)[:, None] * ut)
    total = np.zeros_like(v)
    np.add.at(total, i, impulse)
    hits = np.bincount(i, minlength=len(v))
    return v - total / np.maximum(hits, 1)[:, None]


def bounce(x: np.ndarray, v: np.ndarray, dt: float, up: float, e: float, mu: float) -> tuple[np.ndarray, np.ndarray]:
    """Ground plane z = 0: nodes that would pass below it are reflected at their time of impact."""
    falling = ((x[:, 2] + v[:, 2] * dt) * up < 0) & (v[:, 2] * up < -APPROACH)
    a = response(v[:, 2], np.linalg.norm(v[:, :2], axis=1), e, mu)
    bounced = np.concatenate([a[:, None] * v[:, :2], -e * v[:, 2:]], axis=1)
    impact = -x[:, 2] / np.where(falling, v[:, 2], 1.0)
    after = x + v * impact[:, None] + bounced * (dt - impact)[:, None]
    return np.where(falling[:, None], after, x + v * dt), np.where(falling[:, None], bounced, v)
