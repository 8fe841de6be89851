"""The MLflow index: complete, never doubled, never fatal, rebuilt from the files."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pandas
import pytest

from neuspring import tracking
from neuspring.config import Tracking
from neuspring.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = Tracking()
STARTED, ENDED = "2026-11-21T10:00:00+00:00", "2026-11-21T10:05:30+00:00"
STARTED_MS, ENDED_MS = 1795255200000, 1795255530000
STEPS = 1100
"""Points of the longest history: more than one call of `log_batch` takes."""


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated database. Making one takes seconds, copying it does not; its only experiment is not the one under test."""
    results = tmp_path_factory.mktemp("template")
    assert tracking.init(results, Tracking(experiment="template"))["outcome"] == "ready"
    return results / "mlflow.db"


@pytest.fixture
def results(tmp_path: Path, template: Path) -> Path:
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(template, folder / "mlflow.db")
    return folder


def write_run(results: Path, scenario: str = "rope", seed: int = 0, **changes: Any) -> Path:
    """A small run: 3 scores, 1 timing, 2 histories (one in another folder), 2 artifact folders."""
    folder, search = results / scenario / "ours" / str(seed), results / scenario / "search-uniform"
    for path in (folder, search):
        path.mkdir(parents=True, exist_ok=True)
    rows = [("future", "track_error", 0.0125, "m"), ("future", "chamfer", 0.005, "m"), ("train", "chamfer", float("nan"), "m")]
    scores = pandas.DataFrame(rows, columns=["task", "metric", "value", "unit"])
    scores.assign(scenario=scenario, category="toy", method="ours", seed=seed, frames=18).to_parquet(folder / "scores.parquet")
    pandas.DataFrame({"step": range(STEPS), "metric": "loss", "value": 1.0}).to_parquet(folder / "fit.parquet")
    pandas.DataFrame({"step": [0, 1, 1], "metric": ["best", "best", "sigma"], "value": [3.0, 2.0, 0.5]}).to_parquet(
        search / "history.parquet"
    )
    (folder / "twin.npz").write_bytes(b"twin")
    (search / "coarse.npz").write_bytes(b"coarse")
    record = {
        "format": 1,
        "run_key": hashlib.sha256(f"{scenario} {seed}".encode()).hexdigest(),
        "scenario": scenario,
        "source": "toy",
        "category": "toy",
        "method": "ours",
        "variant": {"search": "uniform", "fit": "springs", "clusters": 4, "frozen": False},
        "seed": seed,
        "status": "ok",
        "reason": "",
        "attempt": 1,
        "commit": "abc123",
        "data_digest": "d1",
        "device": "cpu",
        "started": STARTED,
        "ended": ENDED,
        "params": {f"fit.p{i}": i for i in range(120)} | {"fit.betas": [0.9, 0.99], "long": "x" * 900},
        "timings": {"fit": 12.5},
        "scores_file": "scores.parquet",
        "histories": {"fit": "fit.parquet", "search": "../../search-uniform/history.parquet"},
        "artifacts": {"twin": ["twin.npz"], "search": ["../../search-uniform/coarse.npz"]},
    }
    path = folder / "run.json"
    path.write_text(json.dumps(record | changes))
    return path


def client_of(results: Path) -> Any:
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=tracking.default_uri(results))


def runs_of(results: Path) -> list[Any]:
    client = client_of(results)
    return list(client.search_runs([client.get_experiment_by_name(SETTINGS.experiment).experiment_id]))


def artifacts_of(results: Path, run: Any) -> set[str]:
    client = client_of(results)
    top = [item.path for item in client.list_artifacts(run.info.run_id)]
    return {item.path for name in top for item in client.list_artifacts(run.info.run_id, name)} | set(top)


def python(code: str, *arguments: object, **options: Any) -> subprocess.Popen[str]:
    """Start a process that can import neuspring."""
    environment = {name: value for name, value in os.environ.items() if name not in tracking.ENVIRONMENT}
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, **options)


def output(process: subprocess.Popen[str]) -> list[str]:
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return text.splitlines()


