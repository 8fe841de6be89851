"""GPU leases: exclusive use of this machine's GPUs by jobs.

A slot is a lock file in a folder of this machine. The kernel releases the lock when its holder dies, so there are no stale
leases. A job gets all of its slots or none, under one short lock, so two jobs cannot deadlock.

The jobs of a workflow run also share a file of notes that names GPUs on which a job failed. Without it, a broken GPU would fail
one job after the other.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from neuspring.config.settings import Gpus
from neuspring.core.errors import InputError
from neuspring.core.lock import try_lock, wait_for_lock

VISIBLE = "CUDA_VISIBLE_DEVICES"
DEVICE = re.compile(r"\d+$|GPU-|MIG-")
"""An entry of CUDA_VISIBLE_DEVICES that names a device."""
LOCKS = "NEUSPRING_GPU_LOCKS"
"""Environment variable: folder of the slots. Users who share GPUs set it to one folder that all of them can write."""
SLOT_POLL = 0.05
"""Time between two attempts to get a slot, s."""
NOTES = "gpus.txt"
"""File of notes in the folder of job records."""
LOST_GPU, SUSPECT_GPU, WORKS = "lost", "suspect", "works"
"""Words of notes. Suspect: the job may have caused the error on a working device."""
LOST = re.compile(
    r"GPU is lost|GPU requires reset|fallen off the bus|no CUDA-capable device|No CUDA GPUs are available|has 0 CUDA devices|ECC",
    re.I,
)
SUSPECT = re.compile(
    r"CUDA.*(unspecified launch failure|launch timed out|unknown error|illegal memory access|unavailable|LAUNCH_TIMEOUT)", re.I
)


def failure_of(error: str) -> str:
    """Classify an error message: LOST_GPU, SUSPECT_GPU, or empty for other errors."""
    return LOST_GPU if LOST.search(error) else SUSPECT_GPU if SUSPECT.search(error) else ""


def pool_of(settings: Gpus, device: str, *, plan_only: bool = False) -> tuple[str, ...]:
    """The GPUs of this machine that jobs may use; empty for a CPU. Raises InputError for missing or disallowed GPUs.

    `plan_only`: with `device: cuda`, a machine without a GPU is not an error, because the plan may be for another machine.
    """
    if device == "cpu":
        return ()
    visible = visible_devices()
    chosen = visible if settings.devices == "all" else tuple(map(str, settings.devices))
    with nvml() as library:
        known = bool(library) or VISIBLE in os.environ
    missing = [name for name in chosen if name not in visible and name.isdigit()] if known else []
    if missing:
        value = f"{', '.join(missing)}; allowed: {', '.join(visible) or 'none'}"
        raise InputError("configuration, gpus.devices", "must be GPUs that this run may use", value, f"Correct it or {VISIBLE}.")
    if device == "cuda" and not chosen and not plan_only:
        rule, remedy = "device: cuda requires a GPU that this run may use", f"Use device: cpu or auto, or correct {VISIBLE}."
        raise InputError("configuration, device", rule, device, remedy)
    return chosen


def slots_of(pool: Sequence[str], jobs_per_gpu: int, limit: int | None) -> int:
    """Number of jobs that may hold a GPU at the same time: all slots, or `limit` (--resources gpu=...). Raises InputError."""
    slots = len(pool) * jobs_per_gpu
    if limit is not None and not (pool or limit == 0):
        raise InputError("--resources gpu", "this run has no GPU", limit, "Omit it, or set device: cuda on a machine with a GPU.")
    if limit is None or not pool:
        return slots
    if not 1 <= limit <= slots:
        rule = f"must be 1 to {slots} ({len(pool)} GPUs, gpus.jobs_per_gpu {jobs_per_gpu})"
        raise InputError("--resources gpu", rule, limit, "Omit it to use all GPUs. Use device: cpu to use none.")
    return limit


def names_of(devices: Sequence[str]) -> list[str]:
    """Product names of devices; devices unknown to NVML are left out."""
    names = list[str]()
    if not devices:
        return names
    with nvml() as library:
        for device in devices if library else ():
            with contextlib.suppress(Exception):  # a MIG slice has no name
                names.append(str(library.nvmlDeviceGetName(handle_of(library, device))))
    return names


def failures(notes: Path | None) -> dict[str, str]:
    """Device -> LOST_GPU or SUSPECT_GPU, newest failure last; a later success removes the entry.

    The notes contain one line per failure or success. Without notes, the result is empty.
    """
    failed: dict[str, str] = {}
    with contextlib.suppress(OSError):
        for line in notes.read_text(encoding="utf-8").splitlines() if notes else ():
            failure, _, device = line.partition(" ")
            failed.pop(device, None)
            if failure in (LOST_GPU, SUSPECT_GPU):
                failed[device] = failure
    return failed


@dataclass(frozen=True)
class Lease:
    """GPUs held until `release`, or until this process and all processes that inherited `files` have ended."""

    devices: tuple[str, ...]
    """As in CUDA_VISIBLE_DEVICES."""
    files: tuple[IO[str], ...]
    waited: float
    """Waiting time, s."""
    notes: Path | None = None
    """The file of notes of the workflow run."""

    def environment(self) -> dict[str, str]:
        """Environment variables with which a command sees only these devices, numbered as in nvidia-smi."""
        return {VISIBLE: ",".join(self.devices), "CUDA_DEVICE_ORDER": "PCI_BUS_ID"}

    def note(self, outcome: str) -> None:
        """Write to the notes that these devices failed (LOST_GPU, SUSPECT_GPU) or work (WORKS). Raises OSError."""
        if self.notes is None or (outcome == WORKS and not failures(self.notes).keys() & set(self.devices)):
            return
        with self.notes.open("a", encoding="utf-8") as file:
            file.write("".join(f"{outcome} {device}\n" for device in self.devices))

    def release(self) -> None:
        """Release the slots."""
        for file in self.files:
            file.close()


def lock_folder() -> Path:
    """Folder of the slots; created if it is missing. Raises InputError if it is not usable."""
    shared = os.environ.get(LOCKS)
    path = Path(shared or f"/var/tmp/neuspring-gpus-{os.getuid()}")
    try:
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not shared and path.lstat().st_uid != os.getuid():
            raise PermissionError(f"{path} belongs to another user")
        if not os.access(path, os.W_OK):
            raise PermissionError("not writable")
    except OSError as error:
        raise _unusable(path, error) from error
    return path


def _unusable(folder: Path, error: OSError) -> InputError:
    return InputError(folder, "the folder of GPU leases must be writable", error, f"Set {LOCKS} to another folder.")


@contextlib.contextmanager
def nvml() -> Iterator[Any]:
    """NVIDIA's management library, or None where there is no driver."""
    try:
        import pynvml

        pynvml.nvmlInit()
    except Exception:  # the package, the library or the driver is missing
        yield None
        return
    try:
        yield pynvml
    finally:
        pynvml.nvmlShutdown()


