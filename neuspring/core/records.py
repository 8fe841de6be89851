"""Stage records: small JSON files that describe what a step did, in the same folder as the artifacts that they name.

A stage writes its record last, so an existing record means that its files are complete. A numerical failure is also a record
(`status: failed` with a reason), and later stages pass it on.
"""

from __future__ import annotations

import hashlib
import json
import platform
import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from neuspring.core.errors import InputError
from neuspring.core.files import write_text

RECORD_FORMAT = 2
OTHER_FORMAT_REMEDY = "Read it with the commit that wrote it. Delete this folder or use another: --config results=..."
MOST_RECORD_BYTES = 50_000_000
"""Maximum size of a record, bytes: it is read into memory."""
COMPUTING = ("numpy", "scipy", "torch", "warp-lang")
"""Packages on whose versions results depend."""
CAPTURE_FOLDER = "capture_folder"
"""The fact of a scenario's observations.json with the folder of its capture."""
Status = Literal["ok", "failed"]


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def canonical(values: Any) -> str:
    """Canonical JSON text, which is equal for equal values: sorted keys, no spaces, no NaN."""
    return json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)


def now() -> str:
    """UTC time, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """Record of one execution of a stage. `files`: role (for example "twin") -> [name of a file in the same folder, SHA-256]."""

    stage: str
    status: Status
    reason: str = ""
    files: dict[str, list[str]] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    """Role -> SHA-256 of the input file."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Results as numbers and text: found parameters, counts."""
    settings: dict[str, Any] = field(default_factory=dict)
    started: str = ""
    seconds: float = 0.0
    """Wall time, including attempts from whose checkpoints the stage resumed."""
    peak_memory_mb: float = 0.0
    attempts: int = 1
    """1, plus the number of times that the stage resumed from a checkpoint."""
    device: str = "cpu"
    machine: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of the packages in `COMPUTING`."""
    code: str = ""
    """Digest of the stage's code (`neuspring.core.provenance`); empty in records of older versions."""

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        values = {"format": RECORD_FORMAT, **self.__dict__}
        write_text(Path(path), json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: Path) -> StageRecord:
        """Read a record. Raises InputError if it is missing or damaged."""
        values = read_json(path, RECORD_FORMAT)
        try:
            return cls(**values)
        except TypeError as error:
            raise InputError(path, "must be a stage record", str(error), "Delete it and rerun the command.") from error

    def file(self, role: str, record_path: Path) -> Path:
        """The file of a role, verified by its digest. Raises InputError if it is missing or has changed."""
        if role not in self.files:
            raise InputError(record_path, f"this record must name a {role}", sorted(self.files))
        name, digest = self.files[role]
        if Path(name).name != name:
            raise InputError(record_path, "files must be in the folder of their record", name, "Do not use this folder.")
        path = Path(record_path).parent / name
        if not path.is_file():
            raise InputError(
                path, f"this file of {record_path} must exist", "no such file", f"Delete {record_path} and rerun the command."
            )
        if digest_file(path) != digest:
            raise InputError(
                path, f"must be the file that {record_path} names", "other content", f"Delete {record_path} and rerun the command."
            )
        return path


@dataclass(frozen=True)
class Before:
    """An earlier stage: its record and where it is."""

    path: Path
    record: StageRecord

    @classmethod
    def load(cls, path: Path) -> Before:
        """Read a record. Raises InputError if it is missing or damaged."""
        return cls(Path(path), StageRecord.load(path))

    def has(self, role: str) -> bool:
        """True if the stage wrote a file of this role."""
        return role in self.record.files

    def file(self, role: str) -> Path:
        """The file of a role, verified by its digest. Raises InputError if it is missing or has changed."""
        return self.record.file(role, self.path)


def read_json(path: Path, version: int) -> dict[str, Any]:
    """A JSON record of the given format version, without its `format` key. Raises InputError."""
    try:
        if (size := Path(path).stat().st_size) > MOST_RECORD_BYTES:
            raise InputError(path, f"must have at most {MOST_RECORD_BYTES} bytes", size, "Delete it and rerun the command.")
        values = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, "this record must be readable", error.strerror, "Run the step that writes it first.") from error
    except ValueError as error:
        raise InputError(path, "this record must be JSON", str(error), "Delete it and rerun the command.") from error
    if not isinstance(values, dict) or values.pop("format", None) != version:
        raise InputError(path, f"this version reads records of format {version}", "another format", OTHER_FORMAT_REMEDY)
    return values


class Recorder:
    """Measures a stage and writes its record.

    Create it when the stage starts: it digests `inputs` at once, so the record names the content that was read. Raises InputError
    for unreadable inputs.
    """

    def __init__(
        self,
        stage: str,
        output: Path,
        *,
        inputs: Mapping[str, Path] | None = None,
        settings: Any = None,
        device: str = "cpu",
        code: str = "",
    ) -> None:
        self.stage, self.output, self.code = stage, output, code
        self.input_paths = dict(inputs or {})
        self.inputs: dict[str, str] = {}
        for role, path in self.input_paths.items():
            try:
                self.inputs[role] = digest_file(path)
            except OSError as error:
                rule, remedy = "this file must be readable", "Run the step that writes it first."
                raise InputError(path, rule, error.strerror, remedy) from error
        self.settings: dict[str, Any] = dict(settings or {})
        self.device = device
        self.sharers = 1
        """Number of stages in the same batch; the wall time is divided by it."""
        self._started, self._start = now(), time.perf_counter()

    @property
    def seconds(self) -> float:
        """Elapsed time, s."""
        return time.perf_counter() - self._start

    def agrees(self) -> bool:
        """True if the record and its files exist and were made from the same inputs, settings and code."""
        try:
            existing = StageRecord.load(self.output)
        except InputError:
            return False
        settings = json.loads(json.dumps(self.settings))
        # A stage may add settings while it runs, such as `oracle`.
        same = all(name in existing.settings and existing.settings[name] == value for name, value in settings.items())
        made = (existing.stage, existing.inputs, existing.code) == (self.stage, self.inputs, self.code)
        return same and made and all(self.output.with_name(name).is_file() for name, _ in existing.files.values())

    def beside(self, **names: str) -> dict[str, Path]:
        """Role -> path of a file in the record's folder."""
        return {role: self.output.with_name(name) for role, name in names.items()}

    def save(
        self,
        files: Mapping[str, Path] | None = None,
        facts: Mapping[str, Any] | None = None,
        *,
        failure: str = "",
        attempts: int = 1,
        earlier_seconds: float = 0.0,
    ) -> None:
        """Write the record with time, peak memory, machine and digests of `files`; `failure` is the reason of a failed stage."""
        # ru_maxrss is in KiB on Linux and in bytes on macOS.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 1024**2)
        StageRecord(
            stage=self.stage,
            status="failed" if failure else "ok",
            reason=failure,
            files={role: [path.name, digest_file(path)] for role, path in (files or {}).items()},
            inputs=self.inputs,
            facts=dict(facts or {}),
            settings=self.settings,
            started=self._started,
            seconds=round(earlier_seconds + self.seconds / self.sharers, 3),
            peak_memory_mb=round(peak, 1),
            attempts=attempts,
            device=self.device,
            machine=f"{platform.machine()}, Python {platform.python_version()}",
            versions={name: version(name) for name in COMPUTING},
            code=self.code,
        ).save(self.output)
