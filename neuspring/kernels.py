"""Warp kernels, compiled once however many processes start together: one compiles, the others wait and read Warp's cache."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Any

import warp as wp
from filelock import FileLock

_loaded: set[tuple[int, str]] = set()


def quiet() -> None:
    """Warp says nothing of modules that it loads, only of errors. Call this before it starts."""
    wp.config.log_level = logging.ERROR


def load(kernel: Any, device: Any) -> Any:
    """Compile and load a kernel on a device before it is launched; returns the kernel."""
    key = (id(kernel), str(device))
    if key not in _loaded:
        wp.init()
        assert wp.config.kernel_cache_dir, "Warp sets it when it starts"
        folder = Path(wp.config.kernel_cache_dir)
        folder.mkdir(parents=True, exist_ok=True)
        name = hashlib.sha256(f"{kernel.module.name} {kernel.key}".encode()).hexdigest()[:16]
        with FileLock(folder / f"{name}.lock"):
            wp.load_module(kernel.module, device=device)
        # Kernels live as long as the process: each module caches its own.
        _loaded.add(key)
    return kernel
