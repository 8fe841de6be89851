"""No type repeats the names of a registry: they are checked where they are read, so that a stranger's package can add to them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from neuspring.registry import Registry

PACKAGE = Path(__file__).parents[2] / "neuspring"
BESIDE = {"auto", "none", "all"}
"""Words that stand for no member."""
CHANCE = {frozenset({"score", "train"}), frozenset({"measured", "none"})}
"""Words that the format of capture.json defines: two are names of stages by chance, two of the lifters that read it."""


def registries() -> dict[str, Registry[object]]:
    """The registries of the package by their kinds."""
    modules = [path for path in PACKAGE.rglob("*.py") if "Registry(" in path.read_text() and path.name != "registry.py"]
    names = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__") for path in modules]
    found = [value for name in names for value in vars(import_module(name)).values() if isinstance(value, Registry)]
    return {registry.kind: registry for registry in found}


def literals() -> Iterator[tuple[str, set[str]]]:
    """Where a `Literal` stands, and its words."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Subscript) and ast.unparse(node.value).split(".")[-1] == "Literal":
                values = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                words = {value.value for value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)}
                yield f"{path.relative_to(PACKAGE.parent)}:{node.lineno}", words


def test_no_literal_repeats_the_names_of_a_registry():
    known = {kind: set(registry) for kind, registry in registries().items()}
    repeated = [
        f"{where}: {', '.join(sorted(words))} are of {kind}"
        for where, words in literals()
        for kind, names in known.items()
        if len(words & names) > 1 and words - BESIDE <= names and words not in CHANCE
    ]
    assert not repeated, "\n".join(repeated)
