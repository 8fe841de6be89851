"""Registers and memory of every kernel on GPUs, from machine code, without a GPU: `python -m tests.benchmarks.kernel_resources`."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path

import warp as wp

from tests.support.cubin import Resources, resources
from tests.support.cuda_kernels import ARCHITECTURES, FORWARD, compile_for_gpus, kernels, modules

BLOCK = 256
"""Warp's threads per block."""


def table() -> str:
    """A row per kernel, in Markdown."""
    both = " / ".join(f"sm_{architecture}" for architecture in ARCHITECTURES)
    lines = [f"Warp {wp.__version__}, {both}, blocks of {BLOCK} threads.", ""]
    lines += ["| kernel | registers | local, B | shared, B | blocks |", "|---|---:|---:|---:|---:|"]
    for module in modules():
        lines.append(f"| **{module.removeprefix('neuspring.')}** | | | | |")
        found = kernels(module)
        taken = measure(found)
        for name, kernel in found.items():
            rows = [_row(*taken[architecture, kernel.get_mangled_name()]) for architecture in ARCHITECTURES]
            lines.append(f"| {name} | {' | '.join(' / '.join(map(str, cells)) for cells in zip(*rows, strict=True))} |")
    return "\n".join(lines) + "\n"


def _row(used: Resources, dynamic: int) -> tuple[int, int, int, int]:
    return used.registers, used.stack, used.shared + dynamic, blocks_by_registers(used.registers)


def measure(found: dict) -> dict[tuple[int, str], tuple[Resources, int]]:
    """Resources, and dynamic shared memory in bytes, by architecture and the kernel's mangled name."""
    taken = {}
    with tempfile.TemporaryDirectory() as folder:
        for path in compile_for_gpus(found, Path(folder)):
            stem, architecture = re.fullmatch(r"(.+)\.sm(\d+)\.cubin", path.name).groups()
            dynamic = json.loads((path.parent / f"{stem}.meta").read_text())
            for entry, used in resources(path.read_bytes()).items():
                taken[int(architecture), entry.removesuffix(FORWARD)] = (used, dynamic[f"{entry}_smem_bytes"])
    return taken


def blocks_by_registers(registers: int) -> int:
    """Blocks that the 65,536 registers of a multiprocessor hold; a warp takes multiples of 256. Its 2,048 threads are 8 blocks."""
    per_warp = -(-registers * 32 // 256) * 256
    return min(65536 // per_warp // (BLOCK // 32), 2048 // BLOCK)


if __name__ == "__main__":
    print(table())
