"""Zero-order stage: CMA-ES over topology and homogeneous material (as in the released PhysTwin code).

Variables are normalized to [0, 1] by their ranges; a piecewise topology of K regions has 2K + 10 of them. A candidate is a
whole twin: its springs are built, it is rolled out over the training frames, and its cost is the mean training loss. The best
candidate wins. With `search.tied_rollouts` the first part of the budget searches the 12 variables of the uniform topology; then
the regions are freed around the best candidate. A trace records every candidate. A killed search continues from it, and so does a
finished one with a larger budget: CMA-ES is replayed with the recorded costs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import cma
import numpy as np
import pandas as pd
import torch

from neuspring import config
from neuspring.core.artifacts import Material, Observations, Simulation, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_atomically
from neuspring.core.progress import Progress
from neuspring.physics import stability
from neuspring.physics.lanes import COST, WIDTHS, width_for
from neuspring.physics.path import waypoints
from neuspring.twin.losses import FrameLoss
from neuspring.twin.masses import volume_masses
from neuspring.twin.motion import initial_velocity
from neuspring.twin.topology import isolated, piecewise_topology, regions
from neuspring.twin.trials import Outcome, outcomes

INTEGERS = ("object_neighbours", "controller_neighbours")
REGIONAL = ("object_radius", "object_neighbours")
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
    labels: np.ndarray = field(init=False)
    """Region of each node [N]."""
    mass: np.ndarray = field(init=False)
    """Mass of each node [N], kg; empty: 1 each."""
    velocity: np.ndarray = field(init=False)
    """Velocity of each node in frame 0 [N, 3], m/s."""

    def __post_init__(self) -> None:
        nodes = self.observations.canonical[: len(self.observations.nodes)]
        object.__setattr__(self, "labels", regions(nodes, self.clusters, self.search.clusters))
        object.__setattr__(self, "mass", volume_masses(nodes) if self.simulation.mass == "volume" else np.zeros(0))
        object.__setattr__(self, "velocity", initial_velocity(self.observations, self.simulation.initial_velocity))

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables: those of `config.SearchRanges`, regional ones as name.0, name.1, ... (bare for one region)."""
        names: list[str] = []
        for f in fields(config.SearchRanges):
            if getattr(self.search.ranges, f.name) is None:
                continue
            regional = f.name in REGIONAL and self.clusters > 1
            names += [f"{f.name}.{region}" for region in range(self.clusters)] if regional else [f.name]
        return tuple(names)

    def decode(self, normalized: np.ndarray) -> dict[str, float]:
        """Physical values of normalized variables [2K + 10]; neighbor counts are truncated to integers."""
        values = {}
        for name, u in zip(self.variables, normalized, strict=True):
            base, low, high, logarithmic = self._range(name)
            value = float(low * (high / low) ** float(u)) if logarithmic else low + float(u) * (high - low)
            values[name] = float(int(value)) if base in INTEGERS else value
        return values

    def encode(self) -> np.ndarray:
        """Normalized variables [2K + 10] of the starting values."""
        normalized = []
        for name in self.variables:
            base, low, high, logarithmic = self._range(name)
            value = getattr(self.search.start, base)
            normalized.append(np.log(value / low) / np.log(high / low) if logarithmic else (value - low) / (high - low))
        return np.array(normalized)

    def _range(self, name: str) -> tuple[str, float, float, bool]:
        """The setting of a variable, its range, and whether its scale is logarithmic."""
        base = name.partition(".")[0]
        return base, *getattr(self.search.ranges, base), base == "stiffness" and self.search.stiffness_scale == "log"

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
        self_collision=scenario.self_collision,
        collision_capacity=settings.collision_capacity,
        controller_velocity=settings.controller_velocity,
        initial_velocity=settings.initial_velocity,
        controller_path=settings.controller_path,
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
    observations, isolated_nodes = problem.observations, problem.search.isolated_nodes
    topology = piecewise_topology(
        observations.nodes,
        observations.controller_points[0],
        problem.labels,
        problem.of_regions(values, "object_radius"),
        [int(n) for n in problem.of_regions(values, "object_neighbours")],
        values["controller_radius"],
        int(values["controller_neighbours"]),
        repair=isolated_nodes == "repair",
        rest_shape=observations.rest_shape,
    )
    count = len(topology.springs)
    if count == 0:
        raise NumericalFailure("no node has a spring")
    lonely = isolated(len(topology.nodes), topology.springs)
    if isolated_nodes == "penalise" and len(lonely):
        raise NumericalFailure(f"{len(lonely)} nodes have no spring, the first is node {lonely[0]}")
    material = replace(homogeneous(values, count), mass=problem.mass)
    return with_substeps(problem, Twin(topology=topology, material=material, simulation=simulation_of(problem, 1)))


