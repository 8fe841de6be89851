"""Many processes and a store that comes and goes: every run is in MLflow exactly once.

Counts are taken from the store itself. PostgreSQL and the server are started here, on localhost.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neuspring.config import Tracking
from neuspring.experiments.tracking import log as tracking
from neuspring.experiments.tracking import store as tracking_store
from tests.support import loggers, stores

pytestmark = pytest.mark.slow
SMALL: dict[str, Any] = {"histories": {}, "artifacts": {"twin": ["twin.npz"]}, "params": {"fit.epochs": 3}}


@pytest.fixture(scope="module")
def cluster() -> Iterator[stores.Postgres]:
    if reason := stores.without_postgres():
        pytest.skip(reason)
    with stores.postgres() as running:
        yield running


@pytest.fixture(scope="module")
def sqlite_server(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[stores.Server]:
    folder = tmp_path_factory.mktemp("server")
    shutil.copy(template, folder / "mlflow.db")
    with stores.server(folder, tracking_store.default_uri(folder)) as running:
        yield running


@pytest.fixture(scope="module")
def postgres_server(cluster: stores.Postgres, tmp_path_factory: pytest.TempPathFactory) -> Iterator[stores.Server]:
    folder = tmp_path_factory.mktemp("server")
    database = cluster.database("behind_server")
    assert tracking.init(folder, Tracking(uri=database, experiment="template"))["outcome"] == "ready"
    with stores.server(folder, database) as running:
        yield running


def write_runs(results: Path, writers: int, each: int) -> list[list[Path]]:
    return [[stores.write_run(results, f"s{writer}", seed, **SMALL) for seed in range(each)] for writer in range(writers)]


def finish(process: subprocess.Popen[str], out: Path) -> Counter[str]:
    """Outcomes by their first word, when all loggers have ended."""
    assert process.wait(300) == 0, (out / "stderr").read_text()
    return Counter(outcome.partition(":")[0] for _, outcome, _ in loggers.outcomes(out))


def all_runs(results: Path, settings: Tracking) -> list[Any]:
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=settings.uri or tracking_store.default_uri(results))
    return list(client.search_runs([client.get_experiment_by_name(settings.experiment).experiment_id]))


def assert_every_run_is_there_once(results: Path, settings: Tracking, groups: list[list[Path]]) -> None:
    """Complete runs are the records on disk, one each; what was cut off is deleted."""
    runs = all_runs(results, settings)
    records = [path.parent.relative_to(results).as_posix() for group in groups for path in group]
    assert Counter(run.info.run_name for run in runs) == Counter(records)
    for run in runs:
        assert run.data.tags["logged"] == "complete" and run.info.status == "FINISHED"
        assert run.data.params["fit.epochs"] == "3" and run.data.metrics["future.chamfer"] == 0.005


def kill_in_the_middle(index: int, out: Path, process: subprocess.Popen[str], results: Path, settings: Tracking) -> None:
    """SIGKILL a logger while a run of its own is half sent. It is stopped to look, so that what is seen is what is killed."""
    stores.wait_until((out / f"{index}.pid").is_file, process, "logger")
    pid = int((out / f"{index}.pid").read_text())

    def half_sent() -> bool:
        os.kill(pid, signal.SIGSTOP)
        names = [run.info.run_name for run in all_runs(results, settings) if run.info.status == "RUNNING"]
        if any(name.startswith(f"s{index}/") for name in names):
            return True
        os.kill(pid, signal.SIGCONT)
        return False

    stores.wait_until(half_sent, process, "a run that is half sent")
    os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("backend", ["sqlite", "postgres"])
def test_sixteen_processes_write_to_one_database(
    tmp_path: Path, template: Path, backend: str, request: pytest.FixtureRequest
) -> None:
    results = tmp_path / "results"
    groups = write_runs(results, writers=16, each=3)
    shutil.copy(template, results / "mlflow.db")
    settings = Tracking(uri=request.getfixturevalue("cluster").database("direct") if backend == "postgres" else None)
    assert tracking.init(results, settings)["outcome"] == "ready"
    assert finish(loggers.start(groups, results, settings, tmp_path), tmp_path) == {"logged": 48}
    assert len(all_runs(results, settings)) == 48
    assert_every_run_is_there_once(results, settings, groups)


@pytest.mark.parametrize("backend", ["sqlite", "postgres"])
def test_a_server_killed_under_load_loses_and_doubles_no_run(tmp_path: Path, backend: str, request: pytest.FixtureRequest) -> None:
    """And a logger killed while it sends. Runs wait on disk; `sync` sends them when the server is back."""
    server: stores.Server = request.getfixturevalue(f"{backend}_server")
    results, settings = tmp_path / "results", Tracking(uri=server.uri, experiment="killed")
    groups = write_runs(results, writers=4, each=5)
    assert tracking.init(results, settings)["outcome"] == "ready"
    process = loggers.start(groups, results, settings, tmp_path)
    kill_in_the_middle(0, tmp_path, process, results, settings)
    stores.wait_until(lambda: len(loggers.outcomes(tmp_path)) >= 4, process, "four runs")
    server.kill()
    outcomes = finish(process, tmp_path)
    assert set(outcomes) == {"logged", "unreachable"} and outcomes["logged"] >= 4
    assert outcomes.total() < 20, "the killed logger never came to its other records"

    begin = time.monotonic()
    ((outcome, names),) = tracking.sync(results, settings).items()
    assert outcome.startswith("unreachable") and len(names) == 20 and time.monotonic() - begin < 30

    server.start()
    synced = Counter({name: len(of) for name, of in tracking.sync(results, settings).items()})
    assert synced["logged"] + synced["already logged"] == 20
    # A run whose last tag arrived, but not the answer, is said to be unreachable and is there.
    assert synced["already logged"] >= outcomes["logged"]
    assert_every_run_is_there_once(results, settings, groups)
    assert {name: len(of) for name, of in tracking.sync(results, settings).items()} == {"already logged": 20}


def test_a_database_that_crashes_behind_the_server_loses_and_doubles_no_run(
    tmp_path: Path, cluster: stores.Postgres, postgres_server: stores.Server
) -> None:
    results, settings = tmp_path / "results", Tracking(uri=postgres_server.uri, experiment="crashed")
    groups = write_runs(results, writers=4, each=4)
    assert tracking.init(results, settings)["outcome"] == "ready"
    process = loggers.start(groups, results, settings, tmp_path)
    stores.wait_until(lambda: len(loggers.outcomes(tmp_path)) >= 3, process, "three runs")
    cluster.stop(signal.SIGQUIT)
    outcomes = finish(process, tmp_path)
    assert set(outcomes) == {"logged", "unreachable"} and outcomes.total() == 16
    cluster.start()
    synced = Counter({name: len(of) for name, of in tracking.sync(results, settings).items()})
    assert synced["logged"] + synced["already logged"] == 16
    assert_every_run_is_there_once(results, settings, groups)
