"""A server that is killed while several processes log: every run is in MLflow exactly once.

Counts are taken from the store itself. PostgreSQL and the server are started here, on localhost.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from neuspring.config import Tracking
from neuspring.experiments.tracking import log as tracking
from neuspring.experiments.tracking import store as tracking_store
from tests.support import stores

SMALL: dict[str, Any] = {"histories": {}, "artifacts": {"twin": ["twin.npz"]}, "params": {"fit.epochs": 3}}
FORK = multiprocessing.get_context("fork")
WRITERS, EACH = 4, 5


def all_runs(results: Path, settings: Tracking) -> list[Any]:
    client, experiment = tracking_store.connect(results, settings)
    return list(client.search_runs([experiment]))


def wait_until(done: Any, what: str) -> None:
    deadline = time.monotonic() + stores.PATIENCE
    while not done():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def killed_under_load(server: stores.Server, results: Path) -> None:
    """Runs wait on disk; `sync` sends them when the server is back."""
    settings = Tracking(uri=server.uri, experiment="killed")
    groups = [[stores.write_run(results, f"s{writer}", seed, **SMALL) for seed in range(EACH)] for writer in range(WRITERS)]
    assert tracking.init(results, settings)["outcome"] == "ready"
    answers = FORK.Manager().list()

    def log(records: list[Path]) -> None:
        for record in records:
            answers.append(tracking.log_run(record, results, settings).partition(":")[0])

    loggers = [FORK.Process(target=log, args=(group,)) for group in groups]
    for logger in loggers:
        logger.start()

    def half_sent() -> bool:
        """True when the first logger is stopped in the middle of a run of its own."""
        os.kill(loggers[0].pid or 0, signal.SIGSTOP)
        if any(run.info.status == "RUNNING" and run.info.run_name.startswith("s0/") for run in all_runs(results, settings)):
            return True
        os.kill(loggers[0].pid or 0, signal.SIGCONT)
        return False

    wait_until(half_sent, "a run that is half sent")
    loggers[0].kill()
    wait_until(lambda: len(answers) >= 4, "four runs")
    server.kill()
    for logger in loggers:
        logger.join(stores.PATIENCE)
    outcomes = Counter(answers)
    assert set(outcomes) == {"logged", "unreachable"} and 4 <= outcomes["logged"] < WRITERS * EACH

    begin = time.monotonic()
    ((outcome, names),) = tracking.sync(results, settings).items()
    assert outcome.startswith("unreachable") and len(names) == WRITERS * EACH and time.monotonic() - begin < 30

    server.start()
    synced = {name: len(of) for name, of in tracking.sync(results, settings).items()}
    # A run whose last tag arrived, but not the answer, is said to be unreachable and is there.
    assert synced["logged"] + synced["already logged"] == WRITERS * EACH and synced["already logged"] >= outcomes["logged"]
    runs = all_runs(results, settings)
    wanted = Counter(f"s{i}/ours/{seed}" for i in range(WRITERS) for seed in range(EACH))
    assert Counter(run.info.run_name for run in runs) == wanted
    for run in runs:
        assert (run.data.tags["logged"], run.info.status) == ("complete", "FINISHED")
        assert run.data.params["fit.epochs"] == "3" and run.data.metrics["scores/future.chamfer_mm"] == 5.0


@pytest.mark.slow
def test_a_server_killed_under_load_loses_and_doubles_no_run(tmp_path: Path, template: Path) -> None:
    shutil.copy(template, tmp_path / "mlflow.db")
    with stores.server(tmp_path, tracking_store.default_uri(tmp_path)) as server:
        killed_under_load(server, tmp_path / "results")


@pytest.mark.slow
@pytest.mark.skipif(bool(stores.without_postgres()), reason=stores.without_postgres())
def test_a_server_over_postgresql_killed_under_load_loses_and_doubles_no_run(tmp_path: Path) -> None:
    with stores.postgres() as cluster:
        database = cluster.database("behind_server")
        assert tracking.init(tmp_path, Tracking(uri=database, experiment="template"))["outcome"] == "ready"
        with stores.server(tmp_path, database) as server:
            killed_under_load(server, tmp_path / "results")
