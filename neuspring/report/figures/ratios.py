"""The picture of a benchmark: every method's error as a ratio to the baseline's, with its interval."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from neuspring.report.figures.views import save
from neuspring.scores.metrics import DISTANCES

NAME = "ratios.png"
STYLES = (("tab:orange", "s"), ("tab:blue", "o"), ("tab:green", "^"), ("tab:purple", "D"))
"""Color and marker of each distance."""
SHIFT = 0.24
"""The markers of a method stand within so much of its line."""
TITLES = {"reconstruction": "training frames", "future": "future"}
TICKS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0)
REACH = 2.5
"""The axis ends here and at its inverse; what lies beyond stands at the edge with its number, so that it hides no other."""


def ratios_figure(ratios: pd.DataFrame, path: Path, note: str) -> Path | None:
    """Draw `scores.ratios.ratios`, a panel per task, methods in the order given; returns the file.

    Filled markers: the interval leaves out 1. None, and no file, if no ratio has an interval (too few objects, or nothing to
    compare). `note` is added below the title.
    """
    path.unlink(missing_ok=True)
    rows = ratios[np.isfinite(ratios["ratio_low"])] if len(ratios) else ratios
    tasks = [task for task in TITLES if len(rows) and (rows["task"] == task).any()]
    if not tasks:
        return None
    methods, baseline = list(dict.fromkeys(rows["method"])), rows["baseline"].iloc[0]
    shown = [metric for metric in DISTANCES if (rows["metric"] == metric.name).any()]
    size = (4.4 * len(tasks) + 1.2, (0.22 + 0.13 * len(shown)) * len(methods) + 2.0)
    figure, axes = plt.subplots(1, len(tasks), figsize=size, layout="constrained", squeeze=False, sharey=True)
    shifts = np.linspace(SHIFT, -SHIFT, len(shown)) if len(shown) > 1 else [0.0]
    for axis, task in zip(axes[0], tasks, strict=True):
        for index in range(0, len(methods), 2):
            axis.axhspan(index - 0.5, index + 0.5, color="0.96", lw=0)
        for metric, shift in zip(shown, shifts, strict=True):
            part = rows[(rows["task"] == task) & (rows["metric"] == metric.name)]
            if len(part):
                place = np.array([methods.index(method) for method in part["method"]]) - shift
                _intervals(axis, part, place, *STYLES[DISTANCES.index(metric)], metric.title)
        _scale(axis, rows[rows["task"] == task])
        axis.set(title=TITLES[task], xlabel=f"error / that of {baseline} (below 1 is better)")
    axes[0][0].set_yticks(range(len(methods)), methods)
    axes[0][0].set_ylim(len(methods) - 0.5, -0.5)
    handles, names = axes[0][-1].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8)
    objects = {"category": "categories"}.get(str(rows["objects"].iloc[0]), "scenarios") if "objects" in rows else "scenarios"
    about = f"geometric mean and 95 % interval over {objects}; filled: the interval leaves out 1"
    figure.suptitle(f"Ratio to {baseline}, {about}\n{note}", fontsize=9)
    return save(figure, path)


def _intervals(axis: Axes, part: pd.DataFrame, place: np.ndarray, color: str, marker: str, title: str) -> None:
    """Markers and intervals of a metric; the number of a ratio beyond the axis at its edge."""
    ratio = part["ratio"].clip(1 / REACH, REACH)
    ends = part["ratio_low"].clip(1 / REACH, REACH), part["ratio_high"].clip(1 / REACH, REACH)
    axis.errorbar(ratio, place, xerr=np.stack([ratio - ends[0], ends[1] - ratio]), fmt="none", ecolor=color, capsize=2, lw=1.1)
    sure = ((part["ratio_low"] > 1) | (part["ratio_high"] < 1)).to_numpy()
    axis.plot([], [], ls="", marker=marker, color=color, ms=4.5, label=title)
    for values, at, face in ((ratio[sure], place[sure], color), (ratio[~sure], place[~sure], "white")):
        axis.plot(values, at, ls="", marker=marker, color=color, mfc=face, ms=4.5)
    for value, shown, at in zip(part["ratio"], ratio, place, strict=True):
        if value != shown:
            side = "right" if value > 1 else "left"
            gap = (-6, 0) if value > 1 else (6, 0)
            axis.annotate(
                f"{value:.2g}", (shown, at), gap, textcoords="offset points", ha=side, va="center", fontsize=7, color=color
            )


def _scale(axis: Axes, rows: pd.DataFrame) -> None:
    """A log axis around 1, no wider than the intervals and `REACH`."""
    low = max(min(rows["ratio_low"].min(), 0.95), 1 / REACH) / 1.04
    high = min(max(rows["ratio_high"].max(), 1.05), REACH) * 1.04
    axis.axvline(1.0, color="0.3", lw=0.8, ls="--")
    axis.set(xscale="log", xlim=(low, high))
    axis.set_xticks([tick for tick in TICKS if low <= tick <= high])
    axis.tick_params(axis="x", labelsize=8)
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(axis="x", color="0.9")
