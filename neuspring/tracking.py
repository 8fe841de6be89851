"""The MLflow index of the run records. Files are the record; this index can be deleted and rebuilt from them (`sync`).

No other file imports mlflow, and this one imports it only when it is used. An MLflow, network or database error never fails a
run: it becomes the outcome `unreachable: <reason>` and a warning, and `sync` logs the run later.

A run in MLflow is complete when it carries the tag `logged = complete`, which is set after everything else was sent. A run
without that tag, whose record's lock (`<results>/.locks/<run key>.lock`) nobody holds, is what a killed logger left behind.
"""

from __future__ import annotations

import json
import math
import os
import re
import socket
import sqlite3
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar
from urllib.parse import urlsplit

from pydantic import AwareDatetime, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

from neuspring.config import Tracking
from neuspring.config_types import Name
from neuspring.errors import InputError
from neuspring.records import RECORD_FORMAT, read_json

if TYPE_CHECKING:
    from filelock import BaseFileLock
    from mlflow import MlflowClient
    from mlflow.entities import Run

T = TypeVar("T")
ENVIRONMENT = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
"""Defaults set before mlflow is imported, where the user has not set them. No telemetry; no tracebacks beside our own one-line
warnings; and a server that is away costs seconds, where MLflow's own defaults (7 retries of 120 s) would cost minutes."""
RECORD = "run.json"
ARTIFACTS = "mlartifacts"
PORTS = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}
METRICS_PER_CALL, PARAMS_PER_CALL, PARAM_LENGTH, TAG_LENGTH = 1000, 100, 500, 5000
"""The first two are limits of MLflow's API; the others keep its tables readable. The full text stays in run.json."""
METRIC_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:/ -]{0,249}")
RUN_KEY = re.compile(r"[0-9a-f]{8,64}")
PATIENCE = 600.0
"""Seconds to wait for another process that logs the same record or creates the database."""


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
    commit: str
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


def default_uri(results: Path) -> str:
    """The tracking URI of a results folder that has no server: a SQLite file in it."""
    return f"sqlite:///{Path(results).resolve() / 'mlflow.db'}"


def init(results: Path, settings: Tracking) -> dict[str, str]:
    """Create or upgrade the database, and create the experiment. Run it once, before jobs that log; again does no harm.

    MLflow breaks a new database for good when several processes create it at once, so this holds a lock, and a new SQLite
    file is built aside and renamed when complete. Returns `outcome` ("ready", "disabled" or "unreachable: <reason>") with
    `uri`, `experiment` and, when ready, `experiment_id`.
    """
    facts = {"uri": _masked(_uri(results, settings)), "experiment": settings.experiment}
    if not settings.enabled:
        return {"outcome": "disabled", **facts}
    try:
        _, experiment = _prepare(Path(results), settings)
    except Exception as error:
        return {"outcome": _unreachable(error, "no run will be logged until `init` succeeds"), **facts}
    return {"outcome": "ready", **facts, "experiment_id": experiment}


def log_run(run_json: Path, results: Path, settings: Tracking) -> str:
    """Log one run record; logging it again changes nothing.

    Returns "logged", "already logged", "disabled" or "unreachable: <reason>". Raises InputError for a damaged record or a file
    that it names and that is missing or damaged; nothing else.
    """
    if not settings.enabled:
        return "disabled"
    run_json, results = Path(run_json), Path(results)
    record = RunRecord.load(run_json)
    try:
        # Held to the end, not only while the run is created: a held lock is how others tell a live logger from a killed one.
        with _lock(_lock_path(results, record.run_key)):
            client, experiment = _connect(results, settings)
            return _log(client, experiment, record, run_json)
    except InputError:
        raise
    except Exception as error:
        return _unreachable(error, f"{record.name} is not logged; its files are complete, `sync` will log it")


def sync(results: Path, settings: Tracking, progress: Callable[[str], object] = lambda line: None) -> dict[str, list[str]]:
    """Bring the index up to date with every run.json under `results`; on an empty database this rebuilds it.

    Also closes, as KILLED, the runs that killed loggers left RUNNING. `progress` receives one line per run. Returns the run
    names by outcome: those of `log_run`, "damaged" (details on stderr) and "closed" (leftovers).
    """
    results = Path(results)
    outcomes: dict[str, list[str]] = {}

    def note(name: str, outcome: str) -> None:
        outcomes.setdefault(outcome, []).append(name)
        progress(f"{name}: {outcome}")

    down = _close_leftovers(results, settings, note) if settings.enabled else None
    for path in _records(results):
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
        if outcome.startswith("unreachable"):
            # One bad run must not stop the others, but a server that is down must not cost its timeout once per run.
            down = _close_leftovers(results, settings, note)
    return outcomes


