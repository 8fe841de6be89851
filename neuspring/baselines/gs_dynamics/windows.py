"""Training windows: H steps of history and F steps of future around every training frame, a step per `step` m of tool motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from neuspring.baselines.gs_dynamics.tracks import Tracks
from neuspring.config.gs_dynamics import GsDynamics


def moved(tools: np.ndarray, before: int, after: int) -> float:
    """The largest distance, m, of any of tools [T, C, 3] between two frames."""
    return float(np.linalg.norm(tools[after] - tools[before], axis=1).max())


def executed(tools: np.ndarray, step: float) -> list[int]:
    """Frames in which a rollout makes a step: those at which tools [T, C, 3] have moved `step`, m, since the one before."""
    frames = [0]
    for frame in range(1, len(tools)):
        if moved(tools, frames[-1], frame) >= step:
            frames.append(frame)
    return frames[1:]


def past(tools: np.ndarray, frame: int, step: float, count: int) -> list[int]:
    """`count` frames up to `frame`, oldest first, each at least a step before the next; filled up with the oldest."""
    chosen = [frame]
    for other in range(frame - 1, -1, -1):
        if len(chosen) == count:
            break
        if moved(tools, chosen[-1], other) >= step:
            chosen.append(other)
    return [chosen[-1]] * (count - len(chosen)) + chosen[::-1]


def ahead(tools: np.ndarray, frame: int, step: float, count: int, last_accepted: float) -> list[int]:
    """`count` frames after `frame`, each at least a step after the one before; filled up with the latest. Empty: there are none.

    The last frame of all needs only `last_accepted` of a step.
    """
    chosen = [frame]
    for other in range(frame + 1, len(tools)):
        if len(chosen) > count:
            break
        wanted = step * (last_accepted if other == len(tools) - 1 else 1.0)
        if moved(tools, chosen[-1], other) >= wanted:
            chosen.append(other)
    if len(chosen) == 1:
        return []
    return chosen[1:] + [chosen[-1]] * (count + 1 - len(chosen))


def window_frames(tools: np.ndarray, settings: GsDynamics) -> np.ndarray:
    """[W, H + F] frames of each window; frames without a step ahead have none, as a rollout only holds there."""
    size, step = settings.history + settings.future, settings.step
    rows = []
    for frame in range(len(tools)):
        future = ahead(tools, frame, step, settings.future, settings.last_accepted)
        if future:
            rows.append(past(tools, frame, step, settings.history) + future)
    return np.array(rows, dtype=np.int64).reshape(-1, size)


@dataclass(frozen=True, eq=False)
class Windows:
    """On a device."""

    frames: torch.Tensor
    """[W, H + F] int64."""
    usable: torch.Tensor
    """[W, M] bool: tracks that may become particles. Seen in the whole history, so that every input is a real position."""
    points: torch.Tensor
    """[T, M, 3] m."""
    visible: torch.Tensor
    """[T, M] bool."""
    tools: torch.Tensor
    """[T, C, 3] m."""
    history: int

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    def of(cls, tracks: Tracks, settings: GsDynamics, device: str) -> Windows:
        """All windows of tracks that have a particle."""
        frames = window_frames(tracks.tools, settings)
        chosen = usable_tracks(tracks.visible, frames, settings)
        kept = chosen.any(axis=1)
        values = (frames[kept], chosen[kept], tracks.points, tracks.visible, tracks.tools)
        at, usable, points, visible, tools = (torch.tensor(value, device=device) for value in values)
        return cls(at, usable, points, visible, tools, settings.history)


def usable_tracks(visible: np.ndarray, frames: np.ndarray, settings: GsDynamics) -> np.ndarray:
    """[W, M] bool: tracks seen in all frames [W, H + F] of a window, of visible [T, M]; those seen in its history where fewer than
    `min_visible` are."""
    seen: np.ndarray = visible[frames]
    throughout = seen.all(axis=1)
    enough = throughout.sum(axis=1, keepdims=True) >= settings.min_visible
    in_history = seen[:, : settings.history].all(axis=1)
    return np.where(enough, throughout, in_history)
