"""The MLflow index: complete, never doubled, never fatal, rebuilt from the files; created once, upgraded, moved, damaged, away."""

import contextlib
import json
import multiprocessing
import os
import re
import socket
import sqlite3
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from neuspring import config
from neuspring.cli.results import ui
from neuspring.config import Config, Tracking
from neuspring.core.errors import InputError
from neuspring.core.run_record import RunRecord
from neuspring.experiments.tracking import log as tracking
from neuspring.experiments.tracking import store as tracking_store
from neuspring.experiments.tracking.store import score_name
from neuspring.scores.metrics import METRICS, TASKS
from tests.support.stores import STEPS, client_of, free_port, runs_of, write_run

SETTINGS = Tracking()
FORK = multiprocessing.get_context("fork")
STARTED_MS, ENDED_MS = 1795255200000, 1795255530000


@pytest.fixture
def results(tracked):
    return tracked


def test_a_run_is_logged_completely_and_once(results):
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
    # The tag is for copying; the description is what MLflow's page shows first.
    expected |= {"play": f"neuspring play {record.parent}"}
    assert expected.items() <= run.data.tags.items()
    assert f"\nneuspring play {record.parent}\n" in run.data.tags["mlflow.note.content"]
    assert len(run.data.params) == 60, "run.json has all 122"
    assert (run.data.params["fit.p7"], run.data.params["clusters"], len(run.data.params["settings"])) == ("7", "4", 16)
    # Scores come first, here as on MLflow's page.
    assert list(run.data.metrics)[:2] == ["scores/future.track_error_mm", "scores/future.chamfer_mm"]
    assert list(dict.fromkeys(sorted(name.partition("/")[0] for name in run.data.metrics))) == ["scores", "training", "usage"]

    metrics = run.data.metrics
    assert metrics["scores/future.track_error_mm"] == 12.35, "four digits"
    assert metrics["scores/future.chamfer_mm"] == 5.0 and metrics["usage/fit.seconds"] == 12.5
    assert np.isnan(metrics["scores/train.chamfer_mm"]), "a gap stays a gap"
    client = client_of(results)
    assert sorted(m.step for m in client.get_metric_history(run.info.run_id, "training/fit.loss")) == list(range(STEPS))
    assert {m.step: m.value for m in client.get_metric_history(run.info.run_id, "training/search.best")} == {0: 3.0, 1: 2.0}
    folder = results / "mlartifacts" / SETTINGS.experiment / run.info.run_id / "artifacts"
    sent = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert sent == {"run.json", "twin/twin.npz", "search/coarse.npz"}


def test_parameters_are_what_has_not_its_default_under_the_names_of_the_configuration(results):
    settings = config.plain(Config())
    params = {"fit.fit.epochs": 60, "fit.fit.horizon": settings["fit"]["horizon"], "fit.kind": "field", "long": "x" * 900}
    params |= {"search.search.rollouts": 11, "search.seed": 0, "search.result.cost": 0.5, "method.clusters": 4}
    found = tracking.params_of(RunRecord.load(write_run(results, params=params)))
    assert found.pop("settings") and len(found.pop("long")) == 900
    variant = {"search": "uniform", "fit": "springs", "clusters": 4, "frozen": False}
    assert found == variant | {"fit.epochs": 60, "fit.kind": "field", "search.rollouts": 11, "search.seed": 0}


def test_the_page_opens_with_scores_as_columns_and_says_what_is_missing(results, tmp_path):
    assert tracking.log_run(write_run(results), results, SETTINGS) == "logged"
    place, empty = tracking_store.page(results, SETTINGS)
    assert not empty
    client, experiment = tracking_store.connect(results, SETTINGS)
    assert place == f"#/experiments/{experiment}/runs?viewStateShareKey=scores"
    view = json.loads(client.get_experiment(experiment).tags["mlflow.sharedViewState.scores"])
    shown = view["selectedColumns"]
    assert shown[:4] == [
        "tags.`method`",
        "tags.`scenario`",
        "tags.`seed`",
        f"metrics.`{score_name(TASKS[0], next(iter(METRICS)), 'm')}`",
    ]
    assert view["columnOrder"][2:] == shown and view["columnWidths"].keys() == set(shown)
    (run,) = runs_of(results)
    scores = {f"metrics.`{name}`" for name in run.data.metrics if name.startswith("scores/future.")}
    assert scores < set(shown) and len(scores) == 2, "names of the view are those that are logged"
    with contextlib.closing(sqlite3.connect(results / "mlflow.db")) as connection:
        counted = {table for (table,) in connection.execute("SELECT tbl FROM sqlite_stat1")}
    assert {"runs", "latest_metrics"} <= counted, "SQLite plans with statistics"
    with pytest.raises(InputError, match=r"must contain runs .*--results"):
        tracking_store.page(tmp_path / "elsewhere", SETTINGS)


