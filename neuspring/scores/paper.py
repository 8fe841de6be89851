"""Published numbers as data: the paper's tables and the scores of the released PhysTwin. Studies map table rows to our methods."""

from __future__ import annotations

import csv
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import StringConstraints

from neuspring.config.parse import read_rows
from neuspring.core.artifacts import SAFE_NAME
from neuspring.core.errors import InputError
from neuspring.core.section import STRICT, Name
from neuspring.registry import Registry
from neuspring.scores.metrics import METRICS, Metric

if TYPE_CHECKING:
    import pandas as pd

PAPER_TASKS = {"reconstruction": "reconstruction_resimulation", "future": "future_prediction"}
"""Our task -> the paper's name of it."""
MEANS = "MEAN22"


@dataclass(frozen=True, kw_only=True)
class Printed:
    """A printed value of a table; lengths are converted from the paper's m to mm."""

    text: str
    value: float
    slack: float
    """Half a unit of the last printed digit, the uncertainty by rounding."""


Values = dict[tuple[str, str, str], Printed]
"""Printed values by (label of the row, our task, our metric)."""


@functools.cache
def metrics() -> dict[str, Metric]:
    """The metrics of the paper's tables, in its order."""
    ours = {metric.paper_name: metric for metric in METRICS.values() if metric.paper_name}
    return {ours[name].name: ours[name] for name in dict.fromkeys(row["metric"] for row in _rows("paper_tables.csv"))}


def in_studies() -> dict[str, Metric]:
    """The metrics of studies in the order of columns: the paper's, then ours."""
    return metrics() | {name: metric for name, metric in METRICS.items() if metric.in_studies}


@functools.cache
def table(name: str) -> Values:
    """One of the paper's tables by name; empty for an unknown name."""
    tasks = {name: task for task, name in PAPER_TASKS.items()}
    ours = {metric.paper_name: metric for metric in metrics().values()}
    return {
        (row["method"], tasks[row["task"]], ours[row["metric"]].name): printed(row["value"], ours[row["metric"]].unit == "m")
        for row in _rows("paper_tables.csv")
        if row["table"] == name
    }


def tables() -> tuple[str, ...]:
    """Names of the paper's tables, in its order."""
    return tuple(dict.fromkeys(row["table"] for row in _rows("paper_tables.csv")))


def released_scores() -> Values:
    """Scores of the released PhysTwin in stored units, by scenario, task and metric.

    Keys that start with `MEANS` are means over scenarios.
    """
    names = {"chamfer_distance_m": "chamfer", "track_error_m": "track_error", "train": "reconstruction"}
    return {
        (row["scenario"], names.get(row["split"], row["split"]), names.get(row["metric"], row["metric"])): printed(row["value"])
        for row in _rows("released_phystwin_scores.csv")
    }


@functools.cache
def released() -> pd.DataFrame:
    """Scores of the released PhysTwin: scenario, task, metric, value [m]. Only 11 of 22 scenarios have reconstruction scores."""
    import pandas as pd

    rows = [(*key, score.value) for key, score in released_scores().items() if not key[0].startswith(MEANS)]
    return pd.DataFrame(rows, columns=["scenario", "task", "metric", "value"])


@functools.cache
def scenarios() -> frozenset[str]:
    """Names of the 22 scenarios in the averages of the paper's tables."""
    return frozenset(released()["scenario"])


def printed(text: str, in_meters: bool = False) -> Printed:
    """Parse a printed number with its rounding; `in_meters` converts m to mm."""
    text = f"{Decimal(text).scaleb(3):f}" if in_meters else text
    digits = len(text.partition(".")[2])
    return Printed(text=text, value=float(text), slack=0.5 * 10.0**-digits)


def rows_of(package: str, *path: str) -> list[dict[str, str]]:
    """Rows of a CSV file inside a package."""
    return list(csv.DictReader(resources.files(package).joinpath(*path).read_text(encoding="utf-8").splitlines()))


def _rows(name: str) -> list[dict[str, str]]:
    return rows_of("neuspring.data", "tables", name)


Text = Annotated[str, StringConstraints(pattern=r"^[^\n]*\S[^\n]*$")]
TAKEN = ("summary", "scores", "runs", "perception", "report")
"""Reserved names: other commands write files with these names into the same folder."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """An entry of studies.yaml: one of the paper's tables, or our own table."""

    __pydantic_config__ = STRICT
    title: Text
    reference: str | None
    """Name of a table in paper_tables.csv, or of a published table of the study's kind; null: no published numbers."""
    baseline: str
    """Label of the row that all other rows are compared with, on the same scenarios and seeds."""
    rows: dict[Text, Name]
    """The paper's label -> a method of methods.yaml. Labels that are not in the paper have no published values."""

    training: Text = "equal"
    """Description of the methods' training, in words."""
    kind: Name | None = None
    """Kind of study that an extension defines (`STUDY_KINDS`); null: a table of methods like the paper's."""

    def __post_init__(self) -> None:
        if self.baseline not in self.rows:
            raise ValueError(f"baseline: must be a label of rows ({', '.join(self.rows)}), received {self.baseline!r}")
        if len(set(self.rows.values())) != len(self.rows):
            raise ValueError(f"rows: methods must differ, received {list(self.rows.values())}")
        if self.reference is None:
            return
        known = tables() if self.kind is None else tuple(STUDY_KINDS[self.kind].published)
        if self.reference not in known:
            raise ValueError(f"reference: must be null or one of {', '.join(known)}, received {self.reference!r}")
        if self.kind:
            return
        missing = [label for label in dict.fromkeys(label for label, _, _ in self.values) if label not in self.rows]
        if missing:
            raise ValueError(f"rows: must contain every label of the paper's {self.reference}; missing: {missing}")

    @property
    def values(self) -> Values:
        """Published values; empty without a reference."""
        if self.reference is None:
            return {}
        return STUDY_KINDS[self.kind].published[self.reference]() if self.kind else table(self.reference)


class OwnStudy(ABC):
    """The numbers of a kind of study that an extension defines."""

    published: ClassVar[Mapping[str, Callable[[], Values]]] = {}
    """Published tables by name."""

    @classmethod
    @abstractmethod
    def of(cls, name: str, study: Study, table: Any, results: Path) -> Self:
        """Build the numbers of a study from the long table (`scores.table.ScoreTable`) and the results folder."""

    @abstractmethod
    def blocks(self) -> list[Any]:
        """Blocks (neuspring.report.blocks) for the report and the study's files."""

    @abstractmethod
    def files(self, folder: Path) -> list[str]:
        """Write further files into the folder of studies and return the Markdown lines that show them."""


STUDY_KINDS: Registry[type[OwnStudy]] = Registry("studies", {}, type)
"""Kind -> class, from the entry point group `neuspring.studies`."""


def read_studies(path: Path, extra: Iterable[Path] = ()) -> dict[str, Study]:
    """Read the studies of `path` and of the files `extra`, by name. Raises InputError."""
    studies = read_rows(Study, path, "study", extra)
    for name in studies:
        if not SAFE_NAME.fullmatch(name) or name in TAKEN:
            rule = f"a name must consist of letters, digits, _, . and -, and must not be {', '.join(TAKEN)}"
            raise InputError(f"{path}, study {name}", rule, name, "Rename it.")
    return studies
