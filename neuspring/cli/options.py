"""Options that commands share, and how their values are read."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.config import Config


def read_settings(text: str) -> Config:
    """Settings from JSON text, or from YAML files separated by commas (later ones override)."""
    from neuspring import config

    if text.lstrip().startswith("{"):
        return config.parse(config.Config, json_mapping("--settings", text), "--settings")
    values: dict[str, object] = {}
    for name in text.split(","):
        config.merge(values, config.read_yaml(Path(name)))
    return config.parse(config.Config, values, f"--settings {text}")


def json_mapping(option: str, text: str) -> dict[str, object]:
    """The JSON object given with an option. Raises InputError."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(option, "must be JSON", str(error)) from error
    if not isinstance(values, dict):
        raise InputError(option, "must be a JSON object", type(values).__name__)
    return values


def read_left_out(text: str) -> dict[str, tuple[str, ...]]:
    """Method -> scenarios to which it does not apply, from JSON text. Raises InputError."""
    values = json_mapping("--left-out", text)
    if not all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in values.values()):
        raise InputError("--left-out", "must map methods to lists of scenarios", text)
    return {method: tuple(names) for method, names in values.items() if isinstance(names, list)}


def add_left_out(parser: argparse.ArgumentParser) -> None:
    """The option that `read_left_out` reads."""
    about = "JSON: methods and the scenarios to which they do not apply, where they have no runs"
    parser.add_argument("--left-out", metavar="JSON", default="{}", help=about)


class Adder:
    """Adds commands with the options they share."""

    def __init__(self, commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
        self._commands = commands

    def __call__(self, name: str, run: object, text: str, *shared: str) -> argparse.ArgumentParser:
        parser = self._commands.add_parser(name, help=text, description=text)
        parser.set_defaults(run=run)
        if "scenario" in shared:
            which = parser.add_mutually_exclusive_group(required=True)
            which.add_argument("--scenario", help="name of a row of the scenario table")
            which.add_argument("--row", help="the row itself, as JSON")
        if "capture" in shared:
            parser.add_argument("--capture", type=Path, required=True, help="capture.json")
        if "observations" in shared:
            parser.add_argument("--observations", type=Path, required=True, help="observations.npz")
        if "settings" in shared:
            parser.add_argument("--settings", default="{}", help="JSON, or YAML files separated by commas; defaults otherwise")
        if "results" in shared:
            parser.add_argument("--results", type=Path, default=Path("results"), help="results folder")
        if "runs" in shared:
            parser.add_argument("--scenarios", nargs="+", required=True)
            parser.add_argument("--methods", nargs="+", required=True)
            parser.add_argument("--seeds", nargs="+", type=int, required=True)
        if "compute" in shared:
            parser.add_argument("--device", default="auto", help="auto, cpu or cuda:N")
            parser.add_argument("--threads", type=int, default=1)
        if "output" in shared:
            parser.add_argument("--output", type=Path, required=True, help="file (tables, draw: folder) to write")
        return parser
