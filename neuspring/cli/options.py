"""Options that commands share."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from neuspring.stages.stage import json_value, read_settings

__all__ = ["add_device", "add_output", "add_record", "add_settings", "json_value", "read_settings"]


def add_record(parser: ArgumentParser, stage: str, help: str, *, required: bool = True) -> None:
    """The record of a stage before this one."""
    parser.add_argument(f"--{stage}", type=Path, required=required, help=help)


def add_settings(parser: ArgumentParser) -> None:
    """--settings."""
    parser.add_argument("--settings", default="{}", help="JSON, or YAML files separated by commas; defaults otherwise")


def add_device(parser: ArgumentParser) -> None:
    """--device and --threads."""
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda:N")
    parser.add_argument("--threads", type=int, default=1)


def add_output(parser: ArgumentParser, help: str = "file to write") -> None:
    """--output."""
    parser.add_argument("--output", type=Path, required=True, help=help)
