"""Zero-order stage: CMA-ES over topology and homogeneous material (as in the released PhysTwin code), then a polish (polish.py).

Variables are normalized to [0, 1] by their ranges; a piecewise topology of K regions has 2K + 10 of them, less `search.fixed`. A
candidate is a whole twin: its springs are built, it is rolled out over the training frames, and its cost is the mean training loss.
The best candidate wins. With `search.tied_rollouts` the first part of the budget searches the 12 variables of the uniform topology;
then the regions are freed around the best candidate. A trace records every candidate. A killed search continues from it, and so
does a finished one with a larger budget: CMA-ES is replayed with the recorded costs, the polish with the recorded products.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuspring import config
from neuspring.config.search import HANDS, LENGTHS, VARIABLES
from neuspring.core.artifacts import Material, Observations, Simulation, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.text import Progress
from neuspring.physics import stability
from neuspring.physics.controllers import waypoints
from neuspring.physics.lanes import COST, WIDTHS, width_for
from neuspring.twin import hand_paths
from neuspring.twin import trace as trace_file
from neuspring.twin.losses import FrameLoss
from neuspring.twin.motion import initial_velocity
from neuspring.twin.polish import CMAES, POLISH, PRODUCT, RESIDUAL, SLOPES, Polish, slopes
from neuspring.twin.proposals import Proposals
from neuspring.twin.recordings import Recording, mean_outcome, on_recording, require_pool
from neuspring.twin.residuals import Residuals
from neuspring.twin.rollout import FAR
from neuspring.twin.spacing import controller_reach, node_spacing
from neuspring.twin.topology import piecewise_topology, regions
from neuspring.twin.trials import Outcome, motions, outcomes

INTEGERS = ("object_neighbors", "controller_neighbors")
REGIONAL = ("object_radius", "object_neighbors")
"""Variables of which every region has its own."""
PENALTY = 1e6
"""Cost of a candidate that diverges or cannot be integrated; far above any loss in square meters."""
UNSTABLE = "unstable"
Map = Callable[..., Iterable[Any]]
"""As the builtin `map`."""
RELEASED_FRAME_TIME = 667 * 5e-5
RELEASED_SUBSTEPS = 667


@dataclass(frozen=True)
class SearchProblem:
    """Everything that a candidate is judged with."""

    observations: Observations
    search: config.Search
    simulation: config.Simulation
    losses: config.Losses
    quirks: config.ReleasedQuirks
    device: str = "cpu"
    clusters: int = 1
    together: int = 0
    """Candidates in one launch at most; 0: as many as pay (`together`). Costs do not depend on it, bit for bit on a CPU."""
    threads: int = 1
    """Threads that simulate at the same time, on a CPU."""
    pool: tuple[Recording, ...] = ()
    """Other recordings of the object; a candidate's cost is the mean over all.

    Its springs are made once, on the nodes of `observations` in frame 0 (or their rest shape), with that body's `spacing` and
    `reach`, and are moved to each recording, node i on node i. Radii measured in each recording's own lengths would join other
    nodes there, and the material of one topology would be judged on another.
    """
    leave_out: bool = False
    """Judge candidates by the pool alone: nothing after frame 0 of `observations` counts, neither for costs nor for slopes."""
    labels: np.ndarray = field(init=False)
    """Region of each node [N]."""
    velocity: np.ndarray = field(init=False)
    """Velocity of each node in frame 0 [N, 3], m/s."""
    spacing: float = field(init=False)
    """Distance between neighboring nodes in the rest shape, m (spacing.py)."""
    reach: float = field(init=False)
    """Smallest distance between a controller and a node in the rest shape, m."""

    def __post_init__(self) -> None:
        require_pool(self.observations, [recording.observations for recording in self.pool], self.leave_out)
        if self.pool and self.observations.image is not None:
            where = f"pool of {self.observations.scenario.name}"
            raise InputError(where, "recordings of color alone are searched one by one", f"a pool of {len(self.pool) + 1}")
        canonical, count = self.observations.canonical, len(self.observations.nodes)
        nodes, hands = canonical[:count], canonical[count:]
        object.__setattr__(self, "labels", regions(nodes, self.clusters))
        object.__setattr__(self, "velocity", initial_velocity(self.observations, self.simulation.initial_velocity))
        object.__setattr__(self, "spacing", node_spacing(nodes))
        object.__setattr__(self, "reach", controller_reach(nodes, hands))

    @property
    def simulated_frames(self) -> int:
        """Frames that a candidate is simulated over, on all recordings that count."""
        counted = [*([] if self.leave_out else [self.observations]), *(recording.observations for recording in self.pool)]
        return sum(observations.scenario.train_end - 1 for observations in counted)

    @property
    def names(self) -> tuple[str, ...]:
        """All that makes a candidate: the variables of the settings, regional ones as name.0, name.1, ... (bare for one)."""
        names: list[str] = []
        for name in VARIABLES:
            if name in HANDS:
                continue
            regional = name in REGIONAL and self.clusters > 1
            names += [f"{name}.{region}" for region in range(self.clusters)] if regional else [name]
        image = self.observations.image
        return (*names, *(hand_paths.names(image, self.search.hand_knots) if image else ()))

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of what is searched: `names` without `search.fixed`."""
        return tuple(name for name in self.names if name.partition(".")[0] not in self.search.fixed)

    @property
    def polished(self) -> tuple[str, ...]:
        """Names of what is polished, in the order of the settings."""
        bases = self.search.polish.variables
        return tuple(name for base in bases for name in self.variables if name.partition(".")[0] == base)

    def decode(self, normalized: np.ndarray) -> dict[str, float]:
        """Physical values (lengths in m) of all `names`, from normalized `variables`; neighbor counts are truncated to integers."""
        searched = dict(zip(self.variables, normalized, strict=True))
        values = {}
        for name in self.names:
            base = name.partition(".")[0]
            variable = getattr(self.search.variables, base)
            value = variable.value(float(searched[name])) if name in searched else float(variable.start)
            values[name] = float(int(value)) if base in INTEGERS else self._meters(base, value)
        return values

    def encode(self) -> np.ndarray:
        """Normalized `variables` of the starting values."""
        settings = [getattr(self.search.variables, name.partition(".")[0]) for name in self.variables]
        return np.array([variable.normalized(variable.start) for variable in settings])

    def _meters(self, base: str, value: float) -> float:
        """A setting's value; of a length in m, whatever unit it is searched in."""
        if base not in LENGTHS or self.search.lengths == "meter":
            return value
        return value * self.spacing + (self.reach if base == "controller_radius" else 0.0)

    def of_regions(self, values: dict[str, float], name: str) -> list[float]:
        """A regional variable's value in each region."""
        return [values[name]] if self.clusters == 1 else [values[f"{name}.{region}"] for region in range(self.clusters)]


