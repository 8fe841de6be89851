"""Figures of numbers: curves, ratios of errors with intervals, and the error against the number of regions K."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import color_sequences
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from neuspring.core.artifacts import Scenario
from neuspring.scores.metrics import averages, metrics_of

COLORS = color_sequences["petroff10"]
"""Colors that color-blind people can distinguish: the first four differ by 41 or more in CIELAB for protanopes and deuteranopes."""
STYLES = tuple(zip(COLORS, "Dso^v", strict=False))
"""Color and marker of the metrics of positions, in their order."""
TITLES = {"reconstruction": "training frames", "future": "future"}
LEGEND: dict[str, Any] = {"loc": "outside lower center", "frameon": False, "fontsize": 8}


def curves_figure(panels: Mapping[str, Mapping[str, pd.Series]], seen: Mapping[str, Scenario | None] | None = None) -> Figure:
    """One panel per title with one line per label; labels have the same color in all panels.

    `seen` maps titles to scenarios: the x axis is in seconds, and the future is gray. Without it, positive values that span a
    factor of two or more get a log axis.
    """
    labels = list(dict.fromkeys(label for own in panels.values() for label in own))
    columns = min(len(panels), 3)
    size = (max(3.6 * columns, 6.4), 2.3 * -(-len(panels) // columns) + 0.4)
    figure, axes = plt.subplots(-(-len(panels) // columns), columns, figsize=size, layout="constrained", squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (title, own) in zip(axes.flat, panels.items(), strict=False):
        axis.set_title(title, fontsize=9)
        for label, values in own.items():
            place = labels.index(label)
            axis.plot(values.index, values, color=COLORS[place % 10], ls="-" if place < 3 else "--", lw=1.4, label=label)
        if scenario := (seen or {}).get(title):
            axis.axvspan(scenario.train_end / scenario.frame_rate, scenario.frame_count / scenario.frame_rate, color="0.9", lw=0)
        ends = np.array([(values.min(), values.max()) for values in own.values()]).reshape(-1, 2)
        if seen is None and 0 < 2 * ends[:, 0].min(initial=np.inf) <= ends[:, 1].max(initial=0):
            axis.set_yscale("log")
        else:
            axis.set_ylim(np.nanmin(ends[:, 0], initial=0), None)
        axis.tick_params(labelsize=8)
    handles = {text: handle for axis in axes.flat for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), [text.replace("`", "") for text in handles], ncols=3, **LEGEND)
    return figure


def ratios_figure(ratios: pd.DataFrame, baseline: str) -> Figure | None:
    """Draw `scores.statistics.ratios`, one panel per task; filled markers: the interval excludes 1. None without any interval."""
    rows = ratios[ratios["ratio_low"].notna()]
    tasks = [task for task in TITLES if (rows["task"] == task).any()]
    if not tasks:
        return None
    methods = list(dict.fromkeys(rows["method"]))
    shown = [metric for metric in metrics_of("positions") if (rows["metric"] == metric.name).any()]
    size = (4.4 * len(tasks) + 1.2, (0.22 + 0.13 * len(shown)) * len(methods) + 1.8)
    figure, axes = plt.subplots(1, len(tasks), figsize=size, layout="constrained", squeeze=False, sharex=True, sharey=True)
    for axis, task in zip(axes[0], tasks, strict=True):
        for k, (metric, (color, marker)) in enumerate(zip(shown, STYLES * 2, strict=False)):
            part = rows[(rows["task"] == task) & (rows["metric"] == metric.name)]
            heights = np.array([methods.index(name) for name in part["method"]]) + 0.5 * ((k + 0.5) / len(shown) - 0.5)
            axis.hlines(heights, part["ratio_low"], part["ratio_high"], color=color, lw=1.1)
            faces = [color if resolved else "white" for resolved in (part["ratio_low"] > 1) | (part["ratio_high"] < 1)]
            axis.scatter(part["ratio"], heights, marker=marker, s=22, edgecolors=color, c=faces, zorder=3, label=metric.title)
        axis.axvline(1.0, color="0.3", lw=0.8, ls="--")
        axis.set(title=TITLES[task], xscale="log", xlabel=f"error / error of {baseline} (below 1 is better)")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("{x:.2g}")
        axis.tick_params(axis="x", labelsize=7, which="both")
        axis.grid(axis="x", color="0.9")
    axes[0][0].set_ylim(len(methods) - 0.5, -0.5)
    axes[0][0].set_yticks(range(len(methods)), methods)
    handles, names = axes[0][-1].get_legend_handles_labels()
    figure.legend(handles, names, ncols=len(names), **LEGEND)
    figure.suptitle("Geometric mean and 95 % interval; filled: the interval excludes 1", fontsize=9)
    return figure


def clusters_figure(scores: pd.DataFrame) -> Figure | None:
    """Draw the mean Chamfer distance against K for the methods clusters_<K> and model_b (K = 1).

    `scores` are comparable rows, m. None if fewer than two of these methods have scores.
    """
    counts = {name: int(match[1]) for name in set(scores["method"]) if (match := re.fullmatch(r"clusters_(\d+)", name))}
    counts |= {"model_b": 1} if counts else {}
    rows = scores[scores["method"].isin(list(counts)) & (scores["metric"] == "chamfer")]
    if rows["method"].nunique() < 2:
        return None
    curves = averages(rows).assign(clusters=lambda table: table["method"].map(counts)).sort_values("clusters")
    lines = {str(task): 1e3 * own.set_index("clusters")["equal"] for task, own in curves.groupby("task", sort=False)}
    title = f"Chamfer distance [mm] against the number of regions K, mean over {rows['scenario'].nunique()} scenarios"
    return curves_figure({title: lines}, {})
