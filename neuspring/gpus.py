"""GPUs of this machine and their leases: which devices a job may use, without two jobs meeting on one.

A slot is a file that its holder keeps locked (flock): the kernel frees it when the holder dies, whatever the cause, so there are
no stale leases. Slots are handed out under one short lock, all that a job needs or none, so that two jobs cannot wait for each
other. The files lie in a folder of this machine (flock does not hold across machines).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from neuspring.errors import InputError

VISIBLE = "CUDA_VISIBLE_DEVICES"
LOCKS = "NEUSPRING_GPU_LOCKS"
"""Environment: the folder of the slots; set it to a folder that all users of a machine can write to if they share GPUs."""
POLL = 0.05
"""s between two looks for a free slot."""


@dataclass(frozen=True)
class Lease:
    """GPUs held until `release`, or until this process and those that inherited `files` have ended."""

    devices: tuple[str, ...]
    """As in CUDA_VISIBLE_DEVICES."""
    files: tuple[IO[str], ...]
    waited: float
    """s."""

    def environment(self) -> dict[str, str]:
        """What a command needs to see these devices alone, numbered as nvidia-smi does."""
        return {VISIBLE: ",".join(self.devices), "CUDA_DEVICE_ORDER": "PCI_BUS_ID"}

    def release(self) -> None:
        """Give the slots back."""
        for file in self.files:
            file.close()


def lock_folder() -> Path:
    """Where slots lie; made if it is missing. Raises InputError if it is not ours to use."""
    chosen = os.environ.get(LOCKS)
    path = Path(chosen) if chosen else Path("/var/tmp") / f"neuspring-gpus-{os.getuid()}"
    try:
        path.mkdir(parents=True, exist_ok=True, mode=0o700 if chosen is None else 0o777)
        facts = path.lstat()
        if chosen is None and (facts.st_uid != os.getuid() or not path.is_dir() or path.is_symlink()):
            raise PermissionError(f"{path} belongs to another user")
        if not os.access(path, os.W_OK):
            raise PermissionError("not writable")
    except OSError as error:
        raise InputError(path, "the folder of GPU leases must be writable", error, f"Set {LOCKS} to another folder.") from error
    return path


@contextlib.contextmanager
def nvml() -> Iterator[Any]:
    """NVIDIA's management library, or None where there is no driver."""
    try:
        import pynvml

        pynvml.nvmlInit()
    except Exception:  # no package, no library, no driver: all mean that there is nothing to ask
        yield None
        return
    try:
        yield pynvml
    finally:
        pynvml.nvmlShutdown()


def visible_devices(environment: Mapping[str, str] = os.environ) -> tuple[str, ...]:
    """The GPUs that may be used: those of CUDA_VISIBLE_DEVICES, else all of this machine, as CUDA_VISIBLE_DEVICES takes them."""
    if VISIBLE in environment:
        return tuple(name.strip() for name in environment[VISIBLE].split(",") if name.strip() not in ("", "-1"))
    with nvml() as library:
        return tuple(map(str, range(library.nvmlDeviceGetCount()))) if library else ()


def handle_of(library: Any, device: str) -> Any:
    """NVML's handle of a device given by index or UUID."""
    return library.nvmlDeviceGetHandleByIndex(int(device)) if device.isdigit() else library.nvmlDeviceGetHandleByUUID(device)


def _slot_names(pool: Sequence[str]) -> dict[str, str]:
    """Device -> one name for it, whether it was given by index or by UUID."""
    names = {device: device for device in pool}
    with nvml() as library:
        for device in pool if library else ():
            with contextlib.suppress(Exception):  # a MIG name, or an index that is not there: take it as it was given
                names[device] = str(library.nvmlDeviceGetUUID(handle_of(library, device)))
    return {device: re.sub(r"[^A-Za-z0-9-]", "_", name) for device, name in names.items()}


def acquire(
    count: int,
    pool: Sequence[str],
    *,
    jobs_per_gpu: int = 1,
    affinity: str = "",
    timeout: float = float("inf"),
    folder: Path | None = None,
    waiting: Callable[[], object] = lambda: None,
) -> Lease:
    """Hold `count` different devices of `pool`; waits until they are free, calling `waiting` once if it must.

    Of the free devices, one whose last holder had the same `affinity` (the scenario) comes first, then the least used: data
    and kernels of a scenario are then still in that device's caches. Raises InputError if the pool is too small, TimeoutError.
    """
    if count > len(pool):
        rule = f"a job needs {count} GPUs, more than there are"
        raise InputError("GPUs", rule, f"{len(pool)} ({', '.join(pool) or 'none'})", "Ask for fewer, or allow more.")
    folder = folder or lock_folder()
    names = _slot_names(pool)
    start = time.monotonic()
    while True:
        with _open(folder / "allocation.lock") as gate:
            fcntl.flock(gate, fcntl.LOCK_EX)
            held = _take(count, names, jobs_per_gpu, affinity, folder)
        waited = time.monotonic() - start
        if held is not None:
            return Lease(tuple(device for device, _ in held), tuple(file for _, file in held), waited)
        if waited > timeout:
            raise TimeoutError(f"no {count} of the GPUs {', '.join(pool)} became free within {timeout:.0f} s")
        waiting()
        waiting = _nothing
        time.sleep(POLL)


def _nothing() -> None:
    pass


def _take(count: int, names: Mapping[str, str], jobs_per_gpu: int, affinity: str, folder: Path) -> list[tuple[str, IO[str]]] | None:
    """Lock one slot of each of the `count` best devices; None, and nothing held, if there are too few."""
    free: list[tuple[bool, int, str, IO[str]]] = []
    for device, name in names.items():
        slots = [_locked(folder / f"{name}.{slot}.lock") for slot in range(jobs_per_gpu)]
        own = [file for file in slots if file]
        if own:
            known = bool(affinity) and any(file.read() == affinity for file in own)
            free.append((not known, len(slots) - len(own), device, own[0]))
        for file in own[1:]:
            file.close()
    # `sorted` is stable: of equal devices the first of the pool is taken.
    chosen = sorted(free, key=lambda entry: entry[:2])[:count]
    for *_, file in free:
        if len(chosen) < count or all(file is not entry[3] for entry in chosen):
            file.close()
    if len(chosen) < count:
        return None
    for *_, file in chosen:
        file.seek(0)
        file.truncate()
        file.write(affinity)
        file.flush()
    return [(device, file) for *_, device, file in chosen]


def _locked(path: Path) -> IO[str] | None:
    file = _open(path)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def _open(path: Path) -> IO[str]:
    file = open(path, "a+", encoding="utf-8")  # noqa: SIM115 - the caller keeps it open as long as it holds the lock
    with contextlib.suppress(PermissionError):  # in a shared folder other users must be able to lock it too
        os.fchmod(file.fileno(), 0o666)
    file.seek(0)
    return file