def visible_devices(environment: Mapping[str, str] = os.environ) -> tuple[str, ...]:
    """The usable GPUs: those of CUDA_VISIBLE_DEVICES; if it is not set, the indices of all GPUs of this machine."""
    if VISIBLE in environment:
        # As in CUDA, the list ends at the first entry that names no device: -1, an empty entry, or Slurm's NoDevFiles.
        return tuple(itertools.takewhile(DEVICE.match, map(str.strip, environment[VISIBLE].split(","))))
    with nvml() as library:
        return tuple(map(str, range(library.nvmlDeviceGetCount()))) if library else ()


def handle_of(library: Any, device: str) -> Any:
    """NVML's handle of a device given by index or UUID."""
    return library.nvmlDeviceGetHandleByIndex(int(device)) if device.isdigit() else library.nvmlDeviceGetHandleByUUID(device)


def _slot_names(pool: Sequence[str]) -> dict[str, str]:
    """Device -> name of its slots: the UUID, so that index and UUID share slots; without NVML, the given name."""
    names = {device: device for device in pool}
    with nvml() as library:
        for device in pool if library else ():
            with contextlib.suppress(Exception):  # a lost device, or a MIG name
                names[device] = str(library.nvmlDeviceGetUUID(handle_of(library, device)))
    return {device: re.sub(r"[^A-Za-z0-9-]", "_", name) for device, name in names.items()}


