"""The picture of the cluster-count study: Chamfer distance against the number of regions K."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from neuspring.report.figures.views import save
from neuspring.scores.metrics import averages

NAME = "clusters.png"
MM = 1e3
MOST_PANELS = 4
"""For more scenarios than this, one panel shows their mean."""
NAMED = {"model_b": 1, "neuspring": 5}
"""Rows of this study that have names of their own."""
STYLES = {"reconstruction": ("tab:blue", "o"), "future": ("tab:orange", "s")}


def cluster_methods(methods: Iterable[str]) -> dict[str, int]:
    """The methods named clusters_<K> and, beside such, model_b and neuspring, each once, with K; sorted by K."""
    names = set(methods)
    counts = {method: int(match[1]) for method in names if (match := re.fullmatch(r"clusters_(\d+)", method))}
    counts |= {method: count for method, count in NAMED.items() if counts and method in names}
    return dict(sorted(counts.items(), key=lambda item: item[1]))


def cluster_curves(scores: pd.DataFrame) -> pd.DataFrame:
    """The curves: scenario, task, clusters (K), mean and std [mm] over seeds. Rows of the mean over scenarios have the scenario "".

    `scores` are rows of `metrics.COLUMNS`, meters; other methods are ignored. The standard deviation
    is 0 for one seed. The mean over scenarios weighs scenarios equally; its deviation is that of the seeds' means.
    """
    methods = cluster_methods(scores["method"])
    rows = scores[scores["method"].isin(list(methods)) & (scores["metric"] == "chamfer")]
    own = rows.groupby(["scenario", "task", "method"], sort=False)["value"].agg(["mean", "std"]).fillna(0.0).reset_index()
    all_of_them = averages(rows, by=("task", "method")).rename(columns={"equal": "mean", "seed_std": "std"}).assign(scenario="")
    names = ["scenario", "task", "clusters", "mean", "std"]
    table = pd.concat([own, all_of_them]).assign(clusters=lambda t: t["method"].map(methods))[names]
    table[["mean", "std"]] *= MM
    return table.sort_values(["scenario", "task", "clusters"], ignore_index=True)


def clusters_figure(scores: pd.DataFrame, path: Path, note: str = "") -> Path | None:
    """Draw Chamfer distance against K for scores of methods clusters_<K>; returns the file.

    None, and no file, if fewer than two such methods have a score. `note` is added below the title.
    """
    path.unlink(missing_ok=True)
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
    return save(figure, path)


def _draw(axis: Axes, curves: pd.DataFrame, *, faint: bool = False) -> None:
    for task, (color, marker) in STYLES.items():
        part = curves[curves["task"] == task]
        if faint:
            axis.plot(part["clusters"], part["mean"], color=color, lw=0.7, alpha=0.35)
        elif len(part):
            bars = part["std"] if np.any(part["std"] > 0) else None
            axis.errorbar(part["clusters"], part["mean"], bars, color=color, marker=marker, ms=4, capsize=3, label=task)
