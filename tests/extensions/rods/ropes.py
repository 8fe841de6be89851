"""Small ropes and cables whose twins are rods."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.extensions.rods.made import RodStart, rod_twin
from neuspring.twin.rollout import roll_out
from tests.support import scenarios
from tests.support.played import record

RADIUS, LENGTH, HEIGHT = 0.01, 0.4, 0.1
ROD = RodStart(
    vertices=10, bending=0.03, twisting=0.03, damping=0.01, marker_mass=0.01, drag=0.3, drag_quadratic=0.1, substep=0.002
)
SETTINGS = config.Config(rod=ROD)
MARKERS = 7
AXIS = (0.0, 0.6, 0.8)


def tube(line: np.ndarray, radius: float = RADIUS, around: int = 6) -> np.ndarray:
    """Nodes [n * around, 3] on circles around a line [n, 3] in the plane z = constant."""
    along = np.gradient(line, axis=0)
    side = np.cross(along / np.linalg.norm(along, axis=1, keepdims=True), [0, 0, 1.0])
    angle = 2 * np.pi * np.arange(around) / around
    offset = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * np.array([0, 0, 1.0])
    return np.asarray((line[:, None] + radius * offset).reshape(-1, 3))


def straight(count: int = 20, height: float = HEIGHT) -> np.ndarray:
    """Points along x."""
    return np.stack([np.linspace(0, LENGTH, count), np.zeros(count), np.full(count, height)], axis=1)


def rope(frames: int = 4, height: float = HEIGHT, move: Any = (0.0, 0.0, 0.0), count: int = 20, **changes: Any) -> Observations:
    """A straight rope that a hand of three points holds in the middle and moves by `move` per frame."""
    nodes = tube(straight(count, height))
    hand = np.array([[0.19, 0, 0.02], [0.2, 0.01, 0.02], [0.21, 0, 0.02]]) + np.array([0, 0, height])
    hands = hand + np.arange(frames)[:, None, None] * np.asarray(move)
    return scenarios.seen(np.tile(nodes, (frames, 1, 1)), hands, {"train_end": max(2, frames - 2)}, **changes)


def cable(frames: int = 4, move: Any = (0.0, 0.0, 0.0), sag: float = 0.5, **changes: Any) -> Observations:
    """Markers on z = 0.5 + sag (x - 0.2)^2, m, the two at either end held; the last two move by `move` per frame."""
    x = np.linspace(0, LENGTH, MARKERS)
    line = np.stack([x, np.zeros(MARKERS), 0.5 + sag * (x - 0.2) ** 2], axis=1)
    nodes, hands = line[2:-2], line[np.array([0, 1, MARKERS - 2, MARKERS - 1])]
    path = np.tile(hands, (frames, 1, 1))
    path[:, 2:] += np.arange(frames)[:, None, None] * np.asarray(move)
    count = len(nodes)
    order = np.array([count, count + 1, *range(count), count + 2, count + 3])
    return scenarios.seen(np.tile(nodes, (frames, 1, 1)), path, {"train_end": max(2, frames - 2)}, line=order, **changes)


def twin(observations: Observations | None = None, settings: config.Config = SETTINGS) -> Twin:
    """The rod that a fit would start from."""
    return rod_twin(rope() if observations is None else observations, settings, AXIS)


def rod_results(folder: Path, *, clamped: bool = False) -> Path:
    """results/<scenario> of a rope that a hand lifts, or of a cable between clamps, with one run whose twin is a rod."""
    seen = (cable if clamped else rope)(frames=6, move=(0.0, 0.002, 0.004))
    place = folder / "small" / "rod" / "0"
    seen.save(folder / "small" / "observations.npz")
    made = twin(seen)
    made.save(place / "twin.npz")
    roll_out(made, seen.controller_points).save(place / "trajectory.npz")
    record(place)
    return folder / "small"
