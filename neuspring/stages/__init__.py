"""The stages of the workflow: each module is one typed function, one command and one record.

Every module contains a function of the same name with the decorator `neuspring.stages.stage.stage`; the docstring of that module
explains the signature and the declarations. To add a stage, add its module and its name in `FLOW`, or, in another package, an
entry point of the group `neuspring.stages`. The workflow and the command line read only declarations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from neuspring.registry import Registry

if TYPE_CHECKING:
    from neuspring.stages.stage import Stage

LEARNED = "learned"
"""Name of the input that is the record of the last learning stage of a run."""
FLOW = """
    capture segment track lift observe
    search fit appearance train
    rollout predict average render score transfer
"""
STAGES: Registry[Stage] = Registry(
    "stages", {name: f"{__name__}.{name}:{name}" for name in FLOW.split()}, "neuspring.stages.stage:Stage"
)
"""All stages; each comes after the stages whose products it reads."""


def makers(name: str) -> list[Stage]:
    """The stages that write the input of this name; for `learned`, the learning stages, last one first."""
    from neuspring.core.run_folder import LEARNING_STAGES

    if name == LEARNED:
        return [STAGES[learning] for learning in reversed(LEARNING_STAGES)]
    return [stage for stage in STAGES.values() if stage.product == name]
