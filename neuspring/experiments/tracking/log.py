"""The MLflow index of the run records. It can be deleted and rebuilt from the records (`sync`).

mlflow is imported only on use. An MLflow, network or database error never fails a run: it becomes the outcome
`unreachable: <reason>` with a warning, and `sync` logs the run later.

A run in MLflow is complete if it has the tag `logged = complete`, which is set last. A run without this tag whose record is not
locked (`<results>/.locks/<run key>.lock`) was left by a killed logger; it is deleted when the record is logged.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config import Config, Tracking, plain
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.run_record import RUN_RECORD, RunRecord, flat, key_of
from neuspring.core.text import masked, readable
from neuspring.experiments.tracking.store import connect, default_uri, explained, lock, score_name

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric

MOST_PARAMS, TAG_LENGTH = 60, 5000
"""Limits that keep MLflow's tables readable; run.json contains everything."""
OUTCOME = "mlflow.txt"
"""File with the outcome of logging a record, in the record's folder; the workflow's job writes it."""


def init(results: Path, settings: Tracking) -> dict[str, str]:
    """Create the database and the experiment if they do not exist.

    Returns `outcome` ("ready", "disabled" or "unreachable: <reason>") with `uri`, `experiment` and, if ready, `experiment_id`.
    """
    facts = {"uri": masked(settings.uri or default_uri(results)), "experiment": settings.experiment}
    if not settings.enabled:
        return {"outcome": "disabled", **facts}
    try:
        _, experiment = connect(results, settings)
    except Exception as error:
        return {"outcome": _unreachable(error, results, settings, "no run is logged until `init` succeeds"), **facts}
    return {"outcome": "ready", **facts, "experiment_id": experiment}


def log_run(run_json: Path, results: Path, settings: Tracking) -> str:
    """Log one run record; logging it again changes nothing.

    Equal results, made later or by another commit, are the same run. Returns "logged", "already logged", "disabled" or
    "unreachable: <reason>". Raises only InputError, for a damaged record and for a missing or damaged file of the record.
    """
    if not settings.enabled:
        return "disabled"
    run_json, results = Path(run_json), Path(results)
    record = RunRecord.load(run_json)
    try:
        # The lock is held to the end, because it distinguishes a running logger from a killed one.
        with lock(results, record.run_key):
            return _log(*connect(results, settings), record, run_json)
    except InputError:
        raise
    except Exception as error:
        return _unreachable(error, results, settings, f"{record.name} is not logged; its files are complete, and `sync` logs it")


def sync(results: Path, settings: Tracking, progress: Callable[[str], object] = lambda line: None) -> dict[str, list[str]]:
    """Log every run.json in `results` that MLflow does not contain; this also rebuilds an empty database.

    An mlflow.txt with "unreachable" is corrected. `progress` receives one line per run. Returns the run names by outcome: the
    outcomes of `log_run`, and "damaged" (details on stderr).
    """
    results = Path(results).resolve()
    outcomes: dict[str, list[str]] = {}
    # `init` runs once, so that an unreachable server costs one timeout and not one per run.
    first = init(results, settings)["outcome"]
    # MLflow's artifacts contain copies at deeper levels, which the pattern excludes.
    for path in sorted(results.glob(f"*/*/*/{RUN_RECORD}")):
        name = path.parent.relative_to(results).as_posix()
        try:
            outcome = log_run(path, results, settings) if first == "ready" else first
        except InputError as error:
            _warn(f"{name} is not logged: {error}")
            outcome = "damaged"
        outcomes.setdefault(outcome, []).append(name)
        progress(f"{name}: {outcome}")
        file = path.with_name(OUTCOME)
        if outcome in ("logged", "already logged") and file.is_file() and file.read_text().startswith("unreachable"):
            write_text(file, f"{outcome}\n")
    return outcomes


def _unreachable(error: Exception, results: Path, settings: Tracking, consequence: str) -> str:
    """The outcome for an error of MLflow; prints it as a warning with its consequence."""
    outcome = f"unreachable: {explained(error, results, settings)}"
    _warn(f"{outcome}; {consequence}.")
    return outcome


def _warn(message: str) -> None:
    print(f"warning: tracking: {message}", file=sys.stderr)


# --- content of a run: its record and the files that it names, all read and checked before anything is sent ---


