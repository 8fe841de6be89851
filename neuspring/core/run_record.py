"""The record of a run, results/{scenario}/{method}/{seed}/run.json, which tables, report, MLflow and `explain` read.

It is written last. It contains paths of the run's files, relative to its own folder, and their provenance.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, canonical, read_json

RUN_RECORD = "run.json"
CONTENT = ("scenario", "method", "variant", "seed", "status", "reason", "notes", "settings", "data_digest")
"""Fields from which the key of a run is computed, together with the digests of its results."""
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,79}$")]


def _with_zone(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("a time with a time zone is required")
    return text


Moment = Annotated[str, AfterValidator(_with_zone)]
"""ISO 8601 with a time zone."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """One method on one scenario with one seed, from observations to scores.

    Fields with a default may be absent in records of older versions. Unknown fields are ignored.
    """

    __pydantic_config__ = ConfigDict(extra="ignore", strict=True)
    run_key: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8,64}$")]
    """SHA-256 of `CONTENT` and of the digests of the results. Repeated runs with equal results have equal keys."""
    scenario: Name
    source: str
    category: str
    method: Name
    variant: dict[str, str | bool | int | float | None]
    """The method's switches, under dotted names."""
    seed: int
    status: Literal["ok", "failed"]
    reason: str
    """Why the run failed; empty otherwise."""
    notes: list[str] = field(default_factory=list)
    """Notes that a reader of the scores needs although the run did not fail."""
    images: dict[str, Any] | None = None
    """How images were scored, or why they were not; None for scenarios without images."""
    floors: dict[str, float] = field(default_factory=dict)
    """Metric -> its value in frame 0, m: the distance of points from nodes without any motion."""
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Stage -> the settings that it reads."""
    data_digest: str
    """SHA-256 of the observations."""
    attempt: Annotated[int, Field(ge=1)]
    """Maximum over stages of 1 plus the number of times that the stage resumed from a checkpoint."""
    commit: Annotated[str, StringConstraints(pattern=r"^[\w.-]{0,100}$")]
    device: str
    """Device on which the model was made."""
    machine: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of the computing packages (`records.COMPUTING`)."""
    started: Moment
    ended: Moment
    params: dict[str, Any]
    """Settings and facts of all stages, under dotted names."""
    timings: dict[str, float]
    """Stage -> s."""
    peak_memory_mb: dict[str, float] = field(default_factory=dict)
    """Stage -> MB."""
    scores_file: str | None = None
    """None or empty if a failed run has no scores."""
    held_file: str | None = None
    """Scores of a failed run, with its last finite frame repeated to the end."""
    histories: dict[str, str] = field(default_factory=dict)
    """Stage -> Parquet file with values per step."""
    artifacts: dict[str, list[str]] = field(default_factory=dict)
    """Kind -> files."""

    @property
    def name(self) -> str:
        """scenario/method/seed."""
        return f"{self.scenario}/{self.method}/{self.seed}"

    @property
    def ok(self) -> bool:
        """True if the run has a result."""
        return self.status == "ok"

    @property
    def model(self) -> str:
        """The baseline's model; empty for twins."""
        return str(self.variant.get("model") or "")

    @property
    def oracle(self) -> bool:
        """True if the method was fitted on all frames, which excludes it from comparisons."""
        return bool(self.variant.get("oracle"))

    @property
    def content(self) -> dict[str, Any]:
        """The fields from which the key is computed."""
        return {name: getattr(self, name) for name in CONTENT}

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        values = {"format": RECORD_FORMAT, **dataclasses.asdict(self)}
        write_text(Path(path), json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: Path) -> RunRecord:
        """Read a record. Raises InputError, which lists all invalid fields, if it is missing or damaged."""
        try:
            return _ADAPTER.validate_json(json.dumps(read_json(path, RECORD_FORMAT)), strict=True)
        except ValidationError as error:
            problems = [f"{'.'.join(map(str, p['loc']))}: {p['msg'].lower()}, received {p['input']!r:.80}" for p in error.errors()]
            raise InputError(path, "\n  " + "\n  ".join(problems), remedy="Delete it and rerun the command.") from error


_ADAPTER = TypeAdapter(RunRecord)


def key_of(*parts: Any) -> str:
    """SHA-256 of plain values, as hex; for a run, of its content and the digests of its results by stage."""
    return hashlib.sha256(canonical(list(parts)).encode()).hexdigest()


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values under dotted names."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return result
