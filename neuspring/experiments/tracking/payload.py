"""What is sent to MLflow for a run: its record and the files that it names, read and checked before anything is sent."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AwareDatetime, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

from neuspring.config.types import Name
from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER as JOBS
from neuspring.core.job_records import JobRecord
from neuspring.core.records import RECORD_FORMAT, read_json

PARAM_LENGTH, TAG_LENGTH = 500, 5000
"""These keep MLflow's tables readable. The full text stays in run.json."""
METRIC_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:/ -]{0,249}")
RUN_KEY = re.compile(r"[0-9a-f]{8,64}")
SAMPLES = ("cpu_percent", "memory_mb", "gpu_percent", "gpu_memory_mb")
"""Columns of a job record's samples, after the time."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What the index needs of results/{scenario}/{method}/{seed}/run.json. Other keys are the writer's own and are not read."""

    __pydantic_config__ = ConfigDict(extra="ignore", strict=True)
    run_key: Annotated[str, StringConstraints(pattern=f"^{RUN_KEY.pattern}$")]
    scenario: Name
    source: str
    category: str
    method: Name
    variant: dict[str, str | bool | int | float | None]
    seed: int
    status: Literal["ok", "failed"]
    reason: str
    attempt: Annotated[int, Field(ge=1)]
    commit: Annotated[str, StringConstraints(pattern=r"^[\w.-]{0,100}$")]
    data_digest: str
    device: str
    started: AwareDatetime
    ended: AwareDatetime
    params: dict[str, Any]
    timings: dict[str, float]
    scores_file: str | None = None
    """None or empty where a failed run has no scores."""
    histories: dict[str, str] = field(default_factory=dict)
    artifacts: dict[str, list[str]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The run's name in MLflow."""
        return f"{self.scenario}/{self.method}/{self.seed}"

    @classmethod
    def load(cls, path: Path) -> RunRecord:
        """Read a record. Raises InputError if it is missing or damaged."""
        try:
            return TypeAdapter(cls).validate_json(json.dumps(read_json(path, RECORD_FORMAT)), strict=True)
        except ValidationError as error:
            problems = [f"{'.'.join(map(str, p['loc']))}: {p['msg'].lower()}, received {p['input']!r:.80}" for p in error.errors()]
            raise InputError(path, "\n  " + "\n  ".join(problems), remedy="Delete it and run again.") from error


class Point(NamedTuple):
    """One value of a metric."""

    name: str
    value: float
    step: int
    time: int
    """ms since 1970."""


@dataclass(frozen=True, kw_only=True)
class Payload:
    """Everything of a record that goes to MLflow."""

    tags: dict[str, str]
    params: list[tuple[str, str]]
    metrics: list[Point]
    files: list[tuple[Path, str | None]]
    """Local file, artifact folder (None: the root)."""


def payload(record: RunRecord, run_json: Path, results: Path) -> Payload:
    """Read what a record names, and the job records of its stages. Raises InputError."""
    folder = run_json.parent
    files: list[tuple[Path, str | None]] = [(run_json, None)]
    for target, names in record.artifacts.items():
        files += [(_named_file(run_json, folder / name), target) for name in names]
    taken = [(target, path.name) for path, target in files]
    if doubled := [pair for pair in taken if taken.count(pair) > 1]:
        raise InputError(run_json, "artifacts of one folder must have different file names", doubled[0])
    metrics = [*_metrics(record, run_json), *_system_metrics(record, run_json, results)]
    for name in {point.name for point in metrics}:
        _checked_name(run_json, name)
    return Payload(tags=_tags(record), params=_params(record, run_json), metrics=metrics, files=files)


def milliseconds(time: datetime) -> int:
    """ms since 1970, as MLflow counts."""
    return round(time.timestamp() * 1000)


def cut(text: str, length: int) -> str:
    """The text, its end replaced by dots where it is longer than `length`."""
    return text if len(text) <= length else text[: length - 3] + "..."


def _tags(record: RunRecord) -> dict[str, str]:
    names = ("scenario", "category", "source", "method", "seed", "attempt", "status", "reason", "commit", "data_digest", "device")
    tags = {name: str(getattr(record, name)) for name in (*names, "run_key")}
    tags |= {f"variant.{name}": str(value) for name, value in record.variant.items()}
    if record.commit:
        tags["mlflow.source.git.commit"] = record.commit  # MLflow's pages show this one as the version
    return {name: cut(value, TAG_LENGTH) for name, value in tags.items()}


def _params(record: RunRecord, where: Path) -> list[tuple[str, str]]:
    return [(_checked_name(where, name), cut(str(value), PARAM_LENGTH)) for name, value in record.params.items()]


def _metrics(record: RunRecord, run_json: Path) -> Iterator[Point]:
    """Scores as `{task}.{metric}`, timings as `seconds.{stage}`, histories as `{history}.{metric}` by step."""
    end = milliseconds(record.ended)
    for stage, seconds in record.timings.items():
        yield Point(f"seconds.{stage}", seconds, 0, end)
    if record.scores_file:
        for task, metric, value in _table(run_json, record.scores_file, ("task", "metric", "value")):
            yield Point(f"{task}.{metric}", _number(value), 0, end)
    for history, name in record.histories.items():
        for step, metric, value in _table(run_json, name, ("step", "metric", "value")):
            yield Point(f"{history}.{metric}", _number(value), int(step), end)


def _system_metrics(record: RunRecord, run_json: Path, results: Path) -> Iterator[Point]:
    """Use of processor, memory and GPU as `system/{stage}.{what}`, which MLflow shows as system metrics; steps are seconds.

    From the last attempt of each job, the one that made the result. Jobs without a record, as of stages run by hand, have none.
    """
    for stage, path in _jobs(record, run_json, results).items():
        attempts = JobRecord.load(path).attempts if path.is_file() else []
        for attempt in attempts[-1:]:
            start = milliseconds(datetime.fromisoformat(attempt.started))
            for seconds, *values in attempt.samples:
                for what, value in zip(SAMPLES, values, strict=True):
                    if seconds is not None and value is not None:
                        yield Point(f"system/{stage}.{what}", value, round(seconds), start + round(1000 * seconds))
            whole = {
                "peak_memory_mb": attempt.peak_memory_mb,
                "peak_gpu_memory_mb": attempt.peak_gpu_memory_mb,
                "mean_gpu_percent": attempt.gpu_utilisation,
            }
            for what, value in whole.items():
                if value is not None:
                    yield Point(f"system/{stage}.{what}", value, 0, start)


def _jobs(record: RunRecord, run_json: Path, results: Path) -> dict[str, Path]:
    """Stage -> where its job record lies, if it has one: jobs are filed by stage, and then as their results are."""
    folders = {"score": run_json.parent}
    folders |= {Path(name).stem: run_json.parent / Path(name).parent for name in record.artifacts.get("records", [])}
    jobs = {}
    for stage, folder in folders.items():
        parts = Path(os.path.relpath(folder.resolve(), results.resolve())).parts
        if len(parts) == 3 and ".." not in parts:
            scenario, row, seed = parts
            # A search's row is its folder without `search-`.
            row = row.removeprefix("search-") if stage == "search" else row
            # A baseline's model has a rule of its own for its rollout.
            rule = "predict" if stage == "rollout" and "model" in record.variant else stage
            jobs[stage] = results / JOBS / rule / scenario / row / f"{seed}.json"
    return jobs


def _table(run_json: Path, name: str, columns: tuple[str, ...]) -> list[tuple[Any, ...]]:
    """Rows of the named columns of a Parquet file beside a record. Raises InputError."""
    import pandas

    path = _named_file(run_json, run_json.parent / name)
    try:
        table = pandas.read_parquet(path, columns=list(columns))
        types = {"step": "int64", "value": "float64"}
        table = table.astype({column: types[column] for column in columns if column in types})
    except (OSError, ValueError, TypeError, KeyError) as error:
        rule = f"must be a Parquet table with the columns {', '.join(columns)}"
        reason = cut(f"{type(error).__name__}: {error}".partition("\n")[0], 300)
        raise InputError(path, rule, reason, f"Delete {run_json} and run again.") from error
    return list(table.itertuples(index=False, name=None))


def _named_file(run_json: Path, path: Path) -> Path:
    if not path.is_file():
        raise InputError(path, f"named by {run_json}", "no such file", f"Delete {run_json} and run again.")
    return path


def _checked_name(where: Path, name: str) -> str:
    if not METRIC_NAME.fullmatch(name):
        raise InputError(where, f"names of parameters and metrics must match {METRIC_NAME.pattern}", repr(name))
    return name


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
