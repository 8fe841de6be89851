"""The metrics: what they measure, how tables show them, and the functions that compute them.

Chamfer distance: each visible observed point to its nearest surface node, one direction, in the L1 norm |dx| + |dy| + |dz|.
Track error: annotated tracks, matched to the nearest of all nodes at frame 0, Euclidean distance.
Both follow the released evaluation of PhysTwin. The track error has a floor, its value in frame 0. The bound track error has none:
its points move with the nodes around them (`carried`). DEFORM's L1 error is that of its evaluation, of markers along a cable.
Metrics of pictures are in `pictures` and `lpips`.

pandas and SciPy are imported where they are used, because the workflow reads the declarations at its start.

To add a metric, write its function, add its values in `score_tasks` or `pictures.picture_scores`, and declare it in `METRICS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from neuspring.core.artifacts import Observations, Scenario, Trajectory
from neuspring.scores.carried import NEIGHBORS, bound_positions

if TYPE_CHECKING:
    import pandas as pd
    from scipy.spatial import cKDTree

TASKS = ("reconstruction", "future")
SHORT = {"reconstruction": "Recon.", "future": "Future"}
"""Tasks in headings of columns."""
COLUMNS = ("scenario", "category", "method", "seed", "task", "metric", "value", "unit", "frames")
DASH = "–"
"""Stands for a value that there is not."""
AT_BOUND = 0.05
"""A share of springs at the bound of their stiffness above this says that the bound was in training's way: in notes of runs and
below tables alike."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A metric, and how tables show it: in summaries, and beside the paper's values, which stand in mm where they are lengths."""

    name: str
    title: str
    """In words, for legends."""
    heading: str
    unit: str
    """Of stored values; 1 for plain numbers."""
    factor: float = 1.0
    """From the stored unit to that of summaries."""
    digits: int
    """After the point, in summaries."""
    higher_is_better: bool = False
    relative: bool = True
    """Whether a change in per cent means something. It does not in dB."""
    of_pictures: bool = False
    average: Literal["equal", "frames"] = "equal"
    """How the paper averages over scenarios: equally, or weighted by their frames."""
    tolerance: float
    """Largest difference, in the stored unit, from a published value of the same data that conformance checks allow.

    Distances: single precision and its order of summation. Pictures: those of the stand-in agree within 1e-6 dB with another
    drawing in double precision, while half a pixel moves them by 0.2 dB and 0.017 IoU; other rasterizers lie between.
    """
    explained: str = ""
    """In words, below the heading of summaries; empty: the title."""
    paper_name: str = ""
    """In paper_tables.csv; empty for metrics that the paper does not have. Those that it has are named in `IN_PAPER` too."""
    paper_heading: str = ""
    paper_unit: str = ""
    """Empty for plain numbers."""
    paper_factor: float = 1.0
    """From the stored unit to `paper_unit`."""
    paper_digits: int = 3
    """After the point, for our values beside the paper's."""

    @property
    def other_average(self) -> Literal["equal", "frames"]:
        """The average that the paper does not use for this metric."""
        return "frames" if self.average == "equal" else "equal"

    @property
    def label(self) -> str:
        """For an axis: heading and unit."""
        return self.heading if self.unit == "1" else f"{self.heading} [{self.unit}]"

    @property
    def shown_unit(self) -> str:
        """The unit of summaries; empty for plain numbers."""
        return "mm" if self.unit == "m" else "" if self.unit == "1" else self.unit

    @property
    def paper_column(self) -> str:
        """The paper's heading with an arrow that says which direction is better."""
        return f"{self.paper_heading} {'↑' if self.higher_is_better else '↓'}"

    def text(self, value: float, sign: str = "") -> str:
        """A stored value as summaries print it."""
        return f"{self.factor * value:{sign}.{self.digits}f}"

    def paper_text(self, value: float, sign: str = "") -> str:
        """A value in the paper's unit; a dash for NaN."""
        return DASH if np.isnan(value) else f"{value:{sign}.{self.paper_digits}f}"


