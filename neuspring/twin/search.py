"""The search: CMA-ES over topology and homogeneous material, as in the released PhysTwin code.

The best candidate is the result. With `search.hands: auto`, the first generation is evaluated twice: controllers hold, and
controllers push. The search keeps the mode of the best candidate. Controllers that only push leave a grasped object in place, and
early candidates that hold may cost more than that. Therefore pushing must also cost less than a static object.

With `search.tied_rollouts`, the first candidates search the 12 variables of the uniform topology. Then the regions become free
around the best candidate.

A trace records every candidate. A killed search, or a finished one with a larger budget, resumes: it replays CMA-ES with the
recorded costs.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_atomically
from neuspring.core.text import Progress
from neuspring.twin.batch import lockstep, result_of, shared_physics
from neuspring.twin.body import Learned
from neuspring.twin.candidates import (
    OTHER_WAY,
    PENALTY,
    UNSTABLE,
    Map,
    SearchProblem,
    candidate,
    evaluate,
    still_cost,
)
from neuspring.twin.trials import Rollouts, rolled

if TYPE_CHECKING:
    import cma
    import pandas as pd


FIRST_STEP = 1 / 6
"""Initial step of CMA-ES in normalized variables."""
WAYS = {"hold": (False,), "push": (True,), "auto": (False, True)}
"""Modes of controllers to evaluate, by `search.hands`; True: they only push."""
FREED_SIGMA = 0.06
"""Step of CMA-ES in normalized variables when the regions become free."""
MUST_MOVE = 0.9
"""Fraction of the cost of a static object below which controllers may push."""


class Proposals:
    """The candidates of CMA-ES, in all 2K + 10 normalized variables.

    The first `tied` candidates search the 12 variables of the uniform topology. Then CMA-ES restarts in all variables, from the
    best candidate. K regions have too many variables for a few hundred rollouts: if they are free from the start, the piecewise
    search has a higher training loss than the uniform search.
    """

    def __init__(self, start: np.ndarray, variables: Sequence[str], tied: int, seed: int) -> None:
        """Start at `start` [V], normalized `variables`. In the first `tied` candidates, all regions share their values."""
        self._seed, self._tied = seed, tied
        self._columns = np.arange(len(variables))
        """Index of the searched variable from which each variable takes its value."""
        searched = start
        if tied:
            shared = [name.partition(".")[0] for name in variables]
            names = list(dict.fromkeys(shared))
            self._columns = np.array([names.index(name) for name in shared])
            searched = start[[shared.index(name) for name in names]]
        self._strategy = _strategy(searched, FIRST_STEP, seed)
        self._population: list[np.ndarray] = []
        self._best = (np.inf, start)
        self._evaluated = 0
        self.generation = -1

    def ask(self) -> list[np.ndarray]:
        """Return the next generation. The last generation with tied regions may be shorter."""
        if self._tied and self._evaluated == self._tied:
            self._strategy = _strategy(self._best[1], FREED_SIGMA, self._seed)
            self._columns = np.arange(len(self._best[1]))
        self._population = self._strategy.ask()
        if self._evaluated < self._tied:
            self._population = self._population[: self._tied - self._evaluated]
        self.generation += 1
        return [np.asarray(searched)[self._columns] for searched in self._population]

    def tell(self, costs: list[float]) -> None:
        """Record the costs of the first candidates of the last generation. CMA-ES is updated only with complete generations."""
        least = int(np.argmin(costs))
        if costs[least] < self._best[0]:
            self._best = (costs[least], np.asarray(self._population[least])[self._columns])
        self._evaluated += len(costs)
        if len(costs) == self._strategy.popsize:
            self._strategy.tell(self._population, costs)


def _strategy(start: np.ndarray, sigma: float, seed: int) -> cma.CMAEvolutionStrategy:
    # Each search owns its random generator: searches advance in turns, and cma would otherwise share NumPy's global one.
    import cma

    numbers = np.random.RandomState(seed + 1)
    no_end = {"maxiter": np.inf, "tolfun": 0, "tolx": 0, "tolstagnation": np.inf}
    options = {"bounds": [0, 1], "randn": numbers.randn, "seed": np.nan, "verbose": -9, **no_end}
    return cma.CMAEvolutionStrategy(start, sigma, options)


@dataclass(frozen=True, kw_only=True)
class SearchResult(Learned):
    """The best twin, its variables and cost, and the trace: one row per candidate."""

    values: dict[str, float]
    cost: float
    trace: pd.DataFrame


@dataclass(frozen=True)
class SearchRun:
    """A search, its seed, and the file of its trace. The search resumes from a trace with the same `key`."""

    problem: SearchProblem
    seed: int
    record: Path | None = None
    key: str = ""


def search(problem: SearchProblem, seed: int, *, record: Path | None = None, key: str = "") -> SearchResult:
    """Run a search within its budget of rollouts.

    Writes the trace to `record` after every generation, and resumes from an existing trace with the same `key`, whatever its
    budget. Raises NumericalFailure if no candidate could be simulated.
    """
    result: SearchResult = result_of(search_many([SearchRun(problem, seed, record, key)]))
    return result


def search_many(runs: Sequence[SearchRun]) -> list[SearchResult | Exception]:
    """Run several searches, generation by generation; return the result of each, or the exception that ended it.

    On a GPU their rollouts share launches. On a CPU, `threads` of the first problem simulate groups of candidates at the same
    time.
    """
    device = runs[0].problem.device
    with _threads(runs[0].problem.threads) as parallel_map:
        return lockstep(
            [_course(run, parallel_map) for run in runs], partial(_roll_out, device, parallel_map, share=device != "cpu")
        )


def _roll_out(device: str, parallel_map: Map, requests: Mapping[int, Sequence[Rollouts]], *, share: bool) -> dict[int, list[Any]]:
    """Outcomes and seconds of all rollouts. Rollouts of several searches with the same physics `share` a launch."""
    entries = [(k, number, item) for k, items in requests.items() for number, item in enumerate(items)]
    launches: dict[Any, list[tuple[int, int, Rollouts]]] = {}
    for entry in entries:
        item = entry[2]
        together = shared_physics(item.twins[0], item.hands.shape[-1] == 3) if share and len(requests) > 1 else entry[:2]
        launches.setdefault(together, []).append(entry)

    def launch(entries: Sequence[tuple[int, int, Rollouts]]) -> list[tuple[int, int, Any]]:
        start = time.perf_counter()
        results = rolled([item for _, _, item in entries], device)
        seconds = (time.perf_counter() - start) / len(entries)
        return [(k, number, (result, seconds)) for (k, number, _), result in zip(entries, results, strict=True)]

    # On a GPU all threads would share one stream.
    simulated = parallel_map if device == "cpu" else map
    by_entry = {(k, number): answer for answers in simulated(launch, launches.values()) for k, number, answer in answers}
    return {k: [by_entry[k, number] for number in range(len(items))] for k, items in requests.items()}


def _course(run: SearchRun, parallel_map: Map) -> Generator[Any, Any, SearchResult]:
    """A search as a generator of rollouts, one request per generation."""
    clock, problem = time.perf_counter(), run.problem
    settings, variables = problem.search, problem.variables
    recorded, attempts, earlier = recorded_trace(run.record, run.key)
    budget = settings.rollouts
    tied = settings.tied_rollouts if problem.clusters > 1 else 0
    proposals = Proposals(problem.encode(), variables, tied, run.seed)
    label = f"search {problem.observations.scenario.name}, regions: {problem.clusters}, seed {run.seed}"
    progress = Progress(label, budget)
    trace: list[dict[str, Any]] = []

    def judge(population: Sequence[np.ndarray], push: bool) -> Generator[Any, Any, list[dict[str, Any]]]:
        """Rows of a generation: recorded candidates first, then newly evaluated candidates."""
        nonlocal recorded, attempts, earlier
        generation, start = proposals.generation, len(trace)
        known = [row for row in recorded if row["generation"] == generation and row["push"] == push][: len(population)]
        if not replays(known, population, variables):
            print(f"{run.record}: the recorded trace does not replay on this machine; the search restarts from rollout {start}")
            known, recorded = [], []
            attempts, earlier = (attempts, earlier) if start else (1, 0.0)
        fresh = yield from evaluate(problem, population[len(known) :], push, start + len(known), generation, parallel_map)
        return known + fresh

    # A budget of one rollout allows a single mode.
    ways, push = WAYS[settings.hands][:budget], WAYS[settings.hands][0]
    while len(trace) < budget:
        # The last generation may be shorter, so that every search uses exactly its budget.
        population = proposals.ask()[: budget - len(trace)]
        if not trace and len(ways) > 1:
            population = population[: budget // len(ways)]
            hold = yield from judge(population, False)
            pushing = yield from judge(population, True)
            push = _pushes(hold, pushing, problem)
            kept, rejected = (pushing, hold) if push else (hold, pushing)
            trace = [row | {"stage": OTHER_WAY} for row in rejected] + kept
            trace = [row | {"rollout": number} for number, row in enumerate(trace)]
        else:
            kept = yield from judge(population, push)
            trace += kept
        progress.update(len(trace), f"best cost {min(row['cost'] for row in trace):.3e}")
        proposals.tell([row["cost"] for row in kept])
        if run.record is not None and len(trace) > len(recorded):
            save_trace(run.record, run.key, trace, attempts, earlier + time.perf_counter() - clock)
    return _best(problem, trace, push, attempts, earlier)


def _pushes(hold: Sequence[dict[str, Any]], pushing: Sequence[dict[str, Any]], problem: SearchProblem) -> bool:
    """True if controllers push: pushing must cost less than holding, and less than `MUST_MOVE` of a static object."""
    least, held = (float(min(row["cost"] for row in rows)) for rows in (pushing, hold))
    return least < held and least < MUST_MOVE * still_cost(problem.recordings)


def _best(problem: SearchProblem, rows: Sequence[dict[str, Any]], push: bool, attempts: int, earlier: float) -> SearchResult:
    """The result of a search with these rows. Raises InputError or NumericalFailure if no candidate could be simulated."""
    import pandas as pd

    table = pd.DataFrame(rows)
    costs = table["cost"]
    best = _least(table)
    if best["cost"] >= PENALTY:
        substeps = problem.simulation.substeps
        if substeps != "auto" and table["reason"].str.startswith(UNSTABLE).all():
            rule = f"at least one of {len(table)} candidates must be stable with this count"
            raise InputError("simulation.substeps", rule, substeps, str(table.iloc[0]["reason"]))
        raise NumericalFailure(f"none of {len(table)} candidates could be simulated; the first: {table.iloc[0]['reason']}")
    values = {name: float(best[name]) for name in problem.names}
    if problem.quirks.integer_damping:
        values |= {name: float(int(values[name])) for name in ("drag", "dashpot")}
    twin = candidate(problem, values, push)
    facts = {
        **values,
        "hands": "push" if twin.topology.pushes.any() else "hold",
        "cost": float(best["cost"]),
        "spacing": problem.spacing,
        "controller_reach": problem.reach,
        "rollouts": len(table),
        "failed_rollouts": int((table["reason"] != "").sum()),
        "collision_overflow": int(table["collision_overflow"].max()),
        "spring_updates": int((table["springs"] * table["substeps"]).sum()) * sum(len(r.hands) - 1 for r in problem.recordings),
        **twin.counts,
    }
    if held := at_ends(table, problem.variables):
        facts["at_ends"] = ", ".join(held)
    return SearchResult(
        twin=twin,
        values=values,
        cost=float(best["cost"]),
        trace=table,
        course=pd.DataFrame({"cost": costs, "best_cost": costs.cummin()}),
        facts=facts,
        attempts=attempts,
        earlier_seconds=earlier,
    )


def _least(trace: pd.DataFrame) -> Any:
    """The row of the best candidate."""
    return trace.iloc[int(trace["cost"].to_numpy().argmin())]


SURFACES = ("ground_", "contact_")
"""Prefixes of variables that have no effect without contact."""
END = 0.01
"""Distance from an end of the range, in normalized units, within which a variable counts as at the end."""


def at_ends(trace: pd.DataFrame, variables: Sequence[str]) -> list[str]:
    """Variables of the best candidate within `END` of an end of their range, contact variables excluded."""
    best = _least(trace)
    decisive = [name for name in variables if not name.startswith(SURFACES)]
    return [name for name in decisive if not END <= best[f"normalized.{name}"] <= 1 - END]


@contextmanager
def _threads(count: int) -> Iterator[Map]:
    """A map over candidates with `count` threads; a single thread is the calling one, which an interrupt ends immediately.

    Torch uses one thread meanwhile, so that at most `count` cores are busy.
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


