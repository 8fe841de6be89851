"""Convert plain YAML values to settings and back.

Unknown keys are errors, values are never cast, and errors list every problem with its path.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import functools
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import yaml
from pydantic import TypeAdapter, ValidationError

from neuspring.core.errors import InputError
from neuspring.core.section import SettingsSection
from neuspring.core.text import masked

T = TypeVar("T")


def parse(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """Build the dataclass `kind` from plain values, strictly. Raises InputError, which lists every problem with its path."""
    values = kind.completed(values) if issubclass(kind, SettingsSection) and isinstance(values, Mapping) else values
    try:
        result: T = _adapter(kind).validate_json(json.dumps(values), strict=True)  # type: ignore[arg-type]
        return result
    except TypeError as error:
        raise InputError(where, "values must be plain YAML", str(error)) from error
    except ValidationError as error:
        problems = [_describe(problem, kind) for problem in error.errors()]
        raise InputError(where, "\n  " + "\n  ".join(problems), remedy="\nSee config/README.md for every key.") from error


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Cached: building an adapter takes longer than a thousand uses."""
    return TypeAdapter(kind)


def _describe(problem: Any, kind: type) -> str:
    keys = [part for part in problem["loc"] if not str(part).startswith("constrained")]
    path, value = ".".join(map(str, keys)) or "(top level)", problem["input"]
    if problem["type"] == "unexpected_keyword_argument":
        near = difflib.get_close_matches(str(keys[-1]), _keys(kind, keys[:-1]), n=1)
        return f"{path}: unknown key" + (f" (did you mean {near[0]}?)" if near else "")
    if problem["type"] == "missing":
        return f"{path}: required, but missing"
    number = isinstance(value, str) and problem["type"] in ("float_type", "int_type")
    hint = " (YAML reads a number such as 5e-5 as text: write 5.0e-5)" if number else ""
    message = problem["msg"].removeprefix("Value error, ")
    return f"{path}: {message[:1].lower()}{message[1:]}, received {masked(repr(value))}{hint}"


def _keys(kind: Any, path: Iterable[Any]) -> list[str]:
    """The keys of the section at this path in a dataclass."""
    for name in path:
        hint = get_type_hints(kind).get(name)
        kind = next((part for part in (hint, *parts(hint)) if dataclasses.is_dataclass(part)), kind)
    return [spec.name for spec in dataclasses.fields(kind)]


def parts(hint: Any) -> Iterator[Any]:
    """Yield all types inside a type: the members of a union, the values of a mapping."""
    for part in get_args(hint):
        yield part
        yield from parts(part)


def plain(settings: Any) -> dict[str, Any]:
    """Settings as plain YAML/JSON values (lists, not tuples)."""
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    return result


def read_text(path: Path) -> str:
    """Read a file as UTF-8 text. Raises InputError."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "this file must be readable UTF-8 text", error) from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping from a file. Raises InputError."""
    try:
        values = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise InputError(path, "this file must be YAML", str(error).replace("\n", " ")) from error
    if not isinstance(values, dict):
        raise InputError(path, "this file must contain a YAML mapping", type(values).__name__)
    return values


EXTRA_ROWS = {"method": "methods", "search": "searches", "study": "studies"}
"""Kind of row -> its section in a file of extra rows."""


def read_rows(kind: type[T], path: Path, what: str, extra: Iterable[Path] = ()) -> dict[str, T]:
    """Read a table from a YAML file, and rows of the same kind from the files `extra`: name -> row. Raises InputError.

    A row that `extends` another row, in any of these files, inherits its values. A row with `each: [2, 3]` defines one row per
    value, which replaces {each} in the name and the texts.
    """
    table: dict[str, Any] = {}
    files: dict[str, Path] = {}
    for file, rows in [(path, read_yaml(path)), *((file, _extra_rows(file).get(EXTRA_ROWS[what], {})) for file in extra)]:
        for name, row in rows.items():
            values = row.pop("each", None) if isinstance(row, dict) else None
            if values is not None and not (isinstance(values, list) and values):
                raise InputError(f"{file}, {what} {name}", "each: a list of at least one value is required", values)
            for value in [None] if values is None else values:
                key = str(name).replace("{each}", str(value))
                if key in table:
                    raise InputError(f"{file}, {what} {key}", "names of rows must differ", f"a row of {files[key]}", "Rename it.")
                table[key], files[key] = row if value is None else _filled(row, str(value)), file
    return {name: parse(kind, _extended(table, name, files, what, ()), f"{files[name]}, {what} {name}") for name in table}


def _extra_rows(path: Path) -> dict[str, Any]:
    """The sections of a file of extra rows."""
    sections = read_yaml(path)
    for name, rows in sections.items():
        if name not in EXTRA_ROWS.values() or not isinstance(rows, dict):
            raise InputError(path, f"this file must contain mappings of rows under {', '.join(EXTRA_ROWS.values())}", name)
    return sections


def _extended(table: Mapping[str, Any], name: str, files: Mapping[str, Path], what: str, below: tuple[str, ...]) -> Any:
    if name not in table or name in below:
        rule = "extends: another row of this table is required, without a cycle"
        raise InputError(f"{files[below[-1]]}, {what} {below[-1]}", rule, name, f"Known: {', '.join(table)}.")
    row = table[name]
    if not isinstance(row, dict) or "extends" not in row:
        return row
    if not isinstance(row["extends"], str):
        raise InputError(f"{files[name]}, {what} {name}", "extends: the name of a row is required", row["extends"])
    values = copy.deepcopy(_extended(table, row["extends"], files, what, (*below, name)))
    # A title belongs to one row.
    values.pop("title", None)
    merge(values, {key: value for key, value in row.items() if key != "extends"})
    return values


def _filled(row: Any, value: str) -> Any:
    if isinstance(row, dict):
        return {key: _filled(inner, value) for key, inner in row.items()}
    return typed(row.replace("{each}", value)) if isinstance(row, str) and "{each}" in row else row


def of_command_line(values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert values of `--config` to YAML types: Snakemake passes true, false and null as text, and in mappings also numbers.

    Lists do not change, because their entries may be names, such as 0.
    """
    words = ("true", "false", "null")
    return {key: typed(value) if isinstance(value, Mapping) or value in words else value for key, value in values.items()}


def typed(value: Any) -> Any:
    """Convert a text, or all texts in a mapping or list, to its YAML type."""
    if isinstance(value, Mapping):
        return {key: typed(item) for key, item in value.items()}
    if isinstance(value, list):
        return [typed(item) for item in value]
    if isinstance(value, str):
        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError:
            return value
        return parsed if isinstance(parsed, bool | int | float | None) else value
    return value


def merge(base: dict[str, Any], overlay: Mapping[str, Any]) -> None:
    """Override `base` with `overlay`, in place: mappings merge, all other values are replaced."""
    for key, value in overlay.items():
        below = base.get(key)
        if isinstance(value, Mapping) and isinstance(below, dict):
            merge(below, value)
        else:
            base[key] = value


def nested(path: str, value: Any) -> dict[str, Any]:
    """The value under a dotted key, nested as in a configuration file."""
    return functools.reduce(lambda inner, name: {name: inner}, reversed(path.split(".")), value)


def json_value(option: str, text: str, kind: type = dict) -> Any:
    """Parse the JSON object (or list) of an option. Raises InputError."""
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(option, "must be JSON", str(error)) from error
    if not isinstance(values, kind):
        raise InputError(option, f"must be a JSON {'object' if kind is dict else 'list'}", type(values).__name__)
    return values