def test_a_run_is_logged_completely_and_once(results: Path) -> None:
    record = write_run(results)
    assert tracking.log_run(record, results, SETTINGS) == "logged"
    assert tracking.log_run(record, results, SETTINGS) == "already logged"
    assert tracking.sync(results, SETTINGS) == {"already logged": ["rope/ours/0"]}, "also: run.json copies are not records"

    (run,) = runs_of(results)
    assert (run.info.run_name, run.info.status) == ("rope/ours/0", "FINISHED")
    assert (run.info.start_time, run.info.end_time) == (STARTED_MS, ENDED_MS)
    expected = {"scenario": "rope", "category": "toy", "source": "toy", "method": "ours", "seed": "0", "attempt": "1"}
    expected |= {"status": "ok", "reason": "", "commit": "abc123", "data_digest": "d1", "device": "cpu", "logged": "complete"}
    expected |= {"variant.search": "uniform", "variant.fit": "springs", "variant.clusters": "4", "variant.frozen": "False"}
    expected |= {"run_key": json.loads(record.read_text())["run_key"]}
    assert expected.items() <= run.data.tags.items()
    assert "superseded_by" not in run.data.tags
    assert len(run.data.params) == 122
    assert (run.data.params["fit.p7"], run.data.params["fit.betas"], len(run.data.params["long"])) == ("7", "[0.9, 0.99]", 500)

    metrics = run.data.metrics
    assert metrics["future.track_error"] == 0.0125 and metrics["future.chamfer"] == 0.005 and metrics["seconds.fit"] == 12.5
    assert metrics["train.chamfer"] != metrics["train.chamfer"], "a gap stays a gap"
    client = client_of(results)
    assert sorted(m.step for m in client.get_metric_history(run.info.run_id, "fit.loss")) == list(range(STEPS))
    assert {m.step: m.value for m in client.get_metric_history(run.info.run_id, "search.best")} == {0: 3.0, 1: 2.0}
    assert artifacts_of(results, run) == {"run.json", "twin", "twin/twin.npz", "search", "search/coarse.npz"}
    assert (results / "mlartifacts").is_dir()


