"""The size of the package in tokens of code per folder against `size.toml`, and rules of readability."""

import ast
import io
import re
import tokenize
import tomllib
from collections import Counter, defaultdict
from pathlib import Path

import networkx as nx
import pytest

from neuspring.core import provenance

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "neuspring"
BUDGET = tomllib.loads((ROOT / "tests" / "size.toml").read_text(encoding="utf-8"))
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def tokens_of(path):
    """Tokens of code, without docstrings, comments, line ends and indentation: joining lines does not change the count."""
    source = path.read_text(encoding="utf-8")
    documents = set()
    for node in ast.walk(ast.parse(source)):
        for item in node.body if isinstance(getattr(node, "body", None), list) else ():
            if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str):
                documents |= set(range(item.lineno, (item.end_lineno or 0) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return sum(token.type not in NO_CODE and token.start[0] not in documents for token in tokens)


def folder_of(path):
    """core, data, ...; extensions/play; a module of the package itself is of the folder `package`."""
    parts = path.relative_to(PACKAGE).parts
    return "package" if len(parts) == 1 else "/".join(parts[:2]) if parts[0] == "extensions" and len(parts) > 2 else parts[0]


def test_no_folder_is_larger_than_its_budget():
    """The numbers may only fall: what comes in names what goes."""
    folders = Counter[str]()
    for path in PACKAGE.rglob("*.py"):
        folders[folder_of(path)] += tokens_of(path)
    known, limits = BUDGET["folders"], BUDGET["tokens"]
    assert folders.keys() <= known.keys()
    assert {folder: (tokens, known[folder]) for folder, tokens in folders.items() if tokens > known[folder]} == {}
    sizes = {
        "core": sum(tokens for folder, tokens in folders.items() if not folder.startswith("extensions")),
        "package": folders.total(),
        "tests": sum(tokens_of(path) for path in (ROOT / "tests").rglob("*.py")),
        "published": sum(tokens_of(path) for path in (ROOT / "results" / "published").rglob("*.py")),
    }
    assert {name: (tokens, limits[name]) for name, tokens in sizes.items() if tokens > limits[name]} == {}


@pytest.fixture(scope="module")
def trees():
    return {path.relative_to(PACKAGE).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}


def assigned(node):
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    for target in targets:
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        yield from (name.id for name in names if isinstance(name, ast.Name))


def test_a_class_or_constant_has_a_name_of_its_own(trees):
    files = defaultdict(set)
    for name, tree in trees.items():
        for node in tree.body:
            found = (
                [node.name] if isinstance(node, ast.ClassDef) else [n for n in assigned(node) if re.fullmatch("[A-Z][A-Z0-9_]+", n)]
            )
            for each in found:
                files[each].add(name)
    assert {name: sorted(where) for name, where in files.items() if len(where) > 1} == {}


def test_no_files_import_each_other_in_a_circle():
    """Imports inside of functions and for types alone count too."""
    graph = nx.DiGraph()
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(["neuspring", *(part for part in parts if part != "__init__")])
        if module != "neuspring":  # names of the api, imported when they are asked for
            graph.add_edges_from((module, other) for other in provenance.imported_modules(module) if other != module)
    assert [sorted(circle) for circle in nx.strongly_connected_components(graph) if len(circle) > 1] == []
