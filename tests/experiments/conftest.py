"""Fixtures that several files share."""

import shutil
from pathlib import Path

import pytest

from neuspring.config import Tracking
from neuspring.config.tuning import Tune
from neuspring.core.job_records import begin_run
from neuspring.experiments.jobs import gpus
from neuspring.experiments.jobs import wrapper as job
from neuspring.experiments.tracking import log as tracking
from tests.support import sweeps


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A results folder in which a run of the workflow has begun; no GPU is leased to anybody."""
    for name in (job.POOL, job.SHARE, gpus.VISIBLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(gpus.LOCKS, str(tmp_path / "locks"))
    begin_run(tmp_path / "results")
    return tmp_path / "results"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a sweep that has not begun; what it reads lies beside it."""
    return sweeps.furnish(tmp_path)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tune]:
    """A sweep of four trials, reported. Tests leave its trials as they are."""
    folder = sweeps.furnish(tmp_path_factory.mktemp("tune"))
    space = sweeps.FAST | {"fit.damping": {"choices": ["fixed", "homogeneous"]}}
    tune = sweeps.sweep(trials=4, pruner="none", space=space)
    sweeps.work(folder, tune)
    sweeps.report(folder, tune)
    return folder, tune


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated MLflow database. Making one takes seconds, copying it does not; it holds no experiment of a test."""
    results = tmp_path_factory.mktemp("template")
    assert tracking.init(results, Tracking(experiment="template"))["outcome"] == "ready"
    return results / "mlflow.db"


@pytest.fixture
def tracked(tmp_path: Path, template: Path) -> Path:
    """A results folder with a migrated MLflow database."""
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(template, folder / "mlflow.db")
    return folder
