"""Writes the tables of config/README.md from the settings' own declarations: python -m neuspring.config.page"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import math
import types
import typing
from pathlib import Path
from typing import Any, get_type_hints

import yaml
from pydantic.fields import FieldInfo

from neuspring.config import rows, settings
from neuspring.config.parse import Section, parts

PAGE = Path(__file__).parents[2] / "config" / "README.md"
HEADING = "## Keys\n"
"""What stands above it is written by hand, what stands below from the declarations."""
ROWS = {"rows of scenarios.tsv": rows.ScenarioRow, "rows of methods.yaml": rows.Method, "rows of searches.yaml": rows.SearchRow}
BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
PLAIN = {int: "integer", float: "number", str: "text", bool: "`true`, `false`", types.NoneType: "`null`", Any: "any"}


def sections(kind: type = settings.Config, path: str = "") -> dict[str, type]:
    """Path -> dataclass of every section, in the order of their declarations."""
    found = {path or "(top level)": kind}
    hints = get_type_hints(kind)
    for spec in dataclasses.fields(kind):
        for part in (hints[spec.name], *parts(hints[spec.name])):
            if is_section(part):
                found |= sections(part, f"{path}.{spec.name}" if path else spec.name)
    return found


def is_section(kind: Any) -> bool:
    """Whether a type has a table of its own on the page; a dataclass that is no section is one value."""
    return isinstance(kind, type) and issubclass(kind, Section)


def text() -> str:
    """The page: its introduction as it is, its tables anew."""
    parts = [PAGE.read_text(encoding="utf-8").partition(HEADING)[0] + HEADING]
    parts += [section(title, kind) for title, kind in sections().items()]
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
        words, default = ("section", "") if is_section(hints[spec.name]) else (allowed(hints[spec.name]), shown_default(spec))
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
    """A default in YAML's flow style; floats with a point, as the strict reader wants them."""
    # Six digits: 1/6 is meant, not its last bit.
    rounded = json.loads(json.dumps(value, default=vars), parse_float=lambda text: float(f"{float(text):.6g}"))
    listed: str = yaml.safe_dump([rounded], default_flow_style=True, sort_keys=False, width=math.inf)
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
        if arguments[-1] is Ellipsis:
            return f"list of {allowed(arguments[0])}"
        return f"[{', '.join(map(allowed, arguments))}]"
    if is_section(hint):
        return "section"
    if dataclasses.is_dataclass(hint):
        return f"mapping of {', '.join(f'`{spec.name}`' for spec in dataclasses.fields(hint))}"
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
