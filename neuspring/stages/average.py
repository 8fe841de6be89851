"""Stage `average`: trajectories of all seeds of a method -> their mean."""

from __future__ import annotations

from collections.abc import Sequence

from neuspring.core.artifacts import Observations
from neuspring.core.errors import NumericalFailure
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import Written, stage


@stage(output="{scenario}/{method}/{seed}/rollout.json", rule="run", when=lambda rows: bool(rows.method and rows.method.mean_of))
def average(observations: Observations, rollout: Sequence[Before], run: Recorder) -> Written:
    """Trajectories of all seeds of a method -> their mean, node by node and frame by frame: trajectory.npz.

    The record contains the spread per task, m: the root mean square distance of nodes from the mean, with n - 1 for n
    predictions. It measures the dependence on the seed, not errors that all seeds share. A failed seed fails the mean.
    """
    import dataclasses

    import numpy as np

    from neuspring.core.artifacts import Trajectory
    from neuspring.scores import metrics

    predicted = [Trajectory.load(before.file("trajectory")) for before in rollout]
    if len({trajectory.positions.shape for trajectory in predicted}) > 1:
        raise NumericalFailure("the predictions have different nodes or frames")
    positions = np.stack([trajectory.positions for trajectory in predicted]).astype(np.float64)
    mean = positions.mean(axis=0)
    squares = ((positions - mean) ** 2).sum(axis=(0, 3)).mean(axis=1) / max(len(predicted) - 1, 1)
    frames = {task: metrics.task_frames(observations.scenario, task) for task in metrics.TASKS}
    spread = {f"spread_{task}": float(np.sqrt(squares[indices].mean())) for task, indices in frames.items() if len(indices)}
    files = run.beside(trajectory="trajectory.npz")
    overflow = sum(trajectory.collision_overflow for trajectory in predicted)
    dataclasses.replace(predicted[0], positions=mean, collision_overflow=overflow).save(files["trajectory"])
    return Written(files=files, facts={"frames": len(mean), "predictions": len(predicted), **spread})
