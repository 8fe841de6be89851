"""Shared fixtures."""

import shutil

import pytest

from neuspring.config import Tracking
from neuspring.experiments import gpus, job
from neuspring.experiments.tracking import log as tracking


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A results folder; no GPU is leased to anybody."""
    for name in (job.POOL, gpus.VISIBLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(gpus.LOCKS, str(tmp_path / "locks"))
    (tmp_path / "results").mkdir()
    return tmp_path / "results"


@pytest.fixture(scope="session")
def template(tmp_path_factory):
    """A migrated MLflow database. Making one takes seconds, copying it does not; it holds no experiment of a test."""
    results = tmp_path_factory.mktemp("template")
    assert tracking.init(results, Tracking(experiment="template"))["outcome"] == "ready"
    return results / "mlflow.db"


@pytest.fixture
def tracked(tmp_path, template):
    """A results folder with a migrated MLflow database."""
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(template, folder / "mlflow.db")
    return folder
