"""Training windows: H steps of history and F steps of future around every training frame. A step is `step` m of tool motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch

from neuspring.baselines.gs_dynamics.tracks import Tracks
from neuspring.config.gs_dynamics import GsDynamics


def moved(tools: np.ndarray, before: int, after: int) -> float:
    """The largest motion, m, of any of the tools [T, C, 3] between two frames."""
    return float(np.linalg.norm(tools[after] - tools[before], axis=1).max())


def steps(tools: np.ndarray, frames: Iterable[int], step: float, last_accepted: float = 1.0) -> Iterator[int]:
    """The first of `frames`, then each in which a tool of [T, C, 3] has moved `step`, m, since the one before.

    The last frame of the recording needs only `last_accepted` of a step.
    """
    latest = None
    for frame in frames:
        least = step * (last_accepted if frame == len(tools) - 1 else 1.0)
        if latest is None or moved(tools, latest, frame) >= least:
            latest = frame
            yield frame


def executed(tools: np.ndarray, step: float) -> list[int]:
    """Frames in which a rollout makes a step: those in which tools [T, C, 3] have moved `step`, m, since the one before."""
    return list(steps(tools, range(len(tools)), step))[1:]


def past(tools: np.ndarray, frame: int, step: float, count: int) -> list[int]:
    """`count` frames up to `frame`, oldest first, a step apart; where there are fewer, the oldest is repeated."""
    frames = list(islice(steps(tools, range(frame, -1, -1), step), count))
    return [frames[-1]] * (count - len(frames)) + frames[::-1]


def ahead(tools: np.ndarray, frame: int, step: float, count: int, last_accepted: float) -> list[int]:
    """`count` frames after `frame`, a step apart; where there are fewer, the latest is repeated. Empty where there is none."""
    frames = list(islice(steps(tools, range(frame, len(tools)), step, last_accepted), 1, count + 1))
    return frames + frames[-1:] * (count - len(frames))


def window_frames(tools: np.ndarray, settings: GsDynamics) -> np.ndarray:
    """Frames [W, H + F] of each window. A frame without a step ahead has none, as nothing moves there in a rollout."""
    size, step = settings.history + settings.future, settings.step
    rows = []
    for frame in range(len(tools)):
        future = ahead(tools, frame, step, settings.future, settings.last_accepted)
        if future:
            rows.append(past(tools, frame, step, settings.history) + future)
    return np.array(rows, dtype=np.int64).reshape(-1, size)


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows of a capture, on a device."""

    frames: torch.Tensor
    """[W, H + F] int64."""
    usable: torch.Tensor
    """[W, M] bool: tracks that may become particles: those seen in the whole history, so every input is a measured position."""
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
        """All windows in which at least one track may become a particle."""
        frames = window_frames(tracks.tools, settings)
        usable = usable_tracks(tracks.visible, frames, settings)
        nonempty = usable.any(axis=1)
        return cls(
            frames=torch.tensor(frames[nonempty], device=device),
            usable=torch.tensor(usable[nonempty], device=device),
            points=torch.tensor(tracks.points, device=device),
            visible=torch.tensor(tracks.visible, device=device),
            tools=torch.tensor(tracks.tools, device=device),
            history=settings.history,
        )


def usable_tracks(visible: np.ndarray, frames: np.ndarray, settings: GsDynamics) -> np.ndarray:
    """[W, M] bool: tracks, visible [T, M], that are seen in all frames [W, H + F] of a window.

    Where these are fewer than `min_visible`, tracks that are seen in the whole history.
    """
    seen: np.ndarray = visible[frames]
    throughout = seen.all(axis=1)
    enough = throughout.sum(axis=1, keepdims=True) >= settings.min_visible
    in_history = seen[:, : settings.history].all(axis=1)
    return np.where(enough, throughout, in_history)
