"""Material of a report page: runs, jobs and records of a results folder. Damaged files are listed and stop nothing."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

from neuspring.config import Config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.report.blocks import Block, Picture
from neuspring.report.tables import Compared
from neuspring.scores.paper import Study
from neuspring.scores.table import DAMAGED, LeftOut, ScoreTable, one_line

Value = TypeVar("Value")
PERCEPTION = "perception"
"""Kind of the pictures that perception left of a scenario, and their folder in it."""
MARKUP = 400
"""Characters around an embedded picture."""
NO_ROOM = "not embedded, to keep this page small"
MOST_ROWS = 400
"""At most so many rows of a list are shown."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Subject of the report. What is left empty is taken from the settings, else from what is in the results folder."""

    scenarios: Sequence[str] = ()
    methods: Sequence[str] = ()
    seeds: Sequence[int] = ()
    baseline: str | None = None
    """The method that others are compared with; None: the settings', else the first."""
    transfers: Sequence[str] = ()
    """Scenarios whose twins were rolled out on other recordings."""
    left_out: LeftOut = field(default_factory=dict)
    """Method -> scenarios to which it does not apply -> reason."""
    shown: Sequence[str] = ()
    """Methods whose curves and pictures are shown; empty: the baseline and the first methods of the studies, six in all."""
    settings: Config | None = None
    studies: Mapping[str, Study] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    """Method -> its name for people, of those that have one."""
    tables: str = "tables"
    """Folder of tables in the results folder."""
    megabytes: float = 25.0
    """Largest size of the page. Pictures and videos that do not fit are linked."""
    video_megabytes: float = 8.0
    """Largest part of that for videos."""


@dataclass(kw_only=True)
class ReportData:
    """Everything that the sections read."""

    results: Path
    output: Path
    choice: Options
    """With nothing left empty."""
    numbers: Compared
    jobs: Sequence[JobRecord]
    damaged: dict[str, str]
    """Files that cannot be read, relative to the results folder, and why."""
    room: int = 0
    """Characters that pictures and films may take."""
    film_room: int = 0
    """Characters of these that films may take."""

    def take(self, size: int, film: bool = False) -> bool:
        """True, and the room is taken, where a picture or film of this size still fits."""
        if size + MARKUP > (min(self.room, self.film_room) if film else self.room):
            return False
        self.room -= size + MARKUP
        self.film_room -= size * film
        return True

    @property
    def table(self) -> ScoreTable:
        """The long table."""
        return self.numbers.table

    @property
    def runs(self) -> list[RunRecord]:
        """The runs whose records could be read."""
        return list(self.table.records.values())

    def folder(self, run: RunRecord) -> Path:
        """The folder of a run."""
        return self.results / run.name

    def file(self, run: RunRecord, kind: str, stem: str) -> Path | None:
        """A file that a run's record names, or a picture of perception (of the first camera); None where there is none."""
        if kind == PERCEPTION:
            folder = self.results / run.scenario / PERCEPTION
            return next((path for path in (folder / f"{stem}.png", *sorted(folder.glob(f"*/{stem}.png"))) if path.is_file()), None)
        paths = (self.folder(run) / name for name in run.artifacts.get(kind, []))
        return next((path for path in paths if path.stem == stem and path.is_file()), None)

    def relative(self, path: Path) -> str:
        """A path for people: relative to the results folder."""
        place, results = path.resolve(), self.results.resolve()
        return place.relative_to(results).as_posix() if place.is_relative_to(results) else str(path)

    def read(self, path: Path, read: Callable[[Path], Value]) -> Value | None:
        """The content of a file, read by a function; None, and remembered, for a damaged one."""
        try:
            return read(path)
        except (InputError, OSError, ValueError, KeyError, TypeError, AttributeError, SyntaxError) as error:
            self.damaged.setdefault(self.relative(path), one_line(error))
            return None

    def observations(self, scenario: str) -> Observations | None:
        """What was observed of a scenario; None where that is not there or damaged."""
        path = self.results / scenario / "observations.npz"
        return self.read(path, Observations.load) if path.is_file() else None

    def first_runs(self, scenario: str) -> dict[str, RunRecord]:
        """Shown method -> its first run of a scenario, finished ones before failed ones."""
        runs = [run for run in self.runs if run.scenario == scenario]
        own = {method: [run for run in runs if run.method == method] for method in self.choice.shown}
        return {method: min(found, key=lambda run: not run.ok) for method, found in own.items() if found}


def traces(results: Path) -> tuple[list[str], list[str], list[int]]:
    """Scenarios, methods and seeds that have left a record of a stage."""
    paths = [path for name in (RUN_RECORD, "rollout.json", "fit.json", "train.json") for path in results.glob(f"*/*/*/{name}")]
    paths += results.glob("*/search-*/*/search.json")
    found = [parts for path in paths if (parts := path.relative_to(results).parts)[2].isdigit()]
    methods = {parts[1] for parts in found if not parts[1].startswith("search-")}
    return sorted({parts[0] for parts in found}), sorted(methods), sorted({int(parts[2]) for parts in found})


def damaged_files(table: ScoreTable, messages: Sequence[str], results: Path) -> dict[str, str]:
    """Records of runs, transfers and jobs that cannot be read, relative to the results folder, and why."""
    # Messages on job records begin with the file.
    parts = (message.partition(": ") for message in messages)
    damaged = {Path(path).relative_to(results).as_posix(): reason for path, _, reason in parts}
    rows: list[Any] = list(table.runs.itertuples())
    damaged |= {f"{row.run}/{RUN_RECORD}": row.reason.removeprefix(DAMAGED) for row in rows if row.reason.startswith(DAMAGED)}
    moved = {f"{row.run}/transfer.json": row.notes.rpartition(DAMAGED)[2] for row in rows if DAMAGED in row.notes}
    return damaged | moved


def link(path: Path, folder: Path) -> str:
    """A relative link from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


@dataclass(frozen=True, kw_only=True)
class ReportSection:
    """A section of the report: the member of a registry that a module of `sections`, or of a package, declares."""

    order: int
    """Its position on the page, by tens; behind 30 it is folded."""
    title: str
    make: Callable[[ReportData], Sequence[Block]]
    """Its blocks; none where there is nothing to show."""
    about: str = ""
    """A sentence below the title."""
    phase: Literal[0, 1, 2] = 0
    """1: it takes the `room` that all others leave; 2: it lists the damaged files that all others found."""


def shown_figure(figure: Figure, caption: str) -> Picture:
    """A figure as SVG in the page; closes it."""
    stream = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": caption}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    return Picture(caption="", alt=caption, data=data_uri("image/svg+xml", stream.getvalue()), wide=True, paper=True)


def webp(picture: Image.Image, width: int) -> str:
    """Data URI of a picture, not wider than `width`."""
    picture, stream = picture.convert("RGB"), io.BytesIO()
    picture.thumbnail((width, 10 * width))
    picture.save(stream, "WEBP", quality=75)
    return data_uri("image/webp", stream.getvalue())


def data_uri(kind: str, data: bytes) -> str:
    """Bytes as the source of a picture or film."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
