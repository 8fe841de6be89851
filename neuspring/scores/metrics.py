"""What is reported: Chamfer distance and track error (as in the released evaluation) and scores of pictures, per frame and per
task, both averages.

Chamfer: each visible observed point to its nearest surface node, single direction, in the L1 norm |dx| + |dy| + |dz|.
Track: annotated tracks, matched to the nearest of all nodes at frame 0, Euclidean distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Observations, Scenario, Trajectory

TASKS = ("reconstruction", "future")
UNITS = {"chamfer": "m", "track_error": "m", "psnr": "dB", "ssim": "1", "lpips": "1", "iou": "1"}
COLUMNS = ("scenario", "category", "method", "seed", "task", "metric", "value", "unit", "frames")


def visible_to_surface(nodes: np.ndarray, points: np.ndarray, visible: np.ndarray, surface: int) -> float:
    """Mean L1 distance, m, from the visible points [P, 3] to the first `surface` nodes [N, 3]. NaN where no point is visible."""
    seen = points[visible].astype(np.float64)
    if not len(seen):
        return float("nan")
    return float(cKDTree(nodes[:surface].astype(np.float64)).query(seen, p=1)[0].mean())


def chamfer_per_frame(positions: np.ndarray, observations: Observations) -> np.ndarray:
    """Mean L1 distance per frame [T], m, from visible points to surface nodes. NaN where no point is visible."""
    surface, points, visible = observations.surface_count, observations.object_points, observations.object_visibility
    return np.array([visible_to_surface(nodes, points[t], visible[t], surface) for t, nodes in enumerate(positions)])


def track_errors(positions: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """Mean Euclidean error per frame [F], m, of positions [F, N, 3] against annotated tracks [F, K, 3]; NaN: not annotated.

    Tracks annotated at frame 0 are matched once, to the nearest of all nodes. A frame without any of them scores 0, as
    published. NaN everywhere when no track is annotated at frame 0.
    """
    annotated = ~np.isnan(tracks).any(axis=2)
    matched = annotated[0]
    if not matched.any():
        return np.full(len(positions), np.nan)
    tracks = tracks.astype(np.float64)
    index = cKDTree(positions[0].astype(np.float64)).query(tracks[0][matched])[1]
    error = np.linalg.norm(positions[:, index].astype(np.float64) - tracks[:, matched], axis=2)
    valid = annotated[:, matched]
    count = valid.sum(axis=1)
    total = np.where(valid, error, 0.0).sum(axis=1)
    mean: np.ndarray = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    return mean


def track_error_per_frame(positions: np.ndarray, observations: Observations) -> np.ndarray:
    """Mean Euclidean track error per frame [T], m. A frame without any annotated track scores 0, as published.

    NaN everywhere when no track is annotated at frame 0 (nothing can be matched).
    """
    return track_errors(positions, observations.tracks[: len(positions)])


def task_frames(scenario: Scenario, task: str) -> range:
    """Frames that a task averages over: reconstruction 1..train_end-1, future train_end..T-1 (frame 0 is given)."""
    return range(1, scenario.train_end) if task == "reconstruction" else range(scenario.train_end, scenario.frame_count)


def held(trajectory: Trajectory | None, observations: Observations) -> Trajectory:
    """A trajectory of all frames: the last one, at least frame 0, is held where the rollout ended early."""
    frames = observations.scenario.frame_count
    known = observations.nodes[None] if trajectory is None or not len(trajectory.positions) else trajectory.positions
    still = np.repeat(known[-1:], frames - len(known), axis=0)
    return Trajectory(positions=np.concatenate([known, still]), frame_count=frames)


def score(trajectory: Trajectory, observations: Observations, method: str, seed: int) -> pd.DataFrame:
    """Tidy scores, one row per task and metric. Rows that cannot be computed are left out, never NaN:

    a task without frames, a metric without annotation, a task that the rollout diverged in.
    """
    tasks = {task: task_frames(observations.scenario, task) for task in TASKS}
    return score_tasks(trajectory, observations, method, seed, tasks)


def score_tasks(
    trajectory: Trajectory, observations: Observations, method: str, seed: int, tasks: Mapping[str, range]
) -> pd.DataFrame:
    """As `score`, for any tasks: name -> frames that it averages over."""
    scenario = observations.scenario
    rows = []
    per_frame = {
        "chamfer": chamfer_per_frame(trajectory.positions, observations),
        "track_error": track_error_per_frame(trajectory.positions, observations),
    }
    for task, frames in tasks.items():
        if not len(frames) or frames[-1] >= len(trajectory.positions):
            continue
        for metric, values in per_frame.items():
            usable = values[frames.start : frames.stop]
            usable = usable[~np.isnan(usable)]
            if len(usable):
                identity = (scenario.name, scenario.category, method, seed, task, metric)
                rows.append((*identity, float(usable.mean()), UNITS[metric], len(usable)))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def score_images(frames: pd.DataFrame, scenario: Scenario, drawn: int, method: str, seed: int) -> pd.DataFrame:
    """Tidy scores of pictures from `frames` (columns frame, camera, metric, value), of which the first `drawn` frames exist.

    Cameras are averaged within a frame, then frames; a task that the rollout diverged in is left out. An infinite PSNR (nothing but
    black on both sides) is left out of the mean.
    """
    rows = []
    frames = frames[np.isfinite(frames["value"])]
    for task in TASKS:
        span = task_frames(scenario, task)
        if not len(span) or span[-1] >= drawn:
            continue
        part = frames[frames["frame"].isin(span)]
        for metric, values in part.groupby("metric", sort=False):
            per_frame = values.groupby("frame")["value"].mean()
            identity = (scenario.name, scenario.category, method, seed, task, metric)
            rows.append((*identity, float(per_frame.mean()), UNITS[str(metric)], len(per_frame)))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def averages(scores: pd.DataFrame, by: Iterable[str] = ("method", "task", "metric")) -> pd.DataFrame:
    """Both averages over scenarios: `equal` weighs scenarios equally, `frames` weighs them by their frames.

    The paper mixes the two (equal for Chamfer and track, frame-weighted for images), so both are kept. Seeds are averaged
    within each scenario first; `seed_std` is the standard deviation over seeds of the equal average (0 for one seed), over the
    seeds that have every scenario (NaN where fewer than two of several do).
    """
    keys = list(by)
    groups = scores.groupby([*keys, "scenario"], sort=False)
    per_scenario = groups.agg(value=("value", "mean"), frames=("frames", "mean")).reset_index()
    per_scenario["weighted"] = per_scenario["value"] * per_scenario["frames"]
    total = per_scenario.groupby(keys, sort=False)
    result = total.agg(
        equal=("value", "mean"), weighted=("weighted", "sum"), all_frames=("frames", "sum"), scenarios=("scenario", "count")
    )
    result["frames"] = result.pop("weighted") / result.pop("all_frames")
    per_seed = scores.groupby([*keys, "seed"], sort=False).agg(value=("value", "mean"), scenarios=("scenario", "nunique"))
    by_seed = per_seed.groupby(level=list(range(len(keys))))
    complete = per_seed[per_seed["scenarios"] == by_seed["scenarios"].transform("max")]
    spread = complete["value"].groupby(level=list(range(len(keys)))).std(ddof=1)
    result["seed_std"] = spread.reindex(result.index).where(by_seed.size().reindex(result.index) > 1, 0.0)
    return result.reset_index()
