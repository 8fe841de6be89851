"""The metrics: what they measure, the functions that compute them, and how tables show them; averages of scores.

Chamfer distance: each visible observed point to its nearest surface node, one direction, in the L1 norm |dx| + |dy| + |dz|.
Track error: annotated tracks, matched to the nearest of all nodes at frame 0, Euclidean distance.
Both follow the released evaluation of PhysTwin. The track error has a floor, its value in frame 0. The bound track error has none:
its points move with the nodes around them (`carried`).
Metrics of pictures are computed in `pictures` and `lpips`.

A metric is one member of `METRICS` and carries its function: it is computed wherever runs are scored, and stands in all tables.

pandas and SciPy are imported where they are used, because the workflow reads the declarations at its start.
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
"""Stands for a value that there is not."""
Of = Literal["positions", "pictures", "marks"]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A metric: the function that computes it, and how tables show it."""

    name: str
    title: str
    """In words, for legends."""
    heading: str
    unit: str
    """Unit of stored values; 1 for plain numbers."""
    shown_unit: str = ""
    """In tables; empty for plain numbers."""
    factor: float = 1.0
    """From the stored unit to that of tables."""
    digits: int
    """After the point, in tables."""
    better: Literal["lower", "higher", "neither"] = "lower"
    """Values that are better; neither: tables name no best one."""
    relative: bool = True
    """True where a change in per cent means something. It does not in dB."""
    of: Of = "positions"
    """Positions of nodes in space; pictures; points that were marked in images, where there is color alone."""
    function: Callable[..., Any] | str
    """Function that computes it. Of positions and marks: (positions [F, N, 3] m, observations) -> values per frame
    [F], NaN where a frame has none, or None where the metric does not apply. Of pictures: (`pictures.Pair`, LPIPS of two pictures
    or None) -> a value or None. Text "module:name" is imported when it is first called."""
    in_studies: bool = False
    """True where tables of studies show it too."""
    average: Literal["equal", "frames"] = "equal"
    """The paper's average over scenarios: equally, or weighted by their frames."""
    tolerance: float = 1e-6
    """Largest difference, in the stored unit, from a published value of the same data that conformance checks allow.

    Distances: single precision and its order of summation. Pictures: those of the stand-in agree within 1e-6 dB with another
    drawing in double precision, while half a pixel moves them by 0.2 dB and 0.017 IoU; other rasterizers lie between.
    """
    explained: str = ""
    """In words, below the heading of summaries; empty: the title."""
    paper_name: str = ""
    """In paper_tables.csv; empty for metrics that the paper does not have."""

    def measure(self, *given: Any) -> Any:
        """Values that the function returns."""
        return (resolve_name(self.function) if isinstance(self.function, str) else self.function)(*given)

    @property
    def is_error(self) -> bool:
        """True where methods are compared by ratios."""
        return self.of == "positions" and self.better == "lower"

    @property
    def label(self) -> str:
        """For an axis: heading and unit."""
        return self.heading if self.unit == "1" else f"{self.heading} [{self.unit}]"

    @property
    def column(self) -> str:
        """The heading of a column, with the sign of plain per cents."""
        return f"{self.heading} %" if self.shown_unit == "%" else self.heading

    def text(self, value: float, sign: str = "") -> str:
        """A stored value as tables print it."""
        return self.shown(self.factor * value, sign)

    def told(self, value: float) -> str:
        """A stored value with heading and unit, for a sentence."""
        return f"{self.heading} {self.text(value)} {self.shown_unit}".rstrip()

    def shown(self, value: float, sign: str = "") -> str:
        """A value in the unit of tables as they print it; a dash for NaN."""
        return DASH if np.isnan(value) else f"{value:{sign}.{self.digits}f}"


def present(table: pd.DataFrame) -> set[tuple[str, str]]:
    """The pairs of task and metric that a table has rows of."""
    return set(zip(table["task"], table["metric"], strict=True))


def _tree(points: np.ndarray) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(points.astype(np.float64))


def _table(rows: Iterable[tuple[object, ...]]) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(rows, columns=list(SCORE_COLUMNS))


def visible_to_surface(nodes: np.ndarray, points: np.ndarray, visible: np.ndarray, surface: int) -> float:
    """Mean L1 distance, m, from the visible points [P, 3] to the first `surface` nodes [N, 3]. NaN where no point is visible."""
    if not len(seen := points[visible].astype(np.float64)):
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