def test_a_database_of_another_version_is_named_with_what_to_do(results):
    write_run(results)
    (results / "mlartifacts").mkdir()
    with contextlib.closing(sqlite3.connect(results / "mlflow.db")) as connection, connection:
        connection.execute("UPDATE alembic_version SET version_num = 'ffffffffffff'")
    message = r"out-of-date database schema .*rename .*mlflow\.db and run `neuspring sync`"
    with pytest.raises(InputError, match=message):
        tracking_store.page(results, SETTINGS)
    assert re.search(message, tracking.init(results, SETTINGS)["outcome"])


def test_a_failed_run_is_logged_as_failed(results):
    record = write_run(results, status="failed", reason="diverged at frame 3", scores_file=None, histories={}, artifacts={})
    assert tracking.log_run(record, results, SETTINGS) == "logged"
    assert tracking.log_run(record, results, SETTINGS) == "already logged"
    (run,) = runs_of(results)
    assert (run.info.status, run.data.tags["reason"], run.data.tags["status"]) == ("FAILED", "diverged at frame 3", "failed")
    assert set(run.data.metrics) == {"usage/fit.seconds"}


def test_a_killed_logger_leaves_one_complete_run(results, tmp_path, monkeypatch):
    from mlflow import MlflowClient

    record, mark = write_run(results), tmp_path / "uploading"

    def hang(*_):
        mark.touch()
        time.sleep(60)

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "log_artifact", hang)
        logger = FORK.Process(target=tracking.log_run, args=(record, results, SETTINGS))
        logger.start()
    deadline = time.monotonic() + 30
    while not mark.exists():
        assert time.monotonic() < deadline and logger.is_alive()
        time.sleep(0.05)
    assert len(runs_of(results)) == 1
    logger.kill()
    logger.join()

    assert tracking.sync(results, SETTINGS) == {"logged": ["rope/ours/0"]}
    (run,) = runs_of(results)
    assert run.info.status == "FINISHED" and run.data.tags["logged"] == "complete"
    assert tracking.sync(results, SETTINGS) == {"already logged": ["rope/ours/0"]}


def test_a_logger_killed_between_its_two_last_requests_leaves_one_complete_run(results):
    record = write_run(results)
    client, experiment = tracking_store.connect(results, SETTINGS)
    leftover = client.create_run(experiment, tags={"run_key": json.loads(record.read_text())["run_key"]}).info.run_id
    stranger = client.create_run(experiment, run_name="not of NeuSpring").info.run_id
    client.set_terminated(leftover, "FINISHED")
    assert tracking.log_run(record, results, SETTINGS) == "logged"
    assert client.get_run(leftover).info.lifecycle_stage == "deleted"
    assert client.get_run(stranger).info.status == "RUNNING"


def test_processes_that_log_the_same_records_at_once_double_none(results):
    records = [write_run(results, scenario=f"s{i}") for i in range(4)]
    answers = FORK.SimpleQueue()
    for _ in range(4):
        FORK.Process(target=lambda: answers.put([tracking.log_run(record, results, SETTINGS) for record in records])).start()
    outcomes = [outcome for _ in range(4) for outcome in answers.get()]
    assert sorted(outcomes) == ["already logged"] * 12 + ["logged"] * 4
    runs = runs_of(results)
    assert len(runs) == 4 and {run.data.tags["scenario"] for run in runs} == {f"s{i}" for i in range(4)}
    assert {run.info.status for run in runs} == {"FINISHED"}


def test_results_that_another_commit_made_again_are_one_run(results):
    assert tracking.log_run(write_run(results), results, SETTINGS) == "logged"
    again = write_run(results, commit="def456-dirty", ended="2026-11-21T12:00:00+00:00")
    assert tracking.log_run(again, results, SETTINGS) == "already logged"
    (run,) = runs_of(results)
    assert run.info.end_time == ENDED_MS and run.data.tags["commit"] == "abc123"


