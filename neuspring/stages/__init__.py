"""The steps of the workflow: one file is one typed function, one rule, one command and one record.

`STAGES` finds them: every module here has a function of its own name, decorated by `neuspring.stages.stage.stage`, whose docstring
explains the signature. To add a stage: its module.
"""

from __future__ import annotations

import importlib
import pkgutil

from neuspring.core.run_folder import LEARNING_STAGES
from neuspring.stages.stage import Stage


def _found() -> dict[str, Stage]:
    """All stages, each behind those that it reads from; what learns a model comes before what reads the model of a run."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__) if module.name != "stage")
    waiting: dict[str, Stage] = {name: getattr(importlib.import_module(f"{__name__}.{name}"), name) for name in names}
    found: dict[str, Stage] = {}
    while waiting:
        to_come = {one.product for one in waiting.values()} | {LEARNED for name in LEARNING_STAGES if name in waiting}
        ready = [name for name, one in waiting.items() if not to_come & (set(one.inputs) - {one.product})]
        assert ready, f"stages read from each other: {', '.join(waiting)}"
        found |= {name: waiting.pop(name) for name in ready}
    return found


LEARNED = "learned"
"""The input that is the record of whatever learned the run's model."""
STAGES = _found()
