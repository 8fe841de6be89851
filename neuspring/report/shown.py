"""The content of a results folder to look at: its scenario, its runs, and what is missing of each.

Files are not trusted: sizes of arrays are checked before they are read, and names must stay inside the scenario's folder.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from neuspring.core.artifacts import Artifact, Observations, SplatCenters, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.core.files import META, DamagedFile, read_head
from neuspring.core.records import CAPTURE_FOLDER, StageRecord, digest_file
from neuspring.core.run_folder import RunFolder
from neuspring.core.run_record import RUN_RECORD
from neuspring.data.capture import CAPTURE, Capture
from neuspring.splats.draw import prune_by_opacity
from neuspring.splats.model import Splats

Kind = TypeVar("Kind", bound=Artifact)
OBSERVATIONS, ROLLOUT = "observations.npz", "rollout.json"
SEED = re.compile(r"\d{1,9}")
SHOWN_FIRST = ("neuspring", "baseline")
"""Methods that are shown first."""
MOST_RUNS = 200
"""Runs that are looked at in a scenario's folder."""
MOST_BYTES = 2 * 1024**3
"""Largest file, unpacked, that is opened."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run: a method with a seed. Its arrays are read when they are asked for."""

    folder: Path
    notes: tuple[str, ...] = ()
    """Faults and gaps that a viewer must know."""
    paths: Mapping[str, Path] = field(default_factory=dict)
    """Files that it has: twin, trajectory, splats, and centers, where the method's own model puts its splats."""

    @property
    def method(self) -> str:
        """Its row of the method table."""
        return self.folder.parent.name

    @property
    def seed(self) -> str:
        """Its seed."""
        return self.folder.name

    @property
    def name(self) -> str:
        """method/seed."""
        return f"{self.method}/{self.seed}"

    @cached_property
    def twin(self) -> Twin | None:
        """The twin, where the method has one. Raises InputError."""
        return self._read("twin", Twin)

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The prediction, where there is one. Raises InputError."""
        return self._read("trajectory", Trajectory)

    @cached_property
    def splats(self) -> Splats | None:
        """The splats that pictures of this run show, in frame 0, if it has any. Raises InputError."""
        splats = self._read("splats", Splats)
        # As pictures (stages/render.py): where a method's own model moves them, all of them are drawn.
        return splats if splats is None or "centers" in self.paths else prune_by_opacity(splats)

    @cached_property
    def centers(self) -> SplatCenters | None:
        """The centers at which the method's own model puts its splats, if it does. Raises InputError."""
        return self._read("centers", SplatCenters)

    def _read(self, role: str, kind: type[Kind]) -> Kind | None:
        if (path := self.paths.get(role)) is None:
            return None
        if kind is not Splats:
            require_modest(path)
        return kind.load(path)


@dataclass(frozen=True, eq=False)
class Found:
    """A scenario's folder: what was observed, and runs."""

    folder: Path
    observations: Observations
    runs: tuple[Run, ...]
    shown: tuple[str, ...]
    """Names of the runs to begin with."""
    capture: Capture | None = None
    notes: tuple[str, ...] = ()


def find(paths: Sequence[Path]) -> Found:
    """The scenario and the runs of folders: one scenario's folder, or one or several runs of one scenario. Raises InputError."""
    named, scenarios = list[Path](), list[Path]()
    for path in map(Path, paths):
        place = path.resolve()
        if _is_run(place) and (place.parents[1] / OBSERVATIONS).is_file():
            named.append(place)
        elif not (place / OBSERVATIONS).is_file():
            rule = f"must be a scenario's folder, which has {OBSERVATIONS}, or a run <scenario>/<method>/<seed>"
            raise InputError(path, rule, _content(place), "Give results/<scenario>, or a run in it.")
        scenarios.append(place.parents[1] if place in named else place)
    if len(set(scenarios)) != 1:
        raise InputError(", ".join(map(str, paths)), "all runs must be of one scenario", len(set(scenarios)))
    folder = scenarios[0]
    require_modest(folder / OBSERVATIONS)
    observations = Observations.load(folder / OBSERVATIONS)
    whole = len(named) < len(paths)
    below = (place for place in folder.glob("*/*") if place.is_dir() and not place.is_symlink() and _is_run(place))
    places = sorted({*named, *(below if whole else ())}, key=_rank)
    runs = tuple(_run(place, folder) for place in places[:MOST_RUNS])
    notes = [] if len(places) <= MOST_RUNS else [f"{len(places) - MOST_RUNS} runs are left out"]
    if not runs:
        raise InputError(folder, "must have at least one run <method>/<seed>", _content(folder), "Run the benchmark first.")
    shown = tuple(run.name for run in runs if run.folder in named) or _first(runs)
    return Found(folder, observations, runs, shown, capture_of(folder, observations, notes), tuple(notes))


