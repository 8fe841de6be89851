"""Levenberg-Marquardt: a descent by damped steps, each tried with several dampings at once.

With residuals r of the base and their derivatives J, a step d solves

    (J'J + damping diag J'J) d = -J'r        within bounds.

The best step is taken if it costs less than the base, and the damping follows it. Otherwise shorter steps are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(kw_only=True)
class LevenbergMarquardt:
    """The state of a descent."""

    base: np.ndarray
    """Variables of the best candidate so far."""
    cost: float
    damping: float
    factors: Sequence[float]
    """Factors on the damping, for each step that is tried."""
    raised: float
    """Factor on the damping where no step helps."""
    most: float
    """Beyond this damping nothing more is tried."""
    tolerance: float
    """A step that lowers the cost by less than this fraction of it is the last."""
    least: float = 0.0
    """The damping does not fall below this."""
    finished: bool = False

    def moves(self, products: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
        """Steps [V] to try, from J'J [V, V] and J'r [V], with low <= d <= high."""
        return [damped_step(products, gradient, self.damping * factor, low, high) for factor in self.factors]

    def take(self, tried: Sequence[np.ndarray], costs: Sequence[float]) -> int | None:
        """Go on from the best of the tried candidates, whose number is returned; None if the base costs no more."""
        best = int(np.argmin(costs))
        if not costs[best] < self.cost:
            self.damping *= self.raised
            self.finished = self.damping > self.most
            return None
        self.finished = bool(self.cost - costs[best] < self.tolerance * self.cost)
        self.base, self.cost = np.asarray(tried[best]), float(costs[best])
        self.damping = max(self.damping * self.factors[best], self.least)
        return best


def damped_step(products: np.ndarray, gradient: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """d that solves (A + damping diag A) d = -g for A [V, V], g [V], and low <= d <= high; what leaves is held at its bound."""
    scale = np.diag(products)
    # A variable without effect stays where it is.
    matrix = products + damping * np.diag(np.maximum(scale, 1e-12 * scale.max()))
    step, free = np.zeros(len(gradient)), scale > 1e-12 * scale.max()
    while free.any():
        rest = -(gradient + matrix[:, ~free] @ step[~free])
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest[free])
        beyond = np.where(free, np.maximum(low - step, step - high), 0.0)
        if beyond.max() <= 0:
            break
        # One at a time: where it is held, others may not leave any more.
        worst = int(np.argmax(beyond))
        step[worst] = np.clip(step[worst], low[worst], high[worst])
        free[worst] = False
    return step
