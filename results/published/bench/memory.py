"""Peaks of memory: of the process on Linux, of torch's tensors on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch


def resident_mib() -> float:
    """Resident memory now, MiB."""
    return _status("VmRSS")


def growth(run: Callable[[], object], device: str = "cpu") -> float:
    """How far memory rises while `run` runs, MiB."""
    if device == "cpu":
        # Count the peak from now on.
        Path("/proc/self/clear_refs").write_text("5")
        before = resident_mib()
        run()
        return _status("VmHWM") - before
    torch.cuda.reset_peak_memory_stats(device)
    held = torch.cuda.memory_allocated(device)
    run()
    return (torch.cuda.max_memory_allocated(device) - held) / 2**20


def _status(name: str) -> float:
    return float(Path("/proc/self/status").read_text().split(f"{name}:")[1].split()[0]) / 1024
