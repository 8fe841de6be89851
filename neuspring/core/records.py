"""Stage and run records: small JSON files that say what a step did, beside the artifacts they name.

A stage record is the declared output of a workflow rule. It is written last, so its presence means that the files it names
are complete. A numerical failure is a record too (`status: failed` with its reason); later stages pass it on.
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
OTHER_FORMAT_REMEDY = "The commit that made older results reads them. Delete this folder, or use another: --config results=..."
MOST_RECORD_BYTES = 50_000_000
"""Bytes of a record, at most: it is read whole."""
COMPUTING = ("numpy", "scipy", "torch", "warp-lang")
"""Packages on whose versions results depend."""
CAPTURE_FOLDER = "capture_folder"
"""The fact of a scenario's observations.json that says where its capture lies."""
Status = Literal["ok", "failed"]


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def canonical(values: Any) -> str:
    """JSON text that is equal for equal values: sorted keys, no spaces, no NaN."""
    return json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)


def now() -> str:
    """UTC time, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """Record of one run of a stage. `files` maps a role (for example "twin") to [file name beside the record, SHA-256]."""

    stage: str
    status: Status
    reason: str = ""
    files: dict[str, list[str]] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    """Role -> SHA-256 of what was read."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Numbers and text worth keeping: parameters found, counts, versions."""
    settings: dict[str, Any] = field(default_factory=dict)
    started: str = ""
    seconds: float = 0.0
    """Wall time, with the attempts that it continued."""
    peak_memory_mb: float = 0.0
    attempts: int = 1
    """1, plus one for every time the stage continued from a checkpoint."""
    device: str = "cpu"
    machine: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of the packages that compute."""
    code: str = ""
    """Digest of the code that made it (`neuspring.core.provenance`); empty in records of older versions."""

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
            raise InputError(path, "must be a stage record", str(error), "Delete it and run again.") from error

    def file(self, role: str, record_path: Path) -> Path:
        """The file of a role, checked against its digest. Raises InputError if it is missing or has changed."""
        if role not in self.files:
            raise InputError(record_path, f"this record must name a {role}", sorted(self.files))
        name, digest = self.files[role]
        if Path(name).name != name:
            raise InputError(record_path, "files must lie beside their record", name, "Do not use this folder.")
        path = Path(record_path).parent / name
        if not path.is_file():
            raise InputError(path, f"named by {record_path}", "no such file", f"Delete {record_path} and run again.")
        if digest_file(path) != digest:
            raise InputError(
                path, f"must be the file that {record_path} names", "other content", f"Delete {record_path} and run again."
            )
        return path


@dataclass(frozen=True)
class Before:
    """An earlier stage, by its record."""

    path: Path
    record: StageRecord

    @classmethod
    def load(cls, path: Path) -> Before:
        """Raises InputError for a record that is missing or damaged."""
        return cls(Path(path), StageRecord.load(path))

    def has(self, role: str) -> bool:
        """True where the stage wrote a file of this role."""
        return role in self.record.files

    def file(self, role: str) -> Path:
        """The file of a role. Raises InputError if it is missing or has changed since."""
        return self.record.file(role, self.path)


def read_json(path: Path, version: int) -> dict[str, Any]:
    """A JSON record of the given format version, without its `format` key. Raises InputError."""
    try:
        if (size := Path(path).stat().st_size) > MOST_RECORD_BYTES:
            raise InputError(path, f"a record has at most {MOST_RECORD_BYTES} bytes", size, "Delete it and run again.")
        values = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, "this record must be readable", error.strerror, "Run the step that makes it first.") from error
    except ValueError as error:
        raise InputError(path, "this record must be JSON", str(error), "Delete it and run again.") from error
    if not isinstance(values, dict) or values.pop("format", None) != version:
        raise InputError(path, f"this version reads records of format {version}", "another format", OTHER_FORMAT_REMEDY)
    return values


class Recorder:
    """Measures a stage and writes its record.

    Make it when the stage begins; `inputs` are digested at once, so that the record names what was read. Raises InputError for an
    input that cannot be read.
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
                rule, remedy = "this file must be readable", "Run the step that makes it first."
                raise InputError(path, rule, error.strerror, remedy) from error
        self.settings: dict[str, Any] = dict(settings or {})
        self.device = device
        self.sharers = 1
        """Stages that run in one batch; each is charged an equal part of the time."""
        self._started, self._start = now(), time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self._start

    def agrees(self) -> bool:
        """True where the record and its files are there already, made of the same inputs, settings and code."""
        try:
            there = StageRecord.load(self.output)
        except InputError:
            return False
        settings = json.loads(json.dumps(self.settings))
        # A stage may add what it found, such as `oracle`.
        same = all(name in there.settings and there.settings[name] == value for name, value in settings.items())
        made = (there.stage, there.inputs, there.code) == (self.stage, self.inputs, self.code)
        return same and made and all(self.output.with_name(name).is_file() for name, _ in there.files.values())

    def beside(self, **names: str) -> dict[str, Path]:
        """Role -> path of a file beside the record."""
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
        """Write the record, with time, peak memory, machine and the digests of `files`; `failure` says why the stage failed."""
        # Linux counts in KiB, macOS in bytes.
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
