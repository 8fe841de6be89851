"""The MLflow store: where it is, how it is created and upgraded, a client of it, and the locks that tell loggers apart.

mlflow is imported only when it is used, after its environment is set.
"""

from __future__ import annotations

import os
import socket
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from neuspring.config import Tracking

if TYPE_CHECKING:
    from filelock import BaseFileLock
    from mlflow import MlflowClient

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
PATIENCE = 600.0
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


def connect(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """A client and the experiment's id; creates the store if `init` has not run. Raises whatever MLflow raises."""
    return find(results, settings) or prepare(results, settings)


def prepare(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """Bring the database's schema up to date and create the experiment, one process at a time. Raises whatever MLflow raises."""
    uri = uri_of(results, settings)
    database = _database_file(uri)
    with lock(database.with_name(f"{database.name}.lock") if database else lock_path(results, "init")):
        if _is_database(uri):
            _migrate(uri)
        client = _client(uri)
        return client, _experiment(client, results, settings) or _create_experiment(client, results, settings)


def lock_path(results: Path, name: str) -> Path:
    """The lock file of a run key, or of another name."""
    return results / ".locks" / f"{name}.lock"


def lock(path: Path, timeout: float = PATIENCE) -> BaseFileLock:
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
    location = _artifact_location(results, settings) if _is_database(uri_of(results, settings)) else None
    try:
        return client.create_experiment(settings.experiment, artifact_location=location)
    except Exception:
        # Another machine may have created it between our question and our request; our lock does not reach that far.
        if identifier := _experiment(client, results, settings):
            return identifier
        raise


def _artifact_location(results: Path, settings: Tracking) -> str:
    return (results.resolve() / ARTIFACTS / settings.experiment).as_uri()


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