def acquire(
    count: int,
    pool: Sequence[str],
    *,
    jobs_per_gpu: int = 1,
    timeout: float = float("inf"),
    folder: Path | None = None,
    notes: Path | None = None,
    say: Callable[[str], object] = lambda text: None,
) -> Lease:
    """Lease `count` different devices of `pool`; waits until they are free.

    Idle devices are preferred to shared ones. `say` receives one message while waiting, and one for devices that are skipped
    because of `notes`. Raises InputError if too few devices are in the pool or working, and TimeoutError.
    """
    if count > len(pool):
        rule = f"the job requires {count} GPUs, more than this run may use"
        raise InputError("GPUs", rule, f"{len(pool)} ({', '.join(pool) or 'none'})", "Request fewer, or allow more.")
    folder = folder or lock_folder()
    gate, names = folder / "allocation.lock", _slot_names(pool)
    start, messages = time.monotonic(), set[str]()

    def say_once(text: str) -> None:
        if text not in messages:
            messages.add(text)
            say(text)

    while True:
        try:
            with wait_for_lock(gate):
                # Read in every iteration: a device may fail while this job waits.
                failed = failures(notes)
                devices = _usable(count, pool, failed)
                slots = _take(count, [(device, names[device]) for device in devices], jobs_per_gpu, folder)
        except OSError as error:
            raise _unusable(folder, error) from error
        if passed := [f"GPU {device} ({failed[device]})" for device in pool if device not in devices]:
            say_once(f"skipped: {', '.join(passed)}")
        waited = time.monotonic() - start
        if slots:
            return Lease(tuple(slots), tuple(slots.values()), waited, notes)
        if waited > timeout:
            raise TimeoutError(f"fewer than {count} of the GPUs {', '.join(pool)} became free within {timeout:.0f} s")
        say_once(f"waiting for {count} of the GPUs {', '.join(pool)}")
        time.sleep(SLOT_POLL)


def _usable(count: int, pool: Sequence[str], failed: Mapping[str, str]) -> list[str]:
    """The devices that a job may use, best first: those without a failure, then suspects, oldest failure first.

    Suspects remain usable, because one faulty job must not stop all others. Raises InputError if too few devices are not lost,
    because waiting does not bring lost devices back.
    """
    devices = [device for device in pool if device not in failed]
    if len(devices) < count:
        devices += [device for device, failure in failed.items() if device in pool and failure == SUSPECT_GPU]
    if len(devices) < count:
        lost = ", ".join(f"GPU {device} (lost)" for device in pool if failed.get(device) == LOST_GPU)
        remedy = (
            "Check nvidia-smi. Reset broken GPUs (nvidia-smi --gpu-reset) or restart the machine, then rerun the same command; "
            "or select other GPUs with gpus.devices."
        )
        raise InputError("GPUs", f"the job requires {count} working GPUs of {', '.join(pool)}", lost, remedy)
    return devices


def _take(count: int, devices: Sequence[tuple[str, str]], jobs_per_gpu: int, folder: Path) -> dict[str, IO[str]]:
    """Lock one slot on each of `count` of the (device, name) pairs, best first: device -> file; empty if too few are free."""
    slots: dict[str, IO[str]] = {}
    for slot, (device, name) in itertools.product(range(jobs_per_gpu), devices):
        if len(slots) < count and device not in slots and (file := try_lock(folder / f"{name}.{slot}.lock")):
            slots[device] = file
    if len(slots) == count:
        return slots
    for file in slots.values():
        file.close()
    return {}
