"""Figures of a benchmark: ratios of errors with their intervals; the Chamfer distance against the number of regions K."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from neuspring.scores.metrics import averages, metrics_of

STYLES = (("tab:purple", "D"), ("tab:orange", "s"), ("tab:blue", "o"), ("tab:green", "^"), ("tab:red", "v"))
"""Color and marker of the metrics of positions, in their order."""
TITLES = {"reconstruction": "training frames", "future": "future"}
TICKS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 2.5)
REACH = 2.5
"""The axis ends here and at its inverse; markers beyond stand at the edge with their number."""
MOST_PANELS = 4


def ratios_figure(ratios: pd.DataFrame, baseline: str) -> Figure | None:
    """Draw `scores.statistics.ratios`, a panel per task; filled markers: the interval leaves out 1. None without any interval."""
    rows = ratios[ratios["ratio_low"].notna()]
    tasks = [task for task in TITLES if (rows["task"] == task).any()]
    if not tasks:
        return None
    methods = list(dict.fromkeys(rows["method"]))
    shown = [metric for metric in metrics_of("positions") if (rows["metric"] == metric.name).any()]
    size = (4.4 * len(tasks) + 1.2, (0.22 + 0.13 * len(shown)) * len(methods) + 1.8)
    figure, axes = plt.subplots(1, len(tasks), figsize=size, layout="constrained", squeeze=False, sharex=True, sharey=True)
    shifts = np.linspace(-0.24, 0.24, len(shown)) if len(shown) > 1 else [0.0]
    for axis, task in zip(axes[0], tasks, strict=True):
        for metric, (color, marker), shift in zip(shown, STYLES * 2, shifts, strict=False):
            part = rows[(rows["task"] == task) & (rows["metric"] == metric.name)]
            low, value, high = (part[name].clip(1 / REACH, REACH) for name in ("ratio_low", "ratio", "ratio_high"))
            places = np.array([methods.index(name) for name in part["method"]], float) + shift
            axis.hlines(places, low, high, color=color, lw=1.1)
            sure = (part["ratio_low"] > 1) | (part["ratio_high"] < 1)
            faces = [color if one else "white" for one in sure]
            axis.scatter(value, places, marker=marker, s=22, edgecolors=color, c=faces, zorder=3, label=metric.title)
            for true, at, place in zip(part["ratio"], value, places, strict=True):
                if true != at:
                    axis.annotate(
                        f"{true:.2g}", (at, place), (0, 4), textcoords="offset points", fontsize=7, color=color, ha="center"
                    )
        axis.axvline(1.0, color="0.3", lw=0.8, ls="--")
        axis.set(title=TITLES[task], xscale="log", xlabel=f"error / that of {baseline} (below 1 is better)", xticks=TICKS)
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.tick_params(axis="x", labelsize=8)
        axis.grid(axis="x", color="0.9")
    ends = min(rows["ratio_low"].min(), 0.95), max(rows["ratio_high"].max(), 1.05)
    axes[0][0].set(xlim=(max(ends[0], 1 / REACH) / 1.04, min(ends[1], REACH) * 1.04), ylim=(len(methods) - 0.5, -0.5))
    axes[0][0].set_yticks(range(len(methods)), methods)
    handles, names = axes[0][-1].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8)
    figure.suptitle("Geometric mean and 95 % interval; filled: the interval leaves out 1", fontsize=9)
    return figure


def clusters_figure(scores: pd.DataFrame) -> Figure | None:
    """Draw the Chamfer distance against K for methods clusters_<K> and model_b (K = 1); bars: standard deviation over seeds.

    `scores` are comparable rows, m. A panel per scenario; above `MOST_PANELS` scenarios one panel of their mean. None if fewer than
    two such methods have scores.
    """
    counts = {name: int(match[1]) for name in set(scores["method"]) if (match := re.fullmatch(r"clusters_(\d+)", name))}
    counts |= {"model_b": 1} if counts else {}
    rows = scores[scores["method"].isin(list(counts)) & (scores["metric"] == "chamfer")]
    if rows["method"].nunique() < 2:
        return None
    scenarios = list(dict.fromkeys(rows["scenario"]))
    panels: Any = {name: rows[rows["scenario"] == name] for name in scenarios}
    panels = panels if len(scenarios) <= MOST_PANELS else {f"mean over {len(scenarios)} scenarios": rows}
    size = (3.4 * len(panels) + 1.0, 3.4)
    figure, axes = plt.subplots(1, len(panels), figsize=size, layout="constrained", squeeze=False)
    for axis, (title, part) in zip(axes[0], panels.items(), strict=True):
        curves = averages(part).assign(clusters=lambda table: table["method"].map(counts)).sort_values("clusters")
        for task, own in curves.groupby("task", sort=False):
            axis.errorbar(
                own["clusters"], 1e3 * own["equal"], 1e3 * own["seed_std"].fillna(0.0), marker="o", ms=4, capsize=3, label=task
            )
        axis.set(title=title, xlabel="number of regions K", xticks=sorted(counts.values()))
    axes[0][0].set_ylabel("Chamfer distance [mm]")
    axes[0][0].legend(frameon=False, fontsize=8)
    return figure
