"""The metrics: definitions, functions and table formats; scores of a run, and averages of scores.

- Chamfer distance: from each visible observed point to its nearest surface node, one direction, L1 norm |dx| + |dy| + |dz|.
- Track error: from annotated tracks to the nearest of all nodes in frame 0, Euclidean distance. Its value in frame 0 is its floor.
- Bound track error: the same for points that move with the nodes around them (`carried`), without a floor.

The first two follow the released evaluation of PhysTwin. `pictures` and `lpips` compute the image metrics.

Every member of `METRICS` contains its function, so it is computed for all runs and appears in all tables.

pandas and SciPy are imported inside functions, because the workflow reads these declarations at its start.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neuspring.core.artifacts import Observations, Scenario, Trajectory
from neuspring.core.errors import InputError
from neuspring.data.camera import Camera
from neuspring.registry import Registry
from neuspring.scores.carried import CARRIERS, bound_positions, means, points_in_image, points_on_table

if TYPE_CHECKING:
    import pandas as pd
    from scipy.spatial import cKDTree

    from neuspring.config.settings import Aim

TASKS = ("reconstruction", "future")
SHORT = {"reconstruction": "Recon.", "future": "Future", "transfer": "Transfer"}
"""Tasks in headings of columns."""
SCORE_COLUMNS = ("scenario", "category", "method", "seed", "task", "metric", "value", "unit", "frames")
DASH = "–"
"""Printed for a missing value."""
Of = Literal["positions", "pictures", "marks"]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A metric: its function and its format in tables."""

    name: str
    title: str
    """Name in legends."""
    heading: str
    unit: str
    """Unit of stored values; "1" for plain numbers."""
    shown_unit: str = ""
    """Unit in tables; empty for plain numbers."""
    factor: float = 1.0
    """Factor from the stored unit to the unit of tables."""
    digits: int
    """Digits after the decimal point in tables."""
    better: Literal["lower", "higher", "neither"] = "lower"
    """Direction of better values; neither: tables do not mark a best value."""
    relative: bool = True
    """True if a relative change is meaningful; it is not in dB."""
    of: Of = "positions"
    """Input: node positions; images; or points annotated in images (marks), for captures without depth."""
    function: Callable[..., Any] | str
    """Function that computes the metric.

    - Positions and marks: (positions [F, N, 3] m, observations) -> values per frame [F]. NaN: the frame has no value. None instead
      of an array: the metric does not apply.
    - Pictures: (`pictures.Pair`, `pictures.Perceptual` or None) -> a value or None.

    A text "module:name" is imported at the first call."""
    in_studies: bool = False
    """True if tables of studies also show it."""
    average: Literal["equal", "frames"] = "equal"
    """Weights of scenarios in the paper's average: equal, or by frames."""
    tolerance: float = 1e-6
    """Largest difference from a published value, in the stored unit, that conformance checks accept.

    Distances differ by single precision and its order of summation. Image metrics differ between rasterizers: two double-precision
    renderings agree within 1e-6 dB, a shift of half a pixel causes 0.2 dB and 0.017 IoU.
    """
    explained: str = ""
    """Explanation below a summary table; empty: none."""
    paper_name: str = ""
    """Name in paper_tables.csv; empty for metrics that the paper does not report."""

    def measure(self, *arguments: Any) -> Any:
        """Call the function."""
        return (resolve_name(self.function) if isinstance(self.function, str) else self.function)(*arguments)

    @property
    def is_error(self) -> bool:
        """True if methods are compared by ratios of this metric."""
        return self.of == "positions" and self.better == "lower"

    @property
    def label(self) -> str:
        """Label of an axis: heading and stored unit."""
        return self.heading if self.unit == "1" else f"{self.heading} [{self.unit}]"

    @property
    def column(self) -> str:
        """Heading of a table column, with "%" for percentages."""
        return f"{self.heading} %" if self.shown_unit == "%" else self.heading

    def text(self, value: float, sign: str = "") -> str:
        """A stored value in the format of tables."""
        return self.shown(self.factor * value, sign)

    def told(self, value: float) -> str:
        """A stored value with heading and unit, for running text."""
        return f"{self.heading} {self.text(value)} {self.shown_unit}".rstrip()

    def shown(self, value: float, sign: str = "") -> str:
        """A value that already is in the unit of tables, in their format; a dash for NaN."""
        return DASH if np.isnan(value) else f"{value:{sign}.{self.digits}f}"


