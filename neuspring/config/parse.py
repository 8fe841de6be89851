"""The types of which settings are made (strict: no casts, no unknown keys; and bounded), and plain YAML values to settings and
back.

Unknown keys raise, values are never cast, every problem is listed with its path.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterable, Mapping
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
LEFT = "removed; commit a72d24c is the last that has it"
"""The sentences for what lost its trial."""
_LEFT = {
    REMOVED: """
        controller_path drag_quadratic carry_over average_seeds last_frame losses.alpha simulation.mass search.clusters extra
        bending_reach homogeneous_epochs fit.warmup_epochs schedule fit.clip_gradient_norm weight_decay rest_lengths_by field.scale
        field.controllers rest_length_bound rest_prior rest_learning_rate
    """,
    "removed, marks serve such scenes (segment.backend: marks); commit a72d24c is the last that has it": """
        opencv.boxes opencv.table opencv.sleeves opencv.clutter opencv.object opencv.thin
    """,
    "removed, on coordinates and feature always; commit a72d24c is the last that has it": "field.fourier",
    LEFT: "plane_smoothness",
    "removed; commit f43b356 is the last that has it": "fit.rest_shape",
    "removed, hands of color alone move in an upright plane; commit 152a3d9 is the last that searches how far they are": """
        hand_tilt hand_size hand_depth hand_knots
    """,
    "removed: splats follow the nodes that are nearest in each frame": "frozen_skinning",
    "now losses of the whole configuration": "losses",
    "now color_rate": "colour_rate",
    "now neighborhood": "neighbourhood",
    "now outlier_neighbors": "outlier_neighbours",
    "now variables.NAME: {low: ..., high: ...}": "ranges",
    "now variables.NAME: {scale: ...}": "scales",
    "of a search now variables.NAME: {start: ...}": "start",
    "now lift.released": "sequential_motion_filter coordinate_outliers whole_pixels depth_window",
    "a third of the scenarios now": "warmup_scenarios",
    "by the scenario's category now": "gs_dynamics.preset",
    "a constant in neuspring/config/search.py now": "polish.share",
    "a constant beside its user in neuspring/twin now": "betas freed_sigma polish.step polish.tolerance",
    "a constant beside its user in neuspring/data now": "toy.frame_rate",
    "a constant beside its user in neuspring/splats now": """
        l1 densify_from densify_until densify_every densify_gradient split_size prune_opacity most_splats images.opacity
    """,
    "a constant beside its user in neuspring/baselines now": """
        coverage min_visible bound_anchors link_stiffness substeps_added substeps_raised spring_gaus.checkpoint_every
        dense_points smoothing_passes gs_dynamics.checkpoint_every
    """,
    "a constant beside its user in neuspring/perception now": """
        marks.smoothness marks.reach opencv.smoothing opencv.smallest hand_prompt box_threshold text_threshold
        opencv.window opencv.levels opencv.forward_backward opencv.reacquire likeness lift.least_neighbors agreement release_after
        shape.margin shape.tolerance shape.smoothing shape.bend_reach shape.thin shape.bend back_fraction
        sample.surface sample.interior color.beneath color.hands_apart color.hand_radius color.samples color.band color.cell
        color.grip_reach grip_length
    """,
}
RENAMED = {key: sentence for sentence, keys in _LEFT.items() for key in keys.split()}
"""Keys of older versions -> a sentence that says where they went. An entry is a key, or the end of its dotted path."""


def told(names: Iterable[str]) -> str:
    """What became of names in a list that are keys of older versions; empty where none is."""
    sentences = dict.fromkeys(RENAMED[name] for name in names if name in RENAMED)
    return f" ({'; '.join(sentences)})" if sentences else ""


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
        parts = path.split(".")
        now = next((RENAMED[end] for n in range(len(parts)) if (end := ".".join(parts[n:])) in RENAMED), "")
        return f"{path}: unknown key" + (f" ({now})" if now else "")
    if problem["type"] == "missing":
        return f"{path}: required, but missing"
    hint = ""
    if isinstance(value, str) and problem["type"] in ("float_type", "int_type"):
        hint = " (YAML reads a number such as 5e-5 as text: write 5.0e-5)"
    if path.endswith("images.released_quirks") and isinstance(value, dict):
        hint = " (a list of names now; the key corner_pixels is images.corner_pixels now)"
    if "released_quirks" in path and value == "corner_pixels":
        hint = " (now images.corner_pixels: true)"
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


def typed(value: Any) -> Any:
    """A mapping or list of `--config` as YAML has it: inside it Snakemake leaves numbers, true, false and null as text."""
    if isinstance(value, Mapping):
        return {key: typed(each) for key, each in value.items()}
    if isinstance(value, list):
        return [typed(each) for each in value]
    if isinstance(value, str):
        try:
            read = yaml.safe_load(value)
        except yaml.YAMLError:
            return value
        return read if isinstance(read, bool | int | float | None) else value
    return value


def merge(base: dict[str, Any], overlay: Mapping[str, Any]) -> None:
    """Put `overlay` on top of `base`, in place: mappings merge, everything else replaces."""
    for key, value in overlay.items():
        below = base.get(key)
        if isinstance(value, Mapping) and isinstance(below, dict):
            merge(below, value)
        else:
            base[key] = value


def json_value(option: str, text: str, kind: type = dict) -> Any:
    """The JSON object (or list) given with an option. Raises InputError."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(option, "must be JSON", str(error)) from error
    if not isinstance(values, kind):
        raise InputError(option, f"must be a JSON {'object' if kind is dict else 'list'}", type(values).__name__)
    return values
