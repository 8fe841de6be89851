"""Peak memory: of the process on Linux, of torch's tensors on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch


def resident_mib() -> float:
    """Current resident memory, MiB."""
    return _status("VmRSS")


def growth(run: Callable[[], object], device: str = "cpu") -> float:
    """Rise of memory during `run`, MiB."""
    if device == "cpu":
        # Resets the peak.
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
