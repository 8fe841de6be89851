"""Material of a report page: runs, jobs and records of a results folder. Damaged files are listed and stop nothing."""

from __future__ import annotations

import base64
import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

from markdown_it import MarkdownIt
from markupsafe import Markup
from PIL import Image

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord, read_jobs
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.report.blocks import PageSection, Picture, Prose
from neuspring.scores.failures import LeftOut
from neuspring.scores.metrics import DASH
from neuspring.scores.numbers import Numbers
from neuspring.scores.paper import Study
from neuspring.scores.runs import DAMAGED, Collected, one_line

UNREADABLE = (InputError, OSError, ValueError, KeyError, TypeError, AttributeError)
"""Exceptions of a damaged record, table or picture."""
Value = TypeVar("Value")
PERCEPTION = "perception"
"""Kind of the pictures that perception left of a scenario, and their folder in it."""
MOST_ROWS = 400
"""At most so many failures of a kind are listed; the rest is counted."""
METHOD_RECORDS = (RUN_RECORD, "rollout.json", "fit.json", "train.json")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Subject of the report. What is left empty is taken from the settings, else from what lies in the results folder."""

    scenarios: Sequence[str] = ()
    methods: Sequence[str] = ()
    seeds: Sequence[int] = ()
    baseline: str | None = None
    """The method that others are compared with; None: the settings', else the first."""
    transfers: Sequence[str] = ()
    """Scenarios whose twins were rolled out on other recordings."""
    left_out: LeftOut = field(default_factory=dict)
    """Method to the scenarios to which it does not apply, so that it has no runs there."""
    shown: Sequence[str] = ()
    """Methods whose curves and pictures are shown; empty: the baseline and the first rows of the studies, six in all."""
    settings: Config | None = None
    studies: Mapping[str, Study] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    """Method to its name for people, of those that have one."""
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
    collected: Collected
    jobs: list[JobRecord]
    damaged: dict[str, str]
    """Files that cannot be read, relative to the results folder, and why."""
    numbers: Numbers
    """Numbers of the benchmark and its studies."""
    room: int = 0
    """Characters that pictures and films may take."""

    @property
    def runs(self) -> list[RunRecord]:
        """The runs whose records could be read."""
        return list(self.collected.records.values())

    def folder(self, run: RunRecord) -> Path:
        """The folder of a run."""
        return self.results / run.name

    def file(self, run: RunRecord, kind: str, stem: str) -> Path | None:
        """One of the files that a run's record names; None if there is none, or it is not there.

        Of `PERCEPTION`: what it left of the scenario, of the first camera where each has its own.
        """
        if kind == PERCEPTION:
            folder = self.results / run.scenario / PERCEPTION
            return next((path for path in (folder / f"{stem}.png", *sorted(folder.glob(f"*/{stem}.png"))) if path.is_file()), None)
        paths = (self.folder(run) / name for name in run.artifacts.get(kind, []))
        return next((path for path in paths if path.stem == stem and path.is_file()), None)

    def relative(self, path: Path) -> str:
        """A path for people: relative to the results folder."""
        place, results = path.resolve(), self.results.resolve()
        return place.relative_to(results).as_posix() if place.is_relative_to(results) else str(path)

    def lost(self, path: Path, reason: Exception | str) -> None:
        """Remember a damaged file, once."""
        self.damaged.setdefault(self.relative(path), one_line(reason) if isinstance(reason, Exception) else reason)

    def read(self, path: Path, read: Callable[[Path], Value]) -> Value | None:
        """The content of a file, read by a function; None, and remembered, for a damaged one."""
        try:
            return read(path)
        except UNREADABLE as error:
            self.lost(path, error)
            return None

    def runs_of(self, scenario: str, method: str) -> list[RunRecord]:
        """All seeds of a method on a scenario."""
        return [run for run in self.runs if run.scenario == scenario and run.method == method]

    def first_runs(self, scenario: str) -> dict[str, RunRecord]:
        """Shown method to its first run of a scenario, finished ones before failed ones."""
        runs = {method: self.runs_of(scenario, method) for method in self.choice.shown}
        return {method: min(own, key=lambda run: not run.ok) for method, own in runs.items() if own}


