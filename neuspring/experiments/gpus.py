"""GPUs of this machine and their leases: which devices a job may use, so that no two jobs meet on one.

A slot is a file that its holder keeps locked. The kernel frees it when the holder dies, so there are no stale leases. Slots are
handed out under one short lock, all that a job needs or none, so that two jobs cannot wait for each other. The files lie in a
folder of this machine.

The jobs of one run of the workflow also share notes, a file that names the devices that failed a job. Without it each job would
fail on such a device at once and leave it free for the next one.
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
"""What it calls a device."""
LOCKS = "NEUSPRING_GPU_LOCKS"
"""Environment: the folder of the slots. Users who share GPUs set it to one folder that all of them can write to."""
SLOT_POLL = 0.05
"""s between two looks for a free slot."""
NOTES = "gpus.txt"
"""The file of notes among the records of jobs."""
LOST_GPU, SUSPECT_GPU, WORKS = "lost", "suspect", "works"
"""Words of notes. Suspect: the job itself may have caused the error on a sound device."""
LOST = re.compile(
    r"GPU is lost|GPU requires reset|fallen off the bus|no CUDA-capable device|No CUDA GPUs are available|has 0 CUDA devices|ECC",
    re.I,
)
SUSPECT = re.compile(
    r"CUDA.*(unspecified launch failure|launch timed out|unknown error|illegal memory access|unavailable|LAUNCH_TIMEOUT)", re.I
)


def failure_of(error: str) -> str:
    """What an error says of the job's devices: LOST_GPU, SUSPECT_GPU, or nothing."""
    return LOST_GPU if LOST.search(error) else SUSPECT_GPU if SUSPECT.search(error) else ""


def pool_of(settings: Gpus, device: str, *, plan_only: bool = False) -> tuple[str, ...]:
    """The GPUs of this machine that jobs may use; none on a CPU. Raises InputError for one that is not there or not allowed.

    `plan_only`: a plan for other machines may be made where there is no GPU.
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
        raise InputError("configuration, gpus.devices", "must be GPUs that this run may use", value, f"Correct it, or {VISIBLE}.")
    if device == "cuda" and not chosen and not plan_only:
        rule, remedy = "device: cuda requires a GPU that this run may use", f"Use device: cpu or auto, or correct {VISIBLE}."
        raise InputError("configuration, device", rule, device, remedy)
    return chosen


def slots_of(pool: Sequence[str], jobs_per_gpu: int, limit: int | None) -> int:
    """Number of jobs that may hold a GPU at once: all slots, or `limit` (--resources gpu=...). Raises InputError."""
    slots = len(pool) * jobs_per_gpu
    if limit is not None and not (pool or limit == 0):
        raise InputError("--resources gpu", "this run has no GPU", limit, "Leave it out, or set device: cuda where there is one.")
    if limit is None or not pool:
        return slots
    if not 1 <= limit <= slots:
        rule = f"must be 1 to {slots} ({len(pool)} GPUs, gpus.jobs_per_gpu {jobs_per_gpu})"
        raise InputError("--resources gpu", rule, limit, "Leave it out to use all. Use device: cpu for none.")
    return limit


def names_of(devices: Sequence[str]) -> list[str]:
    """Names of devices, of those that NVML knows."""
    found = list[str]()
    if not devices:
        return found
    with nvml() as library:
        for device in devices if library else ():
            with contextlib.suppress(Exception):  # a MIG slice has no name of its own
                found.append(str(library.nvmlDeviceGetName(handle_of(library, device))))
    return found


def failures(notes: Path | None) -> dict[str, str]:
    """Device -> LOST or SUSPECT, the newest failure last; a device on which a job succeeded since has no entry.

    Read from notes, a line per failure or success; none where there are no notes.
    """
    found: dict[str, str] = {}
    with contextlib.suppress(OSError):
        for line in notes.read_text(encoding="utf-8").splitlines() if notes else ():
            failure, _, device = line.partition(" ")
            found.pop(device, None)
            if failure in (LOST_GPU, SUSPECT_GPU):
                found[device] = failure
    return found


@dataclass(frozen=True)
class Lease:
    """GPUs held until `release`, or until this process and those that inherited `files` have ended."""

    devices: tuple[str, ...]
    """As in CUDA_VISIBLE_DEVICES."""
    files: tuple[IO[str], ...]
    waited: float
    """s."""
    notes: Path | None = None
    """The file that the jobs of a run share."""

    def environment(self) -> dict[str, str]:
        """Variables with which a command sees these devices alone, numbered as nvidia-smi does."""
        return {VISIBLE: ",".join(self.devices), "CUDA_DEVICE_ORDER": "PCI_BUS_ID"}

    def note(self, outcome: str) -> None:
        """Note for later jobs that these devices failed (LOST_GPU, SUSPECT_GPU) or work (WORKS). Raises OSError."""
        if self.notes is None or (outcome == WORKS and not failures(self.notes).keys() & set(self.devices)):
            return
        with self.notes.open("a", encoding="utf-8") as file:
            file.write("".join(f"{outcome} {device}\n" for device in self.devices))

    def release(self) -> None:
        """Give the slots back."""
        for file in self.files:
            file.close()


def lock_folder() -> Path:
    """Folder of the slots; made if it is missing. Raises InputError if it cannot be used."""
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
        # As CUDA does, up to the first entry that names no device: -1, nothing, or Slurm's NoDevFiles.
        return tuple(itertools.takewhile(DEVICE.match, map(str.strip, environment[VISIBLE].split(","))))
    with nvml() as library:
        return tuple(map(str, range(library.nvmlDeviceGetCount()))) if library else ()


def handle_of(library: Any, device: str) -> Any:
    """NVML's handle of a device given by index or UUID."""
    return library.nvmlDeviceGetHandleByIndex(int(device)) if device.isdigit() else library.nvmlDeviceGetHandleByUUID(device)


