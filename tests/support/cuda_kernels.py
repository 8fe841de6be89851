"""Every Warp kernel of the package, found in its source, and compiled for GPUs that need not be there.

A kernel is a function that asks for its thread (`wp.tid()`) or that `wp.kernel` decorates. It stands at the top of its module, or
in a factory, a function that takes the scalar type and returns kernels. Nothing is registered: a new kernel is found by its text.
"""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import warp as wp

import neuspring
from neuspring.core.device import start_warp

PACKAGE = Path(neuspring.__file__).parent
ARCHITECTURES = (80, 90)
"""A100 and H100, as compute capability x 10."""
CHOICES: dict[str, tuple[Any, ...]] = {"real": (wp.float32, wp.float64), "width": (1,)}
"""What factories are asked for, by the name of the parameter. On a GPU a thread has one lane (neuspring/physics/arrays.py)."""
FORWARD = "_cuda_kernel_forward"
"""What Warp adds to a kernel's mangled name in machine code."""
Function = ast.FunctionDef | ast.AsyncFunctionDef


def declared(text: str) -> dict[str, set[str]]:
    """Names of the kernel functions in a module's text, by the top-level function that they are or stand in."""
    found: dict[str, set[str]] = {}
    for top in _functions(ast.parse(text)):
        names = {f.name for f in [top, *(node for node in ast.walk(top) if isinstance(node, Function))] if _is_kernel(f)}
        if names:
            found[top.name] = names
    return found


def _functions(tree: ast.AST) -> Iterator[Function]:
    """Functions outside of other functions: at the top, in branches and in classes."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Function):
            yield node
        else:
            yield from _functions(node)


def _is_kernel(function: Function) -> bool:
    words = [ast.unparse(decorator).partition("(")[0].rpartition(".")[2] for decorator in function.decorator_list]
    if words:
        return "kernel" in words
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == "tid":
            return True
        # A nested function is a kernel of its own.
        if not isinstance(node, Function):
            pending += ast.iter_child_nodes(node)
    return False


@functools.cache
def modules() -> tuple[str, ...]:
    """Modules of the package with kernels."""
    paths = sorted(path for path in PACKAGE.rglob("*.py") if declared(path.read_text(encoding="utf-8")))
    return tuple(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths)


def kernels(module: str) -> dict[str, Any]:
    """The kernels of a module by "function" or "function float32", those of factories in all their variants.

    Raises AssertionError if a kernel in its text is not among them.
    """
    start_warp()
    loaded = importlib.import_module(module)
    found: dict[str, Any] = {}
    for top, names in declared(inspect.getsource(loaded)).items():
        holder, made = getattr(loaded, top), {}
        if isinstance(holder, wp.Kernel):
            made[top] = holder
        else:
            for arguments in variants(f"{module}.{top}", holder):
                made |= {" ".join([k.func.__name__, *_words(holder, arguments)]): k for k in _flat(holder(*arguments))}
        missing = names - {kernel.func.__name__ for kernel in made.values()}
        assert not missing, f"{module}.{top} does not give out {sorted(missing)}: return them, or let `kernels` find them"
        found |= made
    return found


def variants(name: str, factory: Any) -> list[tuple[Any, ...]]:
    """Every set of arguments of a factory: all choices of each parameter, both values of a switch."""
    choices: list[tuple[Any, ...]] = []
    for parameter in inspect.signature(factory).parameters.values():
        switch = (False, True) if parameter.annotation in (bool, "bool") else ()
        found = CHOICES.get(parameter.name, switch)
        assert found, f"{name} takes `{parameter.name}`: say in CHOICES of {__name__} what a GPU asks for"
        choices.append(found)
    return list(itertools.product(*choices))


def _words(factory: Any, arguments: tuple[Any, ...]) -> list[str]:
    """A factory's arguments in words: a type by its name, others with their parameter's."""
    names = inspect.signature(factory).parameters
    return [getattr(value, "__name__", f"{name} {value}") for name, value in zip(names, arguments, strict=True)]


def _flat(made: Any) -> Iterator[Any]:
    """The kernels in what a factory returned."""
    if isinstance(made, wp.Kernel):
        yield made
    elif isinstance(made, Mapping):
        yield from _flat(tuple(made.values()))
    elif isinstance(made, tuple | list):
        for part in made:
            yield from _flat(part)


def compile_for_gpus(found: Mapping[str, Any], folder: Path, architectures: tuple[int, ...] = ARCHITECTURES) -> list[Path]:
    """Compile kernels to machine code, a file (a cubin) per Warp module and architecture. NVRTC needs neither GPU nor driver."""
    paths: list[Path] = []
    for module in {id(kernel.module): kernel.module for kernel in found.values()}.values():
        paths += wp.compile_aot_module(module, arch=list(architectures), module_dir=folder, use_ptx=False)
    return paths
