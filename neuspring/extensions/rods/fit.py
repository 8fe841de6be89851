"""Fit of a rod to complete recordings: Levenberg-Marquardt in all unknowns of a cable, through increasing horizons.

Let e be the errors of all coordinates of tracked points in the frames of the horizon, and q variables with start 0 and scale s.
The objective is

    mean(sqrt(e^2 + b^2) - b) + PRIOR sum((q / s)^2).

With the weighted residuals r and their derivatives J, a step d solves (J'J + damping diag J'J) d = -J'r within bounds, for
several dampings at once. The best step is accepted if it lowers the objective, and the damping follows it.
Derivatives are finite differences: one rollout per variable and recording, in batch lanes of one solver in double precision.
Positive numbers are varied on logarithmic scales; values along the arc are fields (`RodFit`) or free at each joint.

Markers are 1 to 2 cm beside the center line of a cable. These offsets (`Rod.offsets`, `Rod.clamps`) and the unloaded lengths are
variables too: without them held ends are at wrong positions, and distances between markers change as the cable bends. With
`rod.lay_out` the variables are the positions and tilts of clamps, and position and mass of each marker.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_table
from neuspring.core.text import Progress
from neuspring.extensions.rods import made
from neuspring.extensions.rods.nodes import PARALLEL, RodFrames, settled
from neuspring.extensions.rods.rod import Rod, arc_of, rod_of
from neuspring.extensions.rods.settings import RodFit
from neuspring.physics.controllers import waypoints
from neuspring.twin.body import Learned
from neuspring.twin.losses import frames_seen
from neuspring.twin.rollout import initial_velocity
from neuspring.twin.transfer import require_alike

if TYPE_CHECKING:
    import pandas as pd

PRIOR = 1e-6
"""Weight of the variables' squares, m. Regularizes variables that the data do not constrain."""
SCALED_STEP = 5e-3
"""Step of the finite differences, in scales."""
LARGEST_ERROR = 2.0
"""Maximum error of a coordinate, m; larger errors are clipped."""
LEAST_GAIN = 2e-3
"""Minimum relative gain of a step; a step below is the last of its stage."""
DAMPINGS = (0.1, 1.0, 10.0, 100.0)
"""Factors on the damping that each step tries."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-6, 1e6
"""Initial damping of a stage, and its range. The damping grows while no step lowers the objective."""
LAUNCHED = 16
"""Number of kept frames per launch."""
STIFFNESS_TRIED = np.arange(-2.0, 9.0, 0.5)
"""Logarithms of stiffness over the initial stiffness; a search tries them in frame 0 of a rod with `lay_out`."""
LANES = 512
"""Maximum number of rollouts in one solver."""
VARIABLE_SCALES = {
    "bending": 1.0, "twisting": 1.0, "damping": 1.0, "drag": 1.0, "drag_quadratic": 1.0, "marker_mass": 1.0, "hands": 1.0,
    "dashpots": 1.0, "roll": 1.0, "curvature": 0.3, "bending_along": 0.5, "twisting_along": 0.5, "clamps": 0.02, "offsets": 0.01,
    "stretch": 0.01, "tilts": 0.05, "places": 0.01, "slip_share": 1.0, "slip_yield": 0.7, "slip_twist": 0.5,
}  # fmt: skip
"""Scale of each kind of variable: logarithms, rad, curvatures (1) and m."""
LOGARITHMIC = (
    "bending", "twisting", "damping", "drag", "drag_quadratic", "marker_mass", "hands", "dashpots", "slip_share", "slip_yield",
    "slip_twist",
)  # fmt: skip
SLIP_SHARE, SLIP_ANGLES = 0.3, (0.02, 3.0)
"""Initial share of each branch that slips, and bends of the rod at which the first and the last branch slip, rad."""
SLIP_DAMPING = 0.02
"""Maximum initial inner damping with such branches, s, because friction replaces it."""


@dataclass(frozen=True, kw_only=True)
class RodSteps(RodFit):
    """The settings, and constants of the optimization."""

    markers: bool = True
    """Fit the offsets of markers from the center line, and the lengths between markers."""
    rounds: int = 8
    """Maximum number of steps per stage."""
    robust: float = 0.02
    """Robustness b, m. Errors e count as sqrt(e^2 + b^2), which limits the influence of recordings that flip."""


@dataclass(frozen=True)
class Variables:
    """Variables of a twin, as one vector q [Q], initially 0."""

    twin: Twin
    tracked: int
    sizes: dict[str, int]
    stiffness_along: np.ndarray
    """Basis of log EI and log GJ along the arc [V, n]."""
    curvature_along: np.ndarray
    """Basis of k1 and k2 per joint along the arc [V, n]."""

    @classmethod
    def of(cls, twin: Twin, settings: RodSteps, tracked: int = 0) -> Variables:
        """The variables of a fit. The first `tracked` nodes are tracked points."""
        rod, held = rod_of(twin), rod_of(twin).held >= 0
        if settings.slip and not len(rod.slip):
            yields = np.geomspace(*SLIP_ANGLES, settings.slip) / rod.lengths.sum()
            branches = np.stack([np.full(settings.slip, SLIP_SHARE), yields], axis=1)
            rod = replace(rod, slip=branches, slip_twist=1.0, damping=min(rod.damping, SLIP_DAMPING))
            twin = replace(twin, body=rod)
        along = _basis(rod, {"constant": "straight"}.get(settings.stiffness, settings.stiffness), settings.knots)
        bent = _basis(rod, settings.curvature, settings.knots)
        if settings.curvature != "free":
            # The field is the curvature per length.
            bent = bent * (rod.spans / rod.spans[1:-1].mean())[:, None]
        ends = int(held[:2].all()) + int(held[-2:].all())
        sizes = dict.fromkeys(("bending", "twisting", "damping", "drag", "drag_quadratic"), 1)
        sizes |= {"marker_mass": tracked if rod.laid else 1} if held.any() else {"hands": 1, "dashpots": 1}
        sizes |= {"slip_share": settings.slip, "slip_yield": settings.slip, "slip_twist": int(settings.slip > 0)}
        sizes |= {"roll": int(ends == 2), "curvature": 2 * bent.shape[1]}
        sizes |= {"bending_along": along.shape[1], "twisting_along": along.shape[1]}
        if settings.markers and rod.laid:
            sizes |= {"clamps": 3 * ends, "tilts": 2 * ends, "places": 3 * tracked}
        elif settings.markers and ends:
            sizes |= {"clamps": 3 * ends, "offsets": 2 * int((~held).sum()), "stretch": len(held) - 3}
        return cls(twin, tracked, {name: size for name, size in sizes.items() if size}, along, bent)

    @property
    def kinds(self) -> np.ndarray:
        """Kind of each variable [Q]."""
        return np.repeat(list(self.sizes), list(self.sizes.values()))

    @property
    def scale(self) -> np.ndarray:
        """Scale of each variable [Q]."""
        return np.array([VARIABLE_SCALES[name] for name in self.kinds])

    def part(self, q: np.ndarray, name: str) -> np.ndarray:
        """The variables of one kind; zero if this kind is not varied."""
        parts = np.split(q, np.cumsum(list(self.sizes.values())))
        return dict(zip(self.sizes, parts, strict=False)).get(name, np.zeros(1))

    def made(self, q: np.ndarray) -> Twin:
        """The twin of variables q [Q]."""
        start, twin = rod_of(self.twin), self.twin
        factor = {name: np.exp(self.part(q, name)) for name in LOGARITHMIC}
        bending, twisting = start.bending * factor["bending"], start.twisting * factor["twisting"]
        if self.stiffness_along.shape[1]:
            bending = bending * np.exp(self.stiffness_along @ self.part(q, "bending_along"))
            twisting = twisting * np.exp(self.stiffness_along @ self.part(q, "twisting_along"))
        changes = {"bending": bending, "twisting": twisting, "roll": start.roll + float(self.part(q, "roll")[0])}
        changes |= {name: getattr(start, name) * float(factor[name][0]) for name in ("damping", "drag_quadratic")}
        if self.curvature_along.shape[1]:
            coefficients = self.part(q, "curvature").reshape(2, -1)
            changes["curvature"] = start.curvature + (self.curvature_along @ coefficients.T)
        if "slip_share" in self.sizes:
            branches = np.stack([factor["slip_share"], factor["slip_yield"]], axis=1)
            changes |= {"slip": start.slip * branches, "slip_twist": start.slip_twist * float(factor["slip_twist"][0])}
        clamps = start.clamps.copy()
        if "clamps" in self.sizes:
            clamped = [bool((start.held[end] >= 0).all()) for end in (slice(2), slice(-2, None))]
            clamps[clamped] += self.part(q, "clamps").reshape(-1, 3)
            changes["clamps"] = clamps
        if "tilts" in self.sizes:
            tilts = start.tilts.copy()
            tilts[clamped] += self.part(q, "tilts").reshape(-1, 2)
            changes |= {"tilts": tilts} | self._relaid(q, clamps - start.clamps)
            # Curvatures per length do not change.
            stretch = changes["lengths"][0] / start.lengths[0]
            changes["curvature"] = stretch * changes.get("curvature", start.curvature)
        lengths = changes.get("lengths", start.lengths).copy()
        if "offsets" in self.sizes:
            free = start.held < 0
            lengths[1:-1] = np.maximum(lengths[1:-1] + self.part(q, "stretch"), 0.1 * lengths[1:-1])
            offsets = np.zeros((len(free), 2)) if not start.offsets.size else start.offsets.copy()
            offsets[free] += self.part(q, "offsets").reshape(-1, 2)
            changes |= {"lengths": lengths, "offsets": offsets}
        if "marker_mass" in self.sizes:
            before, cable = (np.convolve(edges, [0.5, 0.5]) for edges in (start.lengths, lengths))
            markers = (start.mass - before) * factor["marker_mass"][0]
            if start.laid:
                masses = np.linalg.lstsq(made.marker_shares(start, self.tracked), start.mass - before)[0]
                markers = made.marker_shares(replace(start, **changes), self.tracked) @ (masses * factor["marker_mass"])
            changes["mass"] = cable + markers
        material = replace(twin.material, drag=twin.material.drag * float(factor["drag"][0]))
        if "hands" in self.sizes:
            material = replace(
                material, stiffness=material.stiffness * factor["hands"], dashpot=material.dashpot * factor["dashpots"]
            )
        return replace(twin, material=material, body=replace(start, **changes))

    def _relaid(self, q: np.ndarray, moved: np.ndarray) -> dict[str, np.ndarray]:
        """Lengths and node positions of a rod with `lay_out` whose clamps move by `moved` [2, 3], m, along and beside the line.

        Nodes between clamps keep their positions on the unloaded line; tracked points move along and beside it by their
        variables.
        """
        start = rod_of(self.twin)
        low, high = free_part(start)
        ratio = 1 + (moved[1, 0] - moved[0, 0]) / (high - low)
        lengths = start.lengths * ratio
        place = start.place.copy()
        # Distances from the middle of the first edge.
        at = arc_of(start.lengths)[start.edge] + place[:, 0] * start.lengths[start.edge]
        at = at - start.lengths[0] / 2 + lengths[0] / 2 - moved[0, 0]
        shifts = self.part(q, "places").reshape(-1, 3)
        at[: len(shifts)] += shifts[:, 0]
        place[: len(shifts), 1:] += shifts[:, 1:]
        arc = arc_of(lengths)
        edge = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(lengths) - 1)
        place[:, 0] = (at - arc[edge]) / lengths[edge]
        return {"lengths": lengths, "edge": edge.astype(np.int32), "place": place}


def free_part(rod: Rod) -> tuple[float, float]:
    """Range of the knots of fields along the arc: distances from the first vertex, m.

    It is the range of the joints. With `lay_out`, whose number of vertices is arbitrary, it is the range that bends.
    """
    arc = arc_of(rod.lengths)
    if not rod.laid:
        return float(arc[1]), float(arc[-2])
    return float(arc[1] / 2), float(arc[-1] - (rod.held[-1] >= 0) * rod.lengths[-1] / 2)


def _basis(rod: Rod, kind: str, knots: int) -> np.ndarray:
    """Functions along the arc at the vertices [V, n]: none (straight), one constant, one per inner joint, or cubic splines."""
    count = len(rod.mass)
    if kind == "straight":
        return np.zeros((count, 0))
    if kind == "free":
        return np.eye(count)[:, 1:-1]
    if kind == "constant":
        return np.ones((count, 1))
    from scipy.interpolate import CubicSpline

    arc, (low, high) = arc_of(rod.lengths), free_part(rod)
    return np.asarray(CubicSpline(np.linspace(low, high, knots), np.eye(knots), bc_type="natural")(np.clip(arc, low, high)))


@dataclass(frozen=True)
class Recordings:
    """Tracked points and controllers of C recordings of one object, padded to the same number of frames."""

    observations: tuple[Observations, ...]
    hands: torch.Tensor
    """Waypoints of the controllers [T, C, hands, 3 or 4] (controllers.py)."""
    points: np.ndarray
    """Tracked points [C, T, No, 3], m."""
    counts: np.ndarray
    """Whether a point is visible in a training frame [C, T, No]."""
    velocities: tuple[np.ndarray, ...]
    """Velocities of tracked points or of all nodes in frame 0, m/s."""

    @classmethod
    def of(cls, observations: Sequence[Observations], twin: Twin, oracle: bool = False) -> Recordings:
        """Recordings with equally many tracked points and controllers; training frames, or all frames for an oracle."""
        frames = [frames_seen(recording, oracle=oracle) for recording in observations]
        rows = [np.minimum(np.arange(max(frames)), end - 1) for end in frames]
        pairs = list(zip(observations, rows, strict=True))
        inside = [np.arange(max(frames)) < end for end in frames]
        counts = [seen.object_visibility[index] & known[:, None] for (seen, index), known in zip(pairs, inside, strict=True)]
        return cls(
            tuple(observations),
            _paths(pairs),
            np.stack([recording.object_points[index] for recording, index in pairs]).astype(np.float64),
            np.stack(counts),
            tuple(initial_velocity(recording, twin.simulation.initial_velocity) for recording in observations),
        )

    def bodies(self, twins: Sequence[Twin]) -> list[Twin]:
        """Each twin in frame 0 of each recording. A cable that clamps hold has only tracked points as nodes."""
        pairs = [(twin, recording) for twin in twins for recording in self.observations]
        if len(twins[0].topology.springs):
            return [made.on_recording(twin, recording) for twin, recording in pairs]
        if rod_of(twins[0]).laid:
            return made.hung([made.of_first(twin, self.points.shape[2]) for twin, _ in pairs], [seen for _, seen in pairs])
        moved = [made.of_markers(twin, recording) for twin, recording in pairs]
        vertices = settled([rod_of(twin) for twin in moved], np.stack([rod_of(twin).vertices for twin in moved]))
        return [replace(twin, body=replace(rod_of(twin), vertices=x)) for twin, x in zip(moved, vertices, strict=True)]

    def predicted(self, twins: Sequence[Twin], frames: int, every: int, device: str) -> np.ndarray:
        """Predicted tracked points of K twins [K, C, kept frames, No, 3], m: frames 1, 1 + every, ... below `frames`."""
        count, tracked = len(self.observations), self.points.shape[2]
        bodies = self.bodies(twins)
        solver = RodFrames(bodies, device)
        x = torch.tensor(np.stack([body.topology.nodes for body in bodies]))
        nodes = x.shape[1]
        v = torch.tensor(np.stack([v[:nodes] for _ in twins for v in self.velocities]), dtype=torch.float32)
        hands = self.hands.repeat(1, len(twins), 1, 1)
        solver.start(x, v, hands[0])
        kept, size = [], LAUNCHED * every if hands.shape[-1] == 3 else 1
        for first in range(1, frames, size):
            rows = hands[first - 1 : min(first + size, frames)]
            # Frames 1, 1 + every, ...
            kept.append(solver.advance(rows, slice((1 - first) % every, None, every))[:, :, :tracked].cpu())
        predicted = torch.cat(kept).transpose(0, 1).reshape(len(twins), count, -1, tracked, 3).numpy()
        return np.asarray(np.nan_to_num(predicted, nan=LARGEST_ERROR * 10))


def _paths(pairs: Sequence[tuple[Observations, np.ndarray]]) -> torch.Tensor:
    """Waypoints of controllers in these frames of recordings [T, C, hands, 3 or 4]; 4 if some do not always hold."""
    parts = []
    for recording, rows in pairs:
        valid = recording.controller_valid[rows] if recording.controller_valid.size else None
        parts.append(waypoints(torch.tensor(recording.controller_points[rows]), valid))
    width = max(part.shape[-1] for part in parts)
    return torch.stack([torch.cat([part, torch.ones_like(part[..., : width - part.shape[-1]])], dim=-1) for part in parts], dim=1)


class Levenberg:
    """Levenberg-Marquardt for the variables of a rod on recordings."""

    def __init__(self, recordings: Recordings, settings: RodSteps, device: str = "cpu", threads: int = 1) -> None:
        self.recordings, self.settings, self.device = recordings, settings, device
        self.threads = threads if device == "cpu" else 1
        self.rollouts = 0

    def errors(self, variables: Variables, qs: Sequence[np.ndarray], frames: int, every: int) -> np.ndarray:
        """Errors of K candidates in all compared coordinates [K, R], m."""
        recordings, kept = self.recordings, slice(1, frames, every)
        size = max(LANES // len(recordings.observations), 1)
        parts = np.array_split(np.arange(len(qs)), max(-(-len(qs) // size), min(self.threads, len(qs))))

        def of_part(part: np.ndarray) -> np.ndarray:
            predicted = recordings.predicted([variables.made(qs[k]) for k in part], frames, every, self.device)
            apart = np.clip(predicted - recordings.points[None, :, kept], -LARGEST_ERROR, LARGEST_ERROR)
            return np.asarray(apart[:, recordings.counts[:, kept]].reshape(len(part), -1))

        self.rollouts += len(qs) * len(recordings.observations)
        with ThreadPoolExecutor(max(self.threads, 1)) as pool:
            return np.concatenate(list((pool.map if self.threads > 1 else map)(of_part, parts)))

    def objective(self, errors: np.ndarray, q: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """The objective of candidates, m, from errors [K, R] and variables [K, Q]."""
        b = self.settings.robust
        return np.asarray(np.mean(np.sqrt(errors**2 + b**2) - b, axis=-1) + PRIOR * ((q / scale) ** 2).sum(axis=-1))

    def lowered(self, twin: Twin, progress: Progress) -> tuple[Twin, float, list[dict[str, Any]]]:
        """The twin after all stages, the objective of the last stage, m, and one row per step."""
        variables, history = Variables.of(twin, self.settings, self.recordings.points.shape[2]), list[dict[str, Any]]()
        q, end = np.zeros(len(variables.scale)), self.recordings.points.shape[1]
        for horizon in self.settings.horizons:
            frames = min(horizon + 1, end) if horizon else end

            def report(row: dict[str, float], frames: int = frames) -> None:
                history.append(row | {"stage": str(frames - 1)})
                progress.update(len(history), f"{frames - 1} frames, error {1e3 * row['loss'] ** 0.5:.1f} mm")

            q = self.stage(variables, q, frames, report)
        last = self.errors(variables, [q], frames, self.settings.every)
        return variables.made(q), float(self.objective(last, q, variables.scale)[0]), history

    def stage(self, variables: Variables, q: np.ndarray, frames: int, report: Callable[[dict[str, float]], None]) -> np.ndarray:
        """Steps on the first frames, starting from q. `report` gets one row per step."""
        every = self.settings.every
        if frames <= 30 * every:
            every = max(every // 2, 1)
        scale, b = variables.scale, self.settings.robust
        errors = self.errors(variables, [q], frames, every)[0]
        value = float(self.objective(errors, q, scale))
        damping = FIRST_DAMPING
        for _ in range(self.settings.rounds):
            # Derivatives in units of the scales, so that bounds and damping mean the same for all variables.
            slopes = (self.errors(variables, list(q + np.diag(SCALED_STEP * scale)), frames, every) - errors) / SCALED_STEP
            weights = 1 / np.sqrt(errors**2 + b**2) / len(errors)
            products = (slopes * weights) @ slopes.T + 2 * PRIOR * np.eye(len(q))
            gradient = slopes @ (weights * errors) + 2 * PRIOR * q / scale
            best, before = None, value
            while best is None and damping <= MOST_DAMPING:
                tried = [q + scale * damped_step(products, gradient, damping * factor) for factor in DAMPINGS]
                candidates = self.errors(variables, tried, frames, every)
                costs = self.objective(candidates, np.array(tried), scale)
                best = int(np.argmin(costs))
                if not costs[best] < value:
                    best, damping = None, damping * (DAMPINGS[-1] * 10)
            if best is None:
                break
            q, value, errors = tried[best], float(costs[best]), candidates[best]
            damping = max(damping * DAMPINGS[best], LEAST_DAMPING)
            norm = float(np.linalg.norm(gradient))
            report({"loss": float(3 * np.mean(errors**2)), "gradient_norm": norm, "learning_rate": damping})
            if before - value < LEAST_GAIN * before:
                break
        return q


def damped_step(products: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """Solve (A + damping diag A) d = -g for A [V, V], g [V] with -1 <= d <= 1; variables beyond a bound are fixed there."""
    scale = np.diag(products)
    # Variables without effect do not move.
    matrix = products + damping * np.diag(np.maximum(scale, 1e-12 * scale.max()))
    step, free = np.zeros(len(gradient)), scale > 1e-12 * scale.max()
    while free.any():
        rest = -(gradient + matrix[:, ~free] @ step[~free])
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest[free])
        beyond = np.where(free, np.abs(step) - 1, 0.0)
        if beyond.max() <= 0:
            break
        # Fixes one variable at a time, because others may then stay within their bounds.
        worst = int(np.argmax(beyond))
        step[worst] = np.clip(step[worst], -1, 1)
        free[worst] = False
    return step


@dataclass(frozen=True, kw_only=True)
class RodResult(Learned):
    """The best rod and the history of its search or fit."""

    value: float
    """The final objective, m."""
    history: pd.DataFrame
    """One row per step: stage, loss (mean squared error in the horizon, m^2), gradient_norm, learning_rate (the damping)."""


def search_rod(
    observations: Observations,
    pool: Sequence[Observations],
    settings: config.Config,
    *,
    device: str = "cpu",
    threads: int = 1,
    record: Path | None = None,
) -> RodResult:
    """Search the constants of a rod on the frames of the first horizon; the file `record` gets one row per step."""
    import pandas as pd

    require_pool(observations, pool)
    recordings = [observations, *pool]
    first = RodSteps(**vars(settings.fit.section(RodFit)))
    first = replace(first, stiffness="constant", curvature="constant", markers=False, slip=0)
    first = replace(first, horizons=first.horizons[:1])
    axis = axis_for([made.line_of(recording) for recording in recordings if recording.line.size])
    start = made.rod_twin(observations, settings, axis)
    solver = Levenberg(Recordings.of(recordings, start), first, device, threads)
    if rod_of(start).laid:
        # The rod hangs in frame 0, so its shape indicates its stiffness.
        variables = Variables.of(start, first, observations.object_points.shape[1])
        tried = [factor * (variables.kinds == "bending") + factor * (variables.kinds == "twisting") for factor in STIFFNESS_TRIED]
        values = solver.objective(solver.errors(variables, tried, 2, 1), np.array(tried), variables.scale)
        start = variables.made(tried[int(values.argmin())])
    twin, value, history = solver.lowered(start, Progress(f"search {observations.scenario.name}, rod", first.rounds))
    result = _result(twin, value, history)
    if record is not None:
        write_table(result.history, record)
    costs = result.history["loss"]
    facts = {"cost": value, "rollouts": solver.rollouts, "collision_overflow": 0, **result.facts, **twin.counts}
    return replace(result, course=pd.DataFrame({"cost": costs, "best_cost": costs.cummin()}), facts=facts)


def fit_rod(
    observations: Observations,
    pool: Sequence[Observations],
    twin: Twin,
    settings: RodFit,
    *,
    oracle: bool = False,
    device: str = "cpu",
    threads: int = 1,
) -> RodResult:
    """Fit all variables of a rod in stages, starting from the twin of its search. Raises InputError, NumericalFailure."""
    require_pool(observations, pool)
    recordings, settings = Recordings.of([observations, *pool], twin, oracle), RodSteps(**vars(settings))
    solver = Levenberg(recordings, settings, device, threads)
    progress = Progress(f"fit {observations.scenario.name}, rod", settings.rounds * len(settings.horizons))
    twin, value, history = solver.lowered(twin, progress)
    # New offsets of markers change the line of frame 0.
    twin = made.on_recording(twin, observations)
    result = _result(twin, value, history)
    counted = {"best_loss": value, "steps": len(history), "rollouts": solver.rollouts, "collision_overflow": 0}
    return replace(result, facts=counted | result.facts | twin.counts)


def require_pool(here: Observations, pool: Sequence[Observations]) -> None:
    """Raise InputError unless recordings have one center line: equally many tracked points, controllers and vertices."""
    if pool and not here.line.size:
        rule = "for a rod, recordings of a pool must have markers along the line"
        raise InputError(f"pool of {here.scenario.name}", rule, "none", "Use method rod_single.")
    counted = "tracked points, controllers and vertices"
    require_alike(
        [here, *pool], counted, lambda seen: (seen.object_points.shape[1], seen.controller_points.shape[1], len(seen.line))
    )


def axis_for(lines: Sequence[np.ndarray]) -> np.ndarray:
    """`Rod.axis` [3] for lines [V, 3] in frame 0: y, or x if an end of a line is along y."""
    ends = np.concatenate([np.diff(line, axis=0)[[0, -1]] for line in lines] or [np.eye(3)[:1]])
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    axis: np.ndarray = np.eye(3)[1 if np.abs(ends[:, 1]).max() <= PARALLEL else 0]
    return axis


def _result(twin: Twin, value: float, history: list[dict[str, Any]]) -> RodResult:
    import pandas as pd

    if not history or not np.isfinite(value):
        raise NumericalFailure(f"no step lowers the initial error of the rod ({value:.3g} m)")
    rod = rod_of(twin)
    inner = slice(1, -1)
    facts = {name: float(np.median(getattr(rod, name)[inner])) for name in ("bending", "twisting", "mass")}
    facts |= {name: float(getattr(rod, name)) for name in ("damping", "drag_quadratic", "roll")}
    facts |= {"drag": twin.material.drag, "axis": rod.axis.tolist()}
    table = pd.DataFrame(history)
    course = table[["loss", "gradient_norm", "learning_rate"]]
    return RodResult(twin=twin, value=value, history=table, course=course, facts=facts)
