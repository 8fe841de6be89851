"""What the paper printed, as data: its tables, how it averages, and the released PhysTwin's scores per scenario."""

from __future__ import annotations

import csv
import functools
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING

from neuspring.scores.metrics import IN_PAPER

if TYPE_CHECKING:
    import pandas as pd

TASKS = {"reconstruction": "reconstruction_resimulation", "future": "future_prediction"}
"""Our tasks to the paper's."""
UNDERLINED = ("table1_comparison", "table3_network")
"""Tables in which the paper underlines the second best; in all of them the best is bold."""
CLUSTER_CLAIM = (
    "The paper shows the Chamfer distance of two scenarios as curves, without numbers: in both tasks it mostly falls as K grows. "
    "It takes K = 5 everywhere."
)
_MEANS = "MEAN22"


@dataclass(frozen=True, kw_only=True)
class Printed:
    """A value that the paper prints, in its unit."""

    text: str
    value: float
    slack: float
    """Half a unit of the last digit: what rounding may have hidden."""


Values = dict[tuple[str, str, str], Printed]
"""By label of the row, our task, our metric."""


@functools.cache
def table(name: str) -> Values:
    """One of the paper's tables; empty if there is none of that name."""
    tasks = {theirs: ours for ours, theirs in TASKS.items()}
    metrics = {metric.paper_name: metric.name for metric in IN_PAPER.values()}
    return {
        (row["method"], tasks[row["task"]], metrics[row["metric"]]): _printed(row["value"])
        for row in _rows("paper_tables.csv")
        if row["table"] == name
    }


def tables() -> tuple[str, ...]:
    """Names of the paper's tables, in its order."""
    return tuple(dict.fromkeys(row["table"] for row in _rows("paper_tables.csv")))


@functools.cache
def released() -> pd.DataFrame:
    """Scores of the released PhysTwin: scenario, task, metric, value [m]. 11 of 22 scenarios have scores of training frames."""
    import pandas as pd

    names = {"chamfer_distance_m": "chamfer", "track_error_m": "track_error"}
    tasks = {"train": "reconstruction", "future": "future"}
    rows = [
        (row["scenario"], tasks[row["split"]], names[row["metric"]], float(row["value"]))
        for row in _rows("released_phystwin_scores.csv")
        if not row["scenario"].startswith(_MEANS)
    ]
    return pd.DataFrame(rows, columns=["scenario", "task", "metric", "value"])


@functools.cache
def scenarios() -> frozenset[str]:
    """Names of the 22 scenarios that the paper's tables average over."""
    return frozenset(released()["scenario"])


def _printed(text: str) -> Printed:
    digits = len(text.partition(".")[2])
    return Printed(text=text, value=float(text), slack=0.5 * 10.0**-digits)


def _rows(name: str) -> list[dict[str, str]]:
    text = resources.files("neuspring.data.tables").joinpath(name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
