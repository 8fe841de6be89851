"""What CMA-ES proposes: first with all regions tied, where that is asked for, then freed around the best candidate."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cma
import numpy as np

if TYPE_CHECKING:
    from neuspring.twin.search import SearchProblem


class Proposals:
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
            # Those of regions share a value; those of hands are of no region.
            shared = [name if name in searched.variables else name.partition(".")[0] for name in problem.variables]
            self._columns = np.array([searched.variables.index(name) for name in shared])
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
