"""The MLflow store: where it is, how it is created and upgraded, what it holds, and the locks that tell loggers apart.

mlflow is imported only when it is used, after its environment is set.
"""

from __future__ import annotations

import json
import os
import re
import socket
import sqlite3
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from neuspring.config import Tracking
from neuspring.core.errors import InputError
from neuspring.core.text import masked

if TYPE_CHECKING:
    from filelock import BaseFileLock
    from mlflow import MlflowClient
    from mlflow.entities import Run

ENVIRONMENT = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
"""Set before mlflow is imported, where the user has not set them: no telemetry; no tracebacks beside our own one-line warnings;
and a server that is away costs seconds. With MLflow's own defaults (7 retries of 120 s) it would cost minutes."""
ARTIFACTS = "mlartifacts"
PORTS = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}
VIEW = "scores"
"""Name of the view of the table of runs that has scores as columns; a tag of the experiment holds it, as its page would."""
LOGGED_COLUMNS = [
    f"metrics.`{task}.{metric}`" for task in ("reconstruction", "future") for metric in ("chamfer", "track_error", "psnr")
]
LOCK_PATIENCE = 600.0
"""Seconds to wait for another process that logs the same record or creates the database."""


def default_uri(results: Path) -> str:
    """The tracking URI of a results folder that has no server: a SQLite file in it."""
    return f"sqlite:///{Path(results).resolve() / 'mlflow.db'}"


def uri_of(results: Path, settings: Tracking) -> str:
    """The tracking URI that the settings mean."""
    return settings.uri or default_uri(results)


def find(results: Path, settings: Tracking) -> tuple[MlflowClient, str] | None:
    """A client and the experiment's id; None where there is no such store or experiment. Raises whatever MLflow raises."""
    uri = uri_of(results, settings)
    if _is_missing(uri):
        return None
    _probe(uri)
    client = _client(uri)
    experiment = _experiment(client, results, settings)
    return (client, experiment) if experiment else None


def explained(error: Exception, results: Path, settings: Tracking) -> str:
    """The first line of an error of MLflow; of a database that a newer version wrote, what to do."""
    line = (str(error).strip().splitlines() or [""])[0] or type(error).__name__
    if not re.search("Can't locate revision|out-of-date database schema", str(error)):
        return masked(line)
    what = f"written by another version of MLflow than {version('mlflow')}; use that one, or delete mlflow.db and {ARTIFACTS}"
    return f"{what} and run `neuspring sync`, which rebuilds both: {masked(uri_of(results, settings))}"


def page(results: Path, settings: Tracking) -> str:
    """The place in MLflow's pages where the runs are, with the scores as columns. Raises InputError where it cannot be shown."""
    uri, again = masked(uri_of(results, settings)), f"`neuspring sync --results {results}`"
    if settings.uri is None and not any(Path(results).glob("*/*/*/run.json")):
        raise InputError(results, "a results folder with runs is required", "no run.json", "Name it: --results ...")
    if settings.uri is None and _is_missing(uri):
        raise InputError(uri, "MLflow's index must be there", "no such file", f"Make it: {again}.")
    try:
        client, experiment = prepare(results, settings)
        client.set_experiment_tag(experiment, f"mlflow.sharedViewState.{VIEW}", json.dumps({"selectedColumns": LOGGED_COLUMNS}))
        held = len(search(client, experiment, logged="complete"))
    except Exception as error:
        rule = "MLflow must be able to open it"
        raise InputError(uri, rule, explained(error, results, settings)) from error
    if settings.uri is None and held and not (Path(results) / ARTIFACTS).is_dir():
        remedy = f"Delete mlflow.db in {results} and run `neuspring sync --results {results}`."
        raise InputError(
            Path(results) / ARTIFACTS, f"must hold the files of the {held} runs in mlflow.db", "no such folder", remedy
        )
    return f"#/experiments/{experiment}/runs?viewStateShareKey={VIEW}"


def connect(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """A client and the experiment's id; creates the store if `init` has not run. Raises whatever MLflow raises."""
    return find(results, settings) or prepare(results, settings)


def prepare(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """Bring the database's schema up to date and create the experiment, one process at a time. Raises whatever MLflow raises."""
    uri = uri_of(results, settings)
    database = _database_file(uri)
    with lock(database.with_name(f"{database.name}.lock") if database else lock_path(results, "init")):
        if database and _is_missing(uri):
            # Built aside: a process killed in the middle of the migrations would leave a database that no client can open again.
            part = database.with_name(f"{database.name}.part")
            part.unlink(missing_ok=True)
            _upgrade(f"sqlite:///{part}")
            part.replace(database)
        elif _is_database(uri):
            _probe(uri)
            _upgrade(uri)
        client = _client(uri)
        if identifier := _experiment(client, results, settings):
            return client, identifier
        # A server has its own place for artifacts. Without a server MLflow would take ./mlruns of the first process, for ever.
        location = _artifact_location(results, settings) if _is_database(uri) else None
        try:
            return client, client.create_experiment(settings.experiment, artifact_location=location)
        except Exception:
            # Another machine may have created it between our question and our request; our lock does not reach that far.
            if identifier := _experiment(client, results, settings):
                return client, identifier
            raise


def search(client: MlflowClient, experiment: str, **tags: str) -> list[Run]:
    """All runs of the experiment with these tags (values without quotes: keys, names and numbers)."""
    terms = [f"tags.{name} = '{value}'" for name, value in tags.items()]
    runs: list[Run] = []
    token: str | None = None
    while True:
        page = client.search_runs([experiment], " and ".join(terms), page_token=token)
        runs += page
        token = page.token
        if not token:
            return runs


def is_complete(run: Run) -> bool:
    """True if everything of a run was sent."""
    return run.data.tags.get("logged") == "complete" and run.info.status in ("FINISHED", "FAILED")


# --- locks and details ---


def lock_path(results: Path, name: str) -> Path:
    """The lock file of a run key, or of another name."""
    return results / ".locks" / f"{name}.lock"


def lock(path: Path, timeout: float = LOCK_PATIENCE) -> BaseFileLock:
    """A lock that the kernel frees when its holder dies. Its file stays: removing it would let two processes hold it."""
    from filelock import FileLock

    path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path, timeout=timeout)


def _set_environment() -> None:
    """Set ENVIRONMENT. Call this before every import of mlflow, which reads it once."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def _client(uri: str) -> MlflowClient:
    _set_environment()
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=uri)


def _upgrade(uri: str) -> None:
    """Upgrade as `mlflow db upgrade` does, in this process: a command line would show the database's password to `ps`."""
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


def _artifact_location(results: Path, settings: Tracking) -> str:
    return (results.resolve() / ARTIFACTS / settings.experiment).as_uri()


def _is_database(uri: str) -> bool:
    return re.split("[:+]", uri)[0] in ("sqlite", *PORTS)


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
        socket.create_connection((address.hostname, address.port or PORTS[re.split("[:+]", uri)[0]]), timeout=5).close()
