"""A sweep that has not begun, and a finished one."""

from pathlib import Path

import pytest

from neuspring.config.tuning import Tune
from tests.extensions.tuning import sweeps


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a sweep that has not begun; what it reads lies beside it."""
    return sweeps.furnish(tmp_path)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tune]:
    """A sweep of four trials, reported. Tests leave its trials as they are."""
    folder = sweeps.furnish(tmp_path_factory.mktemp("tune"))
    tune = sweeps.sweep(trials=4, space=sweeps.FAST | {"fit.damping": {"choices": ["fixed", "homogeneous"]}})
    sweeps.work(folder, tune)
    sweeps.report(folder, tune)
    return folder, tune
