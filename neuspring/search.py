"""Zero-order stage: CMA-ES over topology and homogeneous material (dataset facts, section 5.4).

Variables are normalised to [0, 1] by their ranges. A candidate is a whole twin: its springs are built, it is rolled out
over the training frames, and its cost is the mean training loss. The best evaluated candidate wins. Every candidate is kept
in a trace, from which a killed search continues: CMA-ES is replayed with the recorded costs.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cma
import numpy as np
import pandas as pd
import torch

from neuspring import config
from neuspring.artifacts import Material, Observations, Simulation, Twin, write_atomically
from neuspring.errors import InputError, NumericalFailure
from neuspring.losses import FrameLoss, acceleration
from neuspring.physics import stability
from neuspring.progress import Progress
from neuspring.rollout import Diverged, frames, solver_for
from neuspring.topology import uniform_topology

VARIABLES = tuple(f.name for f in fields(config.SearchRanges))
INTEGERS = ("object_neighbours", "controller_neighbours")
PENALTY = 1e6
"""Cost of a candidate that diverges or cannot be integrated; far above any loss in square metres."""
UNSTABLE = "unstable"
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


def decode(normalised: np.ndarray, ranges: config.SearchRanges) -> dict[str, float]:
    """Physical values of normalised variables [12]; neighbour counts are truncated to integers."""
    values = {}
    for name, u in zip(VARIABLES, normalised, strict=True):
        low, high = getattr(ranges, name)
        value = low + float(u) * (high - low)
        values[name] = float(int(value)) if name in INTEGERS else value
    return values


def encode(start: config.SearchStart, ranges: config.SearchRanges) -> np.ndarray:
    """Normalised variables [12] of the starting values."""
    limits = [getattr(ranges, name) for name in VARIABLES]
    return np.array([(getattr(start, name) - low) / (high - low) for name, (low, high) in zip(VARIABLES, limits, strict=True)])


def simulation_of(problem: SearchProblem, substeps: int) -> Simulation:
    """The scenario's simulation with a given number of substeps per frame."""
    scenario, chosen = problem.observations.scenario, problem.simulation
    return Simulation(
        frame_time=RELEASED_FRAME_TIME if problem.quirks.frame_time_667 else 1.0 / scenario.frame_rate,
        substeps=substeps,
        up=scenario.up,
        gravity=chosen.gravity,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
        collision_capacity=chosen.collision_capacity,
        controller_velocity=chosen.controller_velocity,
    )


def with_substeps(problem: SearchProblem, twin: Twin) -> Twin:
    """The twin with its substep count settled: 667 with the quirk, the configured count, or the smallest safe one.

    Raises InputError if a fixed count is too small, NumericalFailure if `auto` would need more than `max_substeps`.
    """
    chosen = problem.simulation
    if problem.quirks.frame_time_667 or chosen.substeps != "auto":
        count = RELEASED_SUBSTEPS if problem.quirks.frame_time_667 else int(chosen.substeps)
        settled = replace(twin, simulation=replace(twin.simulation, substeps=count))
        stability.check(settled)
        return settled
    count = stability.smallest_safe_substeps(stability.twin_spectrum(twin), twin.simulation.frame_time, chosen.safety)
    if count > chosen.max_substeps:
        raise NumericalFailure(f"needs {count} substeps per frame, more than max_substeps = {chosen.max_substeps}")
    return replace(twin, simulation=replace(twin.simulation, substeps=count))


def candidate(problem: SearchProblem, values: dict[str, float]) -> Twin:
    """The twin of one set of physical values. Raises InputError or NumericalFailure if it cannot be integrated."""
    observations = problem.observations
    topology = uniform_topology(
        observations.nodes,
        observations.controller_points[0],
        values["object_radius"],
        int(values["object_neighbours"]),
        values["controller_radius"],
        int(values["controller_neighbours"]),
    )
    count = len(topology.springs)
    if count == 0:
        raise NumericalFailure("no node has a spring")
    material = Material(
        stiffness=np.full(count, values["stiffness"]),
        dashpot=np.full(count, values["dashpot"]),
        drag=values["drag"],
        ground_elasticity=values["ground_elasticity"],
        ground_friction=values["ground_friction"],
        contact_elasticity=values["contact_elasticity"],
        contact_friction=values["contact_friction"],
        contact_distance=values["contact_distance"],
    )
    return with_substeps(problem, Twin(topology=topology, material=material, simulation=simulation_of(problem, 1)))


def cost(problem: SearchProblem, twin: Twin, loss: FrameLoss) -> tuple[float, int]:
    """Mean training loss over frames 1 .. train_end - 1, acceleration term included, and the collision list's overflow.

    Raises Diverged.
    """
    hands = torch.tensor(problem.observations.controller_points, device=problem.device)[: problem.observations.scenario.train_end]
    before = torch.zeros((len(twin.topology.nodes), 3), device=problem.device)
    previous: torch.Tensor | None = None
    total = 0.0
    solver = solver_for(twin, problem.device)
    for frame, x, v in frames(twin, solver, hands):
        total += float(loss(frame, x))
        change = v - before
        if previous is not None:
            total += problem.losses.acceleration * float(acceleration(change, previous))
        before, previous = v, change
    return total / (len(hands) - 1), solver.collision_overflow


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