def save_trace(path: Path, key: str, trace: list[dict[str, Any]], attempts: int, seconds: float) -> None:
    """Write the rows of a trace, with the key of its inputs."""
    import pandas as pd

    table = pd.DataFrame(trace)
    table.attrs |= {"key": key, "attempts": attempts, "seconds": seconds}
    write_atomically(path, lambda p: table.to_parquet(p))


def recorded_trace(path: Path | None, key: str) -> tuple[list[dict[str, Any]], int, float]:
    """Read (rows of the trace, attempts, seconds) of a recorded search with this key; ([], 1, 0) if there is none."""
    import pandas as pd

    fresh: tuple[list[dict[str, Any]], int, float] = ([], 1, 0.0)
    if path is None or not path.is_file():
        return fresh
    try:
        table = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        print(f"{path}: unreadable ({error}); the search starts over")
        return fresh
    if table.attrs.get("key") != key:
        print(f"{path}: made with other inputs or settings; the search starts over")
        return fresh
    print(f"resuming the search after {len(table)} rollouts")
    records = [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]
    return records, int(table.attrs["attempts"]) + 1, float(table.attrs["seconds"])


def replays(rows: list[dict[str, Any]], population: Sequence[np.ndarray], variables: tuple[str, ...]) -> bool:
    """True if the recorded candidates equal those that CMA-ES proposes now."""
    return all(
        np.array_equal(np.array([row.get(f"normalized.{name}", np.nan) for name in variables]), normalized)
        for row, normalized in zip(rows, population, strict=False)
    )
