"""The MLflow index of the run records. Files are the record; this index can be deleted and rebuilt from them (`sync`).

Only the tracking modules import mlflow, and only when it is used. An MLflow, network or database error never fails a run: it
becomes the outcome `unreachable: <reason>` and a warning, and `sync` logs the run later.

A run in MLflow is complete when it carries the tag `logged = complete`, which is set after everything else was sent. A run
without that tag was left behind by a killed logger, if nobody holds the lock of its record (`<results>/.locks/<run key>.lock`); it
is deleted when the record is logged.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config import Config, Tracking, plain
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.job_records import FOLDER as JOBS
from neuspring.core.job_records import JobRecord
from neuspring.core.run_record import RUN_RECORD, RunRecord, flat, key_of
from neuspring.core.text import masked
from neuspring.experiments.tracking.store import (
    connect,
    explained,
    is_complete,
    lock,
    lock_path,
    prepare,
    search,
    uri_of,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Param

MOST_PARAMS = 60
PARAM_LENGTH, TAG_LENGTH = 500, 5000
"""These keep MLflow's tables readable. The full text stays in run.json."""
METRIC_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:/ -]{0,249}")
SAMPLE_COLUMNS = ("cpu_percent", "memory_mb", "gpu_percent", "gpu_memory_mb")
"""Columns of a job record's samples, after the time."""
OUTCOME = "mlflow.txt"
"""The outcome of logging a record, beside it; the workflow's rule writes it."""
METRICS_PER_CALL = 1000
"""Limit of MLflow's API; that of parameters is 100."""


def init(results: Path, settings: Tracking) -> dict[str, str]:
    """Create or upgrade the database, and create the experiment. Run it once, before jobs that log; again does no harm.

    MLflow breaks a new database for good when several processes create it at once, so this holds a lock, and a new SQLite
    file is built aside and renamed when complete. Returns `outcome` ("ready", "disabled" or "unreachable: <reason>") with
    `uri`, `experiment` and, when ready, `experiment_id`.
    """
    facts = {"uri": masked(uri_of(results, settings)), "experiment": settings.experiment}
    if not settings.enabled:
        return {"outcome": "disabled", **facts}
    try:
        _, experiment = prepare(Path(results), settings)
    except Exception as error:
        line = explained(error, results, settings)
        return {"outcome": _unreachable(line, "no run will be logged until `init` succeeds"), **facts}
    return {"outcome": "ready", **facts, "experiment_id": experiment}


def log_run(run_json: Path, results: Path, settings: Tracking) -> str:
    """Log one run record; logging it again changes nothing.

    The same results made again, by another commit or later, are the same run.
    Returns "logged", "already logged", "disabled" or "unreachable: <reason>". Raises InputError for a damaged record or a file
    that it names and that is missing or damaged; nothing else.
    """
    if not settings.enabled:
        return "disabled"
    run_json, results = Path(run_json), Path(results)
    record = RunRecord.load(run_json)
    try:
        # Locked to the end, not only while the run is created: the lock tells a live logger from a killed one.
        with lock(lock_path(results, record.run_key)):
            client, experiment = connect(results, settings)
            return _log(client, experiment, record, run_json, results)
    except InputError:
        raise
    except Exception as error:
        line = explained(error, results, settings)
        return _unreachable(line, f"{record.name} is not logged; its files are complete, `sync` will log it")


def sync(results: Path, settings: Tracking, progress: Callable[[str], object] = lambda line: None) -> dict[str, list[str]]:
    """Log every run.json under `results` that MLflow lacks; an empty database is rebuilt like this.

    An mlflow.txt beside a record that says "unreachable" is corrected. `progress` receives one line per run. Returns the run names
    by outcome: those of `log_run`, and "damaged" (details on stderr).
    """
    results = Path(results).resolve()
    outcomes: dict[str, list[str]] = {}

    def note(name: str, outcome: str) -> None:
        outcomes.setdefault(outcome, []).append(name)
        progress(f"{name}: {outcome}")

    down = _down(results, settings) if settings.enabled else None
    # The copies among MLflow's artifacts lie deeper.
    for path in sorted(results.glob(f"*/*/*/{RUN_RECORD}")):
        name = path.parent.relative_to(results).as_posix()
        if down:
            note(name, down)
            continue
        try:
            outcome = log_run(path, results, settings)
        except InputError as error:
            _warn(f"{name} is not logged: {error}")
            outcome = "damaged"
        note(name, outcome)
        file = path.with_name(OUTCOME)
        if outcome in ("logged", "already logged") and file.is_file() and file.read_text().startswith("unreachable"):
            write_text(file, f"{outcome}\n")
        if outcome.startswith("unreachable"):
            # One bad run must not stop the others, but a server that is down must not cost its timeout once per run.
            down = _down(results, settings)
    return outcomes


# --- sending ---


