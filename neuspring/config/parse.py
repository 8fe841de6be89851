"""The types of which settings are made (strict: no casts, no unknown keys; and bounded), and plain YAML values to settings and
back.

Unknown keys raise, values are never cast, every problem is listed with its path.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

from neuspring.core.errors import InputError
from neuspring.core.text import masked

STRICT = ConfigDict(extra="forbid", strict=True)
"""No unknown keys, no casts."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,79}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Range = tuple[Finite, Finite]


class Section:
    """Base of the dataclasses of settings."""

    __pydantic_config__ = STRICT


T = TypeVar("T")
REMOVED = "removed; commit 7308a7b is the last that has it"
"""The sentence for what lost its trial."""
RENAMED = {
    "controller_path": REMOVED,
    "drag_quadratic": REMOVED,
    "colour_rate": "color_rate",
    "neighbourhood": "neighborhood",
    "outlier_neighbours": "outlier_neighbors",
    "carry_over": REMOVED,
    "average_seeds": REMOVED,
    "ranges": "now variables.NAME: {low: ..., high: ...}",
    "scales": "now variables.NAME: {scale: ...}",
    "start": "of a search now variables.NAME: {start: ...}",
    "betas": "a constant of neuspring/twin/fit.py now",
    "freed_sigma": "a constant of neuspring/twin/search.py now",
    "hand_knots": "a constant of neuspring/twin/hand_paths.py now",
    "polish.step": "a constant of neuspring/twin/polish.py now",
    "polish.tolerance": "a constant of neuspring/twin/polish.py now",
    "last_frame": REMOVED,
    "warmup_scenarios": "a third of the scenarios now",
}
RENAMED |= dict.fromkeys(
    (
        *("losses.alpha", "simulation.mass", "search.clusters", "extra", "bending_reach"),
        *("homogeneous_epochs", "fit.warmup_epochs", "schedule", "fit.clip_gradient_norm", "weight_decay"),
        *("rest_lengths_by", "field.scale", "field.controllers"),
        *("rest_length_bound", "rest_prior", "rest_learning_rate"),
    ),
    REMOVED,
)
RENAMED |= dict.fromkeys(("sequential_motion_filter", "coordinate_outliers", "whole_pixels", "depth_window"), "lift.released")
RENAMED |= dict.fromkeys(
    (
        *("perception.segment.marks.smoothness", "perception.segment.marks.reach"),
        *("perception.segment.opencv.smoothing", "perception.segment.opencv.smallest"),
        *("perception.track.opencv.levels", "perception.track.opencv.forward_backward", "perception.lift.least_neighbors"),
        *("perception.shape.margin", "perception.shape.tolerance", "perception.shape.smoothing", "perception.shape.bend_reach"),
        *("perception.sample.surface", "perception.sample.interior"),
        *(f"perception.color.{name}" for name in ("beneath", "hands_apart", "hand_radius", "samples", "band", "cell")),
    ),
    "a constant beside its user in neuspring/perception now",
)
"""Keys of older versions -> their name now, or a sentence that says where they went. An entry is a key or its dotted path."""


def parse(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """Build the dataclass `kind` from plain values, strictly. Raises InputError listing every problem with its path."""
    try:
        result: T = _adapter(kind).validate_json(json.dumps(values), strict=True)  # type: ignore[arg-type]
        return result
    except TypeError as error:
        raise InputError(where, "values must be plain YAML", str(error)) from error
    except ValidationError as error:
        problems = [_describe(problem) for problem in error.errors()]
        raise InputError(where, "\n  " + "\n  ".join(problems), remedy="\nSee config/README.md for every key.") from error


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Building one takes longer than a thousand uses of it."""
    return TypeAdapter(kind)


def _describe(problem: Any) -> str:
    path = ".".join(str(part) for part in problem["loc"] if not str(part).startswith("constrained")) or "(top level)"
    value = problem["input"]
    if problem["type"] == "unexpected_keyword_argument":
        now = RENAMED.get(path) or RENAMED.get(path.rpartition(".")[2])
        return f"{path}: unknown key" + (f" ({now if ' ' in now else f'now {now}'})" if now else "")
    if problem["type"] == "missing":
        return f"{path}: required, but missing"
    hint = ""
    if isinstance(value, str) and problem["type"] in ("float_type", "int_type"):
        hint = " (YAML reads a number such as 5e-5 as text: write 5.0e-5)"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{path}: {message[:1].lower()}{message[1:]}, received {masked(repr(value))}{hint}"


def plain(settings: Any) -> dict[str, Any]:
    """The settings as plain YAML/JSON values (lists, not tuples)."""
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    return result


def read_text(path: Path) -> str:
    """A file's text. Raises InputError."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "this file must be readable UTF-8 text", error) from error


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML mapping from a file. Raises InputError."""
    try:
        values = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise InputError(path, "this file must be YAML", str(error).replace("\n", " ")) from error
    if not isinstance(values, dict):
        raise InputError(path, "this file must hold a YAML mapping", type(values).__name__)
    return values


def merge(base: dict[str, Any], overlay: Mapping[str, Any]) -> None:
    """Put `overlay` on top of `base`, in place: mappings merge, everything else replaces."""
    for key, value in overlay.items():
        below = base.get(key)
        if isinstance(value, Mapping) and isinstance(below, dict):
            merge(below, value)
        else:
            base[key] = value
