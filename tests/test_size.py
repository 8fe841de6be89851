"""The size of the house: lines of code per room against `size.toml`, and what keeps it readable."""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import networkx as nx
import pytest

from neuspring.core import provenance

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "neuspring"
BUDGET = tomllib.loads((ROOT / "tests" / "size.toml").read_text(encoding="utf-8"))
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
OPENINGS = ("What", "Whether", "Of", "How", "Where")
"""A docstring begins with its subject, and so with none of these."""


def texts(tree: ast.AST) -> Iterator[ast.Constant]:
    """Docstrings, and the notes under fields and constants."""
    for node in ast.walk(tree):
        for item in node.body if isinstance(getattr(node, "body", None), list) else ():
            if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str):
                yield item.value


def lines_of_code(path: Path) -> int:
    """Lines with code, without docstrings, comments and blank lines."""
    source = path.read_text(encoding="utf-8")
    documents = {line for text in texts(ast.parse(source)) for line in range(text.lineno, (text.end_lineno or 0) + 1)}
    return len(
        {token.start[0] for token in tokenize.generate_tokens(io.StringIO(source).readline) if token.type not in NO_CODE}
        - documents
    )


def room_of(path: Path) -> str:
    """core, data, ...; extensions/play; a module of the package itself is of the room `package`."""
    parts = path.relative_to(PACKAGE).parts
    return "package" if len(parts) == 1 else "/".join(parts[:2]) if parts[0] == "extensions" and len(parts) > 2 else parts[0]


def test_no_room_is_larger_than_its_budget():
    """A change that exceeds a number changes it in the same commit, and says what came in and what left."""
    rooms = Counter[str]()
    for path in PACKAGE.rglob("*.py"):
        rooms[room_of(path)] += lines_of_code(path)
    known = BUDGET["rooms"]
    assert rooms.keys() <= known.keys()
    assert {room: (lines, known[room]) for room, lines in rooms.items() if lines > known[room]} == {}
    assert max(known.values()) <= BUDGET["limits"]["room"]
    core = sum(lines for room, lines in rooms.items() if not room.startswith("extensions"))
    assert core <= BUDGET["limits"]["core"] and rooms.total() <= BUDGET["limits"]["package"]
    assert sum(lines_of_code(path) for path in (ROOT / "tests").rglob("*.py")) <= BUDGET["limits"]["tests"]


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    return {path.relative_to(PACKAGE).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}


def assigned(node: ast.stmt) -> Iterator[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    for target in targets:
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        yield from (name.id for name in names if isinstance(name, ast.Name))


def test_a_class_or_constant_has_a_name_of_its_own(trees):
    files: dict[str, set[str]] = defaultdict(set)
    for name, tree in trees.items():
        for node in tree.body:
            found = (
                [node.name] if isinstance(node, ast.ClassDef) else [n for n in assigned(node) if re.fullmatch("[A-Z][A-Z0-9_]+", n)]
            )
            for each in found:
                files[each].add(name)
    assert {name: sorted(where) for name, where in files.items() if len(where) > 1} == {}


def test_docstrings_begin_with_their_subject(trees):
    wrong = [
        f"{name}:{text.lineno}: {text.value[:60]}"
        for name, tree in trees.items()
        for text in texts(tree)
        if re.match(rf"\s*({'|'.join(OPENINGS)})\b", str(text.value))
    ]
    assert not wrong, "\n".join(wrong)


def test_no_files_import_each_other_in_a_circle():
    """Imports inside of functions and for types alone count too."""
    graph = nx.DiGraph()
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(["neuspring", *(part for part in parts if part != "__init__")])
        if module != "neuspring":  # names of the api, imported when they are asked for
            graph.add_edges_from((module, other) for other in provenance.imported_modules(module) if other != module)
    assert [sorted(circle) for circle in nx.strongly_connected_components(graph) if len(circle) > 1] == []