_ALL = (
    Metric(
        name="chamfer", title="Chamfer distance", heading="CD", unit="m", factor=1e3, digits=2, tolerance=1e-6,
        explained="single-directional L1 Chamfer",
        paper_name="cd", paper_heading="CD", paper_unit="mm", paper_factor=1e3, paper_digits=2,
    ),
    Metric(
        name="track_error", title="track error", heading="TE", unit="m", factor=1e3, digits=2, tolerance=1e-6,
        paper_name="track_error", paper_heading="TE", paper_unit="mm", paper_factor=1e3, paper_digits=2,
    ),
    Metric(
        name="track_error_bound", title="bound track error", heading="TE bound", unit="m", factor=1e3, digits=2, tolerance=1e-6,
        explained="track error of points bound to the nodes around them, 0 for any rigid motion",
        paper_heading="TE bound", paper_unit="mm", paper_factor=1e3, paper_digits=2,
    ),
    Metric(
        name="deform_l1", title="L1 error of DEFORM", heading="L1", unit="m", factor=1e3, digits=2, tolerance=1e-6,
        explained="mean absolute difference of all coordinates of the markers along a cable, held ones (0) included",
        paper_heading="L1", paper_unit="mm", paper_factor=1e3, paper_digits=2,
    ),
    Metric(
        name="psnr", title="PSNR", heading="PSNR", unit="dB", digits=2, tolerance=0.02, relative=False,
        higher_is_better=True, of_pictures=True, average="frames",
        paper_name="psnr", paper_heading="PSNR", paper_unit="dB", paper_digits=3,
    ),
    Metric(
        name="ssim", title="SSIM", heading="SSIM", unit="1", digits=4, tolerance=5e-4,
        higher_is_better=True, of_pictures=True, average="frames",
        paper_name="ssim", paper_heading="SSIM", paper_unit="", paper_digits=3,
    ),
    Metric(
        name="lpips", title="LPIPS", heading="LPIPS", unit="1", digits=4, tolerance=5e-4, of_pictures=True, average="frames",
        paper_name="lpips", paper_heading="LPIPS", paper_unit="", paper_digits=3,
    ),
    Metric(
        name="iou", title="IoU", heading="IoU", unit="1", digits=3, tolerance=2e-3,
        higher_is_better=True, of_pictures=True, average="frames",
        paper_name="iou", paper_heading="IoU %", paper_unit="%", paper_factor=100.0, paper_digits=1,
    ),
)  # fmt: skip
MARKED = (
    Metric(
        name="image_error", title="error of marked points in the image", heading="Marked", unit="px", digits=1, tolerance=1e-3,
    ),
    Metric(
        name="table_error", title="error of marked points that lie on the table", heading="On the table", unit="m", factor=1e3,
        digits=1, tolerance=1e-6,
    ),
)  # fmt: skip
"""Of points that were marked in images, where there is color alone (carried.py)."""
METRICS = {metric.name: metric for metric in (*_ALL, *MARKED)}
"""By name, in the order of summaries."""
IN_PAPER = {name: METRICS[name] for name in ("chamfer", "track_error", "iou", "psnr", "ssim", "lpips")}
"""The metrics of the paper's tables, in its order."""
IN_STUDIES = IN_PAPER | {"track_error_bound": METRICS["track_error_bound"]}
"""The metrics of studies, in the order of their columns: the paper's, then ours."""
DISTANCES = tuple(metric for metric in _ALL if not metric.of_pictures)
PUBLISHED = tuple(metric for metric in DISTANCES if metric.paper_name)
PICTURES = tuple(metric for metric in _ALL if metric.of_pictures)
UNITS = {metric.name: metric.unit for metric in METRICS.values()}
Headings = Mapping[tuple[str, str], str]
"""Task and metric to the heading of their column."""
HEADINGS = {(task, m.name): f"{short} {m.heading}" for task, short in SHORT.items() for m in DISTANCES}
IMAGE_HEADINGS = {(task, m.name): f"{short} {m.heading}" for task, short in SHORT.items() for m in PICTURES}
MARKED_HEADINGS = {(task, m.name): f"{short} {m.heading}" for task, short in SHORT.items() for m in MARKED}
TRANSFER_HEADINGS = {("transfer", m.name): f"Transfer {m.heading}" for m in DISTANCES}


def present(table: pd.DataFrame) -> set[tuple[str, str]]:
    """The pairs of task and metric that a table has rows of."""
    return set(zip(table["task"], table["metric"], strict=True))


def published(headings: Headings, table: pd.DataFrame) -> Headings:
    """Those of `headings` that are of the published distances, or of which a table has rows: older tables lack our metrics."""
    columns = present(table) if len(table) else set()
    return {key: text for key, text in headings.items() if METRICS[key[1]] in PUBLISHED or key in columns}


def headings_of(table: pd.DataFrame) -> Headings:
    """Headings of the published distances, and of the other metrics that a table has rows of."""
    return published(HEADINGS | IMAGE_HEADINGS, table)


def _tree(points: np.ndarray) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(points.astype(np.float64))


