"""Time, memory and GPU use of a running command, sampled from outside."""

from __future__ import annotations

import contextlib
import resource
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

import psutil

from neuspring.experiments.jobs import gpus

INTERVAL, MOST = 1.0, 120
"""s between the first samples; the number of rows at which every second one is dropped and the interval doubles."""
MIB = 2**20


class Watch:
    """Samples a process tree and GPUs in a thread, for the length of a `with` block."""

    def __init__(self, pid: int, devices: Sequence[str]) -> None:
        self._pid, self._devices = pid, tuple(devices)
        self._rows: list[list[float | None]] = []
        self._peak = 0.0
        self._cpu: dict[int, float] = {}
        self._names: list[str] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def facts(self) -> dict[str, Any]:
        """The fields of an `Attempt` that describe the use of the machine. Call this after the block."""
        # Samples miss short peaks; the kernel remembers the peak of the largest ended process.
        largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / (1024 if sys.platform != "darwin" else MIB)
        shares = [row[3] for row in self._rows if row[3] is not None]
        memory = [row[4] for row in self._rows if row[4] is not None]
        return {
            "peak_memory_mb": round(max(self._peak, largest), 1),
            "cpu_seconds": round(sum(self._cpu.values()), 2),
            "samples": self._rows,
            "device_names": self._names,
            "peak_gpu_memory_mb": max(memory) if memory else None,
            "gpu_utilization": round(sum(shares) / len(shares), 1) if shares else None,
        }

    def _sample(self) -> None:
        start = last = time.monotonic()
        interval, before = INTERVAL, 0.0
        with gpus.nvml() if self._devices else contextlib.nullcontext() as library:
            handles = self._handles(library)
            while True:
                # A short first wait, so that jobs of a second are seen too.
                ended = self._stop.wait(interval if self._rows else 0.1)
                moment = time.monotonic()
                memory, cpu = self._tree()
                self._peak = max(self._peak, memory)
                share = 100 * (cpu - before) / max(moment - last, 1e-3)
                if not ended or not self._rows:
                    gpu = _gpu(library, handles)
                    self._rows.append([round(moment - start, 2), round(max(share, 0.0), 1), round(memory, 1), *gpu])
                last, before = moment, cpu
                if ended:
                    return
                if len(self._rows) >= MOST:
                    del self._rows[::2]
                    interval *= 2

    def _handles(self, library: Any) -> list[Any]:
        if library is None:
            return []
        handles = []
        for device in self._devices:
            with contextlib.suppress(Exception):  # a MIG slice: NVML does not measure it by this name
                handle = gpus.handle_of(library, device)
                self._names.append(str(library.nvmlDeviceGetName(handle)))
                handles.append(handle)
        return handles

    def _tree(self) -> tuple[float, float]:
        """(resident MiB, CPU seconds) of the process and its children. The seconds include ended children."""
        memory = 0.0
        with contextlib.suppress(psutil.Error):
            root = psutil.Process(self._pid)
            for process in (root, *root.children(recursive=True)):
                with contextlib.suppress(psutil.Error):
                    times = process.cpu_times()
                    self._cpu[process.pid] = times.user + times.system
                    memory += process.memory_info().rss / MIB
        return memory, sum(self._cpu.values())


def _gpu(library: Any, handles: Sequence[Any]) -> tuple[float | None, float | None]:
    """(mean utilization %, memory in use MiB) of the leased devices."""
    if not handles:
        return None, None
    try:
        rates = [library.nvmlDeviceGetUtilizationRates(handle).gpu for handle in handles]
        memory = [library.nvmlDeviceGetMemoryInfo(handle).used / MIB for handle in handles]
    except Exception:  # a device may be lost while it is watched; the command will say so
        return None, None
    return sum(rates) / len(rates), round(sum(memory), 1)
