"""Pictures of a sweep: how the loss fell, what each setting does to it, which trials were pruned when."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.ticker import MaxNLocator

from neuspring.config.tuning import Dimension
from neuspring.core.records import canonical
from neuspring.report.figures.views import save

LOSS = "loss of the tail [m²]"
COLORS = {"complete": "tab:blue", "pruned": "tab:orange", "failed": "tab:red"}
PANELS_PER_ROW = 4
LOG_FROM = 3.0
"""A loss has a log axis if its largest value is at least this many times its smallest."""


def history_figure(table: pd.DataFrame, path: Path) -> Path:
    """Loss of every trial, the smallest loss so far, and a line at that of the baseline, trial 0."""
    figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
    _points(axis, table, table["trial"].to_numpy(float))
    done = table[table["state"] == "complete"]
    axis.step(done["trial"], done["loss"].cummin(), where="post", color="tab:blue", lw=1.2, label="best so far")
    _baseline(axis, table)
    _scale(axis, table["loss"])
    axis.set(xlabel="trial", ylabel=LOSS)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.legend(frameon=False, fontsize=8)
    return save(figure, path)


def slices_figure(table: pd.DataFrame, space: Mapping[str, Dimension], path: Path) -> Path:
    """Loss against each setting by itself."""
    table = table[table["state"].isin(list(COLORS))]
    columns = min(len(space), PANELS_PER_ROW)
    rows = math.ceil(len(space) / columns)
    size = (2.9 * columns + 0.8, 2.8 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, sharey=True)
    for axis, (name, dimension) in zip(axes.flat, space.items(), strict=False):
        _points(axis, table, _places(table[name], dimension, axis))
        _baseline(axis, table)
        _scale(axis, table["loss"])
        axis.set_xlabel(name)
    for axis in axes.flat[len(space) :]:
        axis.remove()
    for row in axes:
        row[0].set_ylabel(LOSS)
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside upper right", ncols=4, frameon=False, fontsize=8)
    return save(figure, path)


def parallel_figure(table: pd.DataFrame, space: Mapping[str, Dimension], path: Path) -> Path:
    """A line per finished trial through its settings, colored by its loss, the best ones on top."""
    done = table[table["state"] == "complete"].sort_values("loss", ascending=False)
    figure, axis = plt.subplots(figsize=(1.6 * len(space) + 2.4, 3.8), layout="constrained")
    heights = np.stack([_heights(done[name], dimension) for name, dimension in space.items()], axis=1)
    low, high = (done["loss"].min(), done["loss"].max()) if len(done) else (1.0, 1.0)
    norm = LogNorm(low, high) if 0 < low < high else Normalize(low, high)
    colors = matplotlib.colormaps["viridis"]
    for line, loss in zip(heights, done["loss"], strict=True):
        axis.plot(range(len(space)), line, color=colors(norm(loss)), lw=1.2)
    for place, dimension in enumerate(space.values()):
        axis.axvline(place, color="0.3", lw=0.8)
        for text, height in _marks(dimension):
            axis.annotate(text, (place, height), xytext=(3, 0), textcoords="offset points", fontsize=7, va="center", color="0.2")
    axis.set_xticks(range(len(space)), list(space), rotation=20, ha="right", fontsize=8)
    axis.set(ylim=(-0.05, 1.05), yticks=[])
    figure.colorbar(matplotlib.cm.ScalarMappable(norm, colors), ax=axis, label=LOSS)
    return save(figure, path)


def importances_figure(importances: Mapping[str, float], path: Path) -> Path:
    """A bar per setting."""
    figure, axis = plt.subplots(figsize=(6, 0.32 * len(importances) + 1.1), layout="constrained")
    bars = axis.barh(list(importances)[::-1], list(importances.values())[::-1], color="tab:blue")
    axis.bar_label(bars, fmt="%.2f", padding=3, fontsize=8)
    axis.set(xlabel="importance (PED-ANOVA, sum 1)", xlim=(0, 1.12 * max(importances.values())))
    return save(figure, path)


def steps_figure(
    table: pd.DataFrame, steps: Mapping[int, Sequence[tuple[int, float]]], scenes: Sequence[str], epochs: int, path: Path
) -> Path:
    """The values that pruning compares: mean loss of the scenarios begun so far, epoch by epoch, scenario after scenario."""
    figure, axis = plt.subplots(figsize=(8, 3.8), layout="constrained")
    states = dict(zip(table["trial"], table["state"], strict=True))
    for trial, values in steps.items():
        state = states.get(trial)
        if state not in COLORS or not values:
            continue
        color, label = COLORS[state], "finished" if state == "complete" else state
        if trial == 0:
            color, label = "black", "unchanged configuration"
        axis.plot(*zip(*values, strict=True), color=color, lw=1.0, alpha=0.8, marker=".", ms=3, label=label)
    for index, name in enumerate(scenes):
        if index:
            axis.axvline(index * epochs - 0.5, color="0.8", lw=0.8)
        axis.annotate(name, (index * epochs, 1), (2, -2), ("data", "axes fraction"), "offset points", fontsize=7, va="top")
    _scale(axis, pd.Series([value for values in steps.values() for _, value in values], dtype=float))
    axis.set(xlabel="epoch, counted through the scenarios", ylabel="mean " + LOSS)
    # One entry of each kind.
    handles = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    axis.legend(handles.values(), handles.keys(), frameon=False, fontsize=8)
    return save(figure, path)


def _points(axis: Axes, table: pd.DataFrame, places: np.ndarray) -> None:
    """Finished trials at their loss; others on the upper edge, since their losses cannot be compared."""
    done = (table["state"] == "complete").to_numpy()
    axis.scatter(places[done], table.loc[done, "loss"], color=COLORS["complete"], s=16, label="finished")
    for state in ("pruned", "failed"):
        ended = places[(table["state"] == state).to_numpy()]
        if len(ended):
            edge = axis.get_xaxis_transform()
            axis.plot(ended, np.ones(len(ended)), "x", color=COLORS[state], ms=4, transform=edge, clip_on=False, label=state)


def _baseline(axis: Axes, table: pd.DataFrame) -> None:
    first = table[(table["trial"] == 0) & (table["state"] == "complete")]
    if len(first):
        axis.axhline(first["loss"].iloc[0], color="0.4", lw=0.8, ls="--", label="unchanged configuration")


def _scale(axis: Axes, losses: pd.Series) -> None:
    losses = losses.dropna()
    if len(losses) and losses.min() > 0 and losses.max() >= LOG_FROM * losses.min():
        axis.set_yscale("log")


def _places(values: pd.Series, dimension: Dimension, axis: Axes) -> np.ndarray:
    """Positions of values on an axis, which is set up for them; choices stand side by side."""
    if dimension.choices:
        labels = [_text(value) for value in dimension.choices]
        shown = [*labels, *dict.fromkeys(text for text in map(_text, values) if text not in labels)]
        axis.set_xticks(range(len(shown)), shown, rotation=20 if max(map(len, shown)) > 6 else 0)
        axis.set_xlim(-0.5, len(shown) - 0.5)
        return np.array([shown.index(_text(value)) for value in values], dtype=float)
    if dimension.log:
        axis.set_xscale("log")
    # A baseline such as null or adaptive has no place on the axis.
    return pd.to_numeric(values, errors="coerce").to_numpy(float)


def _heights(values: pd.Series, dimension: Dimension) -> np.ndarray:
    """Values as a fraction of their range, choices evenly spaced; NaN for what the dimension cannot hold."""
    if dimension.choices:
        labels = [_text(value) for value in dimension.choices]
        places = {text: place / (len(labels) - 1) for place, text in enumerate(labels)}
        return np.array([places.get(_text(value), np.nan) for value in values])
    low, high = _bounds(dimension)
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(float)
    heights: np.ndarray = (np.log(numbers) - np.log(low)) / np.log(high / low) if dimension.log else (numbers - low) / (high - low)
    return heights


def _text(value: Any) -> str:
    """A choice as YAML has it."""
    return value if isinstance(value, str) else canonical(value)


def _bounds(dimension: Dimension) -> tuple[float, float]:
    assert dimension.low is not None
    assert dimension.high is not None
    return float(dimension.low), float(dimension.high)


def _marks(dimension: Dimension) -> list[tuple[str, Any]]:
    """Texts and heights along a setting's axis."""
    if dimension.choices:
        return [(_text(value), place / (len(dimension.choices) - 1)) for place, value in enumerate(dimension.choices)]
    return [(f"{value:.3g}", place) for value, place in zip(_bounds(dimension), (0, 1), strict=True)]