def homogeneous(values: dict[str, float], springs: int) -> Material:
    """A material that is the same everywhere; `values` has a number for every field of `Material` without default."""
    numbers: dict[str, Any] = {f.name: values[f.name] for f in fields(Material) if f.name in values}
    arrays = {name: np.full(springs, values[name]) for name in ("stiffness", "dashpot")}
    return Material(**(numbers | arrays))


def judge(problem: SearchProblem, twins: Sequence[Twin], loss: FrameLoss) -> list[Outcome]:
    """What becomes of candidates that are rolled out together over the training frames."""
    hands = torch.tensor(problem.observations.controller_points, device=problem.device)[: problem.observations.scenario.train_end]
    start = torch.tensor(problem.velocity, dtype=torch.float32, device=problem.device)
    hands = waypoints(hands, twins[0].simulation)
    return outcomes(twins, hands, start, loss, problem.device)


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
    trace, attempts, earlier = _recorded(record, key)
    saved = len(trace)
    proposals = _Proposals(problem, seed)
    loss = FrameLoss.of(problem.observations, problem.losses, problem.device, frozen_counts=problem.quirks.frozen_loss_denominators)
    budget = problem.search.rollouts
    progress = Progress(f"search {problem.observations.scenario.name}, regions: {problem.clusters}, seed {seed}", budget)
    start = 0
    with _threads(problem.threads) as each:
        # The last generation may be cut short, so that searches of any population size use exactly the same budget.
        while start < budget:
            population = proposals.ask()[: budget - start]
            stop = start + len(population)
            if not _replays(trace[start:stop], population, problem.variables):
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
            if record is not None and len(trace) > saved:
                _save(record, key, trace, attempts, earlier + time.perf_counter() - clock)
    table = pd.DataFrame(trace[:budget])
    best = table.iloc[int(table["cost"].to_numpy().argmin())]
    if best["cost"] >= PENALTY:
        if problem.simulation.substeps != "auto" and table["reason"].str.startswith(UNSTABLE).all():
            rule = f"at least one of {len(table)} candidates must be stable with this count"
            raise InputError("simulation.substeps", rule, problem.simulation.substeps, str(table.iloc[0]["reason"]))
        raise NumericalFailure(f"none of {len(table)} candidates could be simulated; the first: {table.iloc[0]['reason']}")
    values = {name: float(best[name]) for name in problem.variables}
    if problem.quirks.integer_damping:
        values |= {name: float(int(values[name])) for name in ("drag", "dashpot")}
    return SearchResult(candidate(problem, values), values, float(best["cost"]), table, attempts, earlier)


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


class _Proposals:
    """The candidates of CMA-ES, in all 2K + 10 normalized variables.

    In the first `tied_rollouts` it searches the 12 variables of the uniform topology; then it starts again in all variables, from
    the best candidate so far. K regions have too many variables for a few hundred rollouts: free from the start, the piecewise
    search of cables ended above the uniform one on training frames, although its space contains the other's.
    """

    def __init__(self, problem: SearchProblem, seed: int) -> None:
        self._problem, self._seed = problem, seed
        self._tied = problem.search.tied_rollouts if problem.clusters > 1 else 0
        self._columns = np.arange(len(problem.variables))
        """Which of the searched variables each variable takes its value from."""
        searched = problem
        if self._tied:
            searched = replace(problem, clusters=1)
            self._columns = np.array([searched.variables.index(name.partition(".")[0]) for name in problem.variables])
        self._strategy = _strategy(searched.encode(), problem.search.sigma, seed)
        self._population: list[np.ndarray] = []
        self._best = (np.inf, problem.encode())
        self._evaluated = 0
        self.generation = -1

    def ask(self) -> list[np.ndarray]:
        """The next generation; the last one with tied regions may be cut short."""
        if self._tied and self._evaluated == self._tied:
            self._strategy = _strategy(self._best[1], self._problem.search.freed_sigma, self._seed)
            self._columns = np.arange(len(self._problem.variables))
        self._population = self._strategy.ask()
        if self._evaluated < self._tied:
            self._population = self._population[: self._tied - self._evaluated]
        self.generation += 1
        return [np.asarray(searched)[self._columns] for searched in self._population]

    def tell(self, costs: list[float]) -> None:
        """Take the costs of the first candidates of the last generation; CMA-ES learns from whole generations only."""
        least = int(np.argmin(costs))
        if costs[least] < self._best[0]:
            self._best = (costs[least], np.asarray(self._population[least])[self._columns])
        self._evaluated += len(costs)
        if len(costs) == self._strategy.popsize:
            self._strategy.tell(self._population, costs)


