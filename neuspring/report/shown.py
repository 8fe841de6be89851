"""The runs of a scenario in a results folder, for viewers, exports and figures, with a note on everything that is missing.

The files are not trusted: array sizes are checked before arrays are read, and paths must stay inside the scenario's folder.
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
"""Methods that are listed first."""
MOST_RUNS = 200
"""Maximum number of runs that are read from a scenario's folder."""
MOST_BYTES = 2 * 1024**3
"""Maximum unpacked size of a file, bytes."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run: a method with a seed. Each file is read when its property is first used."""

    folder: Path
    notes: tuple[str, ...] = ()
    """Faults and missing files, for display."""
    paths: Mapping[str, Path] = field(default_factory=dict)
    """Role -> existing file. Roles: twin, trajectory, splats, centers (of splats that the method's own model moves)."""

    @property
    def method(self) -> str:
        """Name in the method table."""
        return self.folder.parent.name

    @property
    def seed(self) -> str:
        """The seed, as text."""
        return self.folder.name

    @property
    def name(self) -> str:
        """method/seed."""
        return f"{self.method}/{self.seed}"

    @cached_property
    def twin(self) -> Twin | None:
        """The twin, or None. Raises InputError if the file is damaged or too large."""
        return self._read("twin", Twin)

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The prediction, or None. Raises InputError if the file is damaged or too large."""
        return self._read("trajectory", Trajectory)

    @cached_property
    def splats(self) -> Splats | None:
        """The rendered splats in frame 0, or None. Raises InputError if the file is damaged."""
        splats = self._read("splats", Splats)
        # The same splats as in stages/render.py, which keeps all splats that the method's own model moves.
        return splats if splats is None or "centers" in self.paths else prune_by_opacity(splats)

    @cached_property
    def centers(self) -> SplatCenters | None:
        """Splat centers from the method's own model, or None. Raises InputError if the file is damaged or too large."""
        return self._read("centers", SplatCenters)

    def _read(self, role: str, kind: type[Kind]) -> Kind | None:
        if (path := self.paths.get(role)) is None:
            return None
        if kind is not Splats:
            require_modest(path)
        return kind.load(path)


@dataclass(frozen=True, eq=False)
class Found:
    """A scenario's folder: observations, runs and capture."""

    folder: Path
    observations: Observations
    runs: tuple[Run, ...]
    shown: tuple[str, ...]
    """Names of the initially displayed runs."""
    capture: Capture | None = None
    notes: tuple[str, ...] = ()


def find(paths: Sequence[Path]) -> Found:
    """Find the scenario and the runs of `paths`: the folder of one scenario, or runs of one scenario.

    Raises InputError if a path is neither, if the paths belong to several scenarios, or if there is no run.
    """
    named, scenarios = list[Path](), list[Path]()
    for path in map(Path, paths):
        folder = path.resolve()
        if _is_run(folder) and (folder.parents[1] / OBSERVATIONS).is_file():
            named.append(folder)
        elif not (folder / OBSERVATIONS).is_file():
            rule = f"must be a scenario's folder with {OBSERVATIONS}, or a run <scenario>/<method>/<seed>"
            raise InputError(path, rule, _content(folder), "Give results/<scenario>, or a run in it.")
        scenarios.append(folder.parents[1] if folder in named else folder)
    if len(set(scenarios)) != 1:
        rule = "all runs must belong to one scenario"
        raise InputError(", ".join(map(str, paths)), rule, f"{len(set(scenarios))} scenarios")
    folder = scenarios[0]
    require_modest(folder / OBSERVATIONS)
    observations = Observations.load(folder / OBSERVATIONS)
    has_scenario = len(named) < len(paths)
    inside = (path for path in folder.glob("*/*") if path.is_dir() and not path.is_symlink() and _is_run(path))
    run_folders = sorted({*named, *(inside if has_scenario else ())}, key=_rank)
    runs = tuple(_run(path, folder) for path in run_folders[:MOST_RUNS])
    notes = [] if len(run_folders) <= MOST_RUNS else [f"{len(run_folders) - MOST_RUNS} runs are not shown"]
    if not runs:
        raise InputError(folder, "must contain at least one run <method>/<seed>", _content(folder), "Run the workflow first.")
    shown = tuple(run.name for run in runs if run.folder in named) or _first(runs)
    return Found(folder, observations, runs, shown, capture_of(folder, observations, notes), tuple(notes))


