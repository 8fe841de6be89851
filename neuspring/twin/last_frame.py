"""The state at a frame, by least squares over the frames up to it, through the simulator: prediction from the last frame.

The unknowns are a smooth displacement and a smooth velocity of the body at the window's first frame, s - w:

    x = x(s - w) + sum_m a_m phi_m,    v = v(s - w) + (1 / T) sum_m b_m phi_m,    T = w dt,    a, b in m,

with the body's softest modes phi_m at x(s - w), of unit root mean square: a correction along them strains no spring much, and the
simulation over the window relaxes the rest. They minimize the mean squared distance between the nodes and the visible points in
frames s - w to s, plus mu (|a|^2 + |b|^2). The minimum is sought by Levenberg-Marquardt; a Jacobian is made of 2 M + 1 simulations
of the window, which run in lanes, from differences of 1 mm. Controllers are where they were observed; nothing moves them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import eigsh

from neuspring.config import LastFrame
from neuspring.core.artifacts import Observations, Twin
from neuspring.physics.lanes import WIDTHS
from neuspring.physics.path import waypoints
from neuspring.physics.population import solver_of
from neuspring.twin.rollout import FAR

State = tuple[np.ndarray, np.ndarray]
"""Positions, m, and velocities, m/s, of all nodes, [N, 3] each."""
STEP = 1e-3
"""Differences of the unknowns that the Jacobian is made of, m."""
DAMPINGS = 10.0 ** np.arange(-2, 6)
"""Levenberg-Marquardt dampings that are tried in one launch, over the one that was best before."""
FIRST_DAMPING, DAMPING_RANGE = 1e-3, (1e-6, 1e3)
"""Over the diagonal of the Gauss-Newton matrix."""
TURNING = 1e-3
"""A spring's resistance to being turned, over that to being stretched, in the modes. Without it nothing would keep a fabric's nodes
together across its plane."""


def soft_modes(twin: Twin, positions: np.ndarray, controllers: np.ndarray, count: int) -> np.ndarray:
    """The softest displacements [M, N, 3] of nodes at positions [N, 3] with fixed controllers [C, 3]; M <= count.

    Eigenvectors of the stiffness matrix, whose springs resist with Y / l0 (n n^T + `TURNING` I) along their direction n. Every mode
    has a root mean square displacement of 1.
    """
    springs, nodes = twin.topology.springs, len(positions)
    offset = np.diff(np.concatenate([positions, controllers]).astype(np.float64)[springs], axis=1)[:, 0]
    along = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
    stiffness = twin.material.stiffness.astype(np.float64) / twin.topology.rest_lengths
    stiffness /= max(float(stiffness.mean()), 1e-12)
    blocks = stiffness[:, None, None] * (along[:, :, None] * along[:, None, :] + TURNING * np.eye(3))
    rows, columns, values = [], [], []
    axes = np.arange(3)
    for one, other, sign in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, -1.0), (1, 0, -1.0)):
        inside = (springs[:, [one, other]] < nodes).all(axis=1)
        i, j = 3 * springs[inside, one].astype(np.int64), 3 * springs[inside, other].astype(np.int64)
        block = np.broadcast_to
        rows.append(block(i[:, None, None] + axes[:, None], (len(i), 3, 3)).ravel())
        columns.append(block(j[:, None, None] + axes, (len(j), 3, 3)).ravel())
        values.append(sign * blocks[inside].ravel())
    # A node without a spring would be softer than any mode of the body.
    lonely = np.setdiff1d(np.arange(nodes), springs)
    rows.append((3 * lonely[:, None] + axes).ravel())
    columns.append(rows[-1])
    values.append(np.full(len(rows[-1]), 1.0))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    matrix = coo_matrix(entries, shape=(3 * nodes, 3 * nodes)).tocsc()
    count = min(count, 3 * nodes - 1)
    if 3 * nodes <= DENSE:
        vectors = np.linalg.eigh(matrix.toarray())[1][:, :count]
    else:
        # Below zero, so that a body that nothing holds can be factorized too.
        vectors = eigsh(matrix, count, sigma=-1e-6, v0=np.random.default_rng(0).standard_normal(3 * nodes))[1]
    # The sign of an eigenvector is open.
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)] < 0, -1.0, 1.0)
    modes: np.ndarray = vectors.T.reshape(count, nodes, 3) * np.sqrt(nodes)
    return modes


DENSE = 600
"""Unknowns up to which all eigenvectors are computed at once."""


@dataclass(frozen=True)
class Windows:
    """Results of simulations over a window from several starts."""

    positions: np.ndarray
    """[B, w + 1, N, 3], m; from the window's first frame on."""
    velocities: np.ndarray
    """[B, N, 3], m/s; in the window's last frame."""