def traces(results: Path) -> tuple[list[str], list[str], list[int]]:
    """Scenarios, methods and seeds that have left a record of a stage."""
    paths = [path for name in METHOD_RECORDS for path in results.glob(f"*/*/*/{name}")]
    paths += results.glob("*/search-*/*/search.json")
    found = [path.relative_to(results).parts[:3] for path in paths]
    found = [parts for parts in found if len(parts) == 3 and parts[2].isdigit()]
    methods = {method for _, method, _ in found if not method.startswith("search-")}
    return sorted({scenario for scenario, _, _ in found}), sorted(methods), sorted({int(seed) for _, _, seed in found})


def damaged_files(results: Path, collected: Collected, transfers: Collected, messages: Sequence[str]) -> dict[str, str]:
    """Records of runs, transfers and jobs that cannot be read, relative to the results folder, and why."""
    # The messages on job records begin with the file.
    parts = (message.partition(": ") for message in messages)
    damaged = {Path(path).relative_to(results).as_posix(): reason for path, _, reason in parts}
    for runs, name in ((collected.runs, RUN_RECORD), (transfers.runs, "transfer.json")):
        rows: list[Any] = [row for row in runs.itertuples() if str(row.reason).startswith(DAMAGED)]
        damaged |= {f"{row.scenario}/{row.method}/{row.seed}/{name}": row.reason.removeprefix(DAMAGED) for row in rows}
    return damaged


def job_records(results: Path) -> tuple[list[JobRecord], list[str]]:
    """The job records that can be read, by name, and a message on each other one."""
    messages: list[str] = []
    return read_jobs(results, messages), messages


def several(count: int, noun: str) -> str:
    """`1 run`, `2 runs`."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def hours(seconds: float) -> str:
    """Hours, with fewer decimals for larger values."""
    value = seconds / 3600
    digits = 0 if value >= 100 or not value else 1 if value >= 1 else 2
    return "< 0.01" if 0 < value < 0.01 else f"{value:.{digits}f}"


def memory(mebibytes: float | None) -> str:
    """Mebibytes; gibibytes from 1024 MiB."""
    if mebibytes is None or not math.isfinite(mebibytes):
        return DASH
    return f"{mebibytes / 1024:.1f} GiB" if mebibytes >= 1024 else f"{mebibytes:.0f} MiB"


def link(path: Path, folder: Path) -> str:
    """A relative link from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def rendered(text: str) -> Markup:
    """Markdown as HTML with smaller headings, without links and pictures."""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table").disable(["image", "link"])

    def opened(*_: Any) -> str:
        return '<div class="scroll" tabindex="0" role="region" aria-label="Table"><table>'

    parser.add_render_rule("table_open", opened)
    parser.add_render_rule("table_close", lambda *_: "</table></div>")
    tokens = parser.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = "h3" if token.tag in ("h1", "h2") else "h4"
    return Markup(parser.renderer.render(tokens, parser.options, {}))


def prose(material: ReportData, path: Path) -> Prose | None:
    """A Markdown file; None if it is not there or cannot be read."""
    return material.read(path, lambda path: Prose(html=rendered(path.read_text(encoding="utf-8")))) if path.is_file() else None


@dataclass(frozen=True, kw_only=True)
class ReportSection:
    """A section of the report: the member of a registry that a module of `sections`, or of a package, declares."""

    order: int
    """Its place on the page, by tens."""
    make: Callable[[ReportData], PageSection | None]
    """None where there is nothing to show."""
    phase: Literal[0, 1, 2] = 0
    """1: it takes the `room` that all others leave; 2: it lists the damaged files that all others found."""


def embedded(data: bytes, caption: str) -> Picture:
    """A PNG, drawn for white paper, as a wide picture of the page."""
    size = Image.open(io.BytesIO(data)).size
    return Picture(caption=caption, alt=caption, data=data_uri("image/png", data), size=size, wide=True, paper=True)


def data_uri(kind: str, data: bytes) -> str:
    """Bytes as the source of a picture or film."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