def test_batches_stay_within_the_limits_of_the_api(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mlflow import MlflowClient

    sizes: list[tuple[int, int]] = []
    log_batch = MlflowClient.log_batch

    def spy(self: Any, run_id: str, metrics: Any = (), params: Any = ()) -> None:
        sizes.append((len(metrics), len(params)))
        log_batch(self, run_id, metrics, params)

    monkeypatch.setattr(MlflowClient, "log_batch", spy)
    assert tracking.log_run(write_run(results), results, SETTINGS) == "logged"
    assert sizes == [(0, 100), (0, 22), (1000, 0), (STEPS + 7 - 1000, 0)], "7: scores, a timing, the search's history"


def test_a_failed_run_is_logged_as_failed(results: Path) -> None:
    record = write_run(results, status="failed", reason="diverged at frame 3", scores_file=None, histories={}, artifacts={})
    assert tracking.log_run(record, results, SETTINGS) == "logged"
    assert tracking.log_run(record, results, SETTINGS) == "already logged"
    (run,) = runs_of(results)
    assert (run.info.status, run.data.tags["reason"], run.data.tags["status"]) == ("FAILED", "diverged at frame 3", "failed")
    assert set(run.data.metrics) == {"seconds.fit"}


def test_a_killed_logger_leaves_one_closed_and_one_complete_run(results: Path, tmp_path: Path) -> None:
    record, mark = write_run(results), tmp_path / "uploading"
    code = """
import sys, time
from pathlib import Path
from neuspring import tracking
from neuspring.config import Tracking
from mlflow import MlflowClient

def hang(*_):
    Path(sys.argv[3]).touch()
    time.sleep(60)

MlflowClient.log_artifact = hang
tracking.log_run(Path(sys.argv[1]), Path(sys.argv[2]), Tracking())
"""
    logger = python(code, record, results, mark)
    deadline = time.monotonic() + 30
    while not mark.exists():
        assert time.monotonic() < deadline and logger.poll() is None
        time.sleep(0.05)
    (alive,) = runs_of(results)
    client = client_of(results)
    assert not tracking._close_if_free(client, alive, tracking._lock_path(results, alive.data.tags["run_key"]))
    logger.send_signal(signal.SIGKILL)
    logger.wait()

    assert tracking.sync(results, SETTINGS) == {"closed": ["rope/ours/0"], "logged": ["rope/ours/0"]}
    states = {run.info.status: run.data.tags for run in runs_of(results)}
    assert set(states) == {"KILLED", "FINISHED"} and len(runs_of(results)) == 2
    assert states["KILLED"]["superseded"] == "true" and "logged" not in states["KILLED"]
    assert states["FINISHED"]["logged"] == "complete"
    assert tracking.sync(results, SETTINGS) == {"already logged": ["rope/ours/0"]}


@pytest.mark.parametrize("status", ["RUNNING", "FINISHED"])
def test_log_run_closes_leftovers_of_its_record(results: Path, status: str) -> None:
    """FINISHED without the last tag: killed between the two last requests."""
    record = write_run(results)
    tracking.init(results, SETTINGS)
    client = client_of(results)
    experiment = client.get_experiment_by_name(SETTINGS.experiment).experiment_id
    leftover = client.create_run(experiment, tags={"run_key": json.loads(record.read_text())["run_key"]}).info.run_id
    stranger = client.create_run(experiment, run_name="not of NeuSpring").info.run_id
    if status != "RUNNING":
        client.set_terminated(leftover, status)
    assert tracking.log_run(record, results, SETTINGS) == "logged"
    assert client.get_run(leftover).info.status == "KILLED"
    assert client.get_run(leftover).data.tags["superseded"] == "true"
    assert tracking.sync(results, SETTINGS) == {"already logged": ["rope/ours/0"]}
    assert client.get_run(stranger).info.status == "RUNNING"


def test_sync_leaves_runs_of_other_results_folders_alone(results: Path, tmp_path: Path) -> None:
    shared = Tracking(uri=tracking.default_uri(results))
    other = tmp_path / "other"
    tracking.init(results, shared)
    client = client_of(results)
    experiment = client.get_experiment_by_name(SETTINGS.experiment).experiment_id
    running = client.create_run(experiment, tags={"run_key": "0123456789abcdef"}).info.run_id
    assert tracking.sync(other, shared) == {}
    assert client.get_run(running).info.status == "RUNNING"


def test_an_unreachable_server_costs_seconds_and_no_run(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    away = Tracking(uri=f"http://user:secret@127.0.0.1:{port}")
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

    assert tracking.sync(results, SETTINGS) == {"logged": [f"rope/ours/{seed}" for seed in range(3)]}


@pytest.mark.parametrize("damage", ["text", "postgres"])
def test_a_damaged_database_or_absent_host_fails_at_once(results: Path, damage: str) -> None:
    """MLflow itself would retry these for about two minutes."""
    settings = SETTINGS
    if damage == "text":
        (results / "mlflow.db").write_text("not a database " * 100)
    else:
        settings = Tracking(uri="postgresql://user:secret@127.0.0.1:9/mlflow")
    start = time.monotonic()
    assert tracking.log_run(write_run(results), results, settings).startswith("unreachable: ")
    assert tracking.init(results, settings)["outcome"].startswith("unreachable: ")
    assert "secret" not in tracking.init(results, settings)["uri"]
    assert time.monotonic() - start < 10


def test_a_server_that_fails_midway_leaves_nothing_double(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mlflow import MlflowClient

    record = write_run(results)
    with monkeypatch.context() as patched:
        patched.setattr(MlflowClient, "log_artifact", lambda *_: (_ for _ in ()).throw(OSError("No space left on device")))
        assert tracking.log_run(record, results, SETTINGS) == "unreachable: No space left on device"
    assert tracking.log_run(record, results, SETTINGS) == "logged"
    assert sorted(run.info.status for run in runs_of(results)) == ["FINISHED", "KILLED"]


def test_processes_that_log_the_same_records_at_once_double_none(results: Path) -> None:
    records = [write_run(results, scenario=f"s{i}") for i in range(8)]
    code = """
import sys
from pathlib import Path
from neuspring import tracking
from neuspring.config import Tracking
for path in sys.argv[2:]:
    print(tracking.log_run(Path(path), Path(sys.argv[1]), Tracking()))
"""
    processes = [python(code, results, *records) for _ in range(4)]
    words = [word for process in processes for word in output(process)]
    assert sorted(words) == ["already logged"] * 24 + ["logged"] * 8
    runs = runs_of(results)
    assert len(runs) == 8 and {run.data.tags["scenario"] for run in runs} == {f"s{i}" for i in range(8)}
    assert {run.info.status for run in runs} == {"FINISHED"}


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_newest_record_supersedes_whatever_the_order(results: Path, order: tuple[int, int]) -> None:
    versions: list[dict[str, Any]] = [
        {"run_key": "aa" * 32, "ended": "2026-11-21T11:00:00+00:00"},
        {"run_key": "bb" * 32, "ended": "2026-11-21T12:00:00+00:00"},
    ]
    write_run(results, scenario="other")
    tracking.sync(results, SETTINGS)
    for i in order:
        assert tracking.log_run(write_run(results, **versions[i]), results, SETTINGS) == "logged"
    pointers = {run.data.tags["run_key"][:2]: run.data.tags.get("superseded_by") for run in runs_of(results)}
    assert pointers.pop("aa") == "bb" * 32
    assert list(pointers.values()) == [None, None], "neither the newest nor another scenario's run"

    # The settings change back: the older content is on disk again, made anew, and already in MLflow.
    record = write_run(results, **versions[0] | {"ended": "2026-11-21T13:00:00+00:00"})
    assert tracking.log_run(record, results, SETTINGS) == "already logged"
    pointers = {run.data.tags["run_key"][:2]: run.data.tags.get("superseded_by") for run in runs_of(results)}
    assert (pointers["aa"], pointers["bb"]) == (None, "aa" * 32)


def test_damaged_records_are_input_errors(results: Path) -> None:
    good = json.loads(write_run(results).read_text())

    def message(**changes: Any) -> str:
        record = write_run(results, **changes)
        with pytest.raises(InputError) as caught:
            tracking.log_run(record, results, SETTINGS)
        return str(caught.value)

    assert "run_key" in message(run_key="../../etc")
    assert "status" in message(status="fine") and "seed" in message(seed="0")
    assert "format 1" in message(format=2)
    assert "no such file" in message(artifacts={"twin": ["gone.npz"]})
    assert "different file names" in message(artifacts={"twin": ["twin.npz", "../0/twin.npz"]})
    assert "Parquet" in message(histories={"fit": "twin.npz"}) and "columns step" in message(histories={"fit": "scores.parquet"})
    assert "names of" in message(params={"a=b": 1})
    path = results / "rope" / "ours" / "0" / "run.json"
    del good["started"]
    for text in ("{", "[]", json.dumps(good)):
        path.write_text(text)
        with pytest.raises(InputError, match=r"run\.json"):
            tracking.log_run(path, results, SETTINGS)
    with pytest.raises(InputError, match="readable"):
        tracking.log_run(results / "none" / "run.json", results, SETTINGS)

    write_run(results, seed=1)
    lines: list[str] = []
    assert tracking.sync(results, SETTINGS, lines.append) == {"damaged": ["rope/ours/0"], "logged": ["rope/ours/1"]}
    assert lines == ["rope/ours/0: damaged", "rope/ours/1: logged"]
    assert len(runs_of(results)) == 1, "nothing was sent of the damaged ones"


def test_init_twice_and_by_two_processes_at_once(tmp_path: Path) -> None:
    code = """
import sys
from pathlib import Path
from neuspring import tracking
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


def test_mlflow_is_imported_late_with_telemetry_off(results: Path) -> None:
    code = """
import os, sys
from pathlib import Path
os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"] = "7"
from neuspring import tracking
from neuspring.config import Tracking
assert not {"mlflow", "pandas", "filelock"} & set(sys.modules)
tracking.init(Path(sys.argv[1]), Tracking())
import mlflow.telemetry.client
print(os.environ["MLFLOW_DISABLE_TELEMETRY"], os.environ["DO_NOT_TRACK"], os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"],
      mlflow.telemetry.client.get_telemetry_client())
"""
    process = python(code, results, stderr=subprocess.PIPE)
    text, errors = process.communicate(timeout=60)
    assert (text.split(), errors) == (["true", "true", "7", "None"], "")