def simulation_of(problem: SearchProblem, substeps: int) -> Simulation:
    """The scenario's simulation with a given number of substeps per frame."""
    scenario, settings = problem.observations.scenario, problem.simulation
    return Simulation(
        frame_time=RELEASED_FRAME_TIME if problem.quirks.frame_time_667 else 1.0 / scenario.frame_rate,
        substeps=substeps,
        up=scenario.up,
        gravity=settings.gravity,
        ground=scenario.ground,
        obstacles=scenario.obstacles,
        self_collision=scenario.self_collision,
        collision_capacity=settings.collision_capacity,
        controller_velocity=settings.controller_velocity,
        initial_velocity=settings.initial_velocity,
    )


def with_substeps(problem: SearchProblem, twin: Twin) -> Twin:
    """The twin with its number of substeps: 667 with the quirk, else as configured: a fixed count or the smallest safe one.

    Raises InputError if a fixed count is too small, NumericalFailure if `auto` would need more than `max_substeps`.
    """
    settings = problem.simulation
    if problem.quirks.frame_time_667 or settings.substeps != "auto":
        count = RELEASED_SUBSTEPS if problem.quirks.frame_time_667 else int(settings.substeps)
        twin = replace(twin, simulation=replace(twin.simulation, substeps=count))
        stability.check(twin)
        return twin
    count = stability.smallest_safe_substeps(stability.twin_spectrum(twin), twin.simulation.frame_time, settings.safety)
    if count > settings.max_substeps:
        raise NumericalFailure(f"needs {count} substeps per frame, more than max_substeps = {settings.max_substeps}")
    return replace(twin, simulation=replace(twin.simulation, substeps=count))


