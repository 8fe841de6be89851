"""From the report to the playground: a command for each scenario, and links to the frames of a picture."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

from neuspring.core.artifacts import Observations
from neuspring.report.figures.run import chosen_frames
from neuspring.report.page.sources import UNREADABLE, Material, Run

ADDRESS = "http://127.0.0.1:8080/"
"""Where `neuspring play` listens unless it is told otherwise."""


def command(material: Material, runs: Iterable[Run]) -> str:
    """What shows these runs of one scenario side by side."""
    return shlex.join(["neuspring", "play", *(str(material.results / material.relative(run.folder)) for run in runs)])


def links(material: Material, scenario: str) -> tuple[tuple[str, str], ...]:
    """Text and address of each frame that pictures of motion show; none where the observations cannot be read."""
    path = material.results / scenario / "observations.npz"
    try:
        facts = Observations.load(path).scenario
    except UNREADABLE:
        return ()
    return tuple(
        (f"frame {frame}", f"{ADDRESS}?frame={frame}&scenario={scenario}")
        for frame in sorted(chosen_frames(facts, facts.frame_count))
    )
