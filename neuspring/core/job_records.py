"""Records of the workflow's jobs: results/jobs/<rule>/<name>/<digest>.json for a finished job, failed.json for a failed one.

The digest covers everything that the result depends on, so Snakemake recognizes finished jobs by file name. The job's log and
Snakemake's benchmark are in the same folder.
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
    """The outcome of a job, or of one member of a batch."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)
    rule: str
    name: str
    """<rule>/<wildcards joined by />."""
    outcome: Literal["ok", "failed"] = "ok"
    message: str = ""
    """The error in one line; empty for a successful job."""
    log: str = ""
    """Path relative to the results folder."""
    started: str = ""
    """UTC, ISO 8601."""
    seconds: float = 0.0
    host: str = ""
    devices: list[str] = field(default_factory=list)
    """GPUs, as in CUDA_VISIBLE_DEVICES; empty for a CPU job."""
    device_names: list[str] = field(default_factory=list)
    peak_memory_mb: float = 0.0
    files: list[str] = field(default_factory=list)
    """Paths of results relative to the results folder. Without these files the job counts as unfinished."""
    made_of: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Step -> settings, options, code and inputs, from which the digest is computed."""

    @property
    def scenario(self) -> str:
        """The scenario: the first wildcard of the name."""
        return self.name.split("/")[1]

    @property
    def failed(self) -> bool:
        """True if the job did not succeed."""
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
    """The records of all jobs of a results folder, sorted by path.

    Errors of damaged records are appended to `damaged`. Without that list, a damaged record raises InputError.
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
    """Write what the current run of the workflow was asked to do (`asked`)."""
    write_text(Path(results) / FOLDER / ASKED, json.dumps(dict(about)) + "\n")


def asked(results: Path) -> dict[str, Any]:
    """The last run of the workflow: `command` (words), `only`, `jobs`, `scenarios`, `methods`, `seeds`; empty if unknown."""
    try:
        values = json.loads((Path(results) / FOLDER / ASKED).read_text())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}