# --- what is sent -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Payload:
    """Everything of a record that goes to MLflow, read and checked before a run is created."""

    tags: dict[str, str]
    params: list[tuple[str, str]]
    metrics: list[tuple[str, float, int]]
    """Name, value, step."""
    files: list[tuple[Path, str | None]]
    """Local file, artifact folder (None: the root)."""


def _payload(record: RunRecord, run_json: Path) -> _Payload:
    """Read what a record names. Raises InputError."""
    folder = run_json.parent
    files: list[tuple[Path, str | None]] = [(run_json, None)]
    for target, names in record.artifacts.items():
        files += [(_named_file(run_json, folder / name), target) for name in names]
    taken = [(target, path.name) for path, target in files]
    if doubled := [pair for pair in taken if taken.count(pair) > 1]:
        raise InputError(run_json, "artifacts of one folder must have different file names", doubled[0])
    return _Payload(tags=_tags(record), params=_params(record, run_json), metrics=_metrics(record, run_json), files=files)


def _tags(record: RunRecord) -> dict[str, str]:
    names = ("scenario", "category", "source", "method", "seed", "attempt", "status", "reason", "commit", "data_digest", "device")
    tags = {name: str(getattr(record, name)) for name in (*names, "run_key")}
    tags |= {f"variant.{name}": str(value) for name, value in record.variant.items()}
    if record.commit:
        tags["mlflow.source.git.commit"] = record.commit  # MLflow's pages show this one as the version
    return {name: _cut(value, TAG_LENGTH) for name, value in tags.items()}


def _params(record: RunRecord, where: Path) -> list[tuple[str, str]]:
    return [(_checked_name(where, name), _cut(str(value), PARAM_LENGTH)) for name, value in record.params.items()]


def _metrics(record: RunRecord, run_json: Path) -> list[tuple[str, float, int]]:
    """Scores as `{task}.{metric}`, timings as `seconds.{stage}`, histories as `{history}.{metric}` by step."""
    metrics = [(f"seconds.{stage}", value, 0) for stage, value in record.timings.items()]
    if record.scores_file:
        rows = _table(run_json, record.scores_file, ("task", "metric", "value"))
        metrics += [(f"{task}.{metric}", _number(value), 0) for task, metric, value in rows]
    for history, name in record.histories.items():
        rows = _table(run_json, name, ("step", "metric", "value"))
        metrics += [(f"{history}.{metric}", _number(value), int(step)) for step, metric, value in rows]
    for name in {name for name, _, _ in metrics}:
        _checked_name(run_json, name)
    return metrics


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
        raise InputError(path, rule, f"{type(error).__name__}: {_line(error)}", f"Delete {run_json} and run again.") from error
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


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


# --- sending it ---------------------------------------------------------------------------------------------------------------


def _log(client: MlflowClient, experiment: str, record: RunRecord, run_json: Path) -> str:
    """Log a record whose lock is held."""
    known = _search(client, experiment, run_key=record.run_key)
    complete = any(map(_is_complete, known))
    # A killed logger may also have ended its run and died before the last tag: then it is FINISHED, but not complete.
    for run in known:
        if not _is_complete(run) and "superseded" not in run.data.tags:
            _close(client, run)
    if not complete:
        _send(client, experiment, record, _payload(record, run_json))
    _mark_superseded(client, experiment, record)
    return "already logged" if complete else "logged"


def _send(client: MlflowClient, experiment: str, record: RunRecord, payload: _Payload) -> None:
    from mlflow.entities import Metric, Param

    start, end = _milliseconds(record.started), _milliseconds(record.ended)
    run_id = client.create_run(experiment, start_time=start, tags=payload.tags, run_name=record.name).info.run_id
    for params in _chunks(payload.params, PARAMS_PER_CALL):
        client.log_batch(run_id, params=[Param(name, value) for name, value in params])
    for metrics in _chunks(payload.metrics, METRICS_PER_CALL):
        client.log_batch(run_id, metrics=[Metric(name, value, end, step) for name, value, step in metrics])
    for path, folder in payload.files:
        client.log_artifact(run_id, str(path), folder)
    client.set_terminated(run_id, "FINISHED" if record.status == "ok" else "FAILED", end)
    client.set_tag(run_id, "logged", "complete")


