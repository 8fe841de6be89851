"""Every kernel of the package compiles for GPUs, also where there is none: machine code for two architectures, by NVRTC."""

import ast
from typing import Any

import pytest
import warp as wp

from neuspring.core.device import start_warp
from tests.support.cubin import resources
from tests.support.cuda_kernels import (
    ARCHITECTURES,
    CHOICES,
    FORWARD,
    PACKAGE,
    compile_for_gpus,
    declared,
    kernels,
    modules,
    variants,
)

LONG = {"neuspring.physics.frame"}
"""Modules that take half a minute."""
NO_KERNELS_HERE: set[str] = set()
"""Modules that name `wp.kernel` for the kernels of others."""


@pytest.mark.parametrize(
    "architecture", [ARCHITECTURES[0], *(pytest.param(one, marks=pytest.mark.slow) for one in ARCHITECTURES[1:])]
)
@pytest.mark.parametrize("module", [pytest.param(one, marks=pytest.mark.slow) if one in LONG else one for one in modules()])
def test_every_kernel_compiles_for_gpus(module, architecture, tmp_path):
    found, entries = kernels(module), {}
    for path in compile_for_gpus(found, tmp_path, (architecture,)):
        entries |= resources(path.read_bytes())
    assert entries.keys() == {kernel.get_mangled_name() + FORWARD for kernel in found.values()}
    assert all(0 < used.registers <= 255 and used.shared < 48 * 1024 for used in entries.values())


def test_no_module_that_makes_kernels_is_overlooked():
    makers = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            named = ast.unparse(node) in ("wp.kernel", "warp.kernel") if isinstance(node, ast.Attribute) else False
            imported = isinstance(node, ast.ImportFrom) and node.module == "warp" and any(a.name == "kernel" for a in node.names)
            if named or imported:
                makers.add(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
    assert makers - set(modules()) == NO_KERNELS_HERE


def test_kernels_are_found_in_text():
    text = """
import warp as wp
@wp.kernel(enable_backward=False)
def bare(): ...
@wp.func
def helper(): wp.tid()
if True:
    def factory(real):
        def inner(a):
            i = wp.tid()
        def other(a):
            for k in range(3):
                a[k] = float(wp.tid())
        def plain(a): ...
"""
    assert declared(text) == {"bare": {"bare"}, "factory": {"inner", "other"}}


def test_factories_are_asked_for_every_variant(monkeypatch):
    def with_switch(real: Any, batched: bool): ...

    def with_number(real: Any, columns: int): ...

    both = (wp.float32, wp.float64)
    assert set(variants("m.with_switch", with_switch)) == {(real, batched) for real in both for batched in (False, True)}
    with pytest.raises(AssertionError, match="takes `columns`: say in CHOICES"):
        variants("m.with_number", with_number)
    monkeypatch.setitem(CHOICES, "columns", (8,))
    assert variants("m.with_number", with_number) == [(real, 8) for real in both]


MODULE = """
import warp as wp
def kernels(real):
    def first(values: wp.array(dtype=real)):
        values[wp.tid()] = real(1.0)
    def second(values: wp.array(dtype=real)):
        values[wp.tid()] = real(2.0)
    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(first), {"second": unique(second)}
"""


def test_a_kernel_that_its_factory_keeps_is_an_error(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "module_that_gives.py").write_text(MODULE)
    assert list(kernels("module_that_gives")) == ["first float32", "second float32", "first float64", "second float64"]
    (tmp_path / "module_that_hides.py").write_text(MODULE.replace(", {", "  # {"))
    with pytest.raises(AssertionError, match=r"does not give out \['second'\]"):
        kernels("module_that_hides")


@wp.func_native("this is not C++;")
def nonsense(value: float) -> float: ...


def test_a_kernel_that_a_gpu_cannot_run_fails(tmp_path, capfd):
    start_warp()

    @wp.kernel(module="unique", enable_backward=False)
    def wrong(values: wp.array(dtype=float)):
        i = wp.tid()
        values[i] = nonsense(values[i])

    with pytest.raises(Exception, match="build failed"):
        compile_for_gpus({"wrong": wrong}, tmp_path)
    assert "error" in capfd.readouterr().err