def _slot_names(pool: Sequence[str]) -> dict[str, str]:
    """Device -> the name of its slots: its UUID, so that index and UUID mean one device; as given where NVML knows none."""
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
    """Hold `count` different devices of `pool`; waits until they are free.

    Devices without a job come before shared ones. `say` is told once that we wait, and which devices are passed over because of
    `notes`. Raises InputError if the pool, or what is left of it, is too small; TimeoutError.
    """
    if count > len(pool):
        rule = f"a job needs {count} GPUs, more than there are"
        raise InputError("GPUs", rule, f"{len(pool)} ({', '.join(pool) or 'none'})", "Ask for fewer, or allow more.")
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
                # Read anew each time: a device may fail while we wait for it.
                failed = failures(notes)
                devices = _usable(count, pool, failed)
                slots = _take(count, [(device, names[device]) for device in devices], jobs_per_gpu, folder)
        except OSError as error:
            raise _unusable(folder, error) from error
        if passed := [f"GPU {device} ({failed[device]})" for device in pool if device not in devices]:
            say_once(f"passed over: {', '.join(passed)}")
        waited = time.monotonic() - start
        if slots:
            return Lease(tuple(slots), tuple(slots.values()), waited, notes)
        if waited > timeout:
            raise TimeoutError(f"no {count} of the GPUs {', '.join(pool)} became free within {timeout:.0f} s")
        say_once(f"waiting for {count} of the GPUs {', '.join(pool)}")
        time.sleep(SLOT_POLL)


def _usable(count: int, pool: Sequence[str], failed: Mapping[str, str]) -> list[str]:
    """The devices that a job may take, best first: those without a failure, then suspects, the oldest failure first.

    A suspect is the last choice and no error: one bad job must not stop all others. Too few devices that are not lost are an error:
    waiting would not bring one back. Raises InputError.
    """
    devices = [device for device in pool if device not in failed]
    if len(devices) < count:
        devices += [device for device, failure in failed.items() if device in pool and failure == SUSPECT_GPU]
    if len(devices) < count:
        lost = ", ".join(f"GPU {device} (lost)" for device in pool if failed.get(device) == LOST_GPU)
        remedy = (
            "Look at nvidia-smi. Reset a GPU that it does not show as working (nvidia-smi --gpu-reset), or restart the machine. "
            "Then start the same command again, or let gpus.devices name other GPUs."
        )
        raise InputError("GPUs", f"a job needs {count} of the GPUs {', '.join(pool)}, and too few are left", lost, remedy)
    return devices


def _take(count: int, devices: Sequence[tuple[str, str]], jobs_per_gpu: int, folder: Path) -> dict[str, IO[str]]:
    """Lock a slot of `count` of the (device, name), best first: device -> its file; empty, and none locked, if too few are free."""
    slots: dict[str, IO[str]] = {}
    for slot, (device, name) in itertools.product(range(jobs_per_gpu), devices):
        if len(slots) < count and device not in slots and (file := try_lock(folder / f"{name}.{slot}.lock")):
            slots[device] = file
    if len(slots) == count:
        return slots
    for file in slots.values():
        file.close()
    return {}