def bound_track_errors(positions: np.ndarray, tracks: np.ndarray, neighbors: int = CARRIERS) -> np.ndarray:
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
    return means(error, annotated[:, matched], 0.0)


def _of_marks(positions: np.ndarray, observations: Observations, *, on_table: bool) -> np.ndarray | None:
    """Errors of marked points, px or m on the table; None for captures with depth, and where no point was marked."""
    image = observations.image
    if image is None or not image.marked.shape[1]:
        return None
    camera = Camera("", image.width, image.height, image.intrinsics, image.camera_to_world)
    seen = camera, positions, image.marked.astype(np.float64), observations.surface_count
    return points_on_table(*seen, observations.scenario.up_sign) if on_table else points_in_image(*seen)


_MM: Any = {"unit": "m", "shown_unit": "mm", "factor": 1e3, "digits": 2}
_DRAWN: Any = {"unit": "1", "of": "pictures", "average": "frames", "in_studies": True}
_ALL = (
    Metric(
        name="chamfer", title="Chamfer distance", heading="CD", **_MM, function=chamfer_per_frame, paper_name="cd", in_studies=True,
        explained="single-directional L1 Chamfer",
    ),
    Metric(
        name="track_error", title="track error", heading="TE", **_MM, paper_name="track_error", in_studies=True,
        function=lambda positions, seen: track_errors(positions, seen.tracks[: len(positions)]),
    ),
    Metric(
        name="track_error_bound", title="bound track error", heading="TE bound", **_MM, in_studies=True,
        function=lambda positions, seen: bound_track_errors(positions, seen.tracks[: len(positions)]),
        explained="track error of points bound to the nodes around them, 0 for any rigid motion",
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
        name="image_error", title="error of marked points in the image", heading="Marked", unit="px", shown_unit="px", digits=1,
        of="marks", tolerance=1e-3, function=functools.partial(_of_marks, on_table=False),
    ),
    Metric(
        name="table_error", title="error of marked points that lie on the table", heading="On the table", **_MM | {"digits": 1},
        of="marks", function=functools.partial(_of_marks, on_table=True),
    ),
)  # fmt: skip
METRICS: Registry[Metric] = Registry("metrics", {metric.name: metric for metric in _ALL}, type=Metric)
"""By name, in the order of rows of scores and of columns."""


def metrics_of(of: Of) -> tuple[Metric, ...]:
    """The metrics of positions, of pictures, or of marked points."""
    return tuple(metric for metric in METRICS.values() if metric.of == of)


def require_metrics(aims: Iterable[Aim]) -> None:
    """Raise InputError where an aim names no error, of which alone there are ratios."""
    for aim in aims:
        known = [metric.name for metric in METRICS.values() if metric.is_error]
        if aim.metric not in known:
            raise InputError("aims, metric", "must be an error of positions", aim.metric, f"Known: {', '.join(known)}.")


def errors_per_frame(positions: np.ndarray, observations: Observations, of: Of = "positions") -> dict[str, np.ndarray]:
    """Every metric of positions (or marks) that applies, per frame [T], by its name; positions [T, N, 3], m."""
    found = {metric.name: metric.measure(positions, observations) for metric in metrics_of(of)}
    return {name: values for name, values in found.items() if values is not None}


def floors(observations: Observations) -> dict[str, float]:
    """Metrics of positions in frame 0, m, where the prediction is given: they measure how far points are from nodes, and no motion.

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
    tasks: Mapping[str, range] | None = None,
) -> pd.DataFrame:
    """Tidy scores, one row per task and metric; `errors` are `errors_per_frame`, where they are known already.

    `tasks` maps names to the frames that they average over; None: `TASKS`. There is no row, and never NaN, for a task without
    frames, a metric without annotation, a task that the rollout diverged in.
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
    """`SCORE_COLUMNS` of the values of a metric in the frames of a task."""
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
            rows.append(_score_row(scenario, method, seed, task, str(metric), per_frame))
    return _table(rows)


def averages(scores: pd.DataFrame) -> pd.DataFrame:
    """Both averages over scenarios of every method, task and metric.

    `equal` weighs scenarios equally, `frames` weighs them by their frames.
    The paper uses the first for distances and the second for pictures: that is `mean`. Seeds are
    averaged within each scenario first. `seed_std` is the standard deviation over seeds of the equal average, of the seeds
    that have every scenario: 0 for one seed, NaN where there are several seeds and fewer than two of them have every scenario.
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