def _mark_superseded(client: MlflowClient, experiment: str, record: RunRecord) -> None:
    """Point the older complete runs of this scenario, method and seed to the newest by `superseded_by`.

    The order of logging does not matter. A record that returned (settings changed there and back) may be newer on disk than
    its run in MLflow, hence its own end is taken from the record.
    """
    runs = _search(client, experiment, scenario=record.scenario, method=record.method, seed=str(record.seed))
    runs = [run for run in runs if _is_complete(run)]

    def end(run: Run) -> tuple[int, bool]:
        own = run.data.tags["run_key"] == record.run_key
        return (_milliseconds(record.ended) if own else run.info.end_time or 0), own

    newest = max(runs, key=end)
    for run in runs:
        pointer = run.data.tags.get("superseded_by")
        if run is newest and pointer:
            client.delete_tag(run.info.run_id, "superseded_by")
        elif run is not newest and pointer != newest.data.tags["run_key"]:
            client.set_tag(run.info.run_id, "superseded_by", newest.data.tags["run_key"])


def _is_complete(run: Run) -> bool:
    return run.data.tags.get("logged") == "complete" and run.info.status in ("FINISHED", "FAILED")


def _close(client: MlflowClient, run: Run) -> None:
    """End a run that a killed logger left behind. The tag comes last, so that a close that fails is tried again."""
    client.set_terminated(run.info.run_id, "KILLED")
    client.set_tag(run.info.run_id, "superseded", "true")


def _search(client: MlflowClient, experiment: str, status: str | None = None, **tags: str) -> list[Run]:
    """All runs of the experiment with this status and these tags (values without quotes: keys, names and numbers)."""
    terms = [f"tags.{name} = '{value}'" for name, value in tags.items()]
    terms += [f"attributes.status = '{status}'"] if status else []
    runs: list[Run] = []
    token: str | None = None
    while True:
        page = client.search_runs([experiment], " and ".join(terms), page_token=token)
        runs += page
        token = page.token
        if not token:
            return runs


def _milliseconds(time: AwareDatetime) -> int:
    return round(time.timestamp() * 1000)


def _chunks(items: list[T], size: int) -> Iterator[list[T]]:
    return (items[start : start + size] for start in range(0, len(items), size))


# --- the store ----------------------------------------------------------------------------------------------------------------


def _set_environment() -> None:
    """Call this before every import of mlflow, which reads these once."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def _client(uri: str) -> MlflowClient:
    _set_environment()
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=uri)


def _connect(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """A client and the experiment's id; creates the store if `init` has not run. Raises whatever MLflow raises."""
    uri = _uri(results, settings)
    if not _is_missing(uri):
        _probe(uri)
        client = _client(uri)
        if identifier := _experiment(client, results, settings):
            return client, identifier
    return _prepare(results, settings)


