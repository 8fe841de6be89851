"""Coarse twins of one scenario -> checkpoints of their fits, several in one launch.

Fits of one scenario (rows and seeds) take much less time together than one after the other. Each leaves the checkpoint that it
would leave alone, and `fit` then continues from there: to its end, if nothing went wrong. So this stage makes no result of its own.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuspring import config
from neuspring.config import Kind
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError
from neuspring.core.records import Recorder, StageRecord
from neuspring.physics.lanes import WIDTHS
from neuspring.stages import fit as alone
from neuspring.stages import options as shared
from neuspring.twin.company import Seat, together
from neuspring.twin.fit import FitResult, fit


@dataclass(frozen=True, kw_only=True)
class Row:
    """The fits of one row of the method table: the arguments of their `neuspring fit`."""

    fits: dict[str, str]
    """Record to write -> search.json to start from."""
    kind: Kind = "springs"
    settings: str = "{}"
    oracle: bool = False


@dataclass(frozen=True)
class Member:
    """A fit that is still to be done."""

    output: str
    ready: alone.Prepared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring fits`."""
    shared.add_observations(parser)
    about = (
        'JSON list of rows: [{"kind": springs or field, "settings": as of `fit`, "fits": {fit.json: search.json, ...}}, ...];'
        ' "oracle": true fits all frames'
    )
    parser.add_argument("--rows", required=True, help=about)
    shared.add_device(parser)
    shared.add_twins_per_launch(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring fits`."""
    run(a.observations, read_rows(a.rows), a.device, a.output, shared.read_twins_per_launch(a))


def read_rows(text: str) -> list[Row]:
    """Raises InputError for anything but a list of rows."""
    try:
        values = json.loads(text)
    except ValueError as error:
        raise InputError("--rows", "must be JSON", str(error)) from error
    if not isinstance(values, list):
        raise InputError("--rows", "must be a list of rows", type(values).__name__)
    return [config.parse(Row, value, f"--rows, entry {place}") for place, value in enumerate(values)]


def run(observations_path: Path, rows: list[Row], device: str, output: Path, most: int = 0) -> None:
    """Write a checkpoint beside the record of each fit, and the record `output`.

    At most `most` fits share launches (0: as many as pay). Fits whose record is there already, from the same inputs and settings,
    are left alone, and so are those whose search failed. An error in one fit holds nobody up: it is named here, and its own `fit`
    meets it again.
    """
    device = resolve_device(device)
    record = Recorder("fits", output, inputs={"observations": observations_path}, device=device)
    members = [member for row in rows for member in _members(observations_path, row, device)]
    facts: dict[str, Any] = {"fits": sum(len(row.fits) for row in rows), "errors": {}, "spring_updates": 0}
    groups = companies(members, most or (WIDTHS[-1] if device == "cpu" else len(members)))
    facts["companies"] = [[member.output for member in group] for group in groups]
    for group in groups:
        results = together([member.ready.problem.twin for member in group], device, [_work(member.ready) for member in group])
        for member, result in zip(group, results, strict=True):
            if isinstance(result, FitResult):
                counts, frames = result.twin.counts, member.ready.problem.frame_end - 1
                facts["spring_updates"] += result.epochs_together * frames * counts["springs"] * counts["substeps"]
            else:
                facts["errors"][member.output] = f"{type(result).__name__}: {result}"
                print(f"{member.output}: {facts['errors'][member.output]}; its own job goes on from its last checkpoint")
    record.save(facts=facts)


def _members(observations_path: Path, row: Row, device: str) -> Iterator[Member]:
    settings = shared.read_settings(row.settings)
    for output, search in row.fits.items():
        own = alone.recorder(observations_path, Path(search), settings, row.kind, device, Path(output), oracle=row.oracle)
        if StageRecord.load(Path(search)).status != "failed" and not _is_done(own):
            yield Member(output, alone.prepared(own, observations_path, Path(search), settings))


def companies(members: Sequence[Member], most: int) -> list[list[Member]]:
    """Which fits share launches, at most so many: those of equal horizon and as many frames, which are in step. One alone
    shares with nobody."""
    in_step: dict[tuple[int, int], list[Member]] = {}
    for member in members:
        problem = member.ready.problem
        in_step.setdefault((problem.fit.horizon, problem.frame_end), []).append(member)
    groups = [alike[first : first + most] for alike in in_step.values() for first in range(0, len(alike), most)]
    return [group for group in groups if len(group) > 1]


def _work(ready: alone.Prepared) -> Callable[[Seat], FitResult]:
    def work(seat: Seat) -> FitResult:
        ready.partial.parent.mkdir(parents=True, exist_ok=True)
        return fit(ready.problem, partial=ready.partial, key=ready.key, seat=seat)

    return work


def _is_done(own: Recorder) -> bool:
    """Whether the fit's record is there, made of the same inputs and settings."""
    if not own.output.is_file():
        return False
    record = StageRecord.load(own.output)
    return (record.inputs, record.settings) == (own.inputs, json.loads(json.dumps(own.settings)))
