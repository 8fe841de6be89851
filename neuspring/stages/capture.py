"""A synthetic scene, or PhysTwin's raw layout -> a capture folder."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.config import Config, ScenarioRow
from neuspring.data.sources import write_capture
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring capture`."""
    shared.add_scenario(parser)
    shared.add_settings(parser)
    shared.add_output(parser, "capture.json to write")


def command(a: Namespace) -> None:
    """`neuspring capture`."""
    settings = shared.read_settings(a.settings)
    run(shared.read_row(a, settings), settings, a.output)


def run(row: ScenarioRow, settings: Config, output: Path) -> None:
    """Write the capture whose capture.json is `output`.

    The truth of a synthetic scene lies beside the folder and is never read by a method.
    """
    write_capture(row, settings, output.parent)