def _log(client: MlflowClient, experiment: str, record: RunRecord, run_json: Path) -> str:
    """Log a record whose lock the caller holds."""
    from mlflow.entities import Param

    # A killed logger may have left a FINISHED run without the last tag, which is incomplete.
    runs = client.search_runs([experiment], f"tags.run_key = '{record.run_key}'")
    complete = [run for run in runs if run.data.tags.get("logged") == "complete"]
    for run in runs:
        if run not in complete:
            client.delete_run(run.info.run_id)
    if complete:
        return "already logged"
    files = [(run_json, None)] + [(run_json.parent / name, target) for target, names in record.artifacts.items() for name in names]
    for path, _ in files:
        _require_file(run_json, path)
    metrics = list(_metrics(record, run_json))
    start, end = milliseconds(record.started), milliseconds(record.ended)
    run_id = client.create_run(experiment, start, _tags(record, run_json.parent), record.name).info.run_id
    params = [Param(name, str(value)) for name, value in params_of(record).items()]
    client.log_batch(run_id, metrics=metrics, params=params)
    for path, target in files:
        client.log_artifact(run_id, str(path), target)
    client.set_terminated(run_id, "FINISHED" if record.status == "ok" else "FAILED", end)
    client.set_tag(run_id, "logged", "complete")
    return "logged"


def params_of(record: RunRecord) -> dict[str, Any]:
    """The settings that distinguish runs: the method's own settings and non-default values, with the names of the configuration.

    `settings` is a digest of all settings, so a comparison also shows differences that are not listed; run.json contains all.
    """
    defaults = flat(plain(Config()))
    given = {name: value for name, value in record.params.items() if ".result." not in name}
    params = dict(record.variant)
    for name, value in given.items():
        stage, _, key = name.partition(".")
        if stage != "method" and (key not in defaults or defaults[key] != value):
            params.setdefault(key if "." in key else name, value)
    return {"settings": key_of(given)[:16], **dict(list(params.items())[: MOST_PARAMS - 1])}


def milliseconds(time: str) -> int:
    """MLflow's time, ms since 1970, of an ISO 8601 time with a time zone."""
    return round(datetime.fromisoformat(time).timestamp() * 1000)


def _tags(record: RunRecord, folder: Path) -> dict[str, str]:
    names = ("scenario", "category", "source", "method", "seed", "attempt", "status", "reason", "commit", "data_digest", "device")
    tags = {name: str(getattr(record, name)) for name in (*names, "run_key")}
    tags |= {f"variant.{name}": str(value) for name, value in record.variant.items()}
    if record.commit:
        tags["mlflow.source.git.commit"] = record.commit  # MLflow's pages show this tag as the version
    # The command that opens the twin is a tag, and part of the description on MLflow's page.
    tags["play"] = command = shlex.join(["neuspring", "play", str(folder)])
    tags["mlflow.note.content"] = f"Rotate and pull this run's twin in the browser:\n\n```\n{command}\n```\n"
    return {name: value[:TAG_LENGTH] for name, value in tags.items()}


def _metrics(record: RunRecord, run_json: Path) -> Iterator[Metric]:
    """Scores as `scores/{task}.{metric}`, histories as `training/{history}.{metric}` by step, timings and memory as `usage/...`.

    MLflow's pages of curves have one section per word before `/`, in alphabetical order; metrics without `/` come last.
    """
    from mlflow.entities import Metric

    end = milliseconds(record.ended)
    if record.scores_file:
        for task, metric, value, unit in _table(run_json, record.scores_file, "task", "unit"):
            yield Metric(score_name(task, metric, unit), readable(value, unit)[0], end, 0)
    for history, name in record.histories.items():
        for step, metric, value in _table(run_json, name, "step"):
            yield Metric(f"training/{history}.{metric}", value, end, int(step))
    for stage, seconds in record.timings.items():
        yield Metric(f"usage/{stage}.seconds", seconds, end, 0)
    for stage, megabytes in record.peak_memory_mb.items():
        yield Metric(f"usage/{stage}.peak_memory_mb", megabytes, end, 0)


def _table(run_json: Path, name: str, by: str, *more: str) -> list[tuple[Any, ...]]:
    """(`by`, metric, value, and `more`) for each row of a Parquet file in a record's folder. Raises InputError."""
    import pandas

    path, columns = _require_file(run_json, run_json.parent / name), [by, "metric", "value", *more]
    try:
        types = {"value": "float64"} | ({"step": "int64"} if by == "step" else {})
        table = pandas.read_parquet(path, columns=columns).astype(types)
    except (OSError, ValueError, TypeError, KeyError) as error:
        rule = f"must be a Parquet table with the columns {', '.join(columns)}"
        reason = f"{type(error).__name__}: {error}".partition("\n")[0][:300]
        raise InputError(path, rule, reason, f"Delete {run_json} and rerun the command.") from error
    return list(table.itertuples(index=False, name=None))


def _require_file(run_json: Path, path: Path) -> Path:
    if not path.is_file():
        raise InputError(path, f"this file of {run_json} must exist", "no such file", f"Delete {run_json} and rerun the command.")
    return path
