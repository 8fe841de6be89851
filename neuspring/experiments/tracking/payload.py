"""What is sent to MLflow for a run: its record and the files that it names, read and checked before anything is sent."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER as JOBS
from neuspring.core.job_records import JobRecord
from neuspring.core.run_record import RunRecord

PARAM_LENGTH, TAG_LENGTH = 500, 5000
"""These keep MLflow's tables readable. The full text stays in run.json."""
METRIC_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:/ -]{0,249}")
SAMPLES = ("cpu_percent", "memory_mb", "gpu_percent", "gpu_memory_mb")
"""Columns of a job record's samples, after the time."""


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
    targets = [(target, path.name) for path, target in files]
    if doubles := [target for target in targets if targets.count(target) > 1]:
        raise InputError(run_json, "artifacts of one folder must have different file names", doubles[0])
    metrics = [*_metrics(record, run_json), *_system_metrics(record, run_json, results)]
    for name in [*record.params, *{point.name for point in metrics}]:
        if not METRIC_NAME.fullmatch(name):
            raise InputError(run_json, f"names of parameters and metrics must match {METRIC_NAME.pattern}", repr(name))
    params = [(name, cut(str(value), PARAM_LENGTH)) for name, value in record.params.items()]
    return Payload(tags=_tags(record, folder), params=params, metrics=metrics, files=files)


def milliseconds(time: str) -> int:
    """ms since 1970, as MLflow counts, of an ISO 8601 time with a zone."""
    return round(datetime.fromisoformat(time).timestamp() * 1000)


def cut(text: str, length: int) -> str:
    """The text; one longer than `length` is cut short and ends in dots."""
    return text if len(text) <= length else text[: length - 3] + "..."


def _tags(record: RunRecord, folder: Path) -> dict[str, str]:
    names = ("scenario", "category", "source", "method", "seed", "attempt", "status", "reason", "commit", "data_digest", "device")
    tags = {name: str(getattr(record, name)) for name in (*names, "run_key")}
    tags |= {f"variant.{name}": str(value) for name, value in record.variant.items()}
    if record.commit:
        tags["mlflow.source.git.commit"] = record.commit  # MLflow's pages show this one as the version
    # How to look at the run and pull its twin: as a tag, and in the description on MLflow's page.
    tags["play"] = command = shlex.join(["neuspring", "play", str(folder)])
    tags["mlflow.note.content"] = f"To turn this run's twin in the browser, and pull it:\n\n```\n{command}\n```\n"
    return {name: cut(value, TAG_LENGTH) for name, value in tags.items()}


def _metrics(record: RunRecord, run_json: Path) -> Iterator[Point]:
    """Scores as `{task}.{metric}`, timings as `seconds.{stage}`, histories as `{history}.{metric}` by step."""
    end = milliseconds(record.ended)
    for stage, seconds in record.timings.items():
        yield Point(f"seconds.{stage}", seconds, 0, end)
    if record.scores_file:
        for task, metric, value in _table(run_json, record.scores_file, ("task", "metric", "value")):
            yield Point(f"{task}.{metric}", value, 0, end)
    for history, name in record.histories.items():
        for step, metric, value in _table(run_json, name, ("step", "metric", "value")):
            yield Point(f"{history}.{metric}", value, int(step), end)


def _system_metrics(record: RunRecord, run_json: Path, results: Path) -> Iterator[Point]:
    """Use of processor, memory and GPU as `system/{stage}.{what}`, which MLflow shows as system metrics; steps are seconds.

    They are those of each job's last attempt, which made the result. A stage that was run by hand has no job record and no such
    metrics.
    """
    for stage, path in _jobs(record, run_json, results).items():
        attempts = JobRecord.load(path).attempts if path.is_file() else []
        for attempt in attempts[-1:]:
            start = milliseconds(attempt.started)
            for seconds, *values in attempt.samples:
                for what, value in zip(SAMPLES, values, strict=True):
                    if seconds is not None and value is not None:
                        yield Point(f"system/{stage}.{what}", value, round(seconds), start + round(1000 * seconds))
            totals = {
                "peak_memory_mb": attempt.peak_memory_mb,
                "peak_gpu_memory_mb": attempt.peak_gpu_memory_mb,
                "mean_gpu_percent": attempt.gpu_utilization,
            }
            for what, value in totals.items():
                if value is not None:
                    yield Point(f"system/{stage}.{what}", value, 0, start)


def _jobs(record: RunRecord, run_json: Path, results: Path) -> dict[str, Path]:
    """Stage -> path of its job record, which need not exist: jobs/<rule>/, then the path of the results."""
    folders = {"score": run_json.parent}
    folders |= {Path(name).stem: run_json.parent / Path(name).parent for name in record.artifacts.get("records", [])}
    jobs = {}
    for stage, folder in folders.items():
        parts = Path(os.path.relpath(folder.resolve(), results.resolve())).parts
        if len(parts) == 3 and ".." not in parts:
            scenario, row, seed = parts
            # A search's row is its folder without `search-`.
            row = row.removeprefix("search-") if stage == "search" else row
            # A trained baseline writes the same rollout.json as a twin, but its rule is called predict.
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