def candidate(problem: SearchProblem, values: dict[str, float]) -> Twin:
    """The twin of one set of physical values. Raises InputError or NumericalFailure if it cannot be integrated."""
    observations = problem.observations
    topology = piecewise_topology(
        observations.nodes,
        observations.controller_points[0],
        problem.labels,
        problem.of_regions(values, "object_radius"),
        [int(n) for n in problem.of_regions(values, "object_neighbors")],
        values["controller_radius"],
        int(values["controller_neighbors"]),
        repair=problem.search.isolated_nodes == "repair",
        rest_shape=observations.rest_shape,
        controller_rest=problem.search.controller_rest,
    )
    count = len(topology.springs)
    if count == 0:
        raise NumericalFailure("no node has a spring")
    material = homogeneous(values, count)
    hands = {name: value for name, value in values.items() if name.partition(".")[0] in HANDS}
    return with_substeps(problem, Twin(topology=topology, material=material, simulation=simulation_of(problem, 1), hands=hands))


def homogeneous(values: dict[str, float], springs: int) -> Material:
    """A material that is the same everywhere; `values` has a number for every field of `Material` without a default."""
    every = {f.name: f for f in fields(Material) if f.name in values or (f.default is MISSING and f.default_factory is MISSING)}
    numbers: dict[str, Any] = {name: values[name] for name in every}
    arrays = {name: np.full(springs, values[name]) for name, f in every.items() if "shape" in f.metadata}
    return Material(**(numbers | arrays))


def judge(problem: SearchProblem, twins: Sequence[Twin], loss: FrameLoss) -> list[Outcome]:
    """What becomes of candidates that are rolled out together over the training frames."""
    return outcomes(twins, *_motion(problem, twins), loss, problem.device)


def _motion(problem: SearchProblem, twins: Sequence[Twin]) -> tuple[torch.Tensor, torch.Tensor]:
    """Waypoints of the hands (controllers.py), m, in the training frames, and the velocity of the nodes in frame 0 [N, 3], m/s.

    Waypoints have an axis [B] of twins where each has hands of its own.
    """
    observations, end = problem.observations, problem.observations.scenario.train_end

    def path(points: np.ndarray) -> torch.Tensor:
        hands = torch.tensor(points, dtype=torch.float32, device=problem.device)[:end]
        return waypoints(hands, observations.controller_valid)

    if observations.image is None:
        hands = path(observations.controller_points)
    else:
        hands = torch.stack([path(hand_paths.hand_points(observations, twin.hands)) for twin in twins], dim=1)
    return hands, torch.tensor(problem.velocity, dtype=torch.float32, device=problem.device)


def _recordings(problem: SearchProblem, twins: Sequence[Twin], loss: FrameLoss) -> dict[int, Recording]:
    """The recordings that count, by the place of their twin in a candidate's family; 0 is the scenario's own, with its `twins`."""
    own = {} if problem.leave_out else {0: Recording(problem.observations, *_motion(problem, twins), loss)}
    return own | dict(enumerate(problem.pool, start=1))