def _is_run(path: Path) -> bool:
    return bool(SEED.fullmatch(path.name)) and any((path / name).is_file() for name in (RUN_RECORD, ROLLOUT))


def _rank(path: Path) -> tuple[int, str, int]:
    method = path.parent.name
    return (SHOWN_FIRST.index(method) if method in SHOWN_FIRST else len(SHOWN_FIRST), method, int(path.name))


def _first(runs: Sequence[Run]) -> tuple[str, ...]:
    """Names of the first run and of the first run of another method with a twin."""
    usable = [run for run in runs if "trajectory" in run.paths] or list(runs)
    other = next((run for run in usable if run.method != usable[0].method and "twin" in run.paths), None)
    return tuple(run.name for run in (usable[0], other) if run is not None)


def _run(folder: Path, scenario_folder: Path) -> Run:
    """A run with its usable files; unusable files and records become notes."""
    notes: list[str] = []
    run = RunFolder.of(folder, notes)
    model = "fit" if "fit" in run.stages else "search"
    stages = {"twin": model, "trajectory": "rollout", "centers": "rollout", "splats": "appearance"}
    paths = {}
    for role, stage in stages.items():
        try:
            if (path := run.file(stage, role)) is None:
                continue
            if not path.resolve().is_relative_to(scenario_folder):
                raise InputError(path, f"must be inside {scenario_folder}", str(path.resolve()), "Copy the file there.")
            paths[role] = path.resolve()
        except (InputError, TypeError, ValueError, IndexError) as error:
            notes.append(f"no {'prediction' if role == 'trajectory' else role}: {error}")
    if "rollout" in run.stages and run.records["rollout"].status == "failed":
        notes.append(f"failed: {run.records['rollout'].reason}")
    if "trajectory" not in paths and not notes:
        notes.append("its record names no prediction")
    return Run(folder, tuple(notes), paths)


def capture_of(folder: Path, observations: Observations, notes: list[str]) -> Capture | None:
    """The capture in a scenario's folder, or else the user's capture that the record names.

    Returns None without a usable capture; the reason is appended to `notes`.
    """
    path = folder / "capture" / CAPTURE
    try:
        if not path.is_file():
            record = (folder / OBSERVATIONS).with_suffix(".json")
            named = StageRecord.load(record).facts.get(CAPTURE_FOLDER) if record.is_file() else None
            if named is None:
                return None
            # A record is not trusted: the digest proves that the named capture is the observed one.
            path = Path(str(named)) / CAPTURE
            if observations.scenario.provenance.get(CAPTURE) != f"sha256:{digest_file(path)}":
                raise InputError(path, "must be the capture of this run", "a changed capture", "Run the workflow again.")
        return Capture.load(path.parent)
    except (InputError, OSError) as error:
        notes.append(f"no cameras: {error}")
        return None


def _content(folder: Path) -> str:
    if not folder.is_dir():
        return "no such folder"
    return ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "an empty folder"


def require_modest(path: Path) -> None:
    """Raise InputError if an `.npz` file has more than `MOST_BYTES` of arrays, or less data than its headers declare."""
    if not path.is_file():
        raise InputError(path, "this file must exist", None, "Run the stage that writes it.")
    try:
        shapes, _ = read_head(path)
        with zipfile.ZipFile(path) as archive:
            sizes = {member.filename.removesuffix(".npy"): member.file_size for member in archive.infolist()}
    except (DamagedFile, zipfile.BadZipFile, OSError) as error:
        raise InputError(path, "this file must be readable", str(error), "Delete it and rerun its stage.") from error
    if sum(sizes.values()) > MOST_BYTES:
        rule = f"the unpacked size must be at most {MOST_BYTES / 1e9:.1f} GB"
        raise InputError(path, rule, f"{sum(sizes.values()) / 1e9:.1f} GB", "Choose a smaller run.")
    for name, shape in shapes.items():
        if name != META and math.prod(shape) > sizes[name]:
            rule = f"the header of {name} must match its size of {sizes[name]} bytes"
            raise InputError(path, rule, f"shape {shape}", "Delete the file and rerun its stage.")
