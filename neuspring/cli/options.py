"""Types of options that several commands use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from neuspring.config.parse import json_value
from neuspring.config.settings import read_settings
from neuspring.stages.stage import SETTINGS_HELP

__all__ = ["Device", "Positional", "Results", "Settings", "arg", "json_value", "read_settings"]
Settings = Annotated[str, arg(help=SETTINGS_HELP)]
Device = Annotated[str, arg(help="auto, cpu or cuda:N")]
Results = Annotated[Path, arg(help="results folder")]
