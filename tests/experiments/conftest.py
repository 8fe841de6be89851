"""Fixtures that several files of sweep tests share."""

from pathlib import Path

import pytest

from neuspring.config.tuning import Tune
from tests.support import sweeps


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a sweep that has not begun; what it reads lies beside it."""
    return sweeps.furnish(tmp_path)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tune]:
    """A sweep of four trials, reported. Tests leave its trials as they are."""
    folder = sweeps.furnish(tmp_path_factory.mktemp("tune"))
    space = sweeps.FAST | {"fit.schedule": {"choices": ["constant", "cosine"]}}
    tune = sweeps.sweep(trials=4, pruner="none", space=space)
    sweeps.work(folder, tune)
    sweeps.report(folder, tune)
    return folder, tune
