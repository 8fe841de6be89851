"""Writes the tables of config/README.md from the settings' own declarations: python -m neuspring.config.page"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import json
import math
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_type_hints

import yaml
from pydantic.fields import FieldInfo

from neuspring.config import rows, settings
from neuspring.config.effort import EFFORT_SIZES, EFFORTS
from neuspring.config.parse import parts
from neuspring.core.section import SettingsSection

PAGE = Path(__file__).parents[2] / "config" / "README.md"
HEADING = "## Keys\n"
"""Above it the page is written by hand, below it from the declarations."""
ROWS = {"rows of scenarios.tsv": rows.ScenarioRow, "rows of methods.yaml": rows.Method, "rows of searches.yaml": rows.SearchRow}
BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
WORDS = {int: "integer", float: "number", str: "text", bool: "`true`, `false`", types.NoneType: "`null`", Any: "any"}


def sections(kind: type = settings.Config, path: str = "") -> dict[str, type]:
    """Path -> dataclass of every section, in the order of their declarations."""
    found = {path or "(top level)": kind}
    hints = get_type_hints(kind)
    for spec in dataclasses.fields(kind):
        for part in filter(is_section, (hints[spec.name], *parts(hints[spec.name]))):
            found |= sections(part, f"{path}.{spec.name}" if path else spec.name)
    return found


def is_section(kind: Any) -> bool:
    """True for a type that has a table of its own on the page; a dataclass that is no section is one value."""
    return isinstance(kind, type) and issubclass(kind, SettingsSection)


def text() -> str:
    """The page: its introduction as it is, its tables anew."""
    written = PAGE.read_text(encoding="utf-8").partition(HEADING)[0] + HEADING
    sizes = ((f"`{key}`", *(f"`{yaml_text(value)}`" for value in values)) for key, values in EFFORT_SIZES.items())
    efforts = ["### effort", "", "The sizes that `effort` sets.", "", *table(("key", *EFFORTS), sizes), ""]
    described = [section(title, kind) for title, kind in (sections() | ROWS).items()]
    return "\n".join([written, described[0], *efforts, *described[1:]])


def section(title: str, kind: type) -> str:
    """A heading, what the section is, and a table of its keys."""
    summary = (kind.__doc__ or "").partition("\n")[0]
    return "\n".join([f"### {title}", "", summary, "", *table(("key", "default", "values", "meaning"), fields(kind)), ""])


def table(head: Iterable[str], body: Iterable[Iterable[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, *body)]
    return [lines[0], "|" + "---|" * lines[0].count(" | ") + "---|", *lines[1:]]


def fields(kind: type) -> list[tuple[str, str, str, str]]:
    """(key, default, values, meaning) of every key; the meaning is the first sentence below its declaration."""
    hints, meanings = get_type_hints(kind, include_extras=True), declared_meanings(kind)
    keys = (spec for spec in dataclasses.fields(kind) if not is_section(hints[spec.name]))
    return [(f"`{key.name}`", shown_default(key), allowed(hints[key.name]), meanings.get(key.name, "")) for key in keys]


def declared_meanings(kind: type) -> dict[str, str]:
    """Key -> the first sentence below its declaration in the class's module."""
    module = ast.parse(Path(inspect.getfile(kind)).read_text(encoding="utf-8"))
    body = next((node.body for node in module.body if isinstance(node, ast.ClassDef) and node.name == kind.__name__), [])
    meanings = {}
    for statement, following in itertools.pairwise(body):
        if isinstance(statement, ast.AnnAssign) and isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            words = " ".join(str(following.value.value).split())
            meanings[ast.unparse(statement.target)] = words.partition(". ")[0].rstrip(".").replace("|", r"\|") + "."
    return meanings


def shown_default(spec: dataclasses.Field[Any]) -> str:
    """A default as one would write it in YAML."""
    if spec.default_factory is not dataclasses.MISSING:
        return f"`{yaml_text(spec.default_factory())}`"
    return "required" if spec.default is dataclasses.MISSING else f"`{yaml_text(spec.default)}`"


def yaml_text(value: Any) -> str:
    """A value in YAML's flow style; floats with a point, as the strict reader wants them."""
    values = [json.loads(json.dumps(value, default=vars))]
    listed: str = yaml.safe_dump(values, default_flow_style=True, sort_keys=False, width=math.inf)
    return listed.strip()[1:-1]


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
        several = arguments[-1] is Ellipsis
        return f"list of {allowed(arguments[0])}" if several else f"[{', '.join(map(allowed, arguments))}]"
    if is_section(hint):
        return "section"
    if dataclasses.is_dataclass(hint):
        return "range"
    return "mapping" if origin is dict else WORDS[hint]


def bounds(hint: Any) -> list[Any]:
    """Single constraints of an annotated type."""
    return [each for item in hint.__metadata__ for each in (item.metadata if isinstance(item, FieldInfo) else [item])]


def limit(constraint: Any) -> str:
    """One constraint in words; empty for those that say nothing to a reader (patterns, finiteness)."""
    return " and ".join(f"{sign} {getattr(constraint, name):g}" for name, sign in BOUNDS.items() if hasattr(constraint, name))


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
