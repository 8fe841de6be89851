"""Optional packages, and the extra of the installation that contains each."""

from __future__ import annotations

import importlib
from typing import Any

from neuspring.core.errors import InputError

EXTRAS = {
    "newton": "synthetic",
    "av": "video",
    "viser": "play",
    "pxr": "export",
    "mujoco": "export",
    "rerun": "rerun",
    "rosbags": "recordings",
    "backports": "recordings",
    "ezc3d": "recordings",
    "transformers": "perception",
    "torchvision": "perception",
    "gsplat": "gpu",
    "psycopg2": "postgresql",
    "snakemake_executor_plugin_cluster_generic": "kubernetes",
}
"""Module -> extra, as in pyproject.toml."""


def install(extra: str) -> str:
    """The command that installs an extra with the pinned versions."""
    return f'.venv/bin/pip install -c workflow/envs/constraints.txt -e ".[{extra}]"'


def needed(module: str) -> Any:
    """Import and return a module of an extra. Raises InputError, which names the extra, if the package is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        extra = EXTRAS[package]
        raise InputError(f"package {package}", f"the extra [{extra}] is required", "not installed", install(extra)) from error
