"""Pictures of a sweep, as Optuna draws them: how the loss fell, what each setting does to it, how trials went.

Trials have Optuna's numbers. They differ from those of the slots where a trial was begun again.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna.visualization.matplotlib as plots
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from optuna.study import Study

from neuspring.core.files import write_atomically
from neuspring.report.figures.views import DPI

LOSS = "loss of the tail [m²]"
LOG_FROM = 3.0
"""A loss has a log axis if its largest value is at least this many times its smallest."""
LEGEND = 16
"""The most entries of a legend that is shown."""
WIDTH, HEIGHT = 2.9, 3.8
"""Size of a panel, inches."""


def draw(study: Study, folder: Path, *, importances: bool) -> None:
    """Draw a sweep that has a finished or pruned trial; `importances`: whether they can be computed."""
    losses = [trial.value for trial in study.get_trials(deepcopy=False) if trial.value is not None]
    columns = len({name for trial in study.get_trials(deepcopy=False) for name in trial.params})
    if losses:
        _save(lambda: plots.plot_optimization_history(study, target_name=LOSS), folder / "history.png", 2.4, losses)
        _save(lambda: plots.plot_slice(study, target_name=LOSS), folder / "slices.png", columns, losses)
        _save(lambda: plots.plot_parallel_coordinate(study, target_name=LOSS), folder / "parallel.png", columns)
    if importances:
        _save(lambda: plots.plot_param_importances(study, target_name=LOSS), folder / "importances.png", 2.4)
    values = [value for trial in study.get_trials(deepcopy=False) for value in trial.intermediate_values.values()]
    if values:
        _save(
            lambda: plots.plot_intermediate_values(study), folder / "steps.png", 3.0, values, "epoch, counted through the scenarios"
        )


def _save(plot: Callable[[], Any], path: Path, columns: float, losses: list[float] | None = None, label: str = "") -> None:
    """Save a picture of `columns` panels; `losses` are those on its y axis."""
    with warnings.catch_warnings(), plt.style.context("default"):
        warnings.simplefilter("ignore")
        axes: list[Axes] = list(np.ravel(plot()))
    figure = axes[0].figure.get_figure(root=True)
    assert figure is not None
    figure.set_size_inches(WIDTH * columns + 0.8, HEIGHT)
    if losses and min(losses) > 0 and max(losses) >= LOG_FROM * min(losses):
        axes[0].set_yscale("log")
    if (legend := axes[0].get_legend()) and len(legend.get_texts()) > LEGEND:
        legend.remove()
    if label:
        axes[0].set(xlabel=label, ylabel="mean " + LOSS, title="")
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=DPI, format="png", bbox_inches="tight"))
    plt.close(figure)
