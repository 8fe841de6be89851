"""Types of options that commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from neuspring.config.parse import json_value
from neuspring.config.settings import read_settings
from neuspring.stages.stage import SETTINGS_HELP

__all__ = ["Device", "Host", "NoOpen", "Port", "Positional", "Results", "Settings", "arg", "json_value", "read_settings"]
Settings = Annotated[str, arg(help=SETTINGS_HELP)]
Device = Annotated[str, arg(help="auto, cpu or cuda:N")]
Host = Annotated[str, arg(help="address to listen at; the default is for this machine alone")]
Port = Annotated[int, arg(help="0: any that is free")]
NoOpen = Annotated[bool, arg(help="print the address, and open no browser")]
Results = Annotated[Path, arg(help="results folder")]