def _log(client: MlflowClient, experiment: str, record: RunRecord, run_json: Path, results: Path) -> str:
    """Log a record whose lock the caller holds."""
    runs = search(client, experiment, run_key=record.run_key)
    # A killed logger may have ended its run and died before the last tag. Then the run is FINISHED, but not complete.
    for run in runs:
        if not is_complete(run):
            client.delete_run(run.info.run_id)
    if any(map(is_complete, runs)):
        return "already logged"
    # All is read and checked before anything is sent.
    params, metrics, files = payload(record, run_json, results)
    start, end = milliseconds(record.started), milliseconds(record.ended)
    tags = _tags(record, run_json.parent)
    run_id = client.create_run(experiment, start_time=start, tags=tags, run_name=record.name).info.run_id
    client.log_batch(run_id, params=params)
    for first in range(0, len(metrics), METRICS_PER_CALL):
        client.log_batch(run_id, metrics=metrics[first : first + METRICS_PER_CALL])
    for path, folder in files:
        client.log_artifact(run_id, str(path), folder)
    client.set_terminated(run_id, "FINISHED" if record.status == "ok" else "FAILED", end)
    client.set_tag(run_id, "logged", "complete")
    return "logged"


# --- messages ---


def _down(results: Path, settings: Tracking) -> str | None:
    """Why the store cannot be used; None if it can."""
    try:
        connect(results, settings)
    except Exception as error:
        return _unreachable(explained(error, results, settings), "the runs not yet logged are left for the next `sync`")
    return None


def _unreachable(line: str, consequence: str) -> str:
    """The outcome, with the first line of the error, short and without passwords; told as a warning with its consequence."""
    outcome = f"unreachable: {cut(line, 300)}"
    _warn(f"{outcome}; {consequence}.")
    return outcome


def _warn(message: str) -> None:
    print(f"warning: tracking: {message}", file=sys.stderr)


# --- what is sent for a run: its record and the files that it names, read and checked before anything is sent ---


def payload(record: RunRecord, run_json: Path, results: Path) -> tuple[list[Param], list[Metric], list[tuple[Path, str | None]]]:
    """(parameters, metrics, local files with their artifact folder, None: the root) of a record and of its stages' job records.

    Raises InputError.
    """
    from mlflow.entities import Param

    folder = run_json.parent
    files: list[tuple[Path, str | None]] = [(run_json, None)]
    for target, names in record.artifacts.items():
        files += [(_named_file(run_json, folder / name), target) for name in names]
    targets = [(target, path.name) for path, target in files]
    if doubles := [target for target in targets if targets.count(target) > 1]:
        raise InputError(run_json, "artifacts of one folder must have different file names", doubles[0])
    metrics = [*_metrics(record, run_json), *_system_metrics(record, run_json, results)]
    for name in [*record.params, *{metric.key for metric in metrics}]:
        if not METRIC_NAME.fullmatch(name):
            raise InputError(run_json, f"names of parameters and metrics must match {METRIC_NAME.pattern}", repr(name))
    return [Param(name, cut(str(value), PARAM_LENGTH)) for name, value in _params(record).items()], metrics, files


def _params(record: RunRecord) -> dict[str, Any]:
    """The settings that tell runs apart, named as in the configuration: the method's switches, and what has not its default value.

    `settings` is a digest of all, so that a comparison sees also what is not listed. In full they are in run.json.
    """
    defaults = flat(plain(Config()))
    given = {name: value for name, value in record.params.items() if ".result." not in name}
    found = dict(record.variant)
    for name, value in given.items():
        stage, _, key = name.partition(".")
        if stage != "method" and (key not in defaults or defaults[key] != value):
            found.setdefault(key if "." in key else name, value)
    return {"settings": key_of(given)[:16], **dict(list(found.items())[: MOST_PARAMS - 1])}


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


def _metrics(record: RunRecord, run_json: Path) -> Iterator[Metric]:
    """Scores as `{task}.{metric}`, timings as `seconds.{stage}`, histories as `{history}.{metric}` by step."""
    from mlflow.entities import Metric

    end = milliseconds(record.ended)
    if record.scores_file:
        for task, metric, value in _table(run_json, record.scores_file, ("task", "metric", "value")):
            yield Metric(f"{task}.{metric}", value, end, 0)
    for stage, seconds in record.timings.items():
        yield Metric(f"seconds.{stage}", seconds, end, 0)
    for history, name in record.histories.items():
        for step, metric, value in _table(run_json, name, ("step", "metric", "value")):
            yield Metric(f"{history}.{metric}", value, end, int(step))


def _system_metrics(record: RunRecord, run_json: Path, results: Path) -> Iterator[Metric]:
    """Use of processor, memory and GPU as `usage/{stage}.{what}`; steps are seconds.

    Not under `system/`: MLflow's page shows what is named so before everything else, and scores come first.

    They are those of each job's last attempt, which made the result. A stage that was run by hand has no job record and no such
    metrics.
    """
    from mlflow.entities import Metric

    for stage, path in _jobs(record, run_json, results).items():
        attempts = JobRecord.load(path).attempts if path.is_file() else []
        for attempt in attempts[-1:]:
            start = milliseconds(attempt.started)
            for seconds, *values in attempt.samples:
                for what, value in zip(SAMPLE_COLUMNS, values, strict=True):
                    if seconds is not None and value is not None:
                        yield Metric(f"usage/{stage}.{what}", value, start + round(1000 * seconds), round(seconds))
            totals = {
                "peak_memory_mb": attempt.peak_memory_mb,
                "peak_gpu_memory_mb": attempt.peak_gpu_memory_mb,
                "mean_gpu_percent": attempt.gpu_utilization,
            }
            for what, value in totals.items():
                if value is not None:
                    yield Metric(f"usage/{stage}.{what}", value, start, 0)


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
            rule = "predict" if stage == "rollout" and record.model else stage
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
