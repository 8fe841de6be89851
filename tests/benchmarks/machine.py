"""What a machine is, for a table that is to be compared with others of the same kind."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

import numpy as np
import torch
import warp as wp

from neuspring.core.provenance import commit


def facts() -> dict[str, str | int]:
    """Processor, GPU, versions and the commit. Nothing that names the machine."""
    processor = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    return {
        "cpu": entry(processor, "model name") or platform.machine(),
        "cpu_model": entry(processor, "model"),
        "cpu_flags": len(entry(processor, "flags").split()),
        "cores": os.cpu_count() or 1,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "warp": wp.__version__,
        "commit": commit(),
    }


def entry(text: str, name: str) -> str:
    """The first value of a name in a text of lines `name : value`; empty where there is none."""
    found = re.search(rf"^{re.escape(name)}\s*:\s*(.*)$", text, re.MULTILINE)
    return found.group(1).strip() if found else ""


def kind(machine: dict[str, str | int]) -> str:
    """A file name for machines that should take the same time: processor, cores and GPU."""
    cpu = str(machine["cpu"]).replace("(R)", "").replace("(TM)", "")
    words = f"{cpu} {machine['cpu_model']} {machine['cores']} cores {machine['gpu']}"
    return re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