def _is_run(path: Path) -> bool:
    return bool(SEED.fullmatch(path.name)) and any((path / name).is_file() for name in (RUN_RECORD, ROLLOUT))


def _rank(path: Path) -> tuple[int, str, int]:
    method = path.parent.name
    return (SHOWN_FIRST.index(method) if method in SHOWN_FIRST else len(SHOWN_FIRST), method, int(path.name))


def _first(runs: Sequence[Run]) -> tuple[str, ...]:
    """The first run, and the first one of another method."""
    usable = [run for run in runs if "trajectory" in run.paths] or list(runs)
    other = next((run for run in usable if run.method != usable[0].method and "twin" in run.paths), None)
    return tuple(run.name for run in (usable[0], other) if run is not None)


def _run(folder: Path, scenario_folder: Path) -> Run:
    """A run with what can be used of it; a record that cannot be read is a note."""
    notes: list[str] = []
    run = RunFolder.of(folder, notes)
    model = "fit" if "fit" in run.stages else "search"
    places = {"twin": model, "trajectory": "rollout", "centers": "rollout", "splats": "appearance"}
    paths = {}
    for role, stage in places.items():
        try:
            if (found := run.file(stage, role)) is None:
                continue
            if not found.resolve().is_relative_to(scenario_folder):
                remedy = "A record of a results folder names files of its scenario."
                raise InputError(found, f"must lie inside {scenario_folder}", str(found.resolve()), remedy)
            paths[role] = found.resolve()
        except (InputError, TypeError, ValueError, IndexError) as error:
            notes.append(f"no {'prediction' if role == 'trajectory' else role}: {error}")
    if "rollout" in run.stages and run.records["rollout"].status == "failed":
        notes.append(f"failed: {run.records['rollout'].reason}")
    if "trajectory" not in paths and not notes:
        notes.append("no prediction in its record")
    return Run(folder, tuple(notes), paths)


def capture_of(folder: Path, observations: Observations, notes: list[str]) -> Capture | None:
    """The capture in a scenario's folder, or the user's own that its record names; why one cannot be used goes to `notes`."""
    path = folder / "capture" / CAPTURE
    try:
        if not path.is_file():
            record = (folder / OBSERVATIONS).with_suffix(".json")
            own = StageRecord.load(record).facts.get(CAPTURE_FOLDER) if record.is_file() else None
            if own is None:
                return None
            # Named by a record, and so only believed if it is the one that was observed.
            path = Path(str(own)) / CAPTURE
            if observations.scenario.provenance.get(CAPTURE) != f"sha256:{digest_file(path)}":
                raise InputError(path, "must be the capture of this run", "one that was changed since", "Run the benchmark again.")
        return Capture.load(path.parent)
    except (InputError, OSError) as error:
        notes.append(f"no cameras: {error}")
        return None


def _content(folder: Path) -> str:
    if not folder.is_dir():
        return "no such folder"
    return ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "an empty folder"


def require_modest(path: Path) -> None:
    """Raise InputError for an `.npz` file whose arrays would not fit `MOST_BYTES`, or whose headers promise more than it holds."""
    if not path.is_file():
        raise InputError(path, "this file must exist", "no such file", "Run the step that makes it first.")
    try:
        shapes, _ = read_head(path)
        with zipfile.ZipFile(path) as archive:
            sizes = {member.filename.removesuffix(".npy"): member.file_size for member in archive.infolist()}
    except (DamagedFile, zipfile.BadZipFile, OSError) as error:
        raise InputError(path, "this file must be readable", str(error), "Delete it and run its step again.") from error
    if sum(sizes.values()) > MOST_BYTES:
        rule = f"at most {MOST_BYTES / 1e9:.1f} GB are opened"
        raise InputError(path, rule, f"{sum(sizes.values()) / 1e9:.1f} GB", "Show a smaller run.")
    for name, shape in shapes.items():
        if name != META and math.prod(shape) > sizes[name]:
            rule = f"the header of {name} must agree with its content of {sizes[name]} bytes"
            raise InputError(path, rule, f"shape {shape}", "Delete it and run its step again.")
