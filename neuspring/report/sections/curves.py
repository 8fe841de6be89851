"""Curves of errors over time, search costs and losses: a panel per scenario with a line per method, drawn on white as SVG."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from neuspring.core.artifacts import Observations, Scenario, Trajectory
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RunRecord
from neuspring.report.blocks import Block, Fold, Grid, Legend, PageSection, Picture, Text
from neuspring.report.data import ReportData, ReportSection, data_uri
from neuspring.scores.metrics import METRICS, bound_track_errors, track_errors

LINE_COLORS = ("#2f7ed8", "#d9731a", "#2a9d5c", "#a05cc4", "#c94f7c", "#8a7a2e", "#1f9aa8", "#8d6a57")
LINE_DASHES = ("", "7 3", "2 2", "8 3 2 3")
"""Dash patterns, px. Each is used with all colors before the next one."""
STYLE: Any = {"svg.fonttype": "none", "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7}
PANEL, FRAME = (3.3, 2.1), (0.16, 0.11, 0.77, 0.83)
"""Size, inches, and place of the axes in a panel, which is fixed because a computed layout takes most of the time."""
DIVERGED_COST = 1e3
"""Costs above this stand for candidates that could not be simulated."""
LINE_POINTS = 120
"""Most points of a line."""
CURVE_ERRORS = {"track_error": track_errors, "track_error_bound": bound_track_errors}
PLOTS = (
    (
        "Track error over time",
        "track_error",
        "Track error in mm over time in s, one seed. Gray: the future, which no method has seen.",
    ),
    (
        "Bound track error over time",
        "track_error_bound",
        "The same for points that move with the nodes around them, in mm: it begins at 0.",
    ),
    ("Search: best cost", "search", "Over candidate rollouts; thin: other seeds. Methods that share a search have one curve."),
    ("Fit: loss", "fit", "In mm², over epochs; thin: other seeds. Losses of methods with other horizons differ in height."),
    (
        "Training of baselines: loss",
        "train",
        "Over epochs or iterations; thin: other seeds. Every model has its own loss, so the heights of models cannot be compared.",
    ),
)
"""Title, what is drawn (an error, or the history of a stage), and how to read it."""
Lines = Mapping[str, Mapping[int, pd.Series]]
"""Name and seed to values."""


def curves(material: ReportData) -> PageSection:
    """Error, search, fit and training curves of the shown methods."""
    scenarios = [name for name in material.choice.scenarios if material.first_runs(name)]
    if not scenarios:
        return PageSection(key="curves", title="Curves", blocks=[Text(text="No run has finished.", tone="mute")])
    shown, methods = material.choice.shown, material.choice.methods
    drawn = ", ".join(map(material.numbers.name, shown))
    about = "" if len(shown) == len(methods) else f"{len(shown)} of {len(methods)} methods are drawn: {drawn}."
    seen = {scenario: _observations(material, scenario) for scenario in scenarios}
    blocks: list[Block] = []
    for title, what, text in PLOTS:
        lines = {scenario: _lines(material, scenario, what, seen[scenario]) for scenario in scenarios}
        lines = {scenario: own for scenario, own in lines.items() if own}
        if not lines:
            continue
        # Methods have the same style in all plots; the lines of searches are not methods.
        order = {name: index for index, name in enumerate(shown)} if what != "search" else {}
        names = sorted({name for own in lines.values() for name in own}, key=lambda name: (order.get(name, 0), name))
        index = {name: order.get(name, place) for place, name in enumerate(names)}
        styles = {
            name: (LINE_COLORS[i % len(LINE_COLORS)], LINE_DASHES[i // len(LINE_COLORS) % len(LINE_DASHES)])
            for name, i in index.items()
        }
        legend = Legend(entries=[(material.numbers.name(name), *style) for name, style in styles.items()])
        pictures = []
        for scenario, own in lines.items():
            future = observed.scenario if what in CURVE_ERRORS and (observed := seen[scenario]) else None
            pictures.append(_panel(own, styles, future, scenario, f"{title}, {scenario}: {', '.join(own)}"))
        is_open = what == "track_error"
        blocks.append(Fold(summary=title, blocks=[Text(text=text), legend, Grid(blocks=pictures)], open=is_open))
    return PageSection(key="curves", title="Curves", about=about, blocks=blocks)


def _observations(material: ReportData, scenario: str) -> Observations | None:
    place = material.results / scenario / "observations.npz"
    return material.read(place, Observations.load) if place.is_file() else None


def _lines(material: ReportData, scenario: str, what: str, observations: Observations | None) -> Lines:
    """The lines of a scenario: an error of the first run of every shown method, or the history of a stage in all runs."""
    lines: dict[str, dict[int, pd.Series]] = {}
    first = material.first_runs(scenario)
    for method in first:
        for run in [first[method]] if what in CURVE_ERRORS else material.runs_of(scenario, method):
            name = _search_row(run) if what == "search" else method
            if not name or run.seed in lines.get(name, {}):
                continue
            values = _error(material, run, what, observations) if what in CURVE_ERRORS else _history(material, run, what)
            if values is not None and len(values):
                lines.setdefault(name, {})[run.seed] = values
    return lines


def _search_row(run: RunRecord) -> str:
    """Name of the search that a run started from."""
    parts = Path(run.histories.get("search", "")).parts
    return next((part.removeprefix("search-") for part in parts if part.startswith("search-")), "")


def _history(material: ReportData, run: RunRecord, stage: str) -> pd.Series | None:
    """Losses or best costs by step; None if the run has none."""
    if not run.histories.get(stage):
        return None

    def read(path: Path) -> pd.Series:
        table = pd.read_parquet(path, columns=["step", "metric", "value"])
        own = table["metric"] == ("best_cost" if stage == "search" else "loss")
        values = table.loc[own].set_index("step")["value"].astype(float)
        return values[values < DIVERGED_COST] if stage == "search" else 1e6 * values if stage == "fit" else values

    return material.read((material.folder(run) / run.histories[stage]).resolve(), read)


def _error(material: ReportData, run: RunRecord, metric: str, observations: Observations | None) -> pd.Series | None:
    """A track error over seconds, mm; None if the run has no trajectory or no track is annotated."""
    record = material.file(run, "records", "rollout")
    if record is None or observations is None or not run.ok:
        return None

    def read(path: Path) -> pd.Series | None:
        stage = StageRecord.load(path)
        if "trajectory" not in stage.files:
            return None
        positions = Trajectory.load(path.parent / stage.files["trajectory"][0]).positions
        values = METRICS[metric].factor * CURVE_ERRORS[metric](positions, observations.tracks[: len(positions)])
        seconds = np.arange(len(values)) / observations.scenario.frame_rate
        return None if np.isnan(values).all() else pd.Series(values, index=seconds)

    return material.read(record, read)


def _panel(lines: Lines, styles: Mapping[str, Any], future: Scenario | None, caption: str, alt: str) -> Picture:
    """Lines as a picture; errors over time, with the future in gray, if that is given. Equal lines have equal bytes."""
    with matplotlib.rc_context(STYLE | {"svg.hashsalt": alt}):
        figure = Figure(figsize=PANEL)
        axis = figure.add_axes(FRAME)
        for name in reversed(list(lines)):
            for index, values in enumerate(lines[name].values()):
                steps = np.unique(np.linspace(0, len(values) - 1, LINE_POINTS).round().astype(int))
                color, dash = styles[name]
                style: Any = {"color": color, "ls": (0, [float(part) / 1.4 for part in dash.split()]) if dash else "-"}
                style |= {"lw": 0.8, "alpha": 0.5} if index else {"lw": 1.5}
                dot = "o" if len(steps) == 1 else ""
                axis.plot(values.index[steps], values.to_numpy()[steps], marker=dot, ms=3, **style)
        if future is not None:
            end = future.frame_count / future.frame_rate
            axis.axvspan(future.train_end / future.frame_rate, end, color="#888", alpha=0.18, lw=0)
            axis.set_xlim(0, end)
        drawn = np.concatenate([np.asarray(line.get_ydata(), float) for line in axis.lines])
        drawn = drawn[np.isfinite(drawn)]
        low, high = (drawn.min(), drawn.max()) if len(drawn) else (0.0, 0.0)
        if future is None and 0 < 2 * low <= high:
            axis.set_yscale("log")
            axis.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0), numticks=6))
            axis.yaxis.set_minor_locator(NullLocator())
        else:
            axis.set_ylim(0, None)
            axis.yaxis.set_major_locator(MaxNLocator(5))
        # Labels without mathematics are drawn faster.
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}".replace("-", "−")))
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.tick_params(length=2.5, width=0.6)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Picture(caption=caption, alt=alt, data=data_uri("image/svg+xml", stream.getvalue()), paper=True)


section = ReportSection(order=40, make=curves)