def present(table: pd.DataFrame) -> set[tuple[str, str]]:
    """The pairs of task and metric in a table."""
    return set(zip(table["task"], table["metric"], strict=True))


def _tree(points: np.ndarray) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(points.astype(np.float64))


def _table(rows: Iterable[tuple[object, ...]]) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(rows, columns=list(SCORE_COLUMNS))


def visible_to_surface(nodes: np.ndarray, points: np.ndarray, visible: np.ndarray, surface: int) -> float:
    """Mean L1 distance, m, from the visible points [P, 3] to the first `surface` nodes [N, 3]; NaN if no point is visible."""
    if not len(seen := points[visible].astype(np.float64)):
        return float("nan")
    return float(_tree(nodes[:surface]).query(seen, p=1)[0].mean())


def chamfer_per_frame(positions: np.ndarray, observations: Observations) -> np.ndarray:
    """Mean L1 distance per frame [T], m, from visible points to surface nodes; NaN if no point is visible."""
    surface, points, visible = observations.surface_count, observations.object_points, observations.object_visibility
    return np.array([visible_to_surface(nodes, points[t], visible[t], surface) for t, nodes in enumerate(positions)])


def track_errors(positions: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """Mean Euclidean error per frame [F], m, of positions [F, N, 3] against annotated tracks [F, K, 3]; NaN: not annotated.

    Tracks annotated in frame 0 are matched once, to the nearest of all nodes. A frame without any of them scores 0, as published.
    All frames are NaN if no track is annotated in frame 0.
    """
    tracks = tracks.astype(np.float64)
    return _mean_errors(positions, tracks, lambda points: positions[:, _tree(positions[0]).query(points)[1]].astype(np.float64))


def bound_track_errors(positions: np.ndarray, tracks: np.ndarray, neighbors: int = CARRIERS) -> np.ndarray:
    """As `track_errors`, for points that move with the nodes around them (`carried.bound_positions`); 0 for every rigid motion."""
    tracks = tracks.astype(np.float64)
    return _mean_errors(positions, tracks, lambda points: bound_positions(positions, points, neighbors))


def _mean_errors(positions: np.ndarray, tracks: np.ndarray, carried: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Mean distance per frame [F] between the tracks of frame 0 and their predicted points, `carried(points [P, 3])` [F, P, 3]."""
    annotated = ~np.isnan(tracks).any(axis=2)
    matched = annotated[0]
    if not matched.any():
        return np.full(len(positions), np.nan)
    error = np.linalg.norm(carried(tracks[0][matched]) - tracks[:, matched], axis=2)
    return means(error, annotated[:, matched], 0.0)


def _annotated_errors(positions: np.ndarray, observations: Observations, *, on_table: bool) -> np.ndarray | None:
    """Errors of annotated points, px or m on the table; None for captures with depth or without annotated points."""
    image = observations.image
    if image is None or not image.marked.shape[1]:
        return None
    camera = Camera("", image.width, image.height, image.intrinsics, image.camera_to_world)
    arguments = camera, positions, image.marked.astype(np.float64), observations.surface_count
    return points_on_table(*arguments, observations.scenario.up_sign) if on_table else points_in_image(*arguments)


_MM: Any = {"unit": "m", "shown_unit": "mm", "factor": 1e3, "digits": 2}
_DRAWN: Any = {"unit": "1", "of": "pictures", "average": "frames", "in_studies": True}
_ALL = (
    Metric(
        name="chamfer", title="Chamfer distance", heading="CD", **_MM, function=chamfer_per_frame, paper_name="cd", in_studies=True,
        explained="L1 Chamfer distance in one direction",
    ),
    Metric(
        name="track_error", title="track error", heading="TE", **_MM, paper_name="track_error", in_studies=True,
        function=lambda positions, seen: track_errors(positions, seen.tracks[: len(positions)]),
    ),
    Metric(
        name="track_error_bound", title="bound track error", heading="TE bound", **_MM, in_studies=True,
        function=lambda positions, seen: bound_track_errors(positions, seen.tracks[: len(positions)]),
        explained="track error of points bound to the nodes around them; 0 for every rigid motion",
    ),
    Metric(
        name="psnr", title="PSNR", heading="PSNR", paper_name="psnr", **_DRAWN | {"unit": "dB"}, shown_unit="dB", digits=3,
        relative=False, better="higher", tolerance=0.02, function="neuspring.scores.pictures:psnr_of",
    ),
    Metric(
        name="ssim", title="SSIM", heading="SSIM", paper_name="ssim", **_DRAWN, digits=4, better="higher", tolerance=5e-4,
        function="neuspring.scores.pictures:ssim_of",
    ),
    Metric(
        name="iou", title="IoU", heading="IoU", paper_name="iou", **_DRAWN, shown_unit="%", factor=100.0, digits=1,
        better="higher", tolerance=2e-3, function="neuspring.scores.pictures:iou_of",
    ),
    Metric(
        name="lpips", title="LPIPS", heading="LPIPS", paper_name="lpips", **_DRAWN, digits=4, tolerance=5e-4,
        function="neuspring.scores.pictures:lpips_of",
    ),
    Metric(
        name="image_error", title="error of annotated points in the image", heading="Marked", unit="px", shown_unit="px", digits=1,
        of="marks", tolerance=1e-3, function=functools.partial(_annotated_errors, on_table=False),
    ),
    Metric(
        name="table_error", title="error of annotated points on the table", heading="On the table", **_MM | {"digits": 1},
        of="marks", function=functools.partial(_annotated_errors, on_table=True),
    ),
)  # fmt: skip
METRICS: Registry[Metric] = Registry("metrics", {metric.name: metric for metric in _ALL}, type=Metric)
"""Metrics by name, in the order of table columns."""


def metrics_of(of: Of) -> tuple[Metric, ...]:
    """The metrics of one kind of input: positions, pictures or marks."""
    return tuple(metric for metric in METRICS.values() if metric.of == of)


def require_metrics(aims: Iterable[Aim]) -> None:
    """Raise InputError if the metric of an aim is not an error, because ratios exist only for errors."""
    for aim in aims:
        known = [metric.name for metric in METRICS.values() if metric.is_error]
        if aim.metric not in known:
            raise InputError("aims, metric", "must be an error of positions", aim.metric, f"Known: {', '.join(known)}.")


def errors_per_frame(positions: np.ndarray, observations: Observations, of: Of = "positions") -> dict[str, np.ndarray]:
    """Values per frame [T] of every applicable metric of positions (or marks), by name; positions are [T, N, 3], m."""
    measured = {metric.name: metric.measure(positions, observations) for metric in metrics_of(of)}
    return {name: values for name, values in measured.items() if values is not None}


def floors(observations: Observations) -> dict[str, float]:
    """Metrics of positions in frame 0, m: the distance of points from nodes, because frame 0 of a prediction is given.

    Metrics without a value in frame 0 are left out.
    """
    first = errors_per_frame(observations.nodes[None], observations)
    return {name: float(values[0]) for name, values in first.items() if np.isfinite(values[0])}


def task_frames(scenario: Scenario, task: str) -> range:
    """Frames of a task: reconstruction 1..train_end-1 (frame 0 is given), future train_end..T-1."""
    return range(1, scenario.train_end) if task == "reconstruction" else range(scenario.train_end, scenario.frame_count)


def last_frame_frozen(trajectory: Trajectory | None, observations: Observations) -> Trajectory:
    """Extend a trajectory to all frames by repeating its last frame; an empty trajectory repeats frame 0 of the observations."""
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
    tasks: Mapping[str, range] | None = None,
) -> pd.DataFrame:
    """Scores of a trajectory as a tidy table (`SCORE_COLUMNS`), one row per task and metric.

    `errors` is the result of `errors_per_frame`, if already computed. `tasks` maps names to frames; None: `TASKS`. A row is left
    out, never NaN, if the task has no frames, the metric has no annotation, or the rollout diverged within the task.
    """
    scenario = observations.scenario
    rows = []
    known = errors_per_frame(trajectory.positions, observations) if errors is None else errors
    per_frame = {**known, **errors_per_frame(trajectory.positions, observations, "marks")}
    for task, frames in (tasks or {task: task_frames(scenario, task) for task in TASKS}).items():
        if not len(frames) or frames[-1] >= len(trajectory.positions):
            continue
        for metric, values in per_frame.items():
            usable = values[frames.start : frames.stop]
            usable = usable[~np.isnan(usable)]
            if len(usable):
                rows.append(_score_row(scenario, method, seed, task, metric, usable))
    return _table(rows)


def _score_row(scenario: Scenario, method: str, seed: int, task: str, metric: str, values: Any) -> tuple[object, ...]:
    """One row of `SCORE_COLUMNS`: the mean of a metric's values in the frames of a task."""
    measured = float(values.mean()), METRICS[metric].unit, len(values)
    return scenario.name, scenario.category, method, seed, task, metric, *measured


def score_run(
    trajectory: Trajectory | None,
    pictures: pd.DataFrame | None,
    observations: Observations,
    method: str,
    seed: int,
    errors: Mapping[str, np.ndarray] | None = None,
) -> pd.DataFrame:
    """Scores of a prediction (`score`) and of its images (`score_images`), if any; an empty table without a prediction."""
    import pandas as pd

    if trajectory is None:
        return _table([])
    scores = score(trajectory, observations, method, seed, errors)
    if pictures is None:
        return scores
    pictured = score_images(pictures, observations.scenario, len(trajectory.positions), method, seed)
    return pd.concat([part for part in (scores, pictured) if len(part)] or [scores], ignore_index=True)


def score_images(frames: pd.DataFrame, scenario: Scenario, drawn: int, method: str, seed: int) -> pd.DataFrame:
    """Tidy scores of images from `frames` (columns frame, camera, metric, value); the prediction has `drawn` frames.

    Cameras are averaged within a frame, then frames. A task without all its frames has no row. Infinite PSNR values are left out;
    they occur if both images are black.
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
            rows.append(_score_row(scenario, method, seed, task, str(metric), per_frame))
    return _table(rows)


def averages(scores: pd.DataFrame) -> pd.DataFrame:
    """Average the scores of every method, task and metric over scenarios; seeds are averaged within each scenario first.

    - equal: scenarios weighted equally
    - frames: scenarios weighted by their frames
    - mean: the paper's choice, `equal` for distances and `frames` for images
    - seed_std: standard deviation of the equal average over the seeds that have every scenario; 0 for one seed, NaN if fewer than
      two of several seeds have every scenario
    """
    keys = ["method", "task", "metric"]
    groups = scores.groupby([*keys, "scenario"], sort=False)
    per_scenario = groups.agg(value=("value", "mean"), frames=("frames", "mean")).reset_index()
    per_scenario["weighted"] = per_scenario["value"] * per_scenario["frames"]
    total = per_scenario.groupby(keys, sort=False)
    result = total.agg(
        equal=("value", "mean"), weighted=("weighted", "sum"), all_frames=("frames", "sum"), scenarios=("scenario", "count")
    )
    result["frames"] = result.pop("weighted") / result.pop("all_frames")
    per_seed = scores.groupby([*keys, "seed"], sort=False).agg(value=("value", "mean"), scenarios=("scenario", "nunique"))
    by_seed = per_seed.groupby(level=keys)
    complete = per_seed[per_seed["scenarios"] == by_seed["scenarios"].transform("max")]
    spread = complete["value"].groupby(level=keys).std(ddof=1)
    result["seed_std"] = spread.reindex(result.index).where(by_seed.size().reindex(result.index) > 1, 0.0)
    result = result.reset_index()
    framed = result["metric"].map(lambda name: METRICS[name].average == "frames")
    return result.assign(mean=np.where(framed, result["frames"], result["equal"]))
