"""Writes the tables of config/README.md from the settings' own declarations: python -m neuspring.config.page"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import types
import typing
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo

from neuspring.config import (
    baselines,
    data,
    gpus,
    gs_dynamics,
    images,
    perception,
    rows,
    settings,
    simulation,
    spring_gaus,
    tuning,
    twin,
)

PAGE = Path(__file__).parents[2] / "config" / "README.md"
HEADING = "## Keys\n"
"""What stands above it is written by hand, what stands below from the declarations."""
KEYS = {
    "(top level)": settings.Config,
    "gpus": gpus.Gpus,
    "simulation": simulation.Simulation,
    "losses": twin.Losses,
    "search": twin.Search,
    "search.clusters": twin.Clusters,
    "search.ranges": twin.SearchRanges,
    "search.start": twin.SearchStart,
    "fit": twin.Fit,
    "fit.field": twin.SpringField,
    "released_quirks": simulation.ReleasedQuirks,
    "toy": data.Toy,
    "mocap": data.Mocap,
    "synthetic": data.Synthetic,
    "perception": perception.Perception,
    "perception.segment": perception.Segmentation,
    "perception.segment.opencv": perception.OpenCvSegmentation,
    "perception.segment.grounded_sam2": perception.GroundedSam2,
    "perception.track": perception.PointTracking,
    "perception.track.opencv": perception.OpenCvTracking,
    "perception.track.cotracker3": perception.CoTracker3,
    "perception.lift": perception.Lift,
    "perception.shape": perception.ShapePriorSettings,
    "perception.sample": perception.Sampling,
    "images": images.Images,
    "images.appearance": images.Appearance,
    "images.lpips": images.LpipsWeights,
    "images.released_quirks": images.ImageQuirks,
    "baselines": baselines.Baselines,
    "baselines.spring_gaus": spring_gaus.SpringGaus,
    "baselines.gs_dynamics": gs_dynamics.GsDynamics,
    "tracking": settings.Tracking,
    "tune": tuning.Tune,
    "tune.space": tuning.Dimension,
}
ROWS = {"rows of scenarios.tsv": rows.ScenarioRow, "rows of methods.yaml": rows.Method, "rows of searches.yaml": rows.SearchRow}
BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
PLAIN = {int: "integer", float: "number", str: "text", bool: "`true`, `false`", types.NoneType: "`null`", Any: "any"}


def text() -> str:
    """The page: its introduction as it is, its tables anew."""
    parts = [PAGE.read_text(encoding="utf-8").partition(HEADING)[0] + HEADING]
    parts += [section(title, kind) for title, kind in KEYS.items()]
    parts += ["## Rows of the tables\n"]
    parts += [section(title, kind) for title, kind in ROWS.items()]
    return "\n".join(parts)


def section(title: str, kind: type) -> str:
    """A heading, what the section is, and a table of its keys."""
    summary = (kind.__doc__ or "").partition("\n")[0]
    lines = ["| key | allowed | default | meaning |", "|---|---|---|---|"]
    for key, words, default, meaning in fields(kind):
        nested = key if kind is settings.Config else f"{title}.{key}"
        link = f"See [{nested}](#{nested.replace('.', '')})."
        shown = link if words == "section" else meaning.replace("|", r"\|")
        lines.append(f"| `{key}` | {words} | {default} | {shown} |")
    return "\n".join([f"### {title}", "", summary, "", *lines, ""])


def fields(kind: type) -> list[tuple[str, str, str, str]]:
    """(key, allowed, default, meaning) of every field; the meaning is the text below its declaration."""
    hints, meanings = typing.get_type_hints(kind, include_extras=True), declared_meanings(kind)
    entries = []
    for spec in dataclasses.fields(kind):
        is_section = dataclasses.is_dataclass(hints[spec.name])
        words, default = ("section", "") if is_section else (allowed(hints[spec.name]), shown_default(spec))
        entries.append((spec.name, words, default, meanings.get(spec.name, "")))
    return entries


def declared_meanings(kind: type) -> dict[str, str]:
    """Key -> the text below its declaration in the class's module."""
    module = ast.parse(Path(inspect.getfile(kind)).read_text(encoding="utf-8"))
    body = next(node.body for node in module.body if isinstance(node, ast.ClassDef) and node.name == kind.__name__)
    meanings = {}
    for statement, following in zip(body, [*body[1:], None], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(following, ast.Expr):
            continue
        if isinstance(following.value, ast.Constant):
            meanings[ast.unparse(statement.target)] = " ".join(str(following.value.value).split())
    return meanings


def shown_default(spec: dataclasses.Field[Any]) -> str:
    """As one would write it in YAML."""
    if spec.default_factory is not dataclasses.MISSING:
        return f"`{yaml_text(spec.default_factory())}`"
    return "required" if spec.default is dataclasses.MISSING else f"`{yaml_text(spec.default)}`"


def yaml_text(value: Any) -> str:
    """A plain value in YAML's flow style; floats with a point, as the strict reader wants them."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, tuple):
        return f"[{', '.join(map(yaml_text, value))}]"
    if value == "":
        return '""'
    # Six digits: 1/6 is meant, not its last bit.
    return repr(float(f"{value:.6g}")) if isinstance(value, float) else str(value)


def allowed(hint: Any) -> str:
    """Type and range of a key in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        limits = " and ".join(filter(None, map(limit, bounds(hint))))
        return f"{allowed(arguments[0])} {limits}".rstrip()
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(allowed, arguments))
    if origin is typing.Literal:
        return ", ".join(f"`{word}`" for word in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"list of {allowed(arguments[0])}"
        return f"[{', '.join(map(allowed, arguments))}]"
    if dataclasses.is_dataclass(hint):
        return "section"
    return "mapping" if origin is dict else PLAIN[hint]


def bounds(hint: Any) -> list[Any]:
    """Single constraints of an annotated type."""
    constraints: list[Any] = []
    for item in hint.__metadata__:
        constraints += item.metadata if isinstance(item, FieldInfo) else [item]
    return constraints


def limit(constraint: Any) -> str:
    """One constraint in words; empty for those that say nothing to a reader (patterns, finiteness)."""
    return " and ".join(f"{sign} {getattr(constraint, name):g}" for name, sign in BOUNDS.items() if hasattr(constraint, name))


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
