"""The picture of a benchmark: every method's error as a ratio to the baseline's, with its interval."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.ticker import NullFormatter, ScalarFormatter

from neuspring.report.figures.views import save
from neuspring.scores.metrics import DISTANCES

NAME = "ratios.png"
STYLES = (("tab:orange", "s"), ("tab:blue", "o"), ("tab:green", "^"), ("tab:purple", "D"))
"""Color and marker of each distance."""
SHIFT = 0.15
"""The markers of a method stand within so much of its line."""
TITLES = {"reconstruction": "training frames", "future": "future"}
TICKS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7, 2.0)


def ratios_figure(differences: pd.DataFrame, path: Path, note: str) -> Path | None:
    """Draw `statistics.paired_differences`, a panel per task, methods in the order given; returns the file.

    None, and no file, if no ratio has an interval (one scenario, or nothing to compare). `note` is added below the title.
    """
    path.unlink(missing_ok=True)
    rows = differences[np.isfinite(differences["ratio_low"])] if len(differences) else differences
    tasks = [task for task in TITLES if len(rows) and (rows["task"] == task).any()]
    if not tasks:
        return None
    methods, baseline = list(dict.fromkeys(rows["method"])), rows["baseline"].iloc[0]
    size = (4.2 * len(tasks) + 1.2, 0.34 * len(methods) + 1.6)
    figure, axes = plt.subplots(1, len(tasks), figsize=size, layout="constrained", squeeze=False, sharey=True)
    for axis, task in zip(axes[0], tasks, strict=True):
        for metric, (color, marker), shift in zip(DISTANCES, STYLES, np.linspace(SHIFT, -SHIFT, len(DISTANCES)), strict=False):
            part = rows[(rows["task"] == task) & (rows["metric"] == metric.name)]
            if not len(part):
                continue
            place = np.array([methods.index(method) for method in part["method"]]) - shift
            reach = np.stack([part["ratio"] - part["ratio_low"], part["ratio_high"] - part["ratio"]])
            axis.errorbar(part["ratio"], place, xerr=reach, fmt=marker, color=color, ms=4, capsize=2, label=metric.title)
        axis.axvline(1.0, color="0.3", lw=0.8, ls="--")
        axis.set(title=TITLES[task], xscale="log", xlabel=f"error / that of {baseline} (below 1 is better)")
        low, high = axis.get_xlim()
        axis.set_xticks([tick for tick in TICKS if low <= tick <= high])
        axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(axis="x", color="0.9")
    axes[0][0].set_yticks(range(len(methods)), methods)
    axes[0][0].invert_yaxis()
    axes[0][-1].legend(frameon=False, fontsize=8)
    figure.suptitle(f"Ratio to {baseline}, geometric mean and 95 % interval\n{note}", fontsize=9)
    return save(figure, path)
