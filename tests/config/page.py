"""Write the tables of config/README.md from pydantic's schema of the settings: python -m tests.config.page"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from neuspring.config.effort import EFFORT_SIZES, EFFORTS
from neuspring.config.rows import Method, ScenarioRow, SearchRow
from neuspring.config.settings import Config
from neuspring.core.section import STRICT

PAGE = Path(__file__).parents[2] / "config" / "README.md"
HEADING = "## Keys\n"
"""The page is written by hand above this line, and from the declarations below it."""
ROWS = {"rows of scenarios.tsv": ScenarioRow, "rows of methods.yaml": Method, "rows of searches.yaml": SearchRow}
SCHEMA_TYPES = {"boolean": "`true`, `false`", "null": "`null`", "string": "text", "object": "mapping"}
BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


def schema_of(kind: type) -> dict[str, Any]:
    """The JSON schema of a dataclass of settings; the text below each field is its description."""
    STRICT["use_attribute_docstrings"] = True
    return TypeAdapter(kind).json_schema()


@functools.cache
def sections() -> dict[str, dict[str, Any]]:
    """Title -> schema of each section, in the order of their declarations."""
    whole = schema_of(Config)

    def below(section: dict[str, Any], path: str) -> Iterator[tuple[str, dict[str, Any]]]:
        yield path or "(top level)", section
        for key, value in section["properties"].items():
            for name in referred(value):
                yield from below(whole["$defs"][name], f"{path}.{key}".lstrip("."))

    return dict(below(whole, "")) | {title: schema_of(kind) for title, kind in ROWS.items()}


def referred(value: Any) -> list[str]:
    """The sections that a key's schema names, inside of lists and mappings too; the range of a variable is one value."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    names = [value["$ref"].rpartition("/")[2]] if isinstance(value, dict) and "$ref" in value else []
    return [name for name in names if name != "Variable"] + [name for each in inner for name in referred(each)]


def text() -> str:
    """The page: its introduction as it is, its tables generated."""
    written = PAGE.read_text(encoding="utf-8").partition(HEADING)[0] + HEADING
    sizes = [[f"`{key}`", *(f"`{yaml_text(value)}`" for value in values)] for key, values in EFFORT_SIZES.items()]
    first, *others = [
        "\n".join([f"### {title}", "", schema["description"].partition("\n")[0], "", *table(fields(schema)), ""])
        for title, schema in sections().items()
    ]
    efforts = ["### effort", "", "The sizes that `effort` sets.", "", *table([["key", *EFFORTS], *sizes]), ""]
    return "\n".join([written, first, *efforts, *others])


def table(rows: list[list[str]]) -> list[str]:
    """The lines of a Markdown table; the first row is its head."""
    head, *lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    return [head, "|" + "---|" * len(rows[0]), *lines]


def fields(schema: dict[str, Any]) -> list[list[str]]:
    """key, default, values and meaning (the first sentence of its description) of every key that is no section."""
    rows = [["key", "default", "values", "meaning"]]
    for key, value in schema["properties"].items():
        if "$ref" in value and referred(value):
            continue
        default = "required" if key in schema.get("required", ()) else f"`{yaml_text(value.get('default', {}))}`"
        meaning = " ".join(value["description"].split()).partition(". ")[0].rstrip(".").replace("|", r"\|")
        rows.append([f"`{key}`", default, allowed(value), f"{meaning}."])
    return rows


def yaml_text(value: Any) -> str:
    """A value in YAML's flow style; floats with a point, as the strict reader requires them."""
    listed: str = yaml.safe_dump([json.loads(json.dumps(value))], default_flow_style=True, sort_keys=False, width=math.inf)
    return listed.strip()[1:-1]


def allowed(value: dict[str, Any]) -> str:
    """Type and range of a key in words."""
    if "$ref" in value:
        return "section" if referred(value) else "range"
    if "anyOf" in value:
        return " or ".join(dict.fromkeys(map(allowed, value["anyOf"])))
    if "enum" in value or "const" in value:
        return ", ".join(f"`{word}`" for word in value.get("enum", [value.get("const")]))
    if "prefixItems" in value:
        return f"[{', '.join(map(allowed, value['prefixItems']))}]"
    kind = value.get("type", "any")
    if kind == "array":
        return f"list of {allowed(value['items'])}"
    limits = " and ".join(f"{sign} {value[name]:g}" for name, sign in BOUNDS.items() if name in value)
    return f"{SCHEMA_TYPES.get(kind, kind)} {limits}".rstrip()


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
