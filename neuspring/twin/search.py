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
from collections.abc import Callable, Iterator, Sequence
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
from neuspring.twin.body import Learned
from neuspring.twin.candidates import (
    CMAES,
    OTHER_WAY,
    PENALTY,
    UNSTABLE,
    Launch,
    Map,
    SearchProblem,
    candidate,
    evaluate,
    still_cost,
)

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
    # Numbers of its own: searches that share launches are threads, and cma would draw from those that numpy has for all.
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


Judge = Callable[[Sequence[np.ndarray], bool, int, int], list[dict[str, Any]]]
"""Rows of candidates [V], given also True where hands only push, the number of the first candidate, and the generation."""


def search(
    problem: SearchProblem, seed: int, *, record: Path | None = None, key: str = "", lane: Launch | None = None
) -> SearchResult:
    """Run the search within its budget of rollouts; with a `lane` it shares launches with others (batch.py).

    The trace is written to `record` after every generation. A trace with the same `key` that is there already is continued,
    whatever its budget was. Raises NumericalFailure if no candidate could be simulated.
    """
    clock, settings, variables = time.perf_counter(), problem.search, problem.variables
    rows, attempts, earlier = recorded_trace(record, key)
    trace, other = ([row for row in rows if row["stage"] == stage] for stage in (CMAES, OTHER_WAY))
    saved = len(trace)
    # One candidate cannot be judged both ways.
    ways = WAYS[settings.hands][: settings.rollouts]
    push = ways[0]
    tied = settings.tied_rollouts if problem.clusters > 1 else 0
    proposals = Proposals(problem.encode(), variables, tied, seed)
    budget, name = settings.rollouts, problem.observations.scenario.name
    progress = Progress(f"search {name}, regions: {problem.clusters}, seed {seed}", settings.rollouts)

    def save(kept: list[dict[str, Any]]) -> None:
        if record is not None:
            save_trace(record, key, kept, attempts - (lane is not None), earlier + time.perf_counter() - clock)

    start = 0
    with _threads(problem.threads) as each:
        judge = partial(evaluate, problem, each=each, lane=lane)
        # The last generation may be cut short, so that searches of any population size use exactly the same budget.
        while start < budget:
            population = proposals.ask()[: budget - start]
            if not start:
                population = population[: budget // len(ways)]
            stop = start + len(population)
            if not replays(trace[start:stop], population, variables):
                print(f"{record}: does not replay on this machine; the search continues afresh from rollout {start}")
                trace, saved = trace[:start], start
                if not start:
                    other, attempts, earlier = [], 1, 0.0
            if not start and len(ways) > 1:
                if len(trace) < stop or len(other) < len(population):
                    trace, other = _ways(judge, population, ways, MUST_MOVE * still_cost(problem.recordings))
                budget -= len(other)
                push = bool(trace[0]["push"])
            if fresh := population[max(len(trace) - start, 0) :]:
                trace += judge(fresh, push, len(other) + len(trace), proposals.generation)
            progress.update(len(other) + len(trace), f"best cost {min(row['cost'] for row in trace):.3e}")
            proposals.tell([row["cost"] for row in trace[start:stop]])
            start = stop
            if len(trace) > saved:
                save(other + trace)
    return _best(problem, other + trace[:budget], push, attempts, earlier)


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
    facts: dict[str, Any] = {
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


def _ways(
    judge: Judge, population: Sequence[np.ndarray], ways: Sequence[bool], most: float
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the first generation in the way that is chosen, and those in the other ways, which were judged first.

    Hands push only if that costs less than `most`.
    """
    judged = {push: judge(population, push, 0, 0) for push in ways}
    costs = {push: min(row["cost"] for row in rows) for push, rows in judged.items()}
    if costs[True] >= most:
        costs[True] = np.inf
    chosen = min(ways, key=lambda push: costs[push])
    other = [row | {"stage": OTHER_WAY} for push, rows in judged.items() if push != chosen for row in rows]
    numbered = [row | {"rollout": number} for number, row in enumerate(other + judged[chosen])]
    return numbered[len(other) :], numbered[: len(other)]


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


def replays(rows: list[dict[str, Any]], population: list[np.ndarray], variables: tuple[str, ...]) -> bool:
    """True where recorded candidates are those that CMA-ES proposes now."""
    return all(
        np.array_equal(np.array([row.get(f"normalized.{name}", np.nan) for name in variables]), normalized)
        for row, normalized in zip(rows, population, strict=False)
    )
