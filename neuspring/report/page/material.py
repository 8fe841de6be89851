"""What lies in a results folder: runs, jobs and records; numbers in words. Damaged files are listed and stop nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord, read_jobs
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.scores.failures import LeftOut, applying
from neuspring.scores.metrics import DASH
from neuspring.scores.paper import Study
from neuspring.scores.runs import DAMAGED, Collected, one_line

UNREADABLE = (InputError, OSError, ValueError, KeyError, TypeError, AttributeError)
"""What a damaged record, table or picture raises."""
METHOD_RECORDS = (RUN_RECORD, "rollout.json", "fit.json", "train.json")
METHOD_RULES = ("fit", "train", "rollout", "predict", "render", "score")
"""Rules whose jobs are named <rule>/<scenario>/<method>/<seed>."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which runs a report is about."""

    scenarios: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    baseline: str
    transfers: tuple[str, ...] = ()
    shown: tuple[str, ...] = ()
    """Methods whose curves and pictures are shown."""
    left_out: LeftOut = field(default_factory=dict)
    """Method to the scenarios to which it does not apply."""

    @property
    def size(self) -> int:
        """Runs that there should be."""
        pairs = len(self.scenarios) * len(self.methods)
        return (pairs - sum(map(len, applying(self.left_out, self.scenarios, self.methods).values()))) * len(self.seeds)


@dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """A finished run (ok, or failed numerically)."""

    folder: Path
    record: RunRecord

    @property
    def scenario(self) -> str:
        """Its scenario."""
        return self.record.scenario

    @property
    def method(self) -> str:
        """Its method."""
        return self.record.method

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.record.seed

    def file(self, kind: str, stem: str) -> Path | None:
        """One of the files that the record names; None if there is none, or it is not there."""
        paths = (self.folder / name for name in self.record.artifacts.get(kind, []))
        return next((path for path in paths if path.stem == stem and path.is_file()), None)


@dataclass(kw_only=True)
class ReportData:
    """Everything that the sections read."""

    results: Path
    output: Path
    choice: Choice
    tables: str
    settings: Config | None
    studies: Mapping[str, Study]
    collected: Collected
    runs: list[FinishedRun]
    """The runs whose records could be read."""
    transfers: Collected
    jobs: list[JobRecord]
    damaged: dict[str, str]
    """Files that cannot be read, relative to the results folder, and why."""

    def relative(self, path: Path) -> str:
        """A path for people: relative to the results folder."""
        return path.relative_to(self.results).as_posix() if path.is_relative_to(self.results) else str(path)

    def lost(self, path: Path, reason: Exception | str) -> None:
        """Remember a damaged file, once."""
        self.damaged.setdefault(self.relative(path), one_line(reason) if isinstance(reason, Exception) else reason)

    def runs_of(self, scenario: str, method: str) -> list[FinishedRun]:
        """All seeds of a method on a scenario."""
        return [run for run in self.runs if run.scenario == scenario and run.method == method]

    def first_runs(self, scenario: str) -> dict[str, FinishedRun]:
        """Shown method to its first run of a scenario, finished ones before failed ones."""
        runs = {method: self.runs_of(scenario, method) for method in self.choice.shown}
        return {method: min(own, key=lambda run: not run.record.ok) for method, own in runs.items() if own}


def on_disk(results: Path, jobs: Iterable[JobRecord]) -> tuple[list[str], list[str], list[int]]:
    """Scenarios, methods and seeds that have left a trace: a record of a stage, or of a job."""
    paths = [path for name in METHOD_RECORDS for path in results.glob(f"*/*/*/{name}")]
    paths += results.glob("*/search-*/*/search.json")
    traces = [path.relative_to(results).parts[:3] for path in paths]
    traces += [tuple(job.name.split("/")[1:]) for job in jobs if job.rule in METHOD_RULES]
    traces = [parts for parts in traces if len(parts) == 3 and parts[2].isdigit()]
    methods = {method for _, method, _ in traces if not method.startswith("search-")}
    return sorted({scenario for scenario, _, _ in traces}), sorted(methods), sorted({int(seed) for _, _, seed in traces})


def damaged_records(runs: pd.DataFrame, name: str) -> dict[str, str]:
    """The records `name` of runs that cannot be read, relative to the results folder, and why."""
    rows: list[Any] = [row for row in runs.itertuples() if str(row.reason).startswith(DAMAGED)]
    return {f"{row.scenario}/{row.method}/{row.seed}/{name}": row.reason.removeprefix(DAMAGED) for row in rows}


def job_records(results: Path) -> tuple[list[JobRecord], dict[str, str]]:
    """The job records that can be read, by name, and the damaged ones with the reason."""
    messages: list[str] = []
    jobs = [job for job in read_jobs(results, messages) if job.attempts]
    # An InputError begins with the file.
    damaged = (message.partition(": ") for message in messages)
    return jobs, {Path(path).relative_to(results).as_posix(): reason for path, _, reason in damaged}


def several(count: int, noun: str, plural: str = "") -> str:
    """`1 run`, `2 runs`."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names for a sentence. Of more than `most`, the rest is counted."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def duration(seconds: float) -> str:
    """A time for people."""
    if not math.isfinite(seconds):
        return DASH
    if seconds < 100:
        return f"{seconds:.1f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def hours(seconds: float) -> str:
    """Hours, with fewer decimals for larger values."""
    value = seconds / 3600
    if value < 0.01:
        return "< 0.01" if value else "0"
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def memory(mebibytes: float | None) -> str:
    """Mebibytes; gibibytes from 1024 MiB."""
    if mebibytes is None or not math.isfinite(mebibytes):
        return DASH
    return f"{mebibytes / 1024:.1f} GiB" if mebibytes >= 1024 else f"{mebibytes:.0f} MiB"


def signed(value: float, digits: int) -> str:
    """A number with its sign, and a typographic minus. What rounds to zero has no sign."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text if text.strip("+−0.") else text[1:]


def number(value: float, digits: int) -> str:
    """A number with a typographic minus; a dash for NaN."""
    return DASH if not math.isfinite(value) else f"{value:.{digits}f}".replace("-", "−")
