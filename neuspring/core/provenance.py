"""Provenance of results: a digest of the package modules that a stage uses, and the commit.

Snakemake does not notice changes in imported code. Each stage record therefore contains `code_digest(module)`, which the workflow
compares. The digest covers the syntax trees, without docstrings and comments, of the module and of all package modules that it
imports, directly or indirectly. Editing `twin/fit.py` repeats fits; editing a docstring or a table repeats no expensive step.

- Modules that are imported by name (backends, readers, baselines) are declared in `code` of `neuspring.stages.stage.Stage`.
- A module of another package in a registry counts with everything that it imports from its own package.
- A module without source counts with the version of its package.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions, version
from importlib.util import cache_from_source, find_spec, resolve_name
from pathlib import Path
from typing import NamedTuple

PACKAGE_NAME = "neuspring"
PACKAGE_FOLDER = Path(__file__).parents[1]
DECLARATIONS = tuple(
    f"{PACKAGE_NAME}.{name}."
    for name in ("config", "core.section", "core.text", "core.records", "core.run_record", "core.run_folder", "stages.stage")
)
"""Modules that are excluded from digests: declarations, records and progress, which change no number. Values of settings are
compared separately."""


FORMAT = b"1"
"""Version of the cached digests. Increase it when `_written` or `_names` change."""


def _root(package: str) -> Path | None:
    """The folder of a package, or the path of a single module without its suffix."""
    if package == PACKAGE_NAME:
        return PACKAGE_FOLDER
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return Path(spec.origin).parent if spec.submodule_search_locations else Path(spec.origin).with_suffix("")


@functools.cache
def _source(module: str) -> Path | None:
    package, *parts = module.split(".")
    if (root := _root(package)) is None:
        return None
    path = root.joinpath(*parts)
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def _tree(text: bytes) -> ast.Module:
    """The syntax tree of a module, without documentation."""
    tree = ast.parse(text)
    for node in _statements(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            # Every bare string is documentation: docstrings, and texts below fields and constants.
            node.body = [item for item in node.body if not _is_text(item)] or [ast.Pass()]
    return tree


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield a module and all statements in it. Skipping expressions, ten times as many nodes, speeds up each workflow start."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        # Exception handlers and match cases contain statements but are no `ast.stmt`.
        waiting += [
            item
            for values in vars(node).values()
            if isinstance(values, list)
            for item in values
            if isinstance(item, ast.stmt | ast.excepthandler | ast.match_case)
        ]


class ModuleCode(NamedTuple):
    """Digest and imports of a module."""

    digest: str
    """SHA-256 of the syntax tree without documentation."""
    names: tuple[str, ...]
    """Imported names, any of which may be a module."""


@functools.cache
def _code(module: str) -> ModuleCode:
    """Cached next to the module's bytecode if possible, because parsing takes longer than a small job."""
    path = _source(module)
    assert path is not None, module
    text = path.read_bytes()
    key = hashlib.sha256(FORMAT + text).hexdigest()
    cache = Path(cache_from_source(str(path))).with_suffix(".json")
    with contextlib.suppress(OSError, ValueError, TypeError):
        cached_key, digest, *names = json.loads(cache.read_text(encoding="utf-8"))
        if cached_key == key:
            return ModuleCode(digest, tuple(names))
    tree = _tree(text)
    code = ModuleCode(hashlib.sha256(_written(tree).encode()).hexdigest(), tuple(sorted(_names(module, path, tree))))
    if not sys.dont_write_bytecode:
        # A truncated file is not valid JSON, so it is written again.
        with contextlib.suppress(OSError):
            cache.parent.mkdir(exist_ok=True)
            cache.write_text(json.dumps([key, code.digest, *code.names]), encoding="utf-8")
    return code


def _names(module: str, path: Path, tree: ast.Module) -> set[str]:
    names: set[str] = set()
    here = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in _statements(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), here) if node.level else node.module or ""
            # In `from package import name`, `name` may be a module or an object of the package.
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return names


@functools.cache
def imported_modules(module: str) -> frozenset[str]:
    """Modules of neuspring and of the module's own package that `module` imports directly, at any position in its text."""
    if _source(module) is None:
        return frozenset()
    packages = {PACKAGE_NAME, module.partition(".")[0]} - {""}
    names = (name for name in _code(module).names if name.partition(".")[0] in packages and name != PACKAGE_NAME)
    return frozenset(name for name in names if _source(name) is not None)


def used_modules(module: str) -> list[str]:
    """`module` and all package modules that it imports, directly or indirectly, sorted."""
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting.extend(imported_modules(name))
    return sorted(seen)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


@functools.cache
def _module_code(module: str) -> bytes:
    if _source(module) is None:
        names = packages_distributions().get(module.partition(".")[0], [])
        return hashlib.sha256(" ".join(f"{name} {version(name)}" for name in names).encode()).digest()
    return bytes.fromhex(_code(module).digest)


def _written(value: object) -> str:
    """A syntax tree as text, without empty fields, which differ between versions of Python."""
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    if not isinstance(value, ast.AST):
        return repr(value)
    fields = ", ".join(f"{name}={_written(item)}" for name, item in ast.iter_fields(value) if item is not None and item != [])
    return f"{type(value).__name__}({fields})"


@functools.cache
def code_digest(*modules: str) -> str:
    """A short SHA-256 of the code that the given package modules use."""
    digest = hashlib.sha256()
    used = {name for module in modules for name in used_modules(module) if not f"{name}.".startswith(DECLARATIONS)}
    for name in sorted(used):
        digest.update(name.encode())
        digest.update(_module_code(name))
    return digest.hexdigest()[:16]


def image_stamps(folder: Path) -> str:
    """A digest of names, sizes and times of a capture's images and annotations, which detects changes by the user."""
    digest = hashlib.sha256()
    # Segmentation reads annotations as well as images; lifting reads controllers and nodes.
    files = [path for kind in ("color", "depth", "mask") for path in (folder / kind).rglob("*")]
    names = ["marks.json", "controllers.*", "nodes.*"]
    described = folder / "capture.json"
    if described.exists() and re.search(r'"tracks":\s*"train"', described.read_text(encoding="utf-8", errors="replace")):
        names.append("tracks.json")
    for path in sorted([*files, *(path for name in names for path in folder.glob(name))]):
        # A broken link must not stop planning: the step that reads it reports the error.
        facts = path.stat() if path.exists() else path.lstat()
        digest.update(f"{path.relative_to(folder)} {facts.st_size} {facts.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


SAMPLES, SAMPLE_BYTES = 64, 16_384


@functools.cache
def file_stamp(path: Path) -> str:
    """A digest of a user's file, independent of its times: of its content, or above 1 MB of its size and 64 samples."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as stream:
        if size <= SAMPLES * SAMPLE_BYTES:
            digest.update(stream.read())
        else:
            for place in range(SAMPLES):
                stream.seek(place * (size - SAMPLE_BYTES) // (SAMPLES - 1))
                digest.update(stream.read(SAMPLE_BYTES))
    return digest.hexdigest()[:16]


def commit() -> str:
    """The commit of the working copy that contains this package, with `-dirty` if it has changes; empty if unknown."""
    try:
        run = functools.partial(subprocess.run, cwd=PACKAGE_FOLDER.parent, capture_output=True, text=True, timeout=10, check=True)
        name = run(["git", "rev-parse", "HEAD"]).stdout.strip()
        changed = run(["git", "status", "--porcelain", "--untracked-files=no", "--", "."]).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
    return f"{name}-dirty" if changed else name
