"""Curves of search costs, losses, and errors over time: a panel per scenario with a line per method, drawn on white as SVG."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from neuspring.core.artifacts import Observations, Scenario, Trajectory
from neuspring.core.records import StageRecord
from neuspring.report.blocks import Block, Fold, Grid, Legend, Picture, Section, Text
from neuspring.report.page.material import UNREADABLE, FinishedRun, ReportData
from neuspring.scores.metrics import METRICS, bound_track_errors, track_errors

COLORS = ("#2f7ed8", "#d9731a", "#2a9d5c", "#a05cc4", "#c94f7c", "#8a7a2e", "#1f9aa8", "#8d6a57")
"""Of methods."""
DASHES = (("-", ""), ((0, (5, 2)), "7 3"), ((0, (1.5, 1.5)), "2 2"), ((0, (6, 2, 1.5, 2)), "8 3 2 3"))
"""Line styles for matplotlib and for SVG. Each is used with all colors before the next one."""
STYLE = {
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
}


def line_style(index: int) -> tuple[str, tuple[object, str]]:
    """Color, and line style for (matplotlib, SVG), of the i-th line."""
    return COLORS[index % len(COLORS)], DASHES[(index // len(COLORS)) % len(DASHES)]


@contextmanager
def styled() -> Iterator[None]:
    """Figures made here fit the page."""
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        yield


def svg(figure: Figure, caption: str, alt: str) -> Picture:
    """The figure as a picture; equal figures have equal bytes."""
    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": alt, "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return Picture(caption=caption, alt=alt, data=f"data:image/svg+xml;base64,{data}", paper=True)


def thinned(count: int, most: int = 120) -> Sequence[int]:
    """Indices of at most `most` of `count` points, the ends included."""
    if count <= most:
        return range(count)
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


PENALTY = 1e3
"""Costs above this stand for candidates that could not be simulated."""
PANEL = (3.3, 2.1)
FRAME = (0.16, 0.11, 0.77, 0.83)
"""Place of the axes in a panel. It is fixed because a computed layout takes most of the time."""
FAINT = 0.5
MOST_OPEN = 6
"""The panels of more scenarios than this are folded."""


@dataclass(frozen=True, kw_only=True)
class Curves:
    """The lines of one panel."""

    by_name: Mapping[str, Mapping[int, pd.Series]]
    """Name of the line, seed, values."""
    future: Scenario | None = None
    """The scenario whose future is marked, if any."""


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A kind of panel."""

    title: str
    about: str
    collect: Callable[[ReportData, str], Curves]
    """Reads the curves of a scenario."""
    of_methods: bool = True
    """Whether its lines are methods, which have the same style in all plots."""
    open: bool = False
    """Shown without a click, however many panels there are."""


def curves_section(material: ReportData) -> Section:
    """Error, search, fit and training curves of the shown methods."""
    scenarios = [name for name in material.choice.scenarios if material.first_runs(name)]
    if not scenarios:
        return Section(key="curves", title="Curves", blocks=[Text(text="No run has finished.", tone="mute")])
    blocks = [block for plot in PLOTS for block in _plot(material, plot, scenarios)]
    return Section(key="curves", title="Curves", about=_about(material), blocks=blocks)


def _plot(material: ReportData, plot: Plot, scenarios: Iterable[str]) -> list[Block]:
    """A panel per scenario; nothing if no scenario has such curves."""
    panels = {scenario: plot.collect(material, scenario) for scenario in scenarios}
    panels = {scenario: curves for scenario, curves in panels.items() if curves.by_name}
    if not panels:
        return []
    order = {name: index for index, name in enumerate(material.choice.shown)} if plot.of_methods else {}
    lines = sorted({name for curves in panels.values() for name in curves.by_name}, key=lambda name: (order.get(name, 0), name))
    styles = {name: line_style(order.get(name, index)) for index, name in enumerate(lines)}
    legend = Legend(entries=[(name, color, dash[1]) for name, (color, dash) in styles.items()])
    pictures = [_panel(curves, styles, scenario, plot.title) for scenario, curves in panels.items()]
    inner: list[Block] = [Text(text=plot.about), legend, Grid(blocks=pictures)]
    return [Fold(summary=plot.title, blocks=inner, open=plot.open or len(pictures) <= MOST_OPEN)]


def _about(material: ReportData) -> str:
    shown, methods = material.choice.shown, material.choice.methods
    return "" if len(shown) == len(methods) else f"{len(shown)} of {len(methods)} methods are drawn: {', '.join(shown)}."


def _search_row(run: FinishedRun) -> str:
    """Name of the search that a run started from."""
    place = run.record.histories.get("search", "")
    parts = [part for part in Path(place).parts if part.startswith("search-")]
    return parts[0].removeprefix("search-") if parts else ""


def _history(material: ReportData, run: FinishedRun, stage: str, metric: str) -> pd.Series | None:
    """Values of a metric by step; None if the run has none."""
    name = run.record.histories.get(stage)
    if not name:
        return None
    path = (run.folder / name).resolve()
    try:
        table = pd.read_parquet(path, columns=["step", "metric", "value"])
        values = table.loc[table["metric"] == metric].set_index("step")["value"].astype(float)
    except UNREADABLE as error:
        material.lost(path, error)
        return None
    return values if len(values) else None


def _search(material: ReportData, scenario: str) -> Curves:
    by_name: dict[str, dict[int, pd.Series]] = {}
    for run in (run for method in material.choice.shown for run in material.runs_of(scenario, method)):
        name = _search_row(run)
        if not name or run.seed in by_name.get(name, {}):
            continue
        values = _history(material, run, "search", "best_cost")
        values = None if values is None else values[values < PENALTY]
        if values is not None and len(values):
            by_name.setdefault(name, {})[run.seed] = values
    return Curves(by_name=by_name)


