"""What lies in a results folder: runs, jobs and records. Damaged files are listed and never stop the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from pydantic import TypeAdapter, ValidationError

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER as JOBS
from neuspring.core.job_records import JobRecord
from neuspring.core.records import RECORD_FORMAT, read_json
from neuspring.report.tables import summary as tables
from neuspring.report.tables.summary import DAMAGED, Collected
from neuspring.scores.failures import LeftOut, applying
from neuspring.scores.metrics import COLUMNS
from neuspring.scores.studies import Study

UNREADABLE = (InputError, OSError, ValueError, KeyError, TypeError, AttributeError)
"""What a damaged record, table or picture raises."""
METHOD_RECORDS = ("run.json", "rollout.json", "fit.json", "train.json")
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
    """Methods that are drawn."""
    left_out: LeftOut = field(default_factory=dict)
    """Method -> the scenarios to which it does not apply."""

    @property
    def size(self) -> int:
        """Runs that there should be."""
        pairs = len(self.scenarios) * len(self.methods)
        return (pairs - sum(map(len, applying(self.left_out, self.scenarios, self.methods).values()))) * len(self.seeds)


@dataclass(frozen=True, kw_only=True)
class Damaged:
    """A file that could not be read."""

    path: str
    """Relative to the results folder."""
    reason: str


@dataclass(frozen=True, kw_only=True)
class Record:
    """What this report reads of run.json."""

    status: Literal["ok", "failed"]
    source: str
    device: str
    machine: str
    commit: str
    variant: dict[str, Any]
    settings: dict[str, dict[str, Any]]
    timings: dict[str, float]
    artifacts: dict[str, list[str]]
    histories: dict[str, str]
    peak_memory_mb: dict[str, float] = field(default_factory=dict)

    @property
    def model(self) -> str:
        """The baseline's model; empty for twins."""
        return str(self.variant.get("model") or "")


@dataclass(frozen=True, kw_only=True)
class Run:
    """A finished run (ok, or failed numerically) and its record."""

    scenario: str
    method: str
    seed: int
    folder: Path
    record: Record

    @property
    def ok(self) -> bool:
        """Whether it has a result."""
        return self.record.status == "ok"

    def file(self, kind: str, stem: str) -> Path | None:
        """One of the files that the record names; None if there is none, or it is not there."""
        named = (self.folder / name for name in self.record.artifacts.get(kind, []))
        return next((path for path in named if path.stem == stem and path.is_file()), None)


@dataclass(kw_only=True)
class Material:
    """Everything that the sections read."""

    results: Path
    output: Path
    choice: Choice
    tables: str
    collected: Collected
    transfers: Collected
    runs: list[Run]
    jobs: list[JobRecord]
    settings: Config | None
    studies: Mapping[str, Study]
    damaged: list[Damaged] = field(default_factory=list)

    def relative(self, path: Path) -> str:
        """A path for people: relative to the results folder."""
        return path.relative_to(self.results).as_posix() if path.is_relative_to(self.results) else str(path)

    def lost(self, path: Path, error: Exception) -> None:
        """Remember a damaged file, once."""
        entry = Damaged(path=self.relative(path), reason=told(error))
        if entry.path not in {other.path for other in self.damaged}:
            self.damaged.append(entry)

    def first_runs(self, scenario: str) -> dict[str, Run]:
        """Drawn method -> its first run of a scenario, finished ones before failed ones."""
        found: dict[str, Run] = {}
        for method in self.choice.shown:
            own = [run for run in self.runs if run.scenario == scenario and run.method == method]
            if own:
                found[method] = min(own, key=lambda run: not run.ok)
        return found


def on_disk(results: Path, jobs: Iterable[JobRecord]) -> tuple[list[str], list[str], list[int]]:
    """Scenarios, methods and seeds that have left a trace: a record of a stage, or of a job."""
    found = []
    for name in METHOD_RECORDS:
        found += [path.relative_to(results).parts[:3] for path in results.glob(f"*/*/*/{name}")]
    found += [path.relative_to(results).parts[:3] for path in results.glob("*/search-*/*/search.json")]
    for job in jobs:
        _, *names = job.name.split("/")
        if job.rule in METHOD_RULES and len(names) == 3:
            found.append(tuple(names))
    found = [parts for parts in found if parts[2].isdigit()]
    methods = {method for _, method, _ in found if not method.startswith("search-")}
    return sorted({scenario for scenario, _, _ in found}), sorted(methods), sorted({int(seed) for _, _, seed in found})


def read_jobs(results: Path, damaged: list[Damaged]) -> list[JobRecord]:
    """The job records that can be read, by name; the others are added to `damaged`."""
    jobs = []
    for path in sorted((results / JOBS).rglob("*.json")):
        try:
            job = JobRecord.load(path)
            if not job.attempts:
                raise InputError(path, "a job record must have an attempt")
            jobs.append(job)
        except UNREADABLE as error:
            damaged.append(Damaged(path=path.relative_to(results).as_posix(), reason=told(error)))
    return jobs


def read_runs(results: Path, collected: Collected, damaged: list[Damaged]) -> list[Run]:
    """The records of the runs that were collected; those that cannot be read are added to `damaged`."""
    runs = []
    rows: list[Any] = list(collected.runs.itertuples())
    for row in rows:
        name = f"{row.scenario}/{row.method}/{row.seed}/run.json"
        path = results / name
        if row.status == "missing":
            continue
        if str(row.reason).startswith(DAMAGED):
            damaged.append(Damaged(path=name, reason=str(row.reason).removeprefix(DAMAGED)))
            continue
        try:
            record = _checked(path)
        except UNREADABLE as error:
            damaged.append(Damaged(path=name, reason=told(error)))
            continue
        runs.append(Run(scenario=row.scenario, method=row.method, seed=row.seed, folder=path.parent, record=record))
    return runs


RECORD = TypeAdapter(Record)


def _checked(path: Path) -> Record:
    """The record of a run. Raises InputError."""
    try:
        return RECORD.validate_python(read_json(path, RECORD_FORMAT))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(path, f"{where}: {first['msg'].lower()}", remedy="Delete it and run again.") from error


def read_transfers(results: Path, choice: Choice, damaged: list[Damaged]) -> Collected:
    """Transferred twins; damaged records are left out and listed."""
    parts = []
    for source, method, seed in product(choice.transfers, choice.methods, choice.seeds):
        try:
            parts.append(tables.collect_transfers(results, [source], [method], [seed]))
        except UNREADABLE as error:
            damaged.append(Damaged(path=f"{source}/{method}/{seed}/transfer.json", reason=told(error)))
    scores = [part.scores for part in parts if len(part.scores)]
    runs = [part.runs for part in parts if len(part.runs)]
    empty = pd.DataFrame(columns=list(COLUMNS))
    return Collected(
        pd.concat(scores, ignore_index=True) if scores else empty, pd.concat(runs, ignore_index=True) if runs else pd.DataFrame()
    )


def told(error: Exception) -> str:
    """The error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
