"""Trajectories of all seeds of a method -> their mean."""

from __future__ import annotations

from collections.abc import Sequence

from neuspring.core.artifacts import Observations
from neuspring.core.errors import NumericalFailure
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import Written, stage


@stage(output="{scenario}/{method}/{seed}/rollout.json", rule="run", when=lambda rows: bool(rows.method and rows.method.mean_of))
def average(observations: Observations, rollout: Sequence[Before], run: Recorder) -> Written:
    """Trajectories of all seeds of a method -> their mean, node by node and frame by frame: trajectory.npz.

    The record has their spread in each task, m: the root mean square distance of nodes in the n predictions from the mean, with
    n - 1. It says how much the prediction depends on the seed, and nothing of what all seeds have wrong. A seed that failed fails
    the mean.
    """
    import dataclasses

    import numpy as np

    from neuspring.core.artifacts import Trajectory
    from neuspring.scores import metrics

    predicted = [Trajectory.load(before.file("trajectory")) for before in rollout]
    if len({one.positions.shape for one in predicted}) > 1:
        raise NumericalFailure("the predictions have different nodes or frames")
    positions = np.stack([one.positions for one in predicted]).astype(np.float64)
    mean = positions.mean(axis=0)
    squares = ((positions - mean) ** 2).sum(axis=(0, 3)).mean(axis=1) / max(len(predicted) - 1, 1)
    frames = {task: metrics.task_frames(observations.scenario, task) for task in metrics.TASKS}
    spread = {f"spread_{task}": float(np.sqrt(squares[these].mean())) for task, these in frames.items() if len(these)}
    files = run.beside(trajectory="trajectory.npz")
    overflow = sum(one.collision_overflow for one in predicted)
    dataclasses.replace(predicted[0], positions=mean, collision_overflow=overflow).save(files["trajectory"])
    return Written(files=files, facts={"frames": len(mean), "predictions": len(predicted), **spread})
