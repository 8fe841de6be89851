"""What the paper printed, as data: its tables, how it averages, and the released PhysTwin's scores per scenario."""

from __future__ import annotations

import csv
import functools
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import pandas as pd

TASKS = {"reconstruction": "reconstruction_resimulation", "future": "future_prediction"}
"""Our tasks -> the paper's."""
UNDERLINED = ("table1_comparison", "table3_network")
"""Tables in which the paper underlines the second best; in all of them the best is bold."""
CLUSTER_CLAIM = (
    "The paper shows the Chamfer distance of two scenarios as curves, without numbers: in both tasks it mostly falls as K grows. "
    "It takes K = 5 everywhere."
)
_MEANS = "MEAN22"


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A metric as the paper prints it."""

    name: str
    """Ours."""
    paper: str
    """Its name in paper_tables.csv."""
    heading: str
    unit: str
    """The paper's; empty for a plain number."""
    higher: bool
    """Higher is better."""
    average: Literal["equal", "frames"]
    """How the paper averages over scenarios: equally, or weighted by their frames."""
    digits: int
    """After the point, where tables print ours."""
    factor: float = 1.0
    """From our unit to the paper's."""
    relative: bool = True
    """A change in per cent means something (it does not in dB)."""

    @property
    def other(self) -> Literal["equal", "frames"]:
        """The average that the paper does not use here."""
        return "frames" if self.average == "equal" else "equal"


_ALL = (
    Measure(name="chamfer", paper="cd", heading="CD", unit="m", higher=False, average="equal", digits=5),
    Measure(name="track_error", paper="track_error", heading="TE", unit="m", higher=False, average="equal", digits=5),
    Measure(name="iou", paper="iou", heading="IoU %", unit="%", higher=True, average="frames", digits=1, factor=100.0),
    Measure(name="psnr", paper="psnr", heading="PSNR", unit="dB", higher=True, average="frames", digits=3, relative=False),
    Measure(name="ssim", paper="ssim", heading="SSIM", unit="", higher=True, average="frames", digits=3),
    Measure(name="lpips", paper="lpips", heading="LPIPS", unit="", higher=False, average="frames", digits=3),
)
MEASURES = {measure.name: measure for measure in _ALL}
"""By our name, in the paper's order."""


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
    metrics = {measure.paper: measure.name for measure in _ALL}
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
    """Scores of the released PhysTwin: scenario, task, metric (ours), value (our unit: m). The training frames of 11 of 22 only."""
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
