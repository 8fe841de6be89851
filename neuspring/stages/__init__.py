"""The steps of the workflow: one file is one typed function, one rule, one command and one record.

Every module here has a function of its own name, decorated by `neuspring.stages.stage.stage`, whose docstring explains the
signature and the declarations. To add a stage: its module and its name in `FLOW`, or in a package of your own an entry point of the
group `neuspring.stages`; the workflow and the command line ask the declarations and know no stage by name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from neuspring.registry import Registry

if TYPE_CHECKING:
    from neuspring.stages.stage import Stage

LEARNED = "learned"
"""The input that is the record of whatever learned the run's model."""
FLOW = """
    capture segment track lift observe
    search fit appearance train
    rollout predict average render score transfer
"""
STAGES: Registry[Stage] = Registry(
    "stages", {name: f"{__name__}.{name}:{name}" for name in FLOW.split()}, "neuspring.stages.stage:Stage"
)
"""In the order in which they read from each other."""


def makers(name: str) -> list[Stage]:
    """The stages whose product is an input of this name; those that learn a model, the last one first, for `learned`."""
    from neuspring.core.run_folder import LEARNING_STAGES

    if name == LEARNED:
        return [STAGES[learning] for learning in reversed(LEARNING_STAGES)]
    return [one for one in STAGES.values() if one.product == name]
