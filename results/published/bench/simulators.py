"""The interface of a simulator, and the clock.

Simulators take turns within every round, so that other load on the machine affects all of them. A comparison is the median of the
ratios of the rounds.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from neuspring.core.artifacts import Twin

LOSS = "the smooth L1 loss of the final positions against the origin, its mean over 3 N coordinates"
"""Every simulator differentiates this loss, so that gradients can be compared."""


@dataclass(frozen=True)
class Frame:
    """A prepared frame that can run repeatedly from the same start."""

    run: Callable[[], object]
    """Simulate the frame; for `forward_backward` also the gradient of LOSS by the stiffness of every spring."""
    positions: Callable[[], np.ndarray]
    """Positions [N, 3], m, at the end of the last run."""
    gradient: Callable[[], np.ndarray] | None = None
    """dL / d(log stiffness) [S] of the last run."""


class Simulator(Protocol):
    """Prepares frames. `hands` [2, C, 3], m: controllers at the start and at the end of the frame."""

    name: str

    def forward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame of one twin."""

    def forward_backward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame of one twin with its gradient."""


@dataclass(frozen=True)
class Times:
    """Seconds of every round."""

    seconds: tuple[float, ...]

    @property
    def least(self) -> float:
        """The shortest, s."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """The median, s."""
        return statistics.median(self.seconds)

    def over(self, other: Times) -> Times:
        """Ratios of these times to those of `other` in the same rounds."""
        return Times(tuple(mine / its for mine, its in zip(self.seconds, other.seconds, strict=True)))


def take_turns(
    actions: Mapping[str, Callable[[], object]], device: str = "cpu", *, rounds: int = 9, least: int = 3, seconds: float = 5.0
) -> dict[str, Times]:
    """Times of every action in the same rounds, after one round that is not timed.

    Runs at most `rounds` rounds, and stops after `seconds` once `least` rounds are done. The first action changes with each round.
    """
    names = list(actions)
    spent: dict[str, list[float]] = {name: [] for name in actions}
    start = time.perf_counter()
    for turn in range(rounds + 1):
        if turn > least and time.perf_counter() - start > seconds:
            break
        for name in [*names[turn % len(names) :], *names[: turn % len(names)]]:
            begin = time.perf_counter()
            actions[name]()
            if device != "cpu":
                wp.synchronize_device(device)
            if turn:
                spent[name].append(time.perf_counter() - begin)
            else:
                start = time.perf_counter()
    return {name: Times(tuple(times)) for name, times in spent.items()}


def distances(frame: Frame, other: Frame) -> np.ndarray:
    """Distances between the nodes of two frames that ran [N], m."""
    apart: np.ndarray = np.linalg.norm(frame.positions().astype(np.float64) - other.positions(), axis=1)
    return apart


def gradient_difference(frame: Frame, other: Frame) -> float:
    """The norm of the difference of two gradients over the norm of the second."""
    assert frame.gradient is not None and other.gradient is not None
    mine, its = frame.gradient().astype(np.float64), other.gradient().astype(np.float64)
    return float(np.linalg.norm(mine - its) / np.linalg.norm(its))
