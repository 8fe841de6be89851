"""The MLflow index of the run records. Files are the record; this index can be deleted and rebuilt from them (`sync`).

Only the tracking modules import mlflow, and only when it is used. An MLflow, network or database error never fails a run: it
becomes the outcome `unreachable: <reason>` and a warning, and `sync` logs the run later.

A run in MLflow is complete when it carries the tag `logged = complete`, which is set after everything else was sent. A run
without that tag was left behind by a killed logger, if nobody holds the lock of its record (`<results>/.locks/<run key>.lock`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from neuspring.config import Tracking
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.core.text import masked
from neuspring.experiments.tracking.payload import Payload, cut, milliseconds, payload
from neuspring.experiments.tracking.store import (
    AGAIN,
    ARTIFACTS,
    connect,
    default_uri,
    is_complete,
    lock,
    lock_path,
    prepare,
    search,
    uri_of,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

__all__ = ["RunRecord", "default_uri", "init", "log_run", "sync"]
T = TypeVar("T")
OUTCOME = "mlflow.txt"
"""The outcome of logging a record, beside it; the workflow's rule writes it."""
METRICS_PER_CALL, PARAMS_PER_CALL = 1000, 100
"""Limits of MLflow's API."""


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
        return {"outcome": _unreachable(error, "no run will be logged until `init` succeeds"), **facts}
    return {"outcome": "ready", **facts, "experiment_id": experiment}


