"""Commands of sweeps: tune, tune-report."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.cli import options as shared
from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.config import Config
    from neuspring.config.tuning import Tune


def tune_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring tune`."""
    about = "observations.npz of the sweep's scenarios"
    parser.add_argument("--observations", type=Path, nargs="+", required=True, help=about)
    parser.add_argument("--worker", type=int, default=0)
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def tune(a: Namespace) -> None:
    """`neuspring tune`."""
    from neuspring.experiments.tuning import worker

    settings, sweep = _sweep(a)
    worker.work(settings, sweep, a.observations, a.worker, a.device, a.output)


def tune_report_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring tune-report`."""
    shared.add_settings(parser)
    shared.add_output(parser)


def tune_report(a: Namespace) -> None:
    """`neuspring tune-report`."""
    from neuspring.experiments.tuning import report

    settings, sweep = _sweep(a)
    report.report(settings, sweep, a.output)
    print(a.output.read_text(encoding="utf-8"))


def _sweep(a: Namespace) -> tuple[Config, Tune]:
    settings = shared.read_settings(a.settings)
    if settings.tune is None:
        raise InputError("--settings, tune", "a sweep is required", None, "See config/README.md, tune.")
    return settings, settings.tune