def _strategy(start: np.ndarray, sigma: float, seed: int) -> cma.CMAEvolutionStrategy:
    # cma takes 0 to mean "seed from the clock", so seeds are shifted by one.
    no_end = {"maxiter": np.inf, "tolfun": 0, "tolx": 0, "tolstagnation": np.inf}
    options = {"bounds": [0, 1], "seed": seed + 1, "verbose": -9, **no_end}
    return cma.CMAEvolutionStrategy(start, sigma, options)


def _evaluate(
    problem: SearchProblem, population: Sequence[np.ndarray], loss: FrameLoss, index: int, generation: int, each: Map
) -> list[dict[str, Any]]:
    """Rows of the trace for the candidates of a generation, numbered from `index` on."""
    made = list(each(lambda normalized: _made(problem, normalized), population))
    for number, (row, _) in enumerate(made):
        row |= {"rollout": index + number, "generation": generation}
    rows, twins = [row for row, twin in made if twin], [twin for _, twin in made if twin]

    def simulate(members: list[int]) -> None:
        start = time.perf_counter()
        results = judge(problem, [twins[k] for k in members], loss)
        share = (time.perf_counter() - start) / len(members)
        for k, result in zip(members, results, strict=True):
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


def _made(problem: SearchProblem, normalized: np.ndarray) -> tuple[dict[str, Any], Twin | None]:
    """A candidate's row, its cost the penalty, and its twin; none, with the reason in the row, if it cannot be integrated."""
    start = time.perf_counter()
    values = problem.decode(normalized)
    row: dict[str, Any] = {"rollout": 0, "generation": 0, "cost": PENALTY, "reason": ""}
    row |= {"springs": 0, "substeps": 0, "collision_overflow": 0, "seconds": 0.0}
    row |= values | {f"normalised.{name}": float(u) for name, u in zip(problem.variables, normalized, strict=True)}
    twin = None
    try:
        twin = candidate(problem, values)
        row |= {"springs": len(twin.topology.springs), "substeps": twin.simulation.substeps}
    except NumericalFailure as failure:
        row["reason"] = str(failure)
    except stability.Unstable as failure:
        # The candidate is too stiff for a fixed number of substeps.
        row["reason"] = f"{UNSTABLE}: {failure}"
    row["seconds"] = time.perf_counter() - start
    return row, twin


def _save(path: Path, key: str, trace: list[dict[str, Any]], attempts: int, seconds: float) -> None:
    table = pd.DataFrame(trace)
    table.attrs |= {"key": key, "attempts": attempts, "seconds": seconds}
    write_atomically(path, lambda p: table.to_parquet(p))


def _recorded(path: Path | None, key: str) -> tuple[list[dict[str, Any]], int, float]:
    """(rows of the trace, attempts, seconds) of a recorded search with this key; (none, 1, 0) if there is none."""
    fresh: tuple[list[dict[str, Any]], int, float] = ([], 1, 0.0)
    if path is None or not path.is_file():
        return fresh
    try:
        table = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        print(f"{path}: unreadable ({error}); the search starts afresh")
        return fresh
    if table.attrs.get("key") != key:
        print(f"{path}: made with other inputs or settings; the search starts afresh")
        return fresh
    print(f"continuing the search after {len(table)} rollouts")
    records = [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]
    return records, int(table.attrs["attempts"]) + 1, float(table.attrs["seconds"])


def _replays(rows: list[dict[str, Any]], population: list[np.ndarray], variables: tuple[str, ...]) -> bool:
    """Whether recorded candidates are those that CMA-ES proposes now."""
    return all(
        np.array_equal(np.array([row.get(f"normalised.{name}", np.nan) for name in variables]), normalized)
        for row, normalized in zip(rows, population, strict=False)
    )
