"""Pictures of a benchmark: every method's error as a ratio to the baseline's, the error against the number of regions K, and over
time."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from neuspring.scores.metrics import averages, metrics_of

METRIC_STYLES = (("tab:purple", "D"), ("tab:orange", "s"), ("tab:blue", "o"), ("tab:green", "^"), ("tab:red", "v"))
"""Color and marker of the metrics of positions, in their order."""
MARKER_SHIFT = 0.24
"""The markers of a method stand within so much of its line."""
TITLES = {"reconstruction": "training frames", "future": "future"}
TICKS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0)
RATIO_REACH = 2.5
"""The axis ends here and at its inverse; what lies beyond stands at the edge with its number, so that it hides no other."""


def ratios_figure(ratios: pd.DataFrame, note: str) -> Figure | None:
    """Draw `scores.statistics.ratios`, a panel per task, methods in the order given.

    Filled markers: the interval leaves out 1. None if no ratio has an interval (too few objects, or nothing to
    compare). `note` is added below the title.
    """
    rows = ratios[np.isfinite(ratios["ratio_low"])] if len(ratios) else ratios
    tasks = [task for task in TITLES if len(rows) and (rows["task"] == task).any()]
    if not tasks:
        return None
    methods, baseline = list(dict.fromkeys(rows["method"])), rows["baseline"].iloc[0]
    styles = dict(zip(metrics_of("positions"), itertools.cycle(METRIC_STYLES)))
    shown = [metric for metric in styles if (rows["metric"] == metric.name).any()]
    size = (4.4 * len(tasks) + 1.2, (0.22 + 0.13 * len(shown)) * len(methods) + 2.0)
    figure, axes = plt.subplots(1, len(tasks), figsize=size, layout="constrained", squeeze=False, sharey=True)
    shifts = np.linspace(MARKER_SHIFT, -MARKER_SHIFT, len(shown)) if len(shown) > 1 else [0.0]
    for axis, task in zip(axes[0], tasks, strict=True):
        for index in range(0, len(methods), 2):
            axis.axhspan(index - 0.5, index + 0.5, color="0.96", lw=0)
        for metric, shift in zip(shown, shifts, strict=True):
            if len(part := rows[(rows["task"] == task) & (rows["metric"] == metric.name)]):
                place = np.array([methods.index(method) for method in part["method"]]) - shift
                _intervals(axis, part, place, *styles[metric], metric.title)
        _scale(axis, rows[rows["task"] == task])
        axis.set(title=TITLES[task], xlabel=f"error / that of {baseline} (below 1 is better)")
    axes[0][0].set_yticks(range(len(methods)), methods)
    axes[0][0].set_ylim(len(methods) - 0.5, -0.5)
    handles, names = axes[0][-1].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8)
    objects = {"category": "categories"}.get(str(rows["objects"].iloc[0]), "scenarios") if "objects" in rows else "scenarios"
    about = f"geometric mean and 95 % interval over {objects}; filled: the interval leaves out 1"
    figure.suptitle(f"Ratio to {baseline}, {about}\n{note}", fontsize=9)
    return figure


def _intervals(axis: Axes, part: pd.DataFrame, place: np.ndarray, color: str, marker: str, title: str) -> None:
    """Markers and intervals of a metric; the number of a ratio beyond the axis at its edge."""
    ratio = part["ratio"].clip(1 / RATIO_REACH, RATIO_REACH)
    ends = part["ratio_low"].clip(1 / RATIO_REACH, RATIO_REACH), part["ratio_high"].clip(1 / RATIO_REACH, RATIO_REACH)
    axis.errorbar(ratio, place, xerr=np.stack([ratio - ends[0], ends[1] - ratio]), fmt="none", ecolor=color, capsize=2, lw=1.1)
    sure = ((part["ratio_low"] > 1) | (part["ratio_high"] < 1)).to_numpy()
    axis.plot([], [], ls="", marker=marker, color=color, ms=4.5, label=title)
    for values, at, face in ((ratio[sure], place[sure], color), (ratio[~sure], place[~sure], "white")):
        axis.plot(values, at, ls="", marker=marker, color=color, mfc=face, ms=4.5)
    for value, shown, at in zip(part["ratio"], ratio, place, strict=True):
        if value != shown:
            side = "right" if value > 1 else "left"
            gap = (-6, 0) if value > 1 else (6, 0)
            style: dict[str, Any] = {"ha": side, "va": "center", "fontsize": 7, "color": color}
            axis.annotate(f"{value:.2g}", (shown, at), gap, textcoords="offset points", **style)


def _scale(axis: Axes, rows: pd.DataFrame) -> None:
    """A log axis around 1, no wider than the intervals and `RATIO_REACH`."""
    low = max(min(rows["ratio_low"].min(), 0.95), 1 / RATIO_REACH) / 1.04
    high = min(max(rows["ratio_high"].max(), 1.05), RATIO_REACH) * 1.04
    axis.axvline(1.0, color="0.3", lw=0.8, ls="--")
    axis.set(xscale="log", xlim=(low, high))
    axis.set_xticks([tick for tick in TICKS if low <= tick <= high])
    axis.tick_params(axis="x", labelsize=8)
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(axis="x", color="0.9")


CURVE_MM = 1e3
MOST_PANELS = 4
"""For more scenarios than this, one panel shows their mean."""
TASK_STYLES = {"reconstruction": ("tab:blue", "o"), "future": ("tab:orange", "s")}
NAMED_CLUSTERS = {"model_b": 1}
"""Rows of this study that have names of their own."""


def cluster_methods(methods: Iterable[str]) -> dict[str, int]:
    """The methods named clusters_<K> and, beside such, model_b, with K; sorted by K."""
    names = set(methods)
    counts = {method: int(match[1]) for method in names if (match := re.fullmatch(r"clusters_(\d+)", method))}
    counts |= {method: count for method, count in NAMED_CLUSTERS.items() if counts and method in names}
    return dict(sorted(counts.items(), key=lambda item: item[1]))


def cluster_curves(scores: pd.DataFrame) -> pd.DataFrame:
    """The curves: scenario, task, clusters (K), mean and std [mm] over seeds. Rows of the mean over scenarios have the scenario "".

    `scores` are rows of `metrics.SCORE_COLUMNS`, meters; other methods are ignored. The standard deviation
    is 0 for one seed. The mean over scenarios weighs scenarios equally; its deviation is that of the seeds' means.
    """
    methods = cluster_methods(scores["method"])
    rows = scores[scores["method"].isin(list(methods)) & (scores["metric"] == "chamfer")]
    own = rows.groupby(["scenario", "task", "method"], sort=False)["value"].agg(["mean", "std"]).fillna(0.0).reset_index()
    all_of_them = averages(rows, by=("task", "method")).rename(columns={"equal": "mean", "seed_std": "std"}).assign(scenario="")
    names = ["scenario", "task", "clusters", "mean", "std"]
    table = pd.concat([own, all_of_them]).assign(clusters=lambda t: t["method"].map(methods))[names]
    table[["mean", "std"]] *= CURVE_MM
    return table.sort_values(["scenario", "task", "clusters"], ignore_index=True)


def clusters_figure(scores: pd.DataFrame, note: str = "") -> Figure | None:
    """Draw Chamfer distance against K for scores of methods clusters_<K>.

    None if fewer than two such methods have a score. `note` is added below the title.
    """
    chamfer = scores[scores["metric"] == "chamfer"]
    if len(cluster_methods(chamfer["method"])) < 2:
        return None
    curves = cluster_curves(scores)
    scenarios = [name for name in dict.fromkeys(curves["scenario"]) if name]
    alone = scenarios if len(scenarios) <= MOST_PANELS else [""]
    width = 3.4 if len(alone) > 1 else 5.2
    figure, axes = plt.subplots(1, len(alone), figsize=(width * len(alone), 3.6), layout="constrained", squeeze=False)
    for axis, scenario in zip(axes[0], alone, strict=True):
        if not scenario:
            for name in scenarios:
                _draw(axis, curves[curves["scenario"] == name], faint=True)
        _draw(axis, curves[curves["scenario"] == scenario])
        axis.set(title=scenario or f"mean over {len(scenarios)} scenarios (thin: each)", xlabel="number of regions K")
        axis.set_xticks(sorted(curves["clusters"].unique()))
    axes[0][0].set_ylabel("Chamfer distance [mm]")
    axes[0][0].legend(frameon=False, fontsize=8)
    seeds = int(chamfer["seed"].nunique())
    spread = f"bars: standard deviation over {seeds} seeds" if seeds > 1 else "one seed"
    figure.suptitle(f"Chamfer distance against the number of regions\n{spread}{note}", fontsize=9)
    return figure


def _draw(axis: Axes, curves: pd.DataFrame, *, faint: bool = False) -> None:
    for task, (color, marker) in TASK_STYLES.items():
        part = curves[curves["task"] == task]
        if faint:
            axis.plot(part["clusters"], part["mean"], color=color, lw=0.7, alpha=0.35)
        elif len(part):
            bars = part["std"] if np.any(part["std"] > 0) else None
            axis.errorbar(part["clusters"], part["mean"], bars, color=color, marker=marker, ms=4, capsize=3, label=task)
