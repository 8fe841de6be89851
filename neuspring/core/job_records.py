"""Records of the workflow's jobs: results/jobs/<rule>/<name>/<digest>.json of a finished job, failed.json of one that failed.

The digest is that of everything the result follows from, so the name of the file tells Snakemake whether a job is finished. A
job's log and Snakemake's benchmark lie beside it.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, read_json

FOLDER = "jobs"
ASKED = "asked.json"
FAILED = "failed.json"


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """The end of a job, or of one member of a batch."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)
    rule: str
    name: str
    """<rule>/<wildcards joined by />."""
    outcome: Literal["ok", "failed"] = "ok"
    message: str = ""
    """The error, in a line; empty for a job that succeeded."""
    log: str = ""
    """Relative to the results folder."""
    started: str = ""
    """UTC, ISO 8601."""
    seconds: float = 0.0
    host: str = ""
    devices: list[str] = field(default_factory=list)
    """GPUs, as in CUDA_VISIBLE_DEVICES; empty on the CPU."""
    device_names: list[str] = field(default_factory=list)
    peak_memory_mb: float = 0.0
    files: list[str] = field(default_factory=list)
    """Results, relative to the results folder. The record is void without them."""
    made_of: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Step -> settings, options, code and inputs that the digest is of."""

    @property
    def scenario(self) -> str:
        """The first wildcard."""
        return self.name.split("/")[1]

    @property
    def failed(self) -> bool:
        """True where it ended without success."""
        return self.outcome == "failed"

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        write_text(path, json.dumps({"format": RECORD_FORMAT, **asdict(self)}, allow_nan=False, sort_keys=True) + "\n")

    @classmethod
    def load(cls, path: Path) -> JobRecord:
        """Read a record. Raises InputError if it is missing or damaged."""
        try:
            return _adapter().validate_json(json.dumps(read_json(path, RECORD_FORMAT)), strict=True)
        except ValidationError as error:
            raise InputError(path, "must be a job record", error.errors()[0]["msg"], "Delete it.") from error


@functools.cache
def _adapter() -> TypeAdapter[JobRecord]:
    return TypeAdapter(JobRecord)


def read_jobs(results: Path, damaged: list[str] | None = None) -> list[JobRecord]:
    """The records of all jobs of a results folder, by name.

    Errors of damaged records are added to `damaged`. Without that list, a damaged record raises InputError.
    """
    records = []
    for path in sorted((Path(results) / FOLDER).glob("*/**/*.json")):
        try:
            records.append(JobRecord.load(path))
        except InputError as error:
            if damaged is None:
                raise
            damaged.append(str(error))
    return records


def keep_asked(results: Path, about: Mapping[str, Any]) -> None:
    """Keep what a run of the workflow is about."""
    write_text(Path(results) / FOLDER / ASKED, json.dumps(dict(about)) + "\n")


def asked(results: Path) -> dict[str, Any]:
    """The last run of the workflow: `command` (words), `only`, `scenarios`, `methods`, `seeds`; empty if unknown."""
    try:
        values = json.loads((Path(results) / FOLDER / ASKED).read_text())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}