def log_run(run_json: Path, results: Path, settings: Tracking) -> str:
    """Log one run record; logging it again changes nothing.

    The same results made again, by another commit or later, are the same run: it is noted there when, and by which commit.
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
        return _unreachable(error, f"{record.name} is not logged; its files are complete, `sync` will log it")


def sync(
    results: Path, settings: Tracking, progress: Callable[[str], object] = lambda line: None, under: Path | None = None
) -> dict[str, list[str]]:
    """Log every run.json under `results`, or under its folder `under`, that MLflow lacks; an empty database is rebuilt like this.

    Runs that killed loggers left RUNNING are closed as KILLED. An mlflow.txt beside a record that says "unreachable" is corrected.
    `progress` receives one line per run. Returns the run names by outcome: those of `log_run`, "damaged" (details on stderr) and
    "closed" (leftovers).
    """
    results, under = Path(results).resolve(), Path(under or results).resolve()
    if not under.is_relative_to(results):
        raise InputError("--under", f"must lie in the results folder {results}", under)
    outcomes: dict[str, list[str]] = {}

    def note(name: str, outcome: str) -> None:
        outcomes.setdefault(outcome, []).append(name)
        progress(f"{name}: {outcome}")

    records: list[Path] = []
    for folder, folders, files in os.walk(under):
        # Neither the copies among MLflow's artifacts, nor hidden folders.
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != ARTIFACTS)
        records += [Path(folder) / RUN_RECORD] if RUN_RECORD in files else []
    down = _close_leftovers(results, settings, note) if settings.enabled else None
    for path in records:
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
            down = _close_leftovers(results, settings, note)
    return outcomes


# --- sending ------------------------------------------------------------------------------------------------------------------


def _log(client: MlflowClient, experiment: str, record: RunRecord, run_json: Path, results: Path) -> str:
    """Log a record whose lock the caller holds."""
    runs = search(client, experiment, run_key=record.run_key)
    complete = next(filter(is_complete, runs), None)
    # A killed logger may have ended its run and died before the last tag. Then the run is FINISHED, but not complete.
    for run in runs:
        if not is_complete(run) and "superseded" not in run.data.tags:
            _close(client, run)
    if complete:
        _note_again(client, complete, record)
    else:
        _send(client, experiment, record, payload(record, run_json, results))
    _mark_superseded(client, experiment, record)
    return "already logged" if complete else "logged"


def _send(client: MlflowClient, experiment: str, record: RunRecord, content: Payload) -> None:
    from mlflow.entities import Metric, Param

    start, end = milliseconds(record.started), milliseconds(record.ended)
    run_id = client.create_run(experiment, start_time=start, tags=content.tags, run_name=record.name).info.run_id
    for params in _chunks(content.params, PARAMS_PER_CALL):
        client.log_batch(run_id, params=[Param(name, value) for name, value in params])
    for points in _chunks(content.metrics, METRICS_PER_CALL):
        client.log_batch(run_id, metrics=[Metric(p.name, p.value, p.time, p.step) for p in points])
    for path, folder in content.files:
        client.log_artifact(run_id, str(path), folder)
    client.set_terminated(run_id, "FINISHED" if record.status == "ok" else "FAILED", end)
    client.set_tag(run_id, "logged", "complete")


def _note_again(client: MlflowClient, run: Run, record: RunRecord) -> None:
    """Tag a run with the commit and time at which its results were made again, if they were."""
    ended = milliseconds(record.ended)
    first = record.commit == run.data.tags.get("commit") and ended == run.info.end_time
    if record.commit and not first and run.data.tags.get(f"{AGAIN}{record.commit}") != str(ended):
        client.set_tag(run.info.run_id, f"{AGAIN}{record.commit}", str(ended))


def _mark_superseded(client: MlflowClient, experiment: str, record: RunRecord) -> None:
    """Point the older complete runs of this scenario, method and seed to the newest by `superseded_by`.

    The order of logging does not matter. A record that returned (settings changed there and back) may be newer on disk than
    its run in MLflow, hence its own end is taken from the record.
    """
    runs = search(client, experiment, scenario=record.scenario, method=record.method, seed=str(record.seed))
    runs = [run for run in runs if is_complete(run)]

    def end(run: Run) -> tuple[int, bool]:
        own = run.data.tags["run_key"] == record.run_key
        return (milliseconds(record.ended) if own else run.info.end_time or 0), own

    newest = max(runs, key=end)
    for run in runs:
        pointer = run.data.tags.get("superseded_by")
        if run is newest and pointer:
            client.delete_tag(run.info.run_id, "superseded_by")
        elif run is not newest and pointer != newest.data.tags["run_key"]:
            client.set_tag(run.info.run_id, "superseded_by", newest.data.tags["run_key"])


def _close(client: MlflowClient, run: Run) -> None:
    """End a run that a killed logger left behind. The tag comes last, so that a close that fails is tried again."""
    client.set_terminated(run.info.run_id, "KILLED")
    client.set_tag(run.info.run_id, "superseded", "true")


def _chunks(items: list[T], size: int) -> Iterator[list[T]]:
    return (items[start : start + size] for start in range(0, len(items), size))


# --- records, leftovers, messages ---------------------------------------------------------------------------------------------


def _close_leftovers(results: Path, settings: Tracking, note: Callable[[str, str], None]) -> str | None:
    """Close RUNNING runs that nobody is logging. Returns why the store cannot be used, None if it can."""
    try:
        client, experiment = connect(results, settings)
        for run in search(client, experiment, status="RUNNING"):
            path = lock_path(results, run.data.tags.get("run_key", ""))
            # A shared store also holds runs of other results folders, whose locks are elsewhere: a logger may be alive there.
            ours = "run_key" in run.data.tags and (settings.uri is None or path.exists())
            if ours and _close_if_free(client, run, path):
                note(run.info.run_name or run.info.run_id, "closed")
    except Exception as error:
        return _unreachable(error, "the runs not yet logged are left for the next `sync`")
    return None


def _close_if_free(client: MlflowClient, run: Run, path: Path) -> bool:
    from filelock import Timeout

    try:
        with lock(path, timeout=0):
            # Its logger may have finished between the search and the lock.
            if client.get_run(run.info.run_id).info.status != "RUNNING":
                return False
            _close(client, run)
            return True
    except Timeout:
        return False  # a logger is at work


def _unreachable(error: Exception, consequence: str) -> str:
    """The outcome, with the first line of the error, short and without passwords; told as a warning with its consequence."""
    line = (str(error).strip().splitlines() or [""])[0] or type(error).__name__
    outcome = f"unreachable: {masked(cut(line, 300))}"
    _warn(f"{outcome}; {consequence}.")
    return outcome


def _warn(message: str) -> None:
    print(f"warning: tracking: {message}", file=sys.stderr)
