"""Every kernel of the package compiles for GPUs, also where there is none: machine code for two architectures, by NVRTC.

A module's kernels stand at its top, or are made by factories: functions of the scalar type, of a width of lanes, and of switches.
"""

import importlib
import inspect
import itertools
from pathlib import Path
from typing import Any

import pytest
import warp as wp

import neuspring
from neuspring.core.device import start_warp

PACKAGE = Path(neuspring.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if "wp.kernel" in path.read_text(encoding="utf-8")
)
LONG = {"neuspring.physics.frame", "neuspring.extensions.rods.solver"}
"""Modules that take minutes: each architecture compiles them for one of the scalar types."""
ARCHITECTURES = (80, 90)
"""A100 and H100, as compute capability x 10."""
CHOICES: dict[str, tuple[Any, ...]] = {"real": (wp.float32, wp.float64), "width": (1,)}
"""Arguments of factories by name of the parameter. On a GPU a thread has one lane (neuspring/physics/arrays.py)."""
FORWARD = "_cuda_kernel_forward"
"""Suffix that Warp adds to a kernel's mangled name in machine code."""


def variants(made: Any) -> list[tuple[Any, ...]]:
    """Every set of arguments of a factory: all choices of each parameter, both values of a switch; none where it is no factory."""
    parameters = inspect.signature(made).parameters.values() if inspect.isfunction(made) else ()
    if not any(parameter.name in CHOICES for parameter in parameters):
        return []
    switches = {parameter.name: (False, True) for parameter in parameters if parameter.annotation in (bool, "bool")}
    return list(itertools.product(*((CHOICES | switches)[parameter.name] for parameter in parameters)))


def kernels(module: str, patch: pytest.MonkeyPatch) -> list[wp.Kernel]:
    """Kernels of a module, those of factories in all their variants. Raises AssertionError if one in its text is not among them."""
    start_warp()
    loaded = importlib.import_module(module)
    members = list(vars(loaded).values())
    found = [member for member in members if isinstance(member, wp.Kernel) and member.func.__module__ == module]
    decorator = wp.kernel

    def recorded(*arguments: Any, **options: Any) -> Any:
        return lambda function: found.append(decorator(*arguments, **options)(function)) or found[-1]

    patch.setattr(wp, "kernel", recorded)
    for factory in (inspect.unwrap(member) for member in members if getattr(member, "__module__", "") == module):
        for arguments in variants(factory):
            factory(*arguments)
    text = inspect.getsource(loaded)
    threads = sum(inspect.getsource(code).count("wp.tid()") for code in {kernel.func.__code__ for kernel in found})
    assert threads == text.count("wp.tid()"), f"{module}: a kernel is made neither at the top nor by a function of {set(CHOICES)}"
    return found


def compiled(found: list[wp.Kernel], folder: Path, architecture: int) -> bytes:
    """Their machine code. NVRTC needs neither GPU nor driver."""
    paths: list[Path] = []
    for module in {id(kernel.module): kernel.module for kernel in found}.values():
        paths += wp.compile_aot_module(module, arch=[architecture], module_dir=folder, use_ptx=False)
    return b"".join(path.read_bytes() for path in paths)


@pytest.mark.parametrize(
    "architecture", [ARCHITECTURES[0], *(pytest.param(one, marks=pytest.mark.slow) for one in ARCHITECTURES[1:])]
)
@pytest.mark.parametrize("module", [pytest.param(one, marks=pytest.mark.slow) if one in LONG else one for one in MODULES])
def test_every_kernel_compiles_for_gpus(module, architecture, tmp_path, monkeypatch):
    if module in LONG:
        monkeypatch.setitem(CHOICES, "real", (CHOICES["real"][ARCHITECTURES.index(architecture)],))
    found = kernels(module, monkeypatch)
    code = compiled(found, tmp_path, architecture)
    assert found and all((kernel.get_mangled_name() + FORWARD).encode() in code for kernel in found)
