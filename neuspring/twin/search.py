"""Zero-order stage: CMA-ES over topology and homogeneous material (as in the released PhysTwin code).

The best candidate wins. With `search.hands: auto` the first generation is judged with hands that hold and with hands that push, and
the way of its best candidate is kept. Hands that push an object that is held leave it where it is, and first candidates that hold
may be worse than that: so pushing must also cost less than a body that stays. With `search.tied_rollouts` the first part of the
budget searches the 12 variables of the uniform topology; then the regions are freed around the best candidate. A trace records
every candidate. A killed search continues from it, and so does a finished one with a larger budget: CMA-ES is replayed with the
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
"""Ways of hands that are judged, by `search.hands`: True where they only push."""
FREED_SIGMA = 0.06
"""Step of CMA-ES in normalized variables when each region becomes free."""
MUST_MOVE = 0.9
"""Hands push if that costs less than this fraction of a body that stays as it is in frame 0."""


class Proposals:
    """The candidates of CMA-ES, in all 2K + 10 normalized variables.

    In the first `tied_rollouts` it searches the 12 variables of the uniform topology; then it starts again in all variables, from
    the best candidate so far. K regions have too many variables for a few hundred rollouts: free from the start, the piecewise
    search ended above the uniform one on training frames, although its space contains the other's.
    """

    def __init__(self, start: np.ndarray, variables: Sequence[str], tied: int, seed: int) -> None:
        """From normalized `variables` at `start` [V]; the first `tied` candidates have regions alike."""
        self._seed, self._tied = seed, tied
        self._columns = np.arange(len(variables))
        """Which of the searched variables each variable takes its value from."""
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
        """The next generation; the last one with tied regions may be cut short."""
        if self._tied and self._evaluated == self._tied:
            self._strategy = _strategy(self._best[1], FREED_SIGMA, self._seed)
            self._columns = np.arange(len(self._best[1]))
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
    # Each search owns its random generator: searches advance in turns, and cma would otherwise share NumPy's global one.
    import cma

    numbers = np.random.RandomState(seed + 1)
    no_end = {"maxiter": np.inf, "tolfun": 0, "tolx": 0, "tolstagnation": np.inf}
    options = {"bounds": [0, 1], "randn": numbers.randn, "seed": np.nan, "verbose": -9, **no_end}
    return cma.CMAEvolutionStrategy(start, sigma, options)


@dataclass(frozen=True, kw_only=True)
class SearchResult(Learned):
    """The best twin found, its variables and cost, and the trace: one row per candidate."""

    values: dict[str, float]
    cost: float
    trace: pd.DataFrame


@dataclass(frozen=True)
class SearchRun:
    """A search, its seed, and the file of its trace, which is continued where it has the same `key`."""

    problem: SearchProblem
    seed: int
    record: Path | None = None
    key: str = ""


def search(problem: SearchProblem, seed: int, *, record: Path | None = None, key: str = "") -> SearchResult:
    """Run the search within its budget of rollouts.

    The trace is written to `record` after every generation. A trace with the same `key` that is there already is continued,
    whatever its budget was. Raises NumericalFailure if no candidate could be simulated.
    """
    result: SearchResult = result_of(search_many([SearchRun(problem, seed, record, key)]))
    return result


def search_many(runs: Sequence[SearchRun]) -> list[SearchResult | Exception]:
    """The result of each search, or the exception that ended it.

    The searches advance generation by generation. On a GPU their rollouts share launches; on a CPU `threads` of the first problem
    simulate groups of candidates at the same time.
    """
    device = runs[0].problem.device
    with _threads(runs[0].problem.threads) as each:
        return lockstep([_course(run, each) for run in runs], partial(_roll_out, device, each, share=device != "cpu"))


def _roll_out(device: str, each: Map, requests: Mapping[int, Sequence[Rollouts]], *, share: bool) -> dict[int, list[Any]]:
    """Outcomes and seconds of each of the rollouts; those of several searches with one physics `share` a launch."""
    wanted = [(k, number, one) for k, own in requests.items() for number, one in enumerate(own)]
    launches: dict[Any, list[tuple[int, int, Rollouts]]] = {}
    for entry in wanted:
        one = entry[2]
        together = shared_physics(one.twins[0], one.hands.shape[-1] == 3) if share and len(requests) > 1 else entry[:2]
        launches.setdefault(together, []).append(entry)

    def launch(entries: Sequence[tuple[int, int, Rollouts]]) -> list[tuple[int, int, Any]]:
        start = time.perf_counter()
        results = rolled([one for _, _, one in entries], device)
        seconds = (time.perf_counter() - start) / len(entries)
        return [(k, number, (result, seconds)) for (k, number, _), result in zip(entries, results, strict=True)]

    # Threads would meet in the one stream of a GPU.
    simulated = each if device == "cpu" else map
    found = {(k, number): answer for answers in simulated(launch, launches.values()) for k, number, answer in answers}
    return {k: [found[k, number] for number in range(len(own))] for k, own in requests.items()}


def _course(run: SearchRun, each: Map) -> Generator[Any, Any, SearchResult]:
    """A search that yields the rollouts of its generations."""
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
        """Rows of the first candidates of a generation: those that are recorded, then new ones."""
        nonlocal recorded, attempts, earlier
        generation, start = proposals.generation, len(trace)
        known = [row for row in recorded if row["generation"] == generation and row["push"] == push][: len(population)]
        if not replays(known, population, variables):
            print(f"{run.record}: does not replay on this machine; the search continues afresh from rollout {start}")
            known, recorded = [], []
            attempts, earlier = (attempts, earlier) if start else (1, 0.0)
        fresh = yield from evaluate(problem, population[len(known) :], push, start + len(known), generation, each)
        return known + fresh

    # One candidate cannot be judged both ways.
    ways, push = WAYS[settings.hands][:budget], WAYS[settings.hands][0]
    while len(trace) < budget:
        # The last generation may be cut short, so that searches of any population size use exactly the same budget.
        population = proposals.ask()[: budget - len(trace)]
        if not trace and len(ways) > 1:
            population = population[: budget // len(ways)]
            hold = yield from judge(population, False)
            pushing = yield from judge(population, True)
            push = _pushes(hold, pushing, problem)
            own, other = (pushing, hold) if push else (hold, pushing)
            trace = [row | {"stage": OTHER_WAY} for row in other] + own
            trace = [row | {"rollout": number} for number, row in enumerate(trace)]
        else:
            own = yield from judge(population, push)
            trace += own
        progress.update(len(trace), f"best cost {min(row['cost'] for row in trace):.3e}")
        proposals.tell([row["cost"] for row in own])
        if run.record is not None and len(trace) > len(recorded):
            save_trace(run.record, run.key, trace, attempts, earlier + time.perf_counter() - clock)
    return _best(problem, trace, push, attempts, earlier)


def _pushes(hold: Sequence[dict[str, Any]], pushing: Sequence[dict[str, Any]], problem: SearchProblem) -> bool:
    """True if hands push: that must cost less than hands that hold, and than a part of a body that stays."""
    least, held = (float(min(row["cost"] for row in rows)) for rows in (pushing, hold))
    return least < held and least < MUST_MOVE * still_cost(problem.recordings)


def _best(problem: SearchProblem, rows: Sequence[dict[str, Any]], push: bool, attempts: int, earlier: float) -> SearchResult:
    """The result of a search with these rows. Raises InputError, NumericalFailure if none could be simulated."""
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
        "spring_updates": int((table["springs"] * table["substeps"]).sum()) * sum(len(one.hands) - 1 for one in problem.recordings),
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
"""Beginnings of the names of variables that have no effect where nothing touches."""
END = 0.01
"""Distance from an end of its range, in normalized units, within which a variable counts as held by it."""


def at_ends(trace: pd.DataFrame, variables: Sequence[str]) -> list[str]:
    """Variables of the best candidate that lie within `END` of an end of their range; contact is left out."""
    best = _least(trace)
    decisive = [name for name in variables if not name.startswith(SURFACES)]
    return [name for name in decisive if not END <= best[f"normalized.{name}"] <= 1 - END]


@contextmanager
def _threads(count: int) -> Iterator[Map]:
    """A map that makes and simulates candidates: by `count` threads, or by this one, which an interrupt ends at once.

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


def save_trace(path: Path, key: str, trace: list[dict[str, Any]], attempts: int, seconds: float) -> None:
    """Write the rows of a trace, with what they were made from."""
    import pandas as pd

    table = pd.DataFrame(trace)
    table.attrs |= {"key": key, "attempts": attempts, "seconds": seconds}
    write_atomically(path, lambda p: table.to_parquet(p))


def recorded_trace(path: Path | None, key: str) -> tuple[list[dict[str, Any]], int, float]:
    """(rows of the trace, attempts, seconds) of a recorded search with this key; (none, 1, 0) if there is none."""
    import pandas as pd

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


def replays(rows: list[dict[str, Any]], population: Sequence[np.ndarray], variables: tuple[str, ...]) -> bool:
    """True where recorded candidates are those that CMA-ES proposes now."""
    return all(
        np.array_equal(np.array([row.get(f"normalized.{name}", np.nan) for name in variables]), normalized)
        for row, normalized in zip(rows, population, strict=False)
    )