def test_damaged_records_are_input_errors(results):
    good = json.loads(write_run(results).read_text())

    def message(**changes):
        record = write_run(results, **changes)
        with pytest.raises(InputError) as caught:
            tracking.log_run(record, results, SETTINGS)
        return str(caught.value)

    assert "run_key" in message(run_key="../../etc")
    assert "status" in message(status="fine") and "seed" in message(seed="0")
    assert "another format" in message(format=1)
    assert "no such file" in message(artifacts={"twin": ["gone.npz"]})
    assert "Parquet" in message(histories={"fit": "twin.npz"}) and "columns step" in message(histories={"fit": "scores.parquet"})
    path = results / "rope" / "ours" / "0" / "run.json"
    del good["started"]
    for text in ("{", "[]", json.dumps(good)):
        path.write_text(text)
        with pytest.raises(InputError, match=r"run\.json"):
            tracking.log_run(path, results, SETTINGS)
    with pytest.raises(InputError, match="readable"):
        tracking.log_run(results / "none" / "run.json", results, SETTINGS)

    write_run(results, seed=1)
    lines = []
    assert tracking.sync(results, SETTINGS, lines.append) == {"damaged": ["rope/ours/0"], "logged": ["rope/ours/1"]}
    assert lines == ["rope/ours/0: damaged", "rope/ours/1: logged"]
    assert len(runs_of(results)) == 1, "nothing was sent of the damaged ones"


def test_init_twice_and_by_two_processes_at_once(tmp_path):
    answers = FORK.SimpleQueue()
    processes = [FORK.Process(target=lambda: answers.put(tracking.init(tmp_path, SETTINGS))) for _ in range(2)]
    for process in processes:
        process.start()
    first, second = answers.get(), answers.get()
    assert first == second == tracking.init(tmp_path, SETTINGS)
    assert first["outcome"] == "ready"
    assert tracking.log_run(write_run(tmp_path), tmp_path, SETTINGS) == "logged"


def test_a_moved_results_folder_gets_a_new_index_and_keeps_the_old_one(results, tmp_path):
    """The old one would write artifacts to the old place; it may hold tags and notes that no record has."""
    tracking.log_run(write_run(results), results, SETTINGS)
    moved = results.rename(tmp_path / "moved")
    assert list(tracking.sync(moved, SETTINGS)) == ["logged"]
    assert not results.exists() and len(list(moved.glob("mlflow-*.db"))) == 1


@pytest.mark.parametrize("error", ["(sqlite3.OperationalError) database or disk is full", "attempt to write a readonly database"])
def test_an_index_that_cannot_be_written_says_why_and_asks_to_delete_nothing(tmp_path, error):
    text = tracking_store.explained(RuntimeError(error), tmp_path, SETTINGS)
    assert text.startswith(("no space left", str(tmp_path))) and "neuspring sync" in text and "delete" not in text


def test_disabled_touches_nothing(tmp_path):
    off = Tracking(enabled=False)
    record = write_run(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert tracking.init(tmp_path, off)["outcome"] == "disabled"
    assert tracking.log_run(record, tmp_path, off) == "disabled"
    assert tracking.sync(tmp_path, off) == {"disabled": ["rope/ours/0"]}
    assert sorted(tmp_path.rglob("*")) == before


def test_an_unreachable_server_costs_seconds_and_no_run(results, capsys):
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


@pytest.mark.parametrize("damage", ["text", "folder", "postgres"])
def test_a_damaged_database_or_absent_host_fails_at_once(results, damage):
    """MLflow itself would retry these for about two minutes."""
    settings = SETTINGS
    if damage == "text":
        (results / "mlflow.db").write_text("not a database " * 100)
    elif damage == "folder":
        (results / "mlflow.db").unlink()
        (results / "mlflow.db").mkdir()
    else:
        settings = Tracking(uri="postgresql://secret@127.0.0.1:9/mlflow")
    start = time.monotonic()
    assert tracking.log_run(write_run(results), results, settings).startswith("unreachable: ")
    assert tracking.init(results, settings)["outcome"].startswith("unreachable: ")
    assert "secret" not in tracking.init(results, settings)["uri"]
    assert time.monotonic() - start < 10


def test_telemetry_is_off_before_mlflow_is_imported_and_the_users_values_stay(tmp_path, monkeypatch):
    for name in tracking_store.ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "7")
    monkeypatch.setitem(sys.modules, "mlflow", None)
    with pytest.raises(ImportError):
        tracking_store.connect(tmp_path, SETTINGS)
    wanted = tracking_store.ENVIRONMENT | {"MLFLOW_HTTP_REQUEST_TIMEOUT": "7"}
    assert {name: os.environ.get(name) for name in wanted} == wanted
    assert wanted["MLFLOW_DISABLE_TELEMETRY"] == wanted["DO_NOT_TRACK"] == "true"


def test_the_pages_are_served_by_one_process_on_this_machine_alone(results, monkeypatch):
    tracking.log_run(write_run(results), results, SETTINGS)
    asked = []
    ended = SimpleNamespace(poll=lambda: 0, wait=lambda: 0)
    monkeypatch.setattr(subprocess, "Popen", lambda words, env: asked.append(words) or ended)
    ui(results, port=free_port())
    (words,) = asked
    given = dict(zip(words[4::2], words[5::2], strict=True))
    assert (given["--workers"], given["--host"]) == ("1", "127.0.0.1")
