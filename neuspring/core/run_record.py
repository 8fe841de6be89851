"""The record of a run: results/{scenario}/{method}/{seed}/run.json, the one file that tables, report, MLflow and `explain` read.

It is written last. It names the files of the run relative to its own folder and says what made them.
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
"""Fields that the key of a run is made of, beside the digests of its results."""
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,79}$")]


def _with_zone(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("a time with its zone is required")
    return text


Moment = Annotated[str, AfterValidator(_with_zone)]
"""ISO 8601 with a zone."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """One method on one scenario with one seed, from observations to scores.

    Fields with a default are absent in records of older versions; fields that this version does not know are ignored.
    """

    __pydantic_config__ = ConfigDict(extra="ignore", strict=True)
    run_key: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8,64}$")]
    """SHA-256 of `CONTENT` and of the digests of the results. Equal results have equal keys, however often they are made."""
    scenario: Name
    source: str
    category: str
    method: Name
    variant: dict[str, str | bool | int | float | None]
    """The method's switches, under dotted names."""
    seed: int
    status: Literal["ok", "failed"]
    reason: str
    """Reason why the run failed; empty otherwise."""
    notes: list[str] = field(default_factory=list)
    """Notes that a reader of the scores needs although the run did not fail."""
    images: dict[str, Any] | None = None
    """Way in which pictures were scored, or why they were not; None for scenarios without images."""
    floors: dict[str, float] = field(default_factory=dict)
    """Metric -> its value in frame 0, which is given: how far points are from nodes without any motion, m."""
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Stage -> the settings that it read."""
    data_digest: str
    """SHA-256 of the observations."""
    attempt: Annotated[int, Field(ge=1)]
    """The most attempts of any stage: 1, plus one for every time it continued from a checkpoint."""
    commit: Annotated[str, StringConstraints(pattern=r"^[\w.-]{0,100}$")]
    device: str
    """Device that the model was made on."""
    machine: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of the packages that compute."""
    started: Moment
    ended: Moment
    params: dict[str, Any]
    """Settings and facts of all stages, under dotted names."""
    timings: dict[str, float]
    """Stage -> s."""
    peak_memory_mb: dict[str, float] = field(default_factory=dict)
    """Stage -> MB."""
    scores_file: str | None = None
    """None or empty where a failed run has no scores."""
    held_file: str | None = None
    """File of a failed run's scores, with its last finite frame repeated to the end."""
    histories: dict[str, str] = field(default_factory=dict)
    """Stage -> Parquet file of values per step."""
    artifacts: dict[str, list[str]] = field(default_factory=dict)
    """Kind -> files."""

    @property
    def name(self) -> str:
        """scenario/method/seed."""
        return f"{self.scenario}/{self.method}/{self.seed}"

    @property
    def ok(self) -> bool:
        """True where the run has a result."""
        return self.status == "ok"

    @property
    def model(self) -> str:
        """The baseline's model; empty for twins."""
        return str(self.variant.get("model") or "")

    @property
    def oracle(self) -> bool:
        """True where the method has seen all frames, so that it takes no part in comparisons."""
        return bool(self.variant.get("oracle"))

    @property
    def content(self) -> dict[str, Any]:
        """The fields that the key is made of."""
        return {name: getattr(self, name) for name in CONTENT}

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        values = {"format": RECORD_FORMAT, **dataclasses.asdict(self)}
        write_text(Path(path), json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: Path) -> RunRecord:
        """Read a record. Raises InputError, which lists every field that is wrong, if it is missing or damaged."""
        try:
            return _ADAPTER.validate_json(json.dumps(read_json(path, RECORD_FORMAT)), strict=True)
        except ValidationError as error:
            problems = [f"{'.'.join(map(str, p['loc']))}: {p['msg'].lower()}, received {p['input']!r:.80}" for p in error.errors()]
            raise InputError(path, "\n  " + "\n  ".join(problems), remedy="Delete it and run again.") from error


_ADAPTER = TypeAdapter(RunRecord)


def key_of(*parts: Any) -> str:
    """SHA-256 of plain values, as hex; a run's parts are its content and the digests of its results by stage."""
    return hashlib.sha256(canonical(list(parts)).encode()).hexdigest()


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values under dotted names."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return result