def _losses(stage: str) -> Callable[[ReportData, str], Curves]:
    """Collects the losses of a stage."""

    def collect(material: ReportData, scenario: str) -> Curves:
        by_name: dict[str, dict[int, pd.Series]] = {}
        for method in material.choice.shown:
            for run in material.runs_of(scenario, method):
                values = _history(material, run, stage, "loss")
                if values is not None:
                    by_name.setdefault(method, {})[run.seed] = values
        return Curves(by_name=by_name)

    return collect


def _errors(metric: str) -> Callable[[ReportData, str], Curves]:
    """Collects a track error of the first run of every method, from its trajectory."""

    def collect(material: ReportData, scenario: str) -> Curves:
        runs = {method: run for method, run in material.first_runs(scenario).items() if run.record.ok}
        place = material.results / scenario / "observations.npz"
        if not runs or not place.is_file():
            return Curves(by_name={})
        try:
            observations = Observations.load(place)
        except UNREADABLE as error:
            material.lost(place, error)
            return Curves(by_name={})
        facts, by_name = observations.scenario, {}
        for method, run in runs.items():
            values = _track_error(material, run, observations.tracks, metric)
            if values is not None:
                values = METRICS[metric].factor * values
                by_name[method] = {run.seed: pd.Series(values, index=np.arange(len(values)) / facts.frame_rate)}
        return Curves(by_name=by_name, future=facts)

    return collect


def _track_error(material: ReportData, run: FinishedRun, tracks: np.ndarray, metric: str) -> np.ndarray | None:
    record = run.file("records", "rollout")
    if record is None:
        return None
    try:
        stage = StageRecord.load(record)
        if "trajectory" not in stage.files:
            return None
        positions = Trajectory.load(record.parent / stage.files["trajectory"][0]).positions
        values = TRACK_ERRORS[metric](positions, tracks[: len(positions)])
    except UNREADABLE as error:
        material.lost(record, error)
        return None
    return None if np.isnan(values).all() else values


TRACK_ERRORS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "track_error": track_errors,
    "track_error_bound": bound_track_errors,
}
PLOTS = (
    Plot(
        title="Track error over time",
        about="Track error in mm over time in s, one seed. Gray: the future, which no method has seen.",
        collect=_errors("track_error"),
        open=True,
    ),
    Plot(
        title="Bound track error over time",
        about="The same for points that move with the nodes around them, in mm: it begins at 0.",
        collect=_errors("track_error_bound"),
    ),
    Plot(
        title="Search: best cost",
        about="Over candidate rollouts; thin: other seeds. Methods that share a search have one curve.",
        collect=_search,
        of_methods=False,
    ),
    Plot(
        title="Fit: loss",
        about="In m², over epochs; thin: other seeds. Losses of methods with other horizons differ in height.",
        collect=_losses("fit"),
    ),
    Plot(
        title="Training of baselines: loss",
        about="Over epochs or iterations; thin: other seeds. Every model has its own loss, so the heights of models "
        "cannot be compared.",
        collect=_losses("train"),
    ),
)


def _panel(curves: Curves, styles: Mapping[str, Any], scenario: str, title: str) -> Picture:
    future = curves.future
    with styled():
        figure = Figure(figsize=PANEL)
        axis = figure.add_axes(FRAME)
        for name in reversed(list(curves.by_name)):
            _lines(axis, curves.by_name[name], *styles[name])
        if future is not None:
            end = future.frame_count / future.frame_rate
            axis.axvspan(future.train_end / future.frame_rate, end, color="#888", alpha=0.18, lw=0)
            axis.set_xlim(0, end)
        _scale(axis, log=future is None)
        axis.tick_params(length=2.5, width=0.6)
        return svg(figure, scenario, f"{title}, {scenario}: {', '.join(curves.by_name)}")


def _lines(axis: Axes, by_seed: Mapping[int, pd.Series], color: str, dash: tuple[Any, str]) -> None:
    for index, values in enumerate(by_seed.values()):
        steps = list(thinned(len(values)))
        style: dict[str, Any] = {"color": color, "ls": dash[0], "lw": 0.8 if index else 1.5, "alpha": FAINT if index else 1.0}
        style["marker"] = "o" if len(steps) == 1 else ""
        axis.plot(values.index[steps], values.to_numpy()[steps], ms=3, **style)


def _scale(axis: Axes, *, log: bool) -> None:
    """A log axis where values span at least a factor of 2; else an axis from zero."""
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axis.lines])
    values = values[np.isfinite(values)]
    if log and len(values) and values.min() > 0 and values.max() >= 2 * values.min():
        axis.set_yscale("log")
        subs = (1.0,) if values.max() > 100 * values.min() else (1.0, 2.0, 5.0)
        axis.yaxis.set_major_locator(LogLocator(subs=subs, numticks=6))
        axis.yaxis.set_minor_locator(NullLocator())
    else:
        axis.set_ylim(0, None)
        axis.yaxis.set_major_locator(MaxNLocator(5))
    # Labels without mathematics are drawn faster.
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axis.yaxis.set_minor_formatter(NullFormatter())


def _short(value: float) -> str:
    """10, 0.2, 3e−5."""
    if not value or abs(value) >= 0.01:
        return f"{value:g}".replace("-", "−")
    digits, _, power = f"{value:.1e}".partition("e")
    return f"{digits.removesuffix('.0')}e{int(power)}".replace("-", "−")
