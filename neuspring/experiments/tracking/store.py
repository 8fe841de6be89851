"""The MLflow store: its location, its creation, and the locks that distinguish running loggers from killed ones.

mlflow is imported only on use, after its environment variables are set.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config import Tracking
from neuspring.core.errors import InputError
from neuspring.core.run_record import RUN_RECORD
from neuspring.core.text import masked, readable

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
    "PGCONNECT_TIMEOUT": "10",
}
"""Environment variables that are set before mlflow is imported, unless the user has set them: no telemetry, no tracebacks, and
short timeouts. MLflow's defaults (7 retries of 120 s) wait minutes for an unreachable server."""
DATABASE_RETRIES = 2
"""Number of connection attempts. MLflow's default of ten takes two minutes for an unreachable database."""
ARTIFACTS, INDEX = "mlartifacts", "mlflow.db"
REASONS = {
    "disk is full": "no space left on the disk of {results}; free some, then run `neuspring sync`",
    "no space left": "no space left on the disk of {results}; free some, then run `neuspring sync`",
    "readonly database": "{results} cannot be written; make it writable, then run `neuspring sync`",
    "read-only file system": "{results} cannot be written; make it writable, then run `neuspring sync`",
    "permission denied": "{results} cannot be written; make it writable, then run `neuspring sync`",
    "database is locked": "another program locks the index of {results}; close it, then run `neuspring sync`",
}
"""Part of an error message of SQLite or the system, in lower case -> explanation."""
VIEW = "scores"
"""Name of the view of the table of runs with names and scores first, stored in a tag of the experiment, as by MLflow's page."""
RUN_TAGS = ("method", "scenario", "seed")
"""Tags that are the first columns of the table of runs."""
SEED_WIDTH, SCORE_WIDTH = 70, 200
"""Widths of the seed column and of other columns, pixels."""
LOCK_PATIENCE = 600.0
"""Maximum waiting time for another process that logs the same record or creates the database, s."""


def default_uri(results: Path) -> str:
    """The tracking URI of a results folder without a server: a SQLite file in the folder."""
    return f"sqlite:///{Path(results).resolve() / INDEX}"


def lock(results: Path, name: str) -> BaseFileLock:
    """A lock that the kernel releases when its holder dies. Its file is kept, because removing it would allow two holders."""
    from filelock import FileLock

    path = Path(results) / ".locks" / f"{name}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path, timeout=LOCK_PATIENCE)


def connect(results: Path, settings: Tracking) -> tuple[MlflowClient, str]:
    """A client and the experiment's id; creates a missing database and experiment. Raises MLflow's exceptions."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    from mlflow import MlflowClient

    uri = settings.uri or default_uri(results)
    is_database, location = not uri.startswith("http"), None
    if is_database:
        from mlflow.store.db import utils

        utils.MAX_RETRY_COUNT = DATABASE_RETRIES
        # A server has its own artifact location. Without a server, MLflow would always use ./mlruns of the first process.
        location = (Path(results).resolve() / ARTIFACTS / settings.experiment).as_uri()
    # MLflow corrupts a new database if several processes create it at the same time.
    with lock(results, "init") if is_database else nullcontext():
        if settings.uri is None and location:
            _keep_moved(Path(results), settings.experiment, location)
        client = MlflowClient(tracking_uri=uri)
        experiment = client.get_experiment_by_name(settings.experiment)
        if experiment is None:
            return client, client.create_experiment(settings.experiment, artifact_location=location)
    return client, experiment.experiment_id


def _keep_moved(results: Path, experiment: str, location: str) -> None:
    """Rename the index of a moved or copied results folder: its artifact paths are wrong, but it may contain tags and notes."""
    database = results / INDEX
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as db:
        rows = db.execute("SELECT artifact_location FROM experiments WHERE name = ?", [experiment]).fetchall()
        if rows and rows[0][0] != location:
            renamed = database.with_name(f"mlflow-{time.strftime('%Y%m%d-%H%M%S')}.db")
            database.rename(renamed)
            print(f"{results} was moved: a new MLflow index is created; the old index is now {renamed.name}.", flush=True)


def explained(error: Exception, results: Path, settings: Tracking) -> str:
    """The first line of an MLflow error, short and without passwords; for the index of a results folder, with the next move."""
    line = masked((str(error).strip().splitlines() or [""])[0] or type(error).__name__)[:300]
    if settings.uri is not None:
        return line
    reason = next((words for part, words in REASONS.items() if part in line.lower()), "")
    return reason.format(results=results) or f"{line} (if it persists, rename {results}/{INDEX} and run `neuspring sync`)"


def _count_rows(database: Path) -> None:
    """Compute SQLite's query statistics, with which sorting 10,000 runs by a score is ten times faster."""
    # The database stores the statistics. If a job is writing now, older statistics suffice.
    with closing(sqlite3.connect(database, timeout=1)) as db, suppress(sqlite3.OperationalError):
        db.execute("PRAGMA analysis_limit = 1000")
        db.execute("ANALYZE")
        db.commit()


def score_name(task: str, metric: str, unit: str) -> str:
    """The name of a score in the index, with the unit for lengths."""
    return f"scores/{task}.{metric}" + ("_mm" if readable(0.0, unit)[1] == "mm" else "")


def _view() -> dict[str, Any]:
    """The state of MLflow's table of runs: method, scenario, seed, then all scores; MLflow hides columns that no run has."""
    from neuspring.scores.metrics import METRICS, TASKS

    tags = [f"tags.`{name}`" for name in RUN_TAGS]
    scores = [f"metrics.`{score_name(task, metric.name, metric.unit)}`" for task in TASKS for metric in METRICS.values()]
    widths = dict.fromkeys((*tags, *scores), SCORE_WIDTH) | {"tags.`seed`": SEED_WIDTH}
    order = ["attributes.`Run Name`", "runDateAndNestInfo", *tags, *scores]
    return {"selectedColumns": [*tags, *scores], "columnOrder": order, "columnWidths": widths}


def page(results: Path, settings: Tracking) -> tuple[str, bool]:
    """The path of the runs in MLflow's pages, with names and scores first, and whether the index is empty.

    Raises InputError if there are no runs, or if MLflow cannot open the index.
    """
    if settings.uri is None and not any(Path(results).glob(f"*/*/*/{RUN_RECORD}")):
        rule = f"must contain runs (SCENARIO/METHOD/SEED/{RUN_RECORD})"
        raise InputError(results, rule, "none", "Name a folder with runs: --results.")
    try:
        client, experiment = connect(results, settings)
        client.set_experiment_tag(experiment, f"mlflow.sharedViewState.{VIEW}", json.dumps(_view()))
        if settings.uri is None:
            _count_rows(Path(results).resolve() / INDEX)
    except Exception as error:
        uri = masked(settings.uri or default_uri(results))
        raise InputError(uri, "MLflow must be able to open it", explained(error, results, settings)) from error
    return f"#/experiments/{experiment}/runs?viewStateShareKey={VIEW}", not client.search_runs([experiment], max_results=1)
