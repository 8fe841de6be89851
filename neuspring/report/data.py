"""Data of a report page: runs, jobs and records of a results folder. Damaged files are listed and skipped."""

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
"""Kind of the images that perception writes, and their folder in a scenario's folder."""
MARKUP = 400
"""Characters of HTML around an embedded image."""
NO_ROOM = "not embedded, to keep this page small"
MOST_ROWS = 400
"""Maximum number of displayed rows of a list."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Subject of the report. Empty fields are filled from the settings, else from the results folder."""

    scenarios: Sequence[str] = ()
    methods: Sequence[str] = ()
    seeds: Sequence[int] = ()
    baseline: str | None = None
    """Method that all other methods are compared with; None: the baseline of the settings, else the first method."""
    transfers: Sequence[str] = ()
    """Scenarios whose twins also predict other recordings (transfer)."""
    left_out: LeftOut = field(default_factory=dict)
    """Method -> scenarios to which it does not apply -> reason."""
    shown: Sequence[str] = ()
    """Methods with curves and images; empty: the baseline and the first methods of the studies, six in total."""
    settings: Config | None = None
    studies: Mapping[str, Study] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    """Method -> displayed name, for methods with a title."""
    tables: str = "tables"
    """Folder of tables in the results folder."""
    megabytes: float = 25.0
    """Maximum size of the page, MB. Images and videos that do not fit are linked."""
    video_megabytes: float = 8.0
    """Maximum size of the embedded videos, MB; part of `megabytes`."""


@dataclass(kw_only=True)
class ReportData:
    """The data that all sections read."""

    results: Path
    output: Path
    choice: Options
    """The options with all empty fields filled."""
    numbers: Compared
    jobs: Sequence[JobRecord]
    damaged: dict[str, str]
    """Unreadable file, relative to the results folder -> reason."""
    room: int = 0
    """Characters that are left for images and videos."""
    film_room: int = 0
    """Characters of `room` that are left for videos."""

    def take(self, size: int, film: bool = False) -> bool:
        """Reserve `size` characters for an image or video; returns False if it does not fit."""
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
        """The runs with readable records."""
        return list(self.table.records.values())

    def folder(self, run: RunRecord) -> Path:
        """The folder of a run."""
        return self.results / run.name

    def file(self, run: RunRecord, kind: str, stem: str) -> Path | None:
        """A file that the run's record names, or an image of perception (first camera); None if it does not exist."""
        if kind == PERCEPTION:
            folder = self.results / run.scenario / PERCEPTION
            return next((path for path in (folder / f"{stem}.png", *sorted(folder.glob(f"*/{stem}.png"))) if path.is_file()), None)
        paths = (self.folder(run) / name for name in run.artifacts.get(kind, []))
        return next((path for path in paths if path.stem == stem and path.is_file()), None)

    def relative(self, path: Path) -> str:
        """The path relative to the results folder, for display; paths outside the folder stay as they are."""
        absolute, results = path.resolve(), self.results.resolve()
        return absolute.relative_to(results).as_posix() if absolute.is_relative_to(results) else str(path)

    def read(self, path: Path, read: Callable[[Path], Value]) -> Value | None:
        """The content of a file by the function `read`. A damaged file is added to `damaged` and gives None."""
        try:
            return read(path)
        except (InputError, OSError, ValueError, KeyError, TypeError, AttributeError, SyntaxError) as error:
            self.damaged.setdefault(self.relative(path), one_line(error))
            return None

    def observations(self, scenario: str) -> Observations | None:
        """The observations of a scenario; None if the file is missing or damaged."""
        path = self.results / scenario / "observations.npz"
        return self.read(path, Observations.load) if path.is_file() else None

    def first_runs(self, scenario: str) -> dict[str, RunRecord]:
        """Displayed method -> its first finished run of a scenario, else its first failed run."""
        runs = [run for run in self.runs if run.scenario == scenario]
        by_method = {method: [run for run in runs if run.method == method] for method in self.choice.shown}
        return {method: min(candidates, key=lambda run: not run.ok) for method, candidates in by_method.items() if candidates}


def traces(results: Path) -> tuple[list[str], list[str], list[int]]:
    """Scenarios, methods and seeds for which the results folder contains a record of a stage."""
    paths = [path for name in (RUN_RECORD, "rollout.json", "fit.json", "train.json") for path in results.glob(f"*/*/*/{name}")]
    paths += results.glob("*/search-*/*/search.json")
    runs = [parts for path in paths if (parts := path.relative_to(results).parts)[2].isdigit()]
    methods = {parts[1] for parts in runs if not parts[1].startswith("search-")}
    return sorted({parts[0] for parts in runs}), sorted(methods), sorted({int(parts[2]) for parts in runs})


def damaged_files(table: ScoreTable, messages: Sequence[str], results: Path) -> dict[str, str]:
    """Unreadable record of a run, transfer or job, relative to the results folder -> reason."""
    # A message about a job record starts with the path of its file.
    parts = (message.partition(": ") for message in messages)
    damaged = {Path(path).relative_to(results).as_posix(): reason for path, _, reason in parts}
    rows: list[Any] = list(table.runs.itertuples())
    damaged |= {f"{row.run}/{RUN_RECORD}": row.reason.removeprefix(DAMAGED) for row in rows if row.reason.startswith(DAMAGED)}
    moved = {f"{row.run}/transfer.json": row.notes.rpartition(DAMAGED)[2] for row in rows if DAMAGED in row.notes}
    return damaged | moved


def link(path: Path, folder: Path) -> str:
    """Relative link to `path` from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


@dataclass(frozen=True, kw_only=True)
class ReportSection:
    """A section of the report; a module of `sections` or of an extension declares it as a member of the registry."""

    order: int
    """Position on the page, in steps of ten; a section with an order above 30 is folded."""
    title: str
    make: Callable[[ReportData], Sequence[Block]]
    """Returns the blocks; an empty list omits the section."""
    about: str = ""
    """A sentence below the title."""
    phase: Literal[0, 1, 2] = 0
    """1: made after phase 0, because it fills the remaining `room`; 2: made last, because it lists all damaged files."""


def shown_figure(figure: Figure, caption: str) -> Picture:
    """Convert a figure to SVG and close it."""
    stream = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": caption}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    return Picture(caption="", alt=caption, data=data_uri("image/svg+xml", stream.getvalue()), wide=True, paper=True)


def webp(picture: Image.Image, width: int) -> str:
    """Data URI of an image, at most `width` pixels wide."""
    picture, stream = picture.convert("RGB"), io.BytesIO()
    picture.thumbnail((width, 10 * width))
    picture.save(stream, "WEBP", quality=75)
    return data_uri("image/webp", stream.getvalue())


def data_uri(kind: str, data: bytes) -> str:
    """Data URI of an image or video."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