def search(problem: SearchProblem, seed: int, *, partial: Path | None = None, key: str = "") -> SearchResult:
    """Run the search within its budget of rollouts.

    `partial` is where the trace is kept after every generation; a file with the same `key` there is continued from.
    Raises NumericalFailure if no candidate could be simulated.
    """
    clock = time.perf_counter()
    strategy, trace, attempts, earlier = _resume(problem.search, seed, partial, key)
    loss = FrameLoss.of(problem.observations, problem.losses, problem.device, frozen_counts=problem.quirks.frozen_loss_denominators)
    progress = Progress(f"search {problem.observations.scenario.name} seed {seed}", problem.search.rollouts)
    # Whole generations only: CMA-ES learns from complete populations, and every method gets the same count.
    while len(trace) + strategy.popsize <= max(problem.search.rollouts, strategy.popsize):
        population = strategy.ask()
        for normalised in population:
            trace.append(_evaluate(problem, np.asarray(normalised), loss, len(trace), strategy.countiter))
            progress.update(len(trace), f"best cost {min(row['cost'] for row in trace):.3e}")
        strategy.tell(population, [row["cost"] for row in trace[-len(population) :]])
        if partial is not None:
            _save_partial(partial, key, trace, attempts, earlier + time.perf_counter() - clock)
    table = pd.DataFrame(trace)
    best = table.iloc[int(table["cost"].to_numpy().argmin())]
    if best["cost"] >= PENALTY:
        if problem.simulation.substeps != "auto" and table["reason"].str.startswith(UNSTABLE).all():
            rule = f"at least one of {len(table)} candidates must be stable with this count"
            raise InputError("simulation.substeps", rule, problem.simulation.substeps, str(table.iloc[0]["reason"]))
        raise NumericalFailure(f"none of {len(table)} candidates could be simulated; the first: {table.iloc[0]['reason']}")
    values = {name: float(best[name]) for name in VARIABLES}
    if problem.quirks.integer_damping:
        values |= {name: float(int(values[name])) for name in ("drag", "dashpot")}
    return SearchResult(candidate(problem, values), values, float(best["cost"]), table, attempts, earlier)


def _strategy(settings: config.Search, seed: int) -> cma.CMAEvolutionStrategy:
    # cma takes 0 to mean "seed from the clock", so seeds are shifted by one.
    options = {
        "bounds": [0, 1],
        "seed": seed + 1,
        "verbose": -9,
        "maxiter": np.inf,
        "tolfun": 0,
        "tolx": 0,
        "tolstagnation": np.inf,
    }
    return cma.CMAEvolutionStrategy(encode(settings.start, settings.ranges), settings.sigma, options)


def _evaluate(problem: SearchProblem, normalised: np.ndarray, loss: FrameLoss, index: int, generation: int) -> dict[str, Any]:
    start = time.perf_counter()
    values = decode(normalised, problem.search.ranges)
    row: dict[str, Any] = {
        "rollout": index,
        "generation": generation,
        "cost": PENALTY,
        "reason": "",
        "springs": 0,
        "substeps": 0,
        "collision_overflow": 0,
    }
    try:
        twin = candidate(problem, values)
        row |= {"springs": len(twin.topology.springs), "substeps": twin.simulation.substeps}
        value, row["collision_overflow"] = cost(problem, twin, loss)
        row["cost"] = min(value, PENALTY)
    except (Diverged, NumericalFailure) as failure:
        row["reason"] = str(failure)
    except stability.Unstable as failure:
        # A fixed substep count that this candidate is too stiff for: penalised, like divergence.
        row["reason"] = f"{UNSTABLE}: {failure}"
    row["seconds"] = time.perf_counter() - start
    return row | values | {f"normalised.{name}": float(u) for name, u in zip(VARIABLES, normalised, strict=True)}


def _save_partial(path: Path, key: str, trace: list[dict[str, Any]], attempts: int, seconds: float) -> None:
    table = pd.DataFrame(trace)
    table.attrs |= {"key": key, "attempts": attempts, "seconds": seconds}
    write_atomically(path, lambda p: table.to_parquet(p))


_Start = tuple[cma.CMAEvolutionStrategy, list[dict[str, Any]], int, float]


def _resume(settings: config.Search, seed: int, path: Path | None, key: str) -> _Start:
    """(strategy, candidates, attempts, seconds) of a recorded search, by replaying it; a fresh start if none matches."""
    strategy = _strategy(settings, seed)
    fresh: _Start = (strategy, [], 1, 0.0)
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
    columns = [f"normalised.{name}" for name in VARIABLES]
    for start in range(0, len(table), strategy.popsize):
        rows = table.iloc[start : start + strategy.popsize]
        population = strategy.ask()
        if len(rows) != strategy.popsize or not np.array_equal(np.asarray(population), rows[columns].to_numpy()):
            print(f"{path}: does not replay on this machine; the search starts afresh")
            return _strategy(settings, seed), [], 1, 0.0
        strategy.tell(population, rows["cost"].tolist())
    print(f"continuing the search after {len(table)} rollouts")
    records = [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]
    return strategy, records, int(table.attrs["attempts"]) + 1, float(table.attrs["seconds"])
