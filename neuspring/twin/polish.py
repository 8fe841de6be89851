"""Levenberg-Marquardt in few variables, after CMA-ES: asked for candidates and told what they cost, as CMA-ES is.

A round first asks for slopes: the base and one neighbor per variable. Their residuals r (losses.py, |r|^2 is the cost; points stay
assigned as in the base, so that r is smooth) give the products J'J and J'r of finite differences. Then it asks for four damped
steps (core/levenberg.py) of the normalized variables, within the ranges and at most `LONGEST_STEP` per variable, and takes the best
of them if it costs less than the base. Nothing but the costs and products that it is told decides what it asks for next, so a
polish is replayed from its record.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from neuspring.config.search import TRIALS, Search
from neuspring.core.levenberg import LevenbergMarquardt
from neuspring.twin.body import TERMS
from neuspring.twin.candidates import PENALTY, Launch, Map, SearchProblem, launch, made
from neuspring.twin.losses import OF_IMAGES, FrameLoss
from neuspring.twin.rollout import FAR_AWAY
from neuspring.twin.trials import Rollouts

SLOPES, POLISH = "slopes", "polish"
"""Stages of a search after CMA-ES; candidates of `SLOPES` are its means alone and never its result."""
RESIDUAL, PRODUCT = "product.residual", "product."
"""Columns of the trace: J_k'r and J_k'J_l in the row of the neighbor in variable k."""
DIFFERENCE_STEP = 0.01
"""Step of the finite differences, in normalized variables."""
LEAST_DROP = 1e-3
"""A round whose step lowers the cost by less than this fraction of it is the last."""
LONGEST_STEP = 0.25
"""Longest step of a round in a normalized variable."""
TRIED_DAMPINGS = tuple(10.0 ** (k - TRIALS + 2) for k in range(TRIALS))
"""Factors on the damping, for each step that is tried: from 0.01 to 10."""


class Polish(LevenbergMarquardt):
    """The state of a polish: its base, and what is asked for next."""

    def __init__(self, search: Search, columns: Sequence[int], base: np.ndarray, cost: float) -> None:
        """`base`: normalized variables, of which those at `columns` are polished."""
        raised = 10 * TRIED_DAMPINGS[-1] / TRIED_DAMPINGS[0]
        super().__init__(base=base, cost=cost, factors=TRIED_DAMPINGS, raised=raised, damping=0.1, most=1e4, tolerance=LEAST_DROP)
        self._most_rounds, self.columns = search.polish_rounds, list(columns)
        self.stage = SLOPES
        """Stage of the candidates that are asked for now."""
        self.rounds = 0
        """Rounds that are done."""
        self._asked: list[np.ndarray] = []

    @property
    def done(self) -> bool:
        """True where nothing more is asked for."""
        return self.finished or self.rounds >= self._most_rounds

    def steps(self) -> np.ndarray:
        """Signed steps of the finite differences: downwards, where a twin needs no more substeps, but at a lower bound."""
        here, step = self.base[self.columns], DIFFERENCE_STEP
        return np.where(here - step < 0, step, -step)

    def ask(self) -> list[np.ndarray]:
        """The next candidates, in normalized variables."""
        if self.stage == SLOPES:
            moves = [np.zeros(len(self.columns)), *np.diag(self.steps())]
        else:
            here = self.base[self.columns]
            low, high = np.maximum(-here, -LONGEST_STEP), np.minimum(1 - here, LONGEST_STEP)
            moves = self.moves(self._products, self._gradient, low, high)
        self._asked = [self.base.copy() for _ in moves]
        for candidate, move in zip(self._asked, moves, strict=True):
            candidate[self.columns] = np.clip(candidate[self.columns] + move, 0, 1)
        return self._asked

    def tell(self, rows: Sequence[dict[str, Any]]) -> None:
        """Take the rows of the trace of the candidates that were asked for."""
        if self.stage == SLOPES:
            names = [name for name in rows[1] if name.startswith(PRODUCT) and name != RESIDUAL]
            self._products = np.array([[row[name] for name in names] for row in rows[1:]])
            self._gradient = np.array([row[RESIDUAL] for row in rows[1:]])
            self.finished = not self._gradient.any()
            self.stage = POLISH
            return
        self.rounds += 1
        # Where none was taken, the slopes are still those of the base.
        if self.take(self._asked, [row["cost"] for row in rows]) is not None:
            self.stage = SLOPES


def residuals(
    loss: FrameLoss, velocity: torch.Tensor, x: torch.Tensor, v: torch.Tensor, near: Sequence[Mapping[str, torch.Tensor]]
) -> np.ndarray:
    """r of a rollout from `velocity` [N, 3], m/s: positions x and velocities v [F, N, 3] of the frames after the first.

    `near` are the assignments of each frame. All in double precision on the CPU.
    """
    change = torch.diff(torch.cat([velocity[None], v]), dim=0)
    jerk = [None, *torch.diff(change, dim=0)]
    rows, last = list[tuple[int, int, torch.Tensor]](), len(TERMS)
    rank = {name: last if name in OF_IMAGES else place for place, name in enumerate(TERMS)}
    for frame, (nodes, assigned, own) in enumerate(zip(x, near, jerk, strict=True), start=1):
        for name, parts in loss.errors(frame, nodes, assigned, own).items():
            rows += [(rank[name], frame, part.residuals(len(x)).flatten()) for part in parts]
    # Sums depend on the order by a rounding; it is that of earlier results: terms one after the other, those of images by frames.
    return np.asarray(torch.cat([r for _, _, r in sorted(rows, key=lambda row: row[:2])]).numpy())


def products(
    loss: FrameLoss,
    velocity: torch.Tensor,
    positions: torch.Tensor,
    velocities: torch.Tensor,
    fine: Sequence[bool],
    steps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(costs [1 + V], J'J [V, V], J'r [V]) of the rollouts [F, 1 + V, N, 3] of a base and its neighbors, `steps` [V] away.

    A rollout that is not `fine` (it left the scene), or whose residuals are no numbers, costs infinity and has no slope.
    """
    costs, none = np.full(1 + len(steps), np.inf), (np.zeros((len(steps), len(steps))), np.zeros(len(steps)))
    if not fine[0]:
        return costs, *none
    loss, velocity = loss.to("cpu", torch.float64), velocity.double().cpu()
    x, v = positions.double(), velocities.double()
    near = [loss.assigned(frame, nodes) for frame, nodes in enumerate(x[:, 0], start=1)]
    base = residuals(loss, velocity, x[:, 0], v[:, 0], near)
    if not np.isfinite(base).all():
        return costs, *none
    jacobian, costs[0] = np.zeros((len(steps), len(base))), base @ base
    for k in np.flatnonzero(fine[1:]):
        neighbor = residuals(loss, velocity, x[:, k + 1], v[:, k + 1], near)
        if np.isfinite(neighbor).all():
            costs[k + 1] = neighbor @ neighbor
            jacobian[k] = (neighbor - base) / steps[k]
    return costs, jacobian @ jacobian.T, jacobian @ base


