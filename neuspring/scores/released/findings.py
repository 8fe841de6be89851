"""Findings of the conformance checks: our number, the published one, how far they may differ, and the verdict."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from neuspring.core.errors import InputError
from neuspring.data.phystwin import released_cases
from neuspring.scores.lpips import Lpips
from neuspring.scores.metrics import METRICS, TASKS, UNITS, averages

Outcome = Literal["passed", "failed", "measured", "skipped"]
"""measured: there is no published number to compare with."""
MEAN = "mean"
"""The scenario of findings about all scenarios."""
SCORES = "released_phystwin_scores.csv"
PUBLISHED_NAMES = {"chamfer_distance_m": "chamfer", "track_error_m": "track_error", "train": "reconstruction"}
MEANS = ("MEAN22_REEVAL", "MEAN22_PAPER")
"""Rows of means over the 22 scenarios: evaluated again with more digits, as printed in the paper."""


class Absent(Exception):
    """The reason why a check cannot run, and the missing file if that is it."""

    def __init__(self, reason: str, file: Path | None = None) -> None:
        super().__init__(reason)
        self.file = file


def require(root: Path, *paths: Path) -> None:
    """Raise Absent for the first path that is not there."""
    for path in paths:
        if not path.exists():
            raise Absent(f"{path.relative_to(root)} is not there", path)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One line of a check."""

    check: int
    scenario: str
    """Its name, or MEAN."""
    quantity: str
    unit: str = ""
    task: str = ""
    """reconstruction, future, or empty."""
    ours: float | None = None
    published: float | None = None
    """The released or published number; 0 for distances from released positions."""
    tolerance: float | None = None
    outcome: Outcome = "measured"
    note: str = ""
    frames: int = 0
    """Number of frames that a score is the mean of."""
    file: Path | None = field(default=None, compare=False, repr=False)
    """The file that is checked."""
    per_frame: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def difference(self) -> float | None:
        """Ours minus the published number."""
        return None if self.ours is None or self.published is None else self.ours - self.published

    def against(self, published: float, tolerance: float) -> Comparison:
        """The finding with its verdict: passed or failed, by the tolerance."""
        assert self.ours is not None
        good = abs(self.ours - published) <= tolerance  # false for NaN
        return replace(self, published=published, tolerance=tolerance, outcome="passed" if good else "failed")


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A published number."""

    value: float
    half_digit: float
    """Half a unit of the last printed digit."""


@dataclass(frozen=True, kw_only=True)
class Published:
    """Published scores of the released results, keyed by (scenario, task, metric). Means stand under the names in MEANS."""

    scores: Mapping[tuple[str, str, str], Reference]
    scenarios: frozenset[str]
    """The scenarios that the means were taken over."""

    @classmethod
    def load(cls) -> Published:
        """Load the table that ships."""
        text = resources.files("neuspring.data.tables").joinpath(SCORES).read_text(encoding="utf-8")
        return cls.parse(text, frozenset(released_cases()))

    @classmethod
    def parse(cls, text: str, scenarios: frozenset[str]) -> Published:
        """Parse CSV text with the columns scenario, split, metric and value."""
        scores = {}
        for row in csv.DictReader(text.splitlines()):
            task, metric = (PUBLISHED_NAMES.get(row[name], row[name]) for name in ("split", "metric"))
            if task not in TASKS or metric not in UNITS:
                raise InputError(SCORES, "known splits and metrics are required", (row["split"], row["metric"]))
            digits = len(row["value"].partition(".")[2])
            scores[row["scenario"], task, metric] = Reference(value=float(row["value"]), half_digit=0.5 * 10.0**-digits)
        return cls(scores=scores, scenarios=scenarios)

    def means(self, task: str, metric: str) -> list[Reference]:
        """Published means of a task and metric, the one with most digits first."""
        keys = [(name, task, metric) for name in MEANS]
        return [self.scores[key] for key in keys if key in self.scores]


@dataclass(frozen=True, kw_only=True)
class Tools:
    """What the checks of every case share."""

    published: Published
    device: str = "cpu"
    """Where checks 5 and 6 run."""
    lpips: Lpips | str = ""
    """The metric, or the reason why there is none."""


def of_scores(
    base: Comparison, scores: pd.DataFrame, metrics: Sequence[str], published: Published, missing: Mapping[str, str]
) -> list[Comparison]:
    """Findings for tidy scores of one scenario, with check, scenario and file of `base`.

    `missing`: metric -> the reason why it has no score.
    """
    rows = {(row["task"], row["metric"]): row for row in scores.to_dict("records")}
    findings = []
    for metric in metrics:
        blank = replace(base, quantity=metric, unit=UNITS[metric])
        if metric in missing:
            findings.append(replace(blank, outcome="skipped", note=missing[metric]))
            continue
        for task in TASKS:
            if (task, metric) not in rows:
                findings.append(replace(blank, task=task, outcome="skipped", note="no frame has it"))
                continue
            row = rows[task, metric]
            score = replace(blank, task=task, ours=float(row["value"]), frames=int(row["frames"]))
            findings.append(_judged(score, published.scores.get((base.scenario, task, metric))))
    return findings


def _judged(score: Comparison, reference: Reference | None) -> Comparison:
    if reference is None:
        return score
    return score.against(reference.value, max(METRICS[score.quantity].tolerance, reference.half_digit))


def of_means(findings: Iterable[Comparison], published: Published) -> list[Comparison]:
    """Findings about means over scenarios. Only means over the complete set are compared with the published ones."""
    rows = [
        {"check": f.check, "scenario": f.scenario, "seed": 0, "task": f.task, "metric": f.quantity, "value": f.ours}
        | {"frames": f.frames}
        for f in findings
        if f.frames and f.ours is not None
    ]
    if not rows:
        return []
    table = pd.DataFrame(rows)
    means = []
    for row in averages(table, by=("check", "task", "metric")).to_dict("records"):
        same = (table["check"] == row["check"]) & (table["task"] == row["task"]) & (table["metric"] == row["metric"])
        means.append(_mean(row, table[same], published))
    return means


def _mean(row: Mapping[Any, Any], scores: pd.DataFrame, published: Published) -> Comparison:
    """The mean of one metric in one task; `row` is its average, `scores` are the scores of the scenarios."""
    weighted = METRICS[row["metric"]].average == "frames"
    references = published.means(row["task"], row["metric"])
    whole = frozenset(scores["scenario"]) == published.scenarios
    note = f"{'frame' if weighted else 'scenario'}-weighted over {len(scores)} scenarios"
    if references and not whole:
        note += f"; published {references[0].value:g} over {len(published.scenarios)}"
    elif len(references) > 1:
        note += f"; paper: {references[1].value:g}"
    mean = Comparison(
        check=row["check"],
        scenario=MEAN,
        quantity=row["metric"],
        unit=UNITS[row["metric"]],
        task=row["task"],
        ours=float(row["frames" if weighted else "equal"]),
        frames=int(scores["frames"].sum()),
        note=note,
    )
    return _judged(mean, references[0] if references and whole else None)
