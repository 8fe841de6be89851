"""The MLflow index of the run records. Files are the record; this index can be deleted and rebuilt from them (`sync`).

Only the tracking modules import mlflow, and only when it is used. An MLflow, network or database error never fails a run: it
becomes the outcome `unreachable: <reason>` and a warning, and `sync` logs the run later.

A run in MLflow is complete when it carries the tag `logged = complete`, which is set after everything else was sent. A run
without that tag was left behind by a killed logger, if nobody holds the lock of its record (`<results>/.locks/<run key>.lock`); it
is deleted when the record is logged.
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
"""These keep MLflow's tables readable. All is in run.json."""
OUTCOME = "mlflow.txt"
"""The outcome of logging a record, beside it; the workflow's job writes it."""


def init(results: Path, settings: Tracking) -> dict[str, str]:
    """Create the database and the experiment. Run it once, before jobs that log; again does no harm.

    Returns `outcome` ("ready", "disabled" or "unreachable: <reason>") with `uri`, `experiment` and, when ready, `experiment_id`.
    """
    facts = {"uri": masked(settings.uri or default_uri(results)), "experiment": settings.experiment}
    if not settings.enabled:
        return {"outcome": "disabled", **facts}
    try:
        _, experiment = connect(results, settings)
    except Exception as error:
        return {"outcome": _unreachable(error, results, settings, "no run will be logged until `init` succeeds"), **facts}
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
        with lock(results, record.run_key):
            return _log(*connect(results, settings), record, run_json)
    except InputError:
        raise
    except Exception as error:
        return _unreachable(error, results, settings, f"{record.name} is not logged; its files are complete, `sync` will log it")


def sync(results: Path, settings: Tracking, progress: Callable[[str], object] = lambda line: None) -> dict[str, list[str]]:
    """Log every run.json under `results` that MLflow lacks; an empty database is rebuilt like this.

    An mlflow.txt beside a record that says "unreachable" is corrected. `progress` receives one line per run. Returns the run names
    by outcome: those of `log_run`, and "damaged" (details on stderr).
    """
    results = Path(results).resolve()
    outcomes: dict[str, list[str]] = {}
    # A server that is down must not cost its timeout once per run.
    first = init(results, settings)["outcome"]
    # The copies among MLflow's artifacts lie deeper.
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
    """The outcome of an error of MLflow, told as a warning with its consequence."""
    outcome = f"unreachable: {explained(error, results, settings)}"
    _warn(f"{outcome}; {consequence}.")
    return outcome


def _warn(message: str) -> None:
    print(f"warning: tracking: {message}", file=sys.stderr)


# --- what is sent for a run: its record and the files that it names, read and checked before anything is sent ---


def _log(client: MlflowClient, experiment: str, record: RunRecord, run_json: Path) -> str:
    """Log a record whose lock the caller holds."""
    from mlflow.entities import Param

    # A killed logger may have ended its run and died before the last tag. Then the run is FINISHED, but not complete.
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


def _tags(record: RunRecord, folder: Path) -> dict[str, str]:
    names = ("scenario", "category", "source", "method", "seed", "attempt", "status", "reason", "commit", "data_digest", "device")
    tags = {name: str(getattr(record, name)) for name in (*names, "run_key")}
    tags |= {f"variant.{name}": str(value) for name, value in record.variant.items()}
    if record.commit:
        tags["mlflow.source.git.commit"] = record.commit  # MLflow's pages show this one as the version
    # How to look at the run and pull its twin: as a tag, and in the description on MLflow's page.
    tags["play"] = command = shlex.join(["neuspring", "play", str(folder)])
    tags["mlflow.note.content"] = f"To turn this run's twin in the browser, and pull it:\n\n```\n{command}\n```\n"
    return {name: value[:TAG_LENGTH] for name, value in tags.items()}


def _metrics(record: RunRecord, run_json: Path) -> Iterator[Metric]:
    """Scores as `scores/{task}.{metric}`, histories as `training/{history}.{metric}` by step, timings and memory as `usage/...`.

    MLflow's pages of curves have a section for each word before `/`, in the order of the alphabet, and what has none comes last.
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
    """(`by`, metric, value, and `more`) of each row of a Parquet file beside a record. Raises InputError."""
    import pandas

    path, columns = _require_file(run_json, run_json.parent / name), [by, "metric", "value", *more]
    try:
        types = {"value": "float64"} | ({"step": "int64"} if by == "step" else {})
        table = pandas.read_parquet(path, columns=columns).astype(types)
    except (OSError, ValueError, TypeError, KeyError) as error:
        rule = f"must be a Parquet table with the columns {', '.join(columns)}"
        reason = f"{type(error).__name__}: {error}".partition("\n")[0][:300]
        raise InputError(path, rule, reason, f"Delete {run_json} and run again.") from error
    return list(table.itertuples(index=False, name=None))


def _require_file(run_json: Path, path: Path) -> Path:
    if not path.is_file():
        raise InputError(path, f"named by {run_json}", "no such file", f"Delete {run_json} and run again.")
    return path
