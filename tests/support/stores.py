"""What tests of tracking share: small run records, and PostgreSQL and `mlflow server`, started on localhost and stopped at will."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas

from neuspring.config import Tracking
from neuspring.experiments.tracking.store import ENVIRONMENT, default_uri
from tests.support.runs import STARTED as STARTED
from tests.support.runs import run_record

ENDED = "2026-11-21T10:05:30+00:00"
STEPS = 1100
"""Points of the longest history: more than one call of `log_batch` takes."""
PATIENCE = 120
"""Seconds for a server to start; it takes 6 on two idle cores."""


def write_run(results: Path, scenario: str = "rope", seed: int = 0, **changes: Any) -> Path:
    """A small run: 3 scores, 1 timing, 2 histories (one in another folder), 2 artifact folders."""
    folder, search = results / scenario / "ours" / str(seed), results / scenario / "search-uniform"
    for path in (folder, search):
        path.mkdir(parents=True, exist_ok=True)
    rows = [("future", "track_error", 0.0123456, "m"), ("future", "chamfer", 0.005, "m"), ("train", "chamfer", float("nan"), "m")]
    scores = pandas.DataFrame(rows, columns=["task", "metric", "value", "unit"])
    scores.assign(scenario=scenario, category="toy", method="ours", seed=seed, frames=18).to_parquet(folder / "scores.parquet")
    pandas.DataFrame({"step": range(STEPS), "metric": "loss", "value": 1.0}).to_parquet(folder / "fit.parquet")
    steps = {"step": [0, 1, 1], "metric": ["best", "best", "sigma"], "value": [3.0, 2.0, 0.5]}
    pandas.DataFrame(steps).to_parquet(search / "history.parquet")
    (folder / "twin.npz").write_bytes(b"twin")
    (search / "coarse.npz").write_bytes(b"coarse")
    path = folder / "run.json"
    run_record(
        run_key=hashlib.sha256(f"{scenario} {seed}".encode()).hexdigest(),
        scenario=scenario,
        category="toy",
        variant={"search": "uniform", "fit": "springs", "clusters": 4, "frozen": False},
        seed=seed,
        commit="abc123",
        data_digest="d1",
        ended=ENDED,
        timings={"fit": 12.5},
        histories={"fit": "fit.parquet", "search": "../../search-uniform/history.parquet"},
        artifacts={"twin": ["twin.npz"], "search": ["../../search-uniform/coarse.npz"]},
    ).save(path)
    params = {f"fit.p{i}": i for i in range(120)} | {"fit.betas": [0.9, 0.99], "long": "x" * 900}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"params": params} | changes))
    return path


def client_of(results: Path) -> Any:
    """A client of the results folder's own index."""
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=default_uri(results))


def runs_of(results: Path) -> list[Any]:
    """All runs in the results folder's own index."""
    client = client_of(results)
    return list(client.search_runs([client.get_experiment_by_name(Tracking().experiment).experiment_id]))


def python(code: str, *arguments: object, **options: Any) -> subprocess.Popen[str]:
    """Start a process that can import neuspring, in an environment that says nothing of MLflow."""
    environment = {name: value for name, value in os.environ.items() if name not in ENVIRONMENT}
    environment["PYTHONPATH"] = str(Path(__file__).resolve().parents[2])
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, **options)


def wait_until(done: Callable[[], bool], process: subprocess.Popen[Any], what: str) -> None:
    """Wait for something that `process` brings about; asserts that the process lives."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert process.poll() is None, f"{what}: process ended with {process.returncode}"
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE} s"
        time.sleep(0.05)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Postgres:
    """A PostgreSQL cluster of its own in `folder`. Run by root it drops to user postgres, since PostgreSQL refuses root."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self._who: dict[str, Any] = {"cwd": folder}
        if os.geteuid() == 0:
            self._who |= {"user": "postgres", "group": "postgres", "extra_groups": []}
            shutil.chown(folder, "postgres", "postgres")
        self._run("initdb", "-D", "data", "-U", "neuspring", "--auth=trust", "--no-sync")
        command = ["-D", "data", "-c", "listen_addresses=127.0.0.1", "-c", f"unix_socket_directories={self.folder}"]
        with (self.folder / "log").open("a") as log:
            words = [self._program("postgres"), *command, "-p", str(self.port)]
            self.process = subprocess.Popen(words, stdout=log, stderr=log, **self._who)
        wait_until(self._answers, self.process, "PostgreSQL")

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(30)

    def database(self, name: str) -> str:
        """Create an empty database; returns its URI."""
        self._run("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", "neuspring", name)
        return f"postgresql://neuspring@127.0.0.1:{self.port}/{name}"

    def _answers(self) -> bool:
        command = [self._program("pg_isready"), "-q", "-h", "127.0.0.1", "-p", str(self.port)]
        return subprocess.run(command, check=False).returncode == 0

    def _run(self, program: str, *arguments: str) -> None:
        subprocess.run([self._program(program), *arguments], check=True, stdout=subprocess.DEVNULL, **self._who)

    @staticmethod
    def _program(name: str) -> str:
        folder = programs()
        assert folder is not None
        return str(folder / name)


def programs() -> Path | None:
    """The folder of PostgreSQL's programs, those of the newest version: Debian leaves them out of PATH."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    program = shutil.which("initdb") or next((str(path / "initdb") for path in folders[::-1] if (path / "initdb").exists()), None)
    return Path(program).resolve().parent if program else None


def without_postgres() -> str:
    """Why tests with PostgreSQL cannot run here; empty if they can."""
    if programs() is None:
        return "PostgreSQL is not installed: no initdb in PATH or /usr/lib/postgresql (Debian: apt install postgresql)"
    return "" if importlib.util.find_spec("psycopg2") else "psycopg2 is not installed (pip install 'neuspring[postgresql]')"


@contextmanager
def postgres() -> Iterator[Postgres]:
    """A running cluster, removed at the end."""
    # Not in pytest's folders, which other users than ours, so also postgres, may not enter.
    folder = Path(tempfile.mkdtemp(prefix="neuspring-postgres-"))
    cluster = Postgres(folder)
    try:
        yield cluster
    finally:
        cluster.stop()
        shutil.rmtree(folder)


class Server:
    """`mlflow server` with one worker over a database that is ready for use."""

    def __init__(self, folder: Path, backend: str) -> None:
        self.folder, self.backend, self.port = folder, backend, free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.start()

    def start(self) -> None:
        off = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"}
        command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(self.port), "--workers", "1"]
        command += ["--backend-store-uri", self.backend, "--artifacts-destination", str(self.folder / "artifacts")]
        with (self.folder / "server.log").open("a") as log:
            # A session of its own: its worker must die with it.
            told = {"env": os.environ | off, "stdout": log, "stderr": log, "start_new_session": True}
            self.process = subprocess.Popen(command, cwd=self.folder, **told)
        wait_until(self._answers, self.process, "mlflow server")

    def kill(self) -> None:
        """SIGKILL to it and its worker."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(30)

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"{self.uri}/health", timeout=5) as answer:
                return bool(answer.status == 200)
        except OSError:
            return False


@contextmanager
def server(folder: Path, backend: str) -> Iterator[Server]:
    """A running server, killed at the end."""
    running = Server(folder, backend)
    try:
        yield running
    finally:
        if running.process.poll() is None:
            running.kill()
