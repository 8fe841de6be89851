"""Curves: what the search found, how fits went, and errors over the frames; a panel per scenario, methods over one another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from neuspring.core.artifacts import Observations, Scenario, Trajectory
from neuspring.core.records import StageRecord
from neuspring.report.page import draw
from neuspring.report.page.blocks import Block, Drawing, Fold, Grid, Legend, Section, Text
from neuspring.report.page.sources import UNREADABLE, Material, Run
from neuspring.scores.metrics import track_errors

PENALTY = 1e3
"""Costs above stand for candidates that could not be simulated."""
MM = 1e3
PANEL = (3.3, 2.1)
FRAME = (0.16, 0.11, 0.77, 0.83)
"""Of the axes in a panel; a layout that is computed takes most of the time."""
FAINT = 0.5
MOST_OPEN = 6
"""Scenarios whose panels are shown at once; more are folded."""


@dataclass(frozen=True, kw_only=True)
class Curves:
    """What one panel shows: name -> seed -> values; the scenario's times if its future is marked."""

    by_name: Mapping[str, Mapping[int, pd.Series]]
    future: Scenario | None = None


def section(material: Material) -> Section:
    """Error, search, fit and training curves of the drawn methods."""
    scenarios = [name for name in material.choice.scenarios if material.first_runs(name)]
    if not scenarios:
        return Section(key="curves", title="Curves", blocks=[Text(text="No run has finished.", tone="mute")])
    blocks: list[Block] = []
    for collect, title, about in (
        (
            _errors,
            "Track error over time",
            "Track error in mm over time in s, one seed. Grey: the future, which no method has seen.",
        ),
        (_search, "Search: best cost", "Over candidate rollouts; thin: other seeds. Methods that share a search have one curve."),
        (_fit, "Fit: loss", "In m², over epochs; thin: other seeds. Losses of methods with other horizons differ in height."),
        (
            _train,
            "Training of baselines: loss",
            "Over epochs or iterations; thin: other seeds. Every model has a loss of its own: heights tell nothing across models.",
        ),
    ):
        found = {scenario: collect(material, scenario) for scenario in scenarios}
        found = {scenario: curves for scenario, curves in found.items() if curves.by_name}
        if not found:
            continue
        present = {name for curves in found.values() for name in curves.by_name}
        methods = material.choice.shown
        # A method has the same line in all drawings.
        order = {name: methods.index(name) for name in methods} if collect is not _search else {}
        names = sorted(present, key=lambda name: (order.get(name, 0), name))
        styles = {name: draw.line_style(order.get(name, index)) for index, name in enumerate(names)}
        legend = Legend(entries=[(name, colour, dash[1]) for name, (colour, dash) in styles.items()])
        panels = [_panel(curves, styles, scenario, title) for scenario, curves in found.items()]
        inner: list[Block] = [Text(text=about), legend, Grid(blocks=panels)]
        blocks.append(Fold(summary=title, blocks=inner, open=len(panels) <= MOST_OPEN or collect is _errors))
    return Section(key="curves", title="Curves", about=_about(material), blocks=blocks)


def _about(material: Material) -> str:
    drawn, all_ = len(material.choice.shown), len(material.choice.methods)
    return "" if drawn == all_ else f"{drawn} of {all_} methods are drawn: {', '.join(material.choice.shown)}."


def _search_row(run: Run) -> str:
    """Name of the search that a run started from."""
    place = run.record.histories.get("search", "")
    parts = [part for part in Path(place).parts if part.startswith("search-")]
    return parts[0].removeprefix("search-") if parts else ""


def _own(material: Material, scenario: str, method: str) -> list[Run]:
    return [run for run in material.runs if run.scenario == scenario and run.method == method]


def _history(material: Material, run: Run, stage: str, metric: str) -> pd.Series | None:
    """Values by step; None if the run has none."""
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


def _search(material: Material, scenario: str) -> Curves:
    found: dict[str, dict[int, pd.Series]] = {}
    for run in (run for method in material.choice.shown for run in _own(material, scenario, method)):
        name = _search_row(run)
        if not name or run.seed in found.get(name, {}):
            continue
        values = _history(material, run, "search", "best_cost")
        values = None if values is None else values[values < PENALTY]
        if values is not None and len(values):
            found.setdefault(name, {})[run.seed] = values
    return Curves(by_name=found)


def _fit(material: Material, scenario: str) -> Curves:
    return _losses(material, scenario, "fit")


def _train(material: Material, scenario: str) -> Curves:
    return _losses(material, scenario, "train")


def _losses(material: Material, scenario: str, stage: str) -> Curves:
    found: dict[str, dict[int, pd.Series]] = {}
    for method in material.choice.shown:
        for run in _own(material, scenario, method):
            values = _history(material, run, stage, "loss")
            if values is not None:
                found.setdefault(method, {})[run.seed] = values
    return Curves(by_name=found)


def _errors(material: Material, scenario: str) -> Curves:
    """Track error of the first run of every method, from its trajectory."""
    runs = {method: run for method, run in material.first_runs(scenario).items() if run.ok}
    place = material.results / scenario / "observations.npz"
    if not runs or not place.is_file():
        return Curves(by_name={})
    try:
        facts, tracks = _tracks(place)
    except UNREADABLE as error:
        material.lost(place, error)
        return Curves(by_name={})
    found: dict[str, dict[int, pd.Series]] = {}
    for method, run in runs.items():
        values = _track_error(material, run, tracks)
        if values is not None:
            found[method] = {run.seed: pd.Series(MM * values, index=np.arange(len(values)) / facts.frame_rate)}
    return Curves(by_name=found, future=facts)


def _tracks(path: Path) -> tuple[Scenario, np.ndarray]:
    observations = Observations.load(path)
    return observations.scenario, observations.tracks


def _track_error(material: Material, run: Run, tracks: np.ndarray) -> np.ndarray | None:
    record = run.file("records", "rollout")
    if record is None:
        return None
    try:
        stage = StageRecord.load(record)
        if "trajectory" not in stage.files:
            return None
        positions = Trajectory.load(record.parent / stage.files["trajectory"][0]).positions
        values = track_errors(positions, tracks[: len(positions)])
    except UNREADABLE as error:
        material.lost(record, error)
        return None
    return None if np.isnan(values).all() else values


def _panel(curves: Curves, styles: Mapping[str, Any], scenario: str, title: str) -> Drawing:
    future = curves.future
    with draw.styled():
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
        picture = draw.svg(figure, f"{title} {scenario}", f"{title}, {scenario}: {', '.join(curves.by_name)}")
    return Drawing(svg=picture, caption=scenario)


def _lines(axis: Axes, by_seed: Mapping[int, pd.Series], colour: str, dash: tuple[Any, str]) -> None:
    for index, values in enumerate(by_seed.values()):
        kept = list(draw.thinned(len(values)))
        style: dict[str, Any] = {"color": colour, "ls": dash[0], "lw": 0.8 if index else 1.5, "alpha": FAINT if index else 1.0}
        style["marker"] = "o" if len(kept) == 1 else ""
        axis.plot(values.index[kept], values.to_numpy()[kept], ms=3, **style)


def _scale(axis: Axes, *, log: bool) -> None:
    """A log axis only where values span enough to need one; else from zero."""
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