def slope_rows(
    problem: SearchProblem,
    population: Sequence[np.ndarray],
    push: bool,
    steps: np.ndarray,
    index: int,
    generation: int,
    each: Map = map,
    lane: Launch | None = None,
) -> list[dict[str, Any]]:
    """Rows of a base and its neighbors, with the products of their slopes.

    The residuals of R recordings are stacked and divided by sqrt(R), so that the sum of their squares is the mean cost: products
    are means over the recordings. A neighbor that leaves the scene in one of them has no slope.
    On each recording all take as many substeps as the one that needs most: another step would move a twin as a small change of a
    variable does.
    """
    clock = time.perf_counter()
    candidates = list(each(lambda normalized: made(problem, normalized, push), population))
    base = candidates[0][1]
    assert base, "the base was simulated before"
    families = [family or base for _, family in candidates]
    most = [max(twin.simulation.substeps for twin in twins) for twins in zip(*families, strict=True)]
    fine, seen = [bool(family) for _, family in candidates], []
    for place, recording in enumerate(problem.recordings):
        twins = [family[place] for family in families]
        twins = [replace(twin, simulation=replace(twin.simulation, substeps=most[place])) for twin in twins]
        positions, velocities = launch(problem, Rollouts(twins, recording.hands, recording.velocity), lane)
        fine = [known and bool((positions[:, k].abs() < FAR_AWAY).all()) for k, known in enumerate(fine)]
        seen.append((recording.loss, recording.velocity, positions, velocities))
    # Only now is it known which candidates are fine everywhere.
    parts = [products(*rollout, fine, steps) for rollout in seen]
    costs, squares, gradient = (np.mean(values, axis=0) for values in zip(*parts, strict=True))
    share = (time.perf_counter() - clock) / len(candidates)
    rows = []
    for k, (row, _) in enumerate(candidates):
        row |= {"rollout": index + k, "generation": generation, "stage": SLOPES, "substeps": most[0], "seconds": share}
        row["cost"] = min(float(costs[k]), PENALTY)
        own = (0.0, np.zeros(len(steps))) if k == 0 else (gradient[k - 1], squares[k - 1])
        row |= {RESIDUAL: float(own[0])}
        row |= {f"{PRODUCT}{name}": float(value) for name, value in zip(problem.search.polished, own[1], strict=True)}
        rows.append(row)
    return rows
