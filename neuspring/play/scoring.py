"""A recording against the twins of a scenario: which one was pulled, and how far the others are from it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.play.controls import Controls, compare, replay
from neuspring.play.results import Run, Scene


def pulled_run(found: Scene, controls: Controls, path: Path) -> Run:
    """The run whose twin was pulled, told by its digest. Raises InputError where it is not there."""
    candidates = sorted((run for run in found.runs if run.twin_path), key=lambda run: run.name != controls.name)
    for run in candidates:
        if run.twin_digest == controls.twin_digest:
            return run
    rule = f"its twin ({controls.scenario}/{controls.name}, SHA-256 {controls.twin_digest[:12]}) must be among the runs"
    raise InputError(
        path, rule, f"{len(candidates)} other twins of {found.folder.name}", "Give the results folder that it was recorded in."
    )


def comparison(found: Scene, controls: Controls, own: Run) -> Iterator[str]:
    """A line per twin: how far its nodes are from those of the twin that was pulled, under the same controls."""
    assert own.twin is not None
    yield f"{len(controls.grabbed)} frames recorded with {own.name}; distances of nodes to it, mm"
    yield f"{'run':32} {'mean':>8} {'last':>8} {'worst':>8}"
    seen = replay(own.twin, controls)
    for run in found.runs:
        if run is own or run.twin_path is None:
            continue
        try:
            assert run.twin is not None
            result = compare(controls, own.twin, run.twin, seen)
        except InputError as error:
            yield f"{run.name:32} {error}"
            continue
        numbers = " ".join(f"{1e3 * value:8.1f}" for value in (result.mean, result.last, result.worst))
        yield f"{run.name:32} {numbers}  {result.diverged}".rstrip()
