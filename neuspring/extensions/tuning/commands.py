"""The commands of a sweep: a worker (`tune`) and the report (`tune-report`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from neuspring.cli.options import Device, Settings, arg, read_settings
from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.config import Config
    from neuspring.config.tuning import Tune


def tune(
    observations: Annotated[tuple[Path, ...], arg(help="observations.npz of the sweep's scenarios")],
    output: Path,
    worker: int = 0,
    settings: Settings = "{}",
    device: Device = "auto",
    threads: int = 1,
) -> None:
    """Run one worker of a sweep."""
    from neuspring.extensions.tuning.worker import work

    work(*_sweep(settings), list(observations), worker, device, output)


def tune_report(output: Path, settings: Settings = "{}") -> None:
    """Summarize a sweep: summary, table of trials, best.yaml."""
    from neuspring.extensions.tuning.report import report

    report(*_sweep(settings), output)
    print(output.read_text(encoding="utf-8"))


def _sweep(text: str) -> tuple[Config, Tune]:
    settings = read_settings(text)
    if settings.tune is None:
        raise InputError("--settings, tune", "a sweep is required", None, "Set tune as in config/README.md.")
    return settings, settings.tune
