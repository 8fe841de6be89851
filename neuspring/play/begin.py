"""Where a live twin begins: at a frame of the recording, in the state of its prediction there, and what the hands do from there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.physics.controllers import begins, waypoints
from neuspring.play.results import Run
from neuspring.play.simulator import Start
from neuspring.twin.hand_paths import with_hands
from neuspring.twin.motion import initial_velocity


@dataclass(frozen=True, eq=False)
class Script:
    """What recorded hands do after the begin; E frames, none where they stay."""

    hands: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    """[E, C, 3], m."""
    holds: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))
    """[E, C]."""


@dataclass(frozen=True, eq=False)
class Begin:
    """The start of a live twin."""

    frame: int
    """Of the recording."""
    start: Start
    script: Script


def begin_at(run: Run, seen: Observations, frame: int, repeat: bool) -> Begin:
    """The state of a run's prediction in a frame; with `repeat`, the hands go on as recorded.

    Its velocity is half of what the nodes move from the frame before to the frame after, per frame; in frame 0 it is none, or with
    `repeat` that of the rollout. Raises InputError for a frame that the prediction does not have.
    """
    twin = run.twin
    if twin is None:
        raise InputError(run.folder, "a run with a twin is required", "none", "Choose a method that makes a twin.")
    seen = with_hands(seen, twin)
    count, hands = len(twin.topology.controllers), seen.controller_points
    if frame == 0 and not repeat:
        return Begin(0, Start(), Script())
    if hands.shape[1] != count:
        raise InputError(run.folder, f"its twin has {count} controllers, the observations must too", hands.shape[1])
    holds = seen.controller_valid if seen.controller_valid.size else np.ones(hands.shape[:2], bool)
    rest = slice(frame + 1, None) if repeat else slice(0, 0)
    script = Script(hands[rest], holds[rest])
    if frame == 0:
        velocity = initial_velocity(seen, twin.simulation.initial_velocity)
        return Begin(0, Start(velocity=velocity, hands=hands[0], holds=holds[0]), script)
    x = None if run.trajectory is None else run.trajectory.positions
    if x is None or x.shape[1:] != twin.topology.nodes.shape or not 0 <= frame < len(x):
        known = 0 if x is None else len(x)
        raise InputError(f"{run.name}, frame {frame}", f"its prediction has {known} frames", frame, "Begin at frame 0.")
    before, after = max(frame - 1, 0), min(frame + 1, len(x) - 1)
    velocity = (x[after].astype(float) - x[before]) / max((after - before) * twin.simulation.frame_time, 1e-9)
    rows = waypoints(torch.tensor(hands[: frame + 1]), holds).numpy()
    earlier = np.flatnonzero(begins(torch.tensor(rows[:frame])).any(dim=-1).numpy())
    flags = rows[frame, :, 3] if rows.shape[2] == 4 else np.ones(count)
    start = Start(x[frame], velocity, hands[frame], flags, tuple((rows[t], x[t]) for t in earlier))
    return Begin(frame, start, script)