class StateEstimator:
    """Estimates the states of one twin in one recording."""

    def __init__(self, twin: Twin, observations: Observations, settings: LastFrame, device: str = "cpu") -> None:
        self.twin, self.observations, self.settings = twin, observations, settings
        unknowns = 2 * min(settings.modes, 3 * len(twin.topology.nodes) - 1)
        self._lanes = WIDTHS[-1] if device == "cpu" else max(unknowns + 1, len(DAMPINGS))
        self._solver = solver_of([twin] * self._lanes, device, differentiable=False)
        hands = torch.tensor(observations.controller_points, dtype=torch.float32, device=device)
        self._hands = waypoints(hands, twin.simulation, observations.controller_valid)
        self._before: list[np.ndarray] = []
        """Positions of the nodes in the frames so far: grips that began there hold what was there."""

    @property
    def variants(self) -> tuple[float, ...]:
        """Weights of the prior; a state is estimated with each."""
        return self.settings.weights

    def corrected(self, frame: int, states: list[State], stop: int) -> list[np.ndarray | None]:
        """Positions [stop - frame - 1, N, 3], m, of the frames after `frame` from its state as estimated with each weight.

        None where it diverged. `states` are the uncorrected ones of the frames up to `frame` at least.
        """
        estimated = self.estimates(frame, states)
        self._before = [x for x, _ in states]
        run = self.simulate(np.array([x for x, _ in estimated]), np.array([v for _, v in estimated]), frame, stop - 1)
        finite = np.isfinite(run.positions).all(axis=(1, 2, 3))
        return [positions[1:] if good else None for positions, good in zip(run.positions, finite, strict=True)]

    def estimates(self, frame: int, states: list[State]) -> list[State]:
        """The state at `frame` with each weight of the prior, from the observations of the window that ends there."""
        first = max(frame - self.settings.window, 0)
        self._before = [x for x, _ in states]
        x, v = (values.astype(np.float64) for values in states[first])
        controllers = self.observations.controller_points[first]
        modes = soft_modes(self.twin, x, controllers, self.settings.modes)
        duration = (frame - first) / self.observations.scenario.frame_rate
        targets, seen = self._observed(first, frame)

        def run(unknowns: np.ndarray) -> Windows:
            """Simulations from unknowns [B, 2 M], m."""
            a, b = np.split(unknowns, 2, axis=1)
            return self.simulate(x + np.tensordot(a, modes, 1), v + np.tensordot(b, modes, 1) / duration, first, frame)

        def residuals(windows: Windows) -> np.ndarray:
            """[B, R], m."""
            found: np.ndarray = (windows.positions[:, :, : targets.shape[1]] - targets)[:, seen].reshape(len(windows.positions), -1)
            return found

        size = 2 * len(modes)
        unknowns, scale = np.zeros(size), 1 / max(int(seen.sum()), 1)
        state, damping = (states[frame][0].astype(np.float64), states[frame][1].astype(np.float64)), FIRST_DAMPING
        found: dict[float, State] = {}
        # From the strongest prior to the weakest: each estimate begins where the one before it ended.
        for weight in sorted(self.variants, reverse=True):
            for _ in range(self.settings.iterations if seen.any() else 0):
                base, *moved = residuals(run(np.concatenate([unknowns[None], unknowns + STEP * np.eye(size)])))
                jacobian = (np.array(moved) - base).T / STEP
                if not np.isfinite(jacobian).all():
                    break
                slope = scale * base @ jacobian + weight * unknowns
                curvature = scale * jacobian.T @ jacobian + weight * np.eye(size)
                tried = damping * DAMPINGS
                steps = [np.linalg.solve(curvature + factor * np.diag(np.diag(curvature)), -slope) for factor in tried]
                trials = unknowns + np.array(steps)
                windows = run(trials)
                values = scale * np.square(residuals(windows)).sum(axis=1) + weight * np.square(trials).sum(axis=1)
                # What diverged is not a number, and is the worst.
                best = int(np.argmin(np.nan_to_num(values, nan=np.inf)))
                if not values[best] < scale * base @ base + weight * unknowns @ unknowns:
                    break
                unknowns, damping = trials[best], float(np.clip(tried[best], *DAMPING_RANGE))
                state = (windows.positions[best, -1], windows.velocities[best])
            found[weight] = state
        return [found[weight] for weight in self.variants]

    def _observed(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        """Points [w + 1, No, 3], m, of the frames from `first` to `last`, and where they are visible and moved validly."""
        o, frames = self.observations, slice(first, last + 1)
        seen = np.array(o.object_visibility[frames])
        # motion_valid[t] is about the way from frame t to t + 1.
        seen[1:] &= o.object_motion_valid[first:last]
        if first:
            seen[0] &= o.object_motion_valid[first - 1]
        return o.object_points[frames].astype(np.float64), seen

    def simulate(self, x: np.ndarray, v: np.ndarray, first: int, last: int) -> Windows:
        """Frames `first` to `last` from states x, v [B, N, 3]; NaN from where a simulation diverged."""
        positions, velocities = [], []
        for begin in range(0, len(x), self._lanes):
            part = slice(begin, begin + self._lanes)
            way, speed = self._simulate(x[part], v[part], first, last)
            positions.append(way)
            velocities.append(speed)
        return Windows(np.concatenate(positions), np.concatenate(velocities))

    def _simulate(self, x: np.ndarray, v: np.ndarray, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        count, solver = len(x), self._solver
        # Empty lanes repeat the first.
        filled = [*range(count), *[0] * (self._lanes - count)]
        here, speed = (torch.tensor(values[filled], dtype=solver.dtype, device=solver.device) for values in (x, v))
        solver.resume(self._hands[:first], self._before)
        way, start, gone = [here], here, torch.zeros_like(here[:, :1, :1], dtype=torch.bool)
        for frame in range(first, last):
            begin, end = (self._hands[f].expand(self._lanes, -1, -1) for f in (frame, frame + 1))
            here, speed = solver.forward(here, speed, begin, end)
            # NaN compares false. A lane that left goes on from where it began, out of the way of the others.
            gone = gone | ~(here.abs() < FAR).flatten(1).all(dim=1)[:, None, None]
            way.append(here.masked_fill(gone, float("nan")))
            here, speed = torch.where(gone, start, here), speed.masked_fill(gone, 0.0)
        whole = torch.stack(way, dim=1)
        return whole[:count].double().cpu().numpy(), speed[:count].double().cpu().numpy()