def _table(rows: Iterable[tuple[object, ...]]) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(rows, columns=list(COLUMNS))


def visible_to_surface(nodes: np.ndarray, points: np.ndarray, visible: np.ndarray, surface: int) -> float:
    """Mean L1 distance, m, from the visible points [P, 3] to the first `surface` nodes [N, 3]. NaN where no point is visible."""
    seen = points[visible].astype(np.float64)
    if not len(seen):
        return float("nan")
    return float(_tree(nodes[:surface]).query(seen, p=1)[0].mean())


def chamfer_per_frame(positions: np.ndarray, observations: Observations) -> np.ndarray:
    """Mean L1 distance per frame [T], m, from visible points to surface nodes. NaN where no point is visible."""
    surface, points, visible = observations.surface_count, observations.object_points, observations.object_visibility
    return np.array([visible_to_surface(nodes, points[t], visible[t], surface) for t, nodes in enumerate(positions)])


def track_errors(positions: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """Mean Euclidean error per frame [F], m, of positions [F, N, 3] against annotated tracks [F, K, 3]; NaN: not annotated.

    Tracks annotated at frame 0 are matched once, to the nearest of all nodes. A frame without any of them scores 0, as
    published. NaN everywhere when no track is annotated at frame 0.
    """
    tracks = tracks.astype(np.float64)
    return _mean_errors(positions, tracks, lambda points: positions[:, _tree(positions[0]).query(points)[1]].astype(np.float64))


def bound_track_errors(positions: np.ndarray, tracks: np.ndarray, neighbors: int = NEIGHBORS) -> np.ndarray:
    """As `track_errors`, of points that move with the nodes around them (`carried.bound_positions`): 0 for every rigid motion."""
    tracks = tracks.astype(np.float64)
    return _mean_errors(positions, tracks, lambda points: bound_positions(positions, points, neighbors))


def _mean_errors(positions: np.ndarray, tracks: np.ndarray, carried: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Mean distance per frame [F] of the tracks that frame 0 has from where the prediction carries their points [F, P, 3]."""
    annotated = ~np.isnan(tracks).any(axis=2)
    matched = annotated[0]
    if not matched.any():
        return np.full(len(positions), np.nan)
    error = np.linalg.norm(carried(tracks[0][matched]) - tracks[:, matched], axis=2)
    valid = annotated[:, matched]
    count = valid.sum(axis=1)
    total = np.where(valid, error, 0.0).sum(axis=1)
    mean: np.ndarray = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    return mean


LOWEST = 0.002001
"""Height, m, below which DEFORM's evaluation lifts observed markers."""


def deform_l1(positions: np.ndarray, observations: Observations) -> np.ndarray:
    """Mean absolute difference per frame [F], m, over the markers of the line and coordinates, of positions [F, N, 3].

    As DEFORM's evaluation has it: held markers count with 0, and observed ones are at least `LOWEST` high. The line must consist of
    tracked points, which are visible always, and controllers.
    """
    free = observations.line[observations.line < len(observations.nodes)]
    seen = observations.object_points[: len(positions), free].astype(np.float64)
    seen[..., 2] = np.maximum(seen[..., 2], LOWEST)
    total: np.ndarray = np.abs(positions[:, free] - seen).sum(axis=(1, 2))
    return total / (3 * len(observations.line))


def errors_per_frame(positions: np.ndarray, observations: Observations) -> dict[str, np.ndarray]:
    """Every distance per frame [T], m, by the name of its metric; positions [T, N, 3]. DEFORM's with a line of markers alone."""
    tracks, line = observations.tracks[: len(positions)], observations.line
    of_markers = not ((line >= observations.object_points.shape[1]) & (line < len(observations.nodes))).any()
    of_markers &= bool(line.size) and observations.scenario.up == "+z" and bool(observations.object_visibility.all())
    return ({"deform_l1": deform_l1(positions, observations)} if of_markers else {}) | {
        "chamfer": chamfer_per_frame(positions, observations),
        "track_error": track_errors(positions, tracks),
        "track_error_bound": bound_track_errors(positions, tracks),
    }


def marked_errors(positions: np.ndarray, observations: Observations) -> dict[str, np.ndarray]:
    """Errors of points marked in the image per frame [F], px and m, by the name of their metric, for positions [F, N, 3].

    NaN in frames without marks. Empty for captures with depth, and where no point was marked.
    """
    image = observations.image
    if image is None or not image.marked.shape[1]:
        return {}
    # OpenCV is imported for captures alone.
    from neuspring.scores.carried import points_in_image, points_on_table

    view = image.intrinsics, image.camera_to_world, positions, image.marked.astype(np.float64), observations.surface_count
    up = 1.0 if observations.scenario.up == "+z" else -1.0
    return {"image_error": points_in_image(*view), "table_error": points_on_table(*view, up)}


def floors(observations: Observations) -> dict[str, float]:
    """Every distance in frame 0, m, where the prediction is given: it measures how far points are from nodes, and no motion.

    Metrics without a value there are left out.
    """
    first = errors_per_frame(observations.nodes[None], observations)
    return {name: float(values[0]) for name, values in first.items() if np.isfinite(values[0])}


def task_frames(scenario: Scenario, task: str) -> range:
    """Frames that a task averages over: reconstruction 1..train_end-1, future train_end..T-1 (frame 0 is given)."""
    return range(1, scenario.train_end) if task == "reconstruction" else range(scenario.train_end, scenario.frame_count)


def last_frame_frozen(trajectory: Trajectory | None, observations: Observations) -> Trajectory:
    """A trajectory of all frames: where the rollout ended early, its last frame (frame 0 if there is none) stands for the rest."""
    frames = observations.scenario.frame_count
    empty = trajectory is None or not len(trajectory.positions)
    positions = observations.nodes[None] if trajectory is None or empty else trajectory.positions
    rest = np.repeat(positions[-1:], frames - len(positions), axis=0)
    return Trajectory(positions=np.concatenate([positions, rest]), frame_count=frames)


def score(
    trajectory: Trajectory,
    observations: Observations,
    method: str,
    seed: int,
    errors: Mapping[str, np.ndarray] | None = None,
) -> pd.DataFrame:
    """Tidy scores, one row per task and metric; `errors` are `errors_per_frame`, where they are known already.

    There is no row, and never NaN, for a task without frames, a metric without annotation, a task that the rollout diverged in.
    """
    tasks = {task: task_frames(observations.scenario, task) for task in TASKS}
    return score_tasks(trajectory, observations, method, seed, tasks, errors)


def score_tasks(
    trajectory: Trajectory,
    observations: Observations,
    method: str,
    seed: int,
    tasks: Mapping[str, range],
    errors: Mapping[str, np.ndarray] | None = None,
) -> pd.DataFrame:
    """As `score`, for any tasks: `tasks` maps names to the frames that they average over."""
    scenario = observations.scenario
    rows = []
    known = errors_per_frame(trajectory.positions, observations) if errors is None else errors
    per_frame = {**known, **marked_errors(trajectory.positions, observations)}
    for task, frames in tasks.items():
        if not len(frames) or frames[-1] >= len(trajectory.positions):
            continue
        for metric, values in per_frame.items():
            usable = values[frames.start : frames.stop]
            usable = usable[~np.isnan(usable)]
            if len(usable):
                identity = (scenario.name, scenario.category, method, seed, task, metric)
                rows.append((*identity, float(usable.mean()), UNITS[metric], len(usable)))
    return _table(rows)


def score_run(
    trajectory: Trajectory | None,
    pictures: pd.DataFrame | None,
    observations: Observations,
    method: str,
    seed: int,
    errors: Mapping[str, np.ndarray] | None = None,
) -> pd.DataFrame:
    """Scores of a prediction (`score`) and, where there are any, of its pictures (`score_images`); none without a prediction."""
    import pandas as pd

    if trajectory is None:
        return _table([])
    scores = score(trajectory, observations, method, seed, errors)
    if pictures is None:
        return scores
    pictured = score_images(pictures, observations.scenario, len(trajectory.positions), method, seed)
    return pd.concat([part for part in (scores, pictured) if len(part)] or [scores], ignore_index=True)


def score_images(frames: pd.DataFrame, scenario: Scenario, drawn: int, method: str, seed: int) -> pd.DataFrame:
    """Tidy scores of pictures from `frames` (columns frame, camera, metric, value). The prediction has `drawn` frames.

    Cameras are averaged within a frame, then frames. A task that the rollout diverged in has no row. The mean leaves out an
    infinite PSNR, which pictures have that are black on both sides.
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
    return _table(rows)


def averages(scores: pd.DataFrame, by: Iterable[str] = ("method", "task", "metric")) -> pd.DataFrame:
    """Both averages over scenarios: `equal` weighs scenarios equally, `frames` weighs them by their frames.

    The paper uses the first for distances and the second for pictures. Seeds are averaged within each scenario first. `seed_std` is
    the standard deviation over seeds of the equal average, of the seeds that have every scenario: 0 for one seed, NaN where there
    are several seeds and fewer than two of them have every scenario.
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