def groups(problem: SearchProblem, twins: Sequence[Twin]) -> list[list[int]]:
    """Which candidates are simulated together, the slowest group first.

    On CUDA all. On a CPU lanes wait for their group's largest number of substeps, and work on all springs of their group: alike
    ones are put together, such that the expected time of `threads` is least.
    """
    if problem.device != "cpu":
        size = problem.together or len(twins)
        return [list(range(first, min(first + size, len(twins)))) for first in range(0, len(twins), size)]
    substeps = [twin.simulation.substeps for twin in twins]
    springs = [len(twin.topology.springs) for twin in twins]
    order = sorted(range(len(twins)), key=lambda k: -substeps[k])
    most = min(problem.together or WIDTHS[-1], WIDTHS[-1])

    def time_of(members: Sequence[int]) -> float:
        return COST[width_for(len(members))] * substeps[members[0]] * max(springs[k] for k in members)

    parts = [order[first:last] for first in range(len(order)) for last in range(first + 1, min(first + most, len(order)) + 1)]
    times = {(part[0], len(part)): time_of(part) for part in parts}

    def split(limit: float) -> tuple[float, float, list[list[int]]]:
        """(time of all threads, sum, groups) of the split with the least sum, in which no group of several takes longer."""
        best: list[tuple[float, float, list[list[int]]]] = [(0.0, 0.0, [])]
        for first in reversed(range(len(order))):
            choices = []
            for size in range(1, min(most, len(order) - first) + 1):
                own = times[order[first], size]
                total, longest, rest = best[len(order) - first - size]
                if size == 1 or own <= limit:
                    choices.append((total + own, max(longest, own), [order[first : first + size], *rest]))
            best.append(min(choices, key=lambda choice: choice[0]))
        total, longest, split_parts = best[-1]
        return max(total / problem.threads, longest), total, split_parts

    return min(map(split, set(times.values())), key=lambda choice: choice[:2])[2]


@dataclass(frozen=True)
class SearchResult:
    """The best twin found, its variables and cost, and the trace: one row per candidate."""

    twin: Twin
    values: dict[str, float]
    cost: float
    trace: pd.DataFrame
    attempts: int
    """1, plus one for every time the search continued from its record."""
    earlier_seconds: float
    """Wall time of the attempts that this one continued, up to their last complete generation."""


def search(problem: SearchProblem, seed: int, *, record: Path | None = None, key: str = "") -> SearchResult:
    """Run the search within its budget of rollouts.

    The trace is written to `record` after every generation. A trace with the same `key` that is there already is continued,
    whatever its budget was. Raises NumericalFailure if no candidate could be simulated.
    """
    clock = time.perf_counter()
    rows, attempts, earlier = trace_file.recorded(record, key)
    trace = [row for row in rows if row["stage"] == CMAES]
    saved = len(trace)
    proposals = Proposals(problem, seed)
    loss = FrameLoss.of(problem.observations, problem.losses, problem.device, frozen_counts=problem.quirks.frozen_loss_denominators)
    budget = problem.search.cma_rollouts_of(len(problem.polished))
    progress = Progress(
        f"search {problem.observations.scenario.name}, regions: {problem.clusters}, seed {seed}", problem.search.rollouts
    )

    def save(kept: list[dict[str, Any]]) -> None:
        if record is not None:
            trace_file.save(record, key, kept, attempts, earlier + time.perf_counter() - clock)

    start = 0
    with _threads(problem.threads) as each:
        # The last generation may be cut short, so that searches of any population size use exactly the same budget.
        while start < budget:
            population = proposals.ask()[: budget - start]
            stop = start + len(population)
            if not trace_file.replays(trace[start:stop], population, problem.variables):
                print(f"{record}: does not replay on this machine; the search continues afresh from rollout {start}")
                trace, saved = trace[:start], start
                if not start:
                    attempts, earlier = 1, 0.0
            fresh = population[max(len(trace) - start, 0) :]
            if fresh:
                trace += _evaluate(problem, fresh, loss, len(trace), proposals.generation, each)
            progress.update(len(trace), f"best cost {min(row['cost'] for row in trace):.3e}")
            proposals.tell([row["cost"] for row in trace[start:stop]])
            start = stop
            if len(trace) > saved:
                save(trace)
        polished: list[dict[str, Any]] = []
        recorded = [row for row in rows if row["stage"] != CMAES]
        for polished in _polished(problem, trace[:budget], recorded, loss, proposals.generation, each):
            if len(polished) > len(recorded) or polished[-1] is not recorded[len(polished) - 1]:
                save(trace + polished)
            progress.update(budget + len(polished), "polish")
    table = pd.DataFrame(trace[:budget] + polished)
    judged = table[table["stage"] != SLOPES]
    best = judged.iloc[int(judged["cost"].to_numpy().argmin())]
    if best["cost"] >= PENALTY:
        if problem.simulation.substeps != "auto" and table["reason"].str.startswith(UNSTABLE).all():
            rule = f"at least one of {len(table)} candidates must be stable with this count"
            raise InputError("simulation.substeps", rule, problem.simulation.substeps, str(table.iloc[0]["reason"]))
        raise NumericalFailure(f"none of {len(table)} candidates could be simulated; the first: {table.iloc[0]['reason']}")
    values = {name: float(best[name]) for name in problem.names}
    if problem.quirks.integer_damping:
        values |= {name: float(int(values[name])) for name in ("drag", "dashpot")}
    return SearchResult(candidate(problem, values), values, float(best["cost"]), table, attempts, earlier)


