"""Devices: start Warp, resolve the device setting, compile each kernel once for all processes.

This is the only module of the package that imports torch and Warp on import.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import warp as wp
from filelock import FileLock

from neuspring.core.errors import InputError

DEVICES = re.compile(r"auto|cpu|cuda(:\d+)?")
_loaded: set[tuple[int, str]] = set()
# Warp generates code for one module at a time per process, and fits that share launches run in threads.
_loading = threading.Lock()


@functools.cache
def start_warp() -> None:
    """Initialize Warp once, without its log and without automatic adjoints: the kernels of this package define their own."""
    wp.config.enable_backward = False
    # Warp logs every module that it loads.
    wp.config.log_level = logging.ERROR
    with _without_driver_warning():
        wp.init()


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Drop Warp's native message about a missing CUDA driver if torch finds no GPU either; forward everything else."""
    if torch.cuda.is_available():
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            caught.seek(0)
            for line in caught.read().decode(errors="replace").splitlines(keepends=True):
                if "NVIDIA CUDA driver" not in line:
                    sys.stderr.write(line)


def resolve_device(device: str) -> str:
    """`auto` -> `cuda:0` if CUDA works, else `cpu`. Raises InputError for unknown words and missing devices."""
    if not DEVICES.fullmatch(device):
        raise InputError("device", "must be auto, cpu, cuda or cuda:N", repr(device))
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    held = os.environ.get("CUDA_VISIBLE_DEVICES", "").strip()
    holds = held not in ("", "-1")
    # If CUDA does not find the GPU that this job holds, the GPU is lost. A torch without CUDA never finds one.
    lost = holds and bool(torch.version.cuda)
    if device == "cpu" or (device == "auto" and count == 0 and not lost):
        if device == "auto" and holds:
            _warn_of_idle_gpu(held)
        return "cpu"
    if not torch.version.cuda:
        raise InputError(
            "device", "the installed torch supports only the CPU", device, "Install its CUDA build, or use device: cpu."
        )
    index = int(device.partition(":")[2] or 0)
    if index >= count:
        raise InputError("device", f"this machine has {count} CUDA devices", device, "Use device: cpu or auto.")
    return f"cuda:{index}"


@functools.cache
def _warn_of_idle_gpu(held: str) -> None:
    """Warn once per process: the job may run for hours on the CPU and blocks a GPU."""
    print(
        f"warning: this job holds GPU {held} but runs on the CPU, because the installed torch supports only the CPU. "
        "Install the CUDA build of torch; with device: cuda this is an error.",
        file=sys.stderr,
        flush=True,
    )


def load(kernel: Any, device: Any) -> Any:
    """Compile and load a kernel on a device before its first launch; returns the kernel."""
    key = (id(kernel), str(device))
    if key not in _loaded:
        wp.init()
        assert wp.config.kernel_cache_dir, "Warp sets it when it starts"
        folder = Path(wp.config.kernel_cache_dir)
        folder.mkdir(parents=True, exist_ok=True)
        name = hashlib.sha256(f"{kernel.module.name} {kernel.key}".encode()).hexdigest()[:16]
        with _loading, FileLock(folder / f"{name}.lock"):
            wp.load_module(kernel.module, device=device)
        # Kernels live as long as the process: every module caches its kernels.
        _loaded.add(key)
    return kernel
