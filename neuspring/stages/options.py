"""Options that commands share, and how their values are read."""

from __future__ import annotations

import json
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.config import Config, ScenarioRow


def add_capture(parser: ArgumentParser, *, required: bool = True, help: str = "capture.json") -> None:
    """--capture."""
    parser.add_argument("--capture", type=Path, required=required, help=help)


def add_masks(parser: ArgumentParser, *, required: bool = True) -> None:
    """--masks, of all cameras."""
    about = "masks.json of every camera, in the capture's order"
    parser.add_argument("--masks", type=Path, nargs="+", required=required, help=about)


def add_tracks(parser: ArgumentParser) -> None:
    """--tracks, of all cameras."""
    about = "tracks.json of every camera, in the capture's order"
    parser.add_argument("--tracks", type=Path, nargs="+", required=True, help=about)


def add_observations(parser: ArgumentParser, *, required: bool = True, help: str = "observations.npz") -> None:
    """--observations."""
    parser.add_argument("--observations", type=Path, required=required, help=help)


def add_record(parser: ArgumentParser, stage: str, help: str, *, required: bool = True) -> None:
    """The record of a stage before this one."""
    parser.add_argument(f"--{stage}", type=Path, required=required, help=help)


def add_pool(parser: ArgumentParser) -> None:
    """--pool and --leave-out."""
    about = "observations of other recordings of the object with the same nodes, which one twin is judged on too"
    parser.add_argument("--pool", type=Path, nargs="+", default=[], help=about)
    about = "judge on the pool alone; of --observations only frame 0 is used, where the twin lies"
    parser.add_argument("--leave-out", action="store_true", help=about)


def pool_inputs(pool: Sequence[Path]) -> dict[str, Path]:
    """Inputs of a record: the pool's observations, by place."""
    return {f"pool{place}": path for place, path in enumerate(pool)}


def add_settings(parser: ArgumentParser) -> None:
    """--settings; see `read_settings`."""
    parser.add_argument("--settings", default="{}", help="JSON, or YAML files separated by commas; defaults otherwise")


def add_seed(parser: ArgumentParser) -> None:
    """--seed."""
    parser.add_argument("--seed", type=int, default=0)


def add_device(parser: ArgumentParser) -> None:
    """--device and --threads."""
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda:N")
    parser.add_argument("--threads", type=int, default=1)


def add_twins_per_launch(parser: ArgumentParser) -> None:
    """--twins-per-launch; see `read_twins_per_launch`."""
    about = "twins simulated in one launch, at most: auto, or a number; results do not depend on it"
    parser.add_argument("--twins-per-launch", default="auto", help=about)


def read_twins_per_launch(a: Namespace) -> int:
    """The value of --twins-per-launch; 0 for auto. Raises InputError."""
    word = str(a.twins_per_launch)
    if word == "auto":
        return 0
    if not re.fullmatch(r"0*[1-9][0-9]{0,8}", word):
        raise InputError("--twins-per-launch", "must be auto or an integer of at least 1", repr(word))
    return int(word)


def add_output(parser: ArgumentParser, help: str = "file to write") -> None:
    """--output."""
    parser.add_argument("--output", type=Path, required=True, help=help)


def add_scenario(parser: ArgumentParser) -> None:
    """--scenario or --row; see `read_row`."""
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--scenario", help="name of a row of the scenario table")
    which.add_argument("--row", help="the row itself, as JSON")


def read_row(a: Namespace, settings: Config) -> ScenarioRow:
    """The row that --row gives or --scenario names. Raises InputError."""
    from neuspring import config
    from neuspring.data.sources import read_scenarios

    if a.row:
        return config.parse(config.ScenarioRow, json_mapping("--row", a.row), "--row")
    rows = read_scenarios(Path(settings.scenario_table))
    if a.scenario not in rows:
        raise InputError("--scenario", f"must be a row of {settings.scenario_table}", a.scenario)
    return rows[a.scenario]


def read_settings(text: str) -> Config:
    """Settings from JSON text, or from YAML files separated by commas (later ones override)."""
    from neuspring import config

    if text.lstrip().startswith("{"):
        return config.parse(config.Config, json_mapping("--settings", text), "--settings")
    values: dict[str, object] = {}
    for name in text.split(","):
        config.merge(values, config.read_yaml(Path(name)))
    return config.parse(config.Config, values, f"--settings {text}")


def json_rows(option: str, text: str) -> list[dict[str, Any]]:
    """The JSON list of objects given with an option. Raises InputError."""
    values = json_mapping(option, f'{{"rows": {text}}}')["rows"]
    if not isinstance(values, list) or not all(isinstance(row, dict) for row in values):
        raise InputError(option, "must be a JSON list of objects", text)
    return values


def json_mapping(option: str, text: str) -> dict[str, object]:
    """The JSON object given with an option. Raises InputError."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(option, "must be JSON", str(error)) from error
    if not isinstance(values, dict):
        raise InputError(option, "must be a JSON object", type(values).__name__)
    return values