def _polished(
    problem: SearchProblem,
    trace: Sequence[dict[str, Any]],
    recorded: Sequence[dict[str, Any]],
    loss: FrameLoss,
    generation: int,
    each: Map,
) -> Iterator[list[dict[str, Any]]]:
    """The rows of the polish after each of its generations; those that are recorded are taken as they are, if they replay."""
    best = min(trace, key=lambda row: row["cost"])
    if not problem.search.rounds_of(len(problem.polished)) or best["cost"] >= PENALTY:
        return
    start = np.array([best[f"normalized.{name}"] for name in problem.variables])
    columns = [problem.variables.index(name) for name in problem.polished]
    polish, rows = Polish(problem.search, columns, start, best["cost"]), list[dict[str, Any]]()
    while not polish.done:
        generation += 1
        population, first = polish.ask(), len(trace) + len(rows)
        made = list(recorded[len(rows) : len(rows) + len(population)])
        same = len(made) == len(population) and all(row["rollout"] == first + k for k, row in enumerate(made))
        if not same or not trace_file.replays(made, population, problem.variables):
            made, recorded = [], []
            if polish.stage == SLOPES:
                made = _slopes(problem, population, polish.steps(), loss, first, generation, each)
            else:
                made = [row | {"stage": POLISH} for row in _evaluate(problem, population, loss, first, generation, each)]
        rows = rows + made
        polish.tell(made)
        yield rows


def _slopes(
    problem: SearchProblem,
    population: Sequence[np.ndarray],
    steps: np.ndarray,
    loss: FrameLoss,
    index: int,
    generation: int,
    each: Map,
) -> list[dict[str, Any]]:
    """Rows of a base and its neighbors, with the products of their slopes.

    The residuals of R recordings are stacked and divided by sqrt(R), so that the sum of their squares is the mean cost: products
    are means over the recordings. A neighbor that leaves the scene in one of them has no slope.
    On each recording all take as many substeps as the one that needs most: another step would move a twin as a small change of a
    variable does.
    """
    clock = time.perf_counter()
    made = list(each(lambda normalized: _made(problem, normalized), population))
    base = made[0][1]
    assert base, "the base was simulated before"
    families = [family or base for _, family in made]
    most = [max(twin.simulation.substeps for twin in twins) for twins in zip(*families, strict=True)]
    fine, seen = [bool(family) for _, family in made], []
    for place, recording in _recordings(problem, [family[0] for family in families], loss).items():
        twins = [family[place] for family in families]
        twins = [replace(twin, simulation=replace(twin.simulation, substeps=most[place])) for twin in twins]
        positions, velocities = motions(twins, recording.hands, recording.velocity, problem.device)
        fine = [known and bool((positions[:, k].abs() < FAR).all()) for k, known in enumerate(fine)]
        seen.append((Residuals.of(recording.loss, recording.velocity), positions, velocities))
    # Only now is it known which candidates are fine everywhere.
    parts = [slopes(residuals, positions, velocities, fine, steps) for residuals, positions, velocities in seen]
    costs, products, gradient = (np.mean(values, axis=0) for values in zip(*parts, strict=True))
    share = (time.perf_counter() - clock) / len(made)
    rows = []
    for k, (row, _) in enumerate(made):
        row |= {"rollout": index + k, "generation": generation, "stage": SLOPES, "substeps": most[0], "seconds": share}
        row["cost"] = min(float(costs[k]), PENALTY)
        own = (0.0, np.zeros(len(steps))) if k == 0 else (gradient[k - 1], products[k - 1])
        row |= {RESIDUAL: float(own[0])}
        row |= {f"{PRODUCT}{name}": float(value) for name, value in zip(problem.polished, own[1], strict=True)}
        rows.append(row)
    return rows


