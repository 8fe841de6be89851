"""The MLflow store: created once, upgraded, moved, damaged, away, switched off."""

from __future__ import annotations

import importlib
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from neuspring.config import Tracking
from neuspring.experiments.tracking import log as tracking
from tests.support.stores import python, write_run

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = Tracking()
STARTED_MS, ENDED_MS = 1795255200000, 1795255530000


@pytest.fixture
def results(tracked: Path) -> Path:
    return tracked


def output(process: subprocess.Popen[str]) -> list[str]:
    text, _ = process.communicate(timeout=240)
    assert process.returncode == 0
    return text.splitlines()


def test_init_twice_and_by_two_processes_at_once(tmp_path: Path) -> None:
    code = """
import sys
from pathlib import Path
from neuspring.experiments.tracking import log as tracking
from neuspring.config import Tracking
print(tracking.init(Path(sys.argv[1]), Tracking()))
"""
    (tmp_path / "mlflow.db.part").write_text("left by a killed init")
    first, second = (output(process) for process in [python(code, tmp_path) for _ in range(2)])
    assert first == second and "'outcome': 'ready'" in first[0]
    assert str(tracking.init(tmp_path, SETTINGS)) == first[0]
    assert tracking.log_run(write_run(tmp_path), tmp_path, SETTINGS) == "logged"
    assert not (tmp_path / "mlflow.db.part").exists()


def test_init_upgrades_an_older_database(tmp_path: Path) -> None:
    from alembic import command
    from mlflow.store.tracking.dbmodels.initial_models import Base

    utils: Any = importlib.import_module("mlflow.store.db.utils")
    engine = utils.create_sqlalchemy_engine(tracking.default_uri(tmp_path))
    Base.metadata.create_all(engine)
    settings = utils._get_alembic_config(str(engine.url))
    with engine.begin() as connection:
        settings.attributes["connection"] = connection
        command.upgrade(settings, "451aebb31d03")  # MLflow 1.0
    engine.dispose()
    assert tracking.init(tmp_path, SETTINGS)["outcome"] == "ready"
    assert tracking.log_run(write_run(tmp_path), tmp_path, SETTINGS) == "logged"


def test_a_moved_results_folder_is_refused_with_a_way_out(results: Path, tmp_path: Path) -> None:
    """Its index would write artifacts to the old place."""
    tracking.log_run(write_run(results), results, SETTINGS)
    moved = results.rename(tmp_path / "moved")
    ((word, _),) = tracking.sync(moved, SETTINGS).items()
    assert word.startswith("unreachable: ") and "has moved" in word
    assert not results.exists()


def test_disabled_touches_nothing(tmp_path: Path) -> None:
    off = Tracking(enabled=False)
    record = write_run(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert tracking.init(tmp_path, off)["outcome"] == "disabled"
    assert tracking.log_run(record, tmp_path, off) == "disabled"
    assert tracking.sync(tmp_path, off) == {"disabled": ["rope/ours/0"]}
    assert sorted(tmp_path.rglob("*")) == before


def test_an_unreachable_server_costs_seconds_and_no_run(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    away = Tracking(uri=f"http://secret@127.0.0.1:{port}")
    records = [write_run(results, seed=seed) for seed in range(3)]
    start = time.monotonic()
    outcome = tracking.log_run(records[0], results, away)
    assert outcome.startswith("unreachable: ")
    assert tracking.init(results, away)["outcome"].startswith("unreachable: ")
    ((word, names),) = tracking.sync(results, away).items()
    assert word.startswith("unreachable: ") and len(names) == 3
    assert time.monotonic() - start < 15
    text = capsys.readouterr().err
    assert "warning: tracking: unreachable" in text and "secret" not in text + outcome

    outcome_file = records[0].with_name("mlflow.txt")
    outcome_file.write_text(f"{outcome}\n")
    assert tracking.sync(results, SETTINGS) == {"logged": [f"rope/ours/{seed}" for seed in range(3)]}
    assert outcome_file.read_text() == "logged\n", "the workflow must not count the run as waiting for ever"
    assert not records[1].with_name("mlflow.txt").exists()


@pytest.mark.parametrize("damage", ["text", "postgres"])
def test_a_damaged_database_or_absent_host_fails_at_once(results: Path, damage: str) -> None:
    """MLflow itself would retry these for about two minutes."""
    settings = SETTINGS
    if damage == "text":
        (results / "mlflow.db").write_text("not a database " * 100)
    else:
        settings = Tracking(uri="postgresql://secret@127.0.0.1:9/mlflow")
    start = time.monotonic()
    assert tracking.log_run(write_run(results), results, settings).startswith("unreachable: ")
    assert tracking.init(results, settings)["outcome"].startswith("unreachable: ")
    assert "secret" not in tracking.init(results, settings)["uri"]
    assert time.monotonic() - start < 10


def test_mlflow_is_imported_late_with_telemetry_off(results: Path) -> None:
    code = """
import os, sys
from pathlib import Path
os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"] = "7"
from neuspring.experiments.tracking import log as tracking
from neuspring.config import Tracking
assert not {"mlflow", "pandas", "filelock"} & set(sys.modules)
tracking.init(Path(sys.argv[1]), Tracking())
import mlflow.telemetry.client
print(os.environ["MLFLOW_DISABLE_TELEMETRY"], os.environ["DO_NOT_TRACK"], os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"],
      mlflow.telemetry.client.get_telemetry_client())
"""
    process = python(code, results, stderr=subprocess.PIPE)
    text, errors = process.communicate(timeout=240)
    assert (text.split(), errors) == (["true", "true", "7", "None"], "")