def _prepare(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """Bring the database's schema up to date and create the experiment, one process at a time."""
    uri = _uri(results, settings)
    database = _database_file(uri)
    with _lock(database.with_name(f"{database.name}.lock") if database else _lock_path(results, "init")):
        if _is_database(uri):
            _migrate(uri)
        client = _client(uri)
        return client, _experiment(client, results, settings) or _create_experiment(client, results, settings)


def _migrate(uri: str) -> None:
    database = _database_file(uri)
    if database is None or not _is_missing(uri):
        _probe(uri)
        _upgrade(uri)
        return
    # Built aside: a process killed in the middle of the migrations would leave a database that no client can open again.
    part = database.with_name(f"{database.name}.part")
    part.unlink(missing_ok=True)
    _upgrade(f"sqlite:///{part}")
    part.replace(database)


def _upgrade(uri: str) -> None:
    """What `mlflow db upgrade` does, in this process: a command line would show the database's password to `ps`."""
    _set_environment()
    from mlflow.db import upgrade

    assert upgrade.callback is not None, "mlflow.db.upgrade is a click command with a function"
    upgrade.callback(url=uri)


def _experiment(client: MlflowClient, results: Path, settings: Tracking) -> str | None:
    """The experiment's id, None if it does not exist."""
    experiment = client.get_experiment_by_name(settings.experiment)
    if experiment is None:
        return None
    if experiment.lifecycle_stage != "active":
        raise RuntimeError(
            f"experiment {settings.experiment} is deleted; restore it (mlflow experiments restore -x "
            f"{experiment.experiment_id}) or set another tracking.experiment"
        )
    if settings.uri is None and experiment.artifact_location != _artifact_location(results, settings):
        raise RuntimeError(
            f"{results} has moved, but its index keeps artifacts at {experiment.artifact_location}; delete "
            f"mlflow.db and {ARTIFACTS} in it and run `sync`, which rebuilds both"
        )
    return experiment.experiment_id


def _create_experiment(client: MlflowClient, results: Path, settings: Tracking) -> str:
    # A server has its own place for artifacts. Without a server MLflow would take ./mlruns of the first process, for ever.
    location = _artifact_location(results, settings) if _is_database(_uri(results, settings)) else None
    try:
        return client.create_experiment(settings.experiment, artifact_location=location)
    except Exception:
        # Another machine may have created it between our question and our request; our lock does not reach that far.
        if identifier := _experiment(client, results, settings):
            return identifier
        raise


def _artifact_location(results: Path, settings: Tracking) -> str:
    return (results.resolve() / ARTIFACTS / settings.experiment).as_uri()


def _uri(results: Path, settings: Tracking) -> str:
    return settings.uri or default_uri(results)


def _is_database(uri: str) -> bool:
    return _scheme(uri) in ("sqlite", *PORTS)


def _scheme(uri: str) -> str:
    return uri.split(":", 1)[0].split("+", 1)[0]


def _database_file(uri: str) -> Path | None:
    """The file of a SQLite URI (absolute after `sqlite:////`, else relative to the working folder), None for other URIs."""
    path = uri.removeprefix("sqlite:///").split("?", 1)[0]
    return Path(path) if path and path != uri and path != ":memory:" else None


def _is_missing(uri: str) -> bool:
    database = _database_file(uri)
    return database is not None and not (database.is_file() and database.stat().st_size)


def _probe(uri: str) -> None:
    """Fail at once where MLflow would first retry a database for two minutes: damaged file, nobody at the address."""
    database = _database_file(uri)
    if database:
        with closing(sqlite3.connect(database, timeout=20)) as connection:
            connection.execute("PRAGMA schema_version").fetchone()
    elif _is_database(uri) and (address := urlsplit(uri)).hostname:
        socket.create_connection((address.hostname, address.port or PORTS[_scheme(uri)]), timeout=5).close()


# --- locks, leftovers, messages -----------------------------------------------------------------------------------------------


def _lock_path(results: Path, name: str) -> Path:
    return results / ".locks" / f"{name}.lock"


def _lock(path: Path, timeout: float = PATIENCE) -> BaseFileLock:
    """A lock that the kernel frees when its holder dies. Its file stays: removing it would let two processes hold it."""
    from filelock import FileLock

    path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path, timeout=timeout)


def _records(results: Path) -> Iterator[Path]:
    """Every run.json under `results`, in order, but not the copies among MLflow's artifacts, and no hidden folders."""
    for folder, folders, files in os.walk(results):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != ARTIFACTS)
        if RECORD in files:
            yield Path(folder) / RECORD


def _close_leftovers(results: Path, settings: Tracking, note: Callable[[str, str], None]) -> str | None:
    """Close RUNNING runs that nobody is logging. Returns why the store cannot be used, None if it can."""
    try:
        client, experiment = _connect(results, settings)
        for run in _search(client, experiment, status="RUNNING"):
            path = _lock_path(results, run.data.tags.get("run_key", ""))
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
        with _lock(path, timeout=0):
            # Its logger may have finished between the search and the lock.
            if client.get_run(run.info.run_id).info.status != "RUNNING":
                return False
            _close(client, run)
            return True
    except Timeout:
        return False  # a logger is at work


def _unreachable(error: Exception, consequence: str) -> str:
    outcome = f"unreachable: {_line(error)}"
    _warn(f"{outcome}; {consequence}.")
    return outcome


def _line(error: Exception) -> str:
    """The first line of an error, short and without passwords."""
    lines: Iterable[str] = str(error).strip().splitlines()
    return _masked(_cut(next(iter(lines), "") or type(error).__name__, 300))


def _masked(text: str) -> str:
    """Text without the user and password of any URI in it."""
    return re.sub(r"://[^/@\s]+@", "://***@", text)


def _warn(message: str) -> None:
    print(f"warning: tracking: {message}", file=sys.stderr)
