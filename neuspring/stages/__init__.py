"""The steps of the workflow: one file is one rule, one command and one record.

`STAGES` declares them in their order. Each module `neuspring.stages.NAME` has `options`, which adds the options of its command,
`command`, which runs it from parsed options, and `run`, which does the work: it reads artifacts and records, computes, writes
artifacts, and last its own record. A numerical failure is recorded and passed on to later stages; anything else raises.

To add a stage: its module, its line here, its rule in workflow/rules.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Stage:
    """What is known of a stage before it runs."""

    about: str
    """What the command makes of what."""
    reads: tuple[str, ...] = ()
    """Keys of the configuration that it reads; scenario sources, backends and baselines declare theirs themselves."""
    gpu: Literal["never", "backend", "always"] = "never"
    """Whether its jobs take a GPU where there is one; `backend`: its backend decides."""
    learns: bool = False
    """Whether it learns the model of a run."""
    memory_mb: int = 4000
    minutes: int = 30
    """What its first jobs ask for, before any was measured."""


COMMON = ("simulation", "losses", "released_quirks")
"""Sections that search and fit share."""
STAGES = {
    "capture": Stage(about="synthetic scene or PhysTwin's raw layout -> capture folder", minutes=120),
    "segment": Stage(
        about="one camera of a capture -> masks", reads=("perception.segment.verdict",), gpu="backend", memory_mb=8000, minutes=120
    ),
    "track": Stage(
        about="masks of one camera -> tracks of pixels", reads=("perception.seed",), gpu="backend", memory_mb=8000, minutes=120
    ),
    "lift": Stage(
        about="masks and tracks of all cameras -> points in the world, shape prior",
        reads=("perception.lift", "perception.shape", "perception.color"),
        memory_mb=8000,
        minutes=60,
    ),
    "judge": Stage(about="perception of a synthetic capture -> its errors against the truth", reads=("perception.shape",)),
    "observe": Stage(about="capture -> observations.npz"),
    "search": Stage(
        about="observations -> coarse twin, by CMA-ES",
        reads=("search", *COMMON),
        gpu="always",
        learns=True,
        memory_mb=8000,
        minutes=240,
    ),
    "fits": Stage(
        about="coarse twins of a scenario -> checkpoints of their fits, several in one launch",
        reads=("fit", *COMMON),
        gpu="always",
        memory_mb=16000,
        minutes=960,
    ),
    "fit": Stage(
        about="coarse twin -> fitted twin, by gradients",
        reads=("fit", *COMMON),
        gpu="always",
        learns=True,
        memory_mb=8000,
        minutes=480,
    ),
    "train": Stage(about="observations -> trained model of a baseline", gpu="always", learns=True, memory_mb=8000, minutes=480),
    "rollout": Stage(about="twin -> trajectory over all frames", gpu="always", minutes=60),
    "predict": Stage(about="model of a baseline -> trajectory over all frames", gpu="always", minutes=60),
    "transfer": Stage(
        about="learned model -> scores on other recordings of the object", reads=("simulation",), gpu="always", minutes=60
    ),
    "appearance": Stage(
        about="frame 0 of a capture -> splats",
        reads=("images.backend", "images.appearance", "images.released_quirks.corner_pixels"),
        gpu="always",
        memory_mb=8000,
        minutes=240,
    ),
    "render": Stage(
        about="splats and trajectory -> pictures, scored and filmed",
        reads=(
            "images.backend",
            "images.views",
            "images.opacity",
            "images.frozen_skinning",
            "images.video",
            "images.lpips",
            "images.released_quirks",
        ),
        gpu="always",
        memory_mb=8000,
        minutes=120,
    ),
    "score": Stage(about="trajectory -> scores, plots and run.json"),
}
LEARNING = tuple(name for name, stage in STAGES.items() if stage.learns)
"""Stages that produce a model, in order. A run's model is from the last of these that it has."""
