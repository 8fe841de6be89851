"""Every kernel of the package compiles for GPUs, also where there is none: machine code for two architectures, by NVRTC."""

import ast

import pytest
import warp as wp

from neuspring.core.device import start_warp
from tests.support.cubin import resources
from tests.support.cuda_kernels import ARCHITECTURES, FORWARD, PACKAGE, compile_for_gpus, declared, kernels, modules

NO_KERNELS_HERE: set[str] = set()
"""Modules that name `wp.kernel` for the kernels of others."""


@pytest.mark.parametrize("module", modules())
def test_every_kernel_compiles_for_gpus(module, tmp_path):
    found = kernels(module)
    paths = compile_for_gpus(found, tmp_path)
    expected = {kernel.get_mangled_name() + FORWARD for kernel in found.values()}
    for architecture in ARCHITECTURES:
        entries = {}
        for path in paths:
            if f".sm{architecture}." in path.name:
                entries |= resources(path.read_bytes())
        assert entries.keys() == expected
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
