"""The scripts of workflow/scripts as modules."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).parents[2] / "workflow/scripts"


def load(name: str) -> ModuleType:
    """The module of workflow/scripts/NAME.py, without running its `main`."""
    spec = importlib.util.spec_from_file_location(f"workflow_scripts_{name}", FOLDER / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up here.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