@contextmanager
def _threads(count: int) -> Iterator[Map]:
    """How candidates are made and simulated: by `count` threads, or by this one, which an interrupt ends at once.

    Torch has no threads of its own meanwhile, so that `count` cores are busy and no more.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if count == 1:
            yield map
            return
        with ThreadPoolExecutor(count) as pool:
            yield pool.map
    finally:
        torch.set_num_threads(before)


def _evaluate(
    problem: SearchProblem, population: Sequence[np.ndarray], loss: FrameLoss, index: int, generation: int, each: Map
) -> list[dict[str, Any]]:
    """Rows of the trace for the candidates of a generation, numbered from `index` on."""
    made = list(each(lambda normalized: _made(problem, normalized), population))
    for number, (row, _) in enumerate(made):
        row |= {"rollout": index + number, "generation": generation}
    rows, families = [row for row, family in made if family], [family for _, family in made if family]
    twins = [family[0] for family in families]

    def simulate(members: list[int]) -> None:
        start = time.perf_counter()
        results = [] if problem.leave_out else [judge(problem, [twins[k] for k in members], loss)]
        for place, recording in enumerate(problem.pool, start=1):
            moved = [families[k][place] for k in members]
            results.append(outcomes(moved, recording.hands, recording.velocity, recording.loss, problem.device))
        share = (time.perf_counter() - start) / len(members)
        for k, result in zip(members, map(mean_outcome, zip(*results, strict=True)), strict=True):
            rows[k]["collision_overflow"] = result.collision_overflow
            rows[k]["seconds"] += share
            if result.left:
                rows[k]["reason"] = f"a node left the scene in frame {result.left}"
            else:
                rows[k]["cost"] = min(result.cost, PENALTY)

    # Threads would meet in the one stream of a GPU.
    simulated = each if problem.device == "cpu" else map
    list(simulated(simulate, groups(problem, twins) if twins else []))
    return [row for row, _ in made]


def _made(problem: SearchProblem, normalized: np.ndarray) -> tuple[dict[str, Any], tuple[Twin, ...]]:
    """A candidate's row, its cost the penalty, and its twin, here and on each recording of the pool.

    None, with the reason in the row, if one cannot be integrated.
    """
    start = time.perf_counter()
    values = problem.decode(normalized)
    row: dict[str, Any] = {"rollout": 0, "generation": 0, "stage": CMAES, "cost": PENALTY, "reason": ""}
    row |= {"springs": 0, "substeps": 0, "collision_overflow": 0, "seconds": 0.0}
    row |= values | {f"normalized.{name}": float(u) for name, u in zip(problem.variables, normalized, strict=True)}
    family: tuple[Twin, ...] = ()
    try:
        twin = candidate(problem, values)
        row |= {"springs": len(twin.topology.springs), "substeps": twin.simulation.substeps}
        moved = (on_recording(twin, recording.observations, problem.quirks) for recording in problem.pool)
        family = (twin, *(with_substeps(problem, one) for one in moved))
    except NumericalFailure as failure:
        row["reason"] = str(failure)
    except stability.Unstable as failure:
        # The candidate is too stiff for a fixed number of substeps.
        row["reason"] = f"{UNSTABLE}: {failure}"
    row["seconds"] = time.perf_counter() - start
    return row, family
