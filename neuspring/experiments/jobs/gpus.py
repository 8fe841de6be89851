"""GPUs of this machine and their leases: which devices a job may use, without two jobs meeting on one.

A slot is a file that its holder keeps locked (flock): the kernel frees it when the holder dies, whatever the cause, so there are
no stale leases. Slots are handed out under one short lock, all that a job needs or none, so that two jobs cannot wait for each
other. The files lie in a folder of this machine (flock does not hold across machines).

A device on which a job was lost is marked there and passed over for a while: each job would fail on it at once and leave it free
for the next one, so that it would draw them all.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from neuspring.core.errors import InputError

VISIBLE = "CUDA_VISIBLE_DEVICES"
LOCKS = "NEUSPRING_GPU_LOCKS"
"""Environment: the folder of the slots; set it to a folder that all users of a machine can write to if they share GPUs."""
POLL = 0.05
"""s between two looks for a free slot."""
LOST_FOR = 1800.0
"""s for which a device is passed over after a job was lost on it: it may have been reset since; the next job will find out."""
BOOT = Path("/proc/sys/kernel/random/boot_id")
"""A restart of the machine resets its devices."""


@dataclass(frozen=True)
class Mark:
    """That a device was lost."""

    time: float
    """Unix time, s."""
    boot: str
    """Which start of the machine this was in; empty where it does not tell."""
    gone: bool
    """Whether the device itself was lost for certain. Otherwise the job may have brought the error about, on a sound device."""

    @classmethod
    def now(cls, *, gone: bool) -> Mark:
        """Of this moment."""
        return cls(time.time(), _boot(), gone)

    @classmethod
    def load(cls, path: Path) -> Mark | None:
        """The mark at `path`; None if there is none that still holds, or a disk that was full cut it short."""
        try:
            facts = json.loads(path.read_text(encoding="utf-8"))
            mark = cls(float(facts["time"]), str(facts["boot"]), bool(facts["gone"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None
        # A clock that was set back must not keep a device away for longer.
        return mark if mark.boot == _boot() and abs(time.time() - mark.time) < LOST_FOR else None

    def __str__(self) -> str:
        what = "lost" if self.gone else "failed a job"
        return f"{what} at {_clock(self.time)}, tried again from {_clock(self.time + LOST_FOR)}"


@dataclass(frozen=True)
class Lease:
    """GPUs held until `release`, or until this process and those that inherited `files` have ended."""

    devices: tuple[str, ...]
    """As in CUDA_VISIBLE_DEVICES."""
    files: tuple[IO[str], ...]
    waited: float
    """s."""
    marks: tuple[Path, ...] = ()
    """Where it is noted that a device was lost."""

    def environment(self) -> dict[str, str]:
        """What a command needs to see these devices alone, numbered as nvidia-smi does."""
        return {VISIBLE: ",".join(self.devices), "CUDA_DEVICE_ORDER": "PCI_BUS_ID"}

    def lost(self, *, gone: bool) -> None:
        """Note that a job was lost on these devices, before they are released; `gone` as in `Mark`. Raises OSError."""
        for path in self.marks:
            with _gate(path.parent), _open(path) as file:
                # Of several jobs on a device, one may have seen more plainly than this one what became of it.
                before = Mark.load(path)
                mark = Mark.now(gone=gone or (before is not None and before.gone))
                file.truncate()
                file.write(json.dumps(asdict(mark)))

    def worked(self) -> None:
        """Note that a job succeeded on these devices: whatever was said against them no longer holds. Raises OSError."""
        for path in self.marks:
            if path.exists() and path.stat().st_size:
                # Not removed: in a shared folder it may be another user's.
                with _gate(path.parent), _open(path) as file:
                    file.truncate()

    def release(self) -> None:
        """Give the slots back."""
        for file in self.files:
            file.close()


def lock_folder() -> Path:
    """Where slots lie; made if it is missing, one of `LOCKS` for all users. Raises InputError if it is not ours to use."""
    chosen = os.environ.get(LOCKS)
    path = Path(chosen) if chosen else Path("/var/tmp") / f"neuspring-gpus-{os.getuid()}"
    try:
        if chosen:
            _make_for_all(path)
        else:
            path.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not path.is_dir():
            raise NotADirectoryError("not a folder")
        if not chosen and (path.lstat().st_uid != os.getuid() or path.is_symlink()):
            raise PermissionError(f"{path} belongs to another user")
        if not os.access(path, os.W_OK):
            raise PermissionError("not writable")
    except OSError as error:
        raise _unusable(path, error) from error
    return path


def _unusable(folder: Path, error: OSError) -> InputError:
    return InputError(folder, "the folder of GPU leases must be writable", error, f"Set {LOCKS} to another folder.")


def _make_for_all(path: Path) -> None:
    """A folder like /tmp. One that is there already keeps the rights that it was given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        with _rights_for_all():  # in one step: another user may come by in the next moment
            path.mkdir(mode=0o1777)
        path.chmod(0o1777)  # where mkdir does not take the sticky bit


@contextlib.contextmanager
def _rights_for_all() -> Iterator[None]:
    """What is made meanwhile has the rights that it asks for, whatever this user keeps from others as a rule."""
    before = os.umask(0)
    try:
        yield
    finally:
        os.umask(before)


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


def _slot_names(pool: Sequence[str], folder: Path) -> dict[str, str]:
    """Device -> one name for it, whether it was given by index or by UUID.

    Of a device that is lost NVML tells no name. It keeps the one it had in this start of the machine, so that what is said against
    it still holds, and nobody takes it for another one; a MIG name, or an index that is not there, is taken as it was given.
    """
    told: dict[str, str] = {}
    with nvml() as library:
        for device in pool if library else ():
            with contextlib.suppress(Exception):
                told[device] = str(library.nvmlDeviceGetUUID(handle_of(library, device)))
    with _gate(folder), _open(folder / "names.json") as file:
        known = _names_of_this_boot(file.read())
        if told.items() - known.items():
            known |= told
            file.seek(0)
            file.truncate()
            file.write(json.dumps({"boot": _boot(), "names": known}))
    return {device: re.sub(r"[^A-Za-z0-9-]", "_", known.get(device, device)) for device in pool}


def _names_of_this_boot(text: str) -> dict[str, str]:
    try:
        facts = json.loads(text)
        return dict(facts["names"]) if facts["boot"] == _boot() else {}
    except (ValueError, KeyError, TypeError):
        return {}


def acquire(
    count: int,
    pool: Sequence[str],
    *,
    jobs_per_gpu: int = 1,
    affinity: str = "",
    timeout: float = float("inf"),
    folder: Path | None = None,
    waiting: Callable[[], object] = lambda: None,
    passing: Callable[[Mapping[str, Mark]], object] = lambda marks: None,
) -> Lease:
    """Hold `count` different devices of `pool`; waits until they are free, calling `waiting` once if it must.

    Of the free devices, one whose last holder had the same `affinity` (the scenario) comes first, then the least used: data
    and kernels of a scenario are then still in that device's caches. Devices that were lost are passed over, and `passing` is
    told which and since when. Raises InputError if the pool, or what is left of it, is too small; TimeoutError.
    """
    if count > len(pool):
        rule = f"a job needs {count} GPUs, more than there are"
        raise InputError("GPUs", rule, f"{len(pool)} ({', '.join(pool) or 'none'})", "Ask for fewer, or allow more.")
    folder = folder or lock_folder()
    try:
        names = _slot_names(pool, folder)
    except OSError as error:
        raise _unusable(folder, error) from error
    start, told = time.monotonic(), dict[str, Mark]()
    while True:
        try:
            with _gate(folder):
                # Anew each time: a device may be lost while we wait for it.
                usable, passed = _usable(count, names, folder)
                held = _take(count, usable, jobs_per_gpu, affinity, folder)
        except OSError as error:
            raise _unusable(folder, error) from error
        if passed != told:
            told = passed
            if told:
                passing(told)
        waited = time.monotonic() - start
        if held is not None:
            marks = tuple(_mark_path(folder, names[device]) for device, _ in held)
            return Lease(tuple(device for device, _ in held), tuple(file for _, file in held), waited, marks)
        if waited > timeout:
            raise TimeoutError(f"no {count} of the GPUs {', '.join(pool)} became free within {timeout:.0f} s")
        waiting()
        waiting = _nothing
        time.sleep(POLL)


def _nothing() -> None:
    pass


@dataclass(frozen=True)
class _Device:
    """One that a job may take."""

    device: str
    name: str
    """Of its slots."""
    suspect_since: float
    """0: nothing is known against it; otherwise the time of its mark."""


def _usable(count: int, names: Mapping[str, str], folder: Path) -> tuple[list[_Device], dict[str, Mark]]:
    """The devices that a job may take, and those that it must pass over. Raises InputError if too few are left.

    Too few is an error and no reason to wait: a lost device comes back when somebody sees to it, which nobody does who is not
    told. One on which a job failed by an error of the GPU, without a sign that it is gone, is the last choice, and no error:
    the error may have been the job's own, and one bad job must not stop all others.
    """
    found = {device: Mark.load(_mark_path(folder, name)) for device, name in names.items()}
    marks = {device: mark for device, mark in found.items() if mark}
    sound = [device for device in names if device not in marks]
    taken = sound if len(sound) >= count else [device for device in names if device not in marks or not marks[device].gone]
    if len(taken) < count:
        raise _too_few(count, names, marks, folder)
    since = {device: mark.time for device, mark in marks.items()}
    usable = [_Device(device, names[device], since.get(device, 0.0)) for device in taken]
    return usable, {device: mark for device, mark in marks.items() if device not in taken}


def _too_few(count: int, names: Mapping[str, str], marks: Mapping[str, Mark], folder: Path) -> InputError:
    gone = [f"GPU {device} ({mark})" for device, mark in marks.items() if mark.gone]
    remedy = (
        "Look at nvidia-smi. Reset what it does not show as working (nvidia-smi --gpu-reset), or restart the machine; if all work, "
        f"see that torch finds them. Then delete {folder}/*.lost and start again, or let gpus.devices name other GPUs."
    )
    return InputError("GPUs", f"a job needs {count} of the GPUs {', '.join(names)}, and too few are left", ", ".join(gone), remedy)


def _take(
    count: int, usable: Sequence[_Device], jobs_per_gpu: int, affinity: str, folder: Path
) -> list[tuple[str, IO[str]]] | None:
    """Lock one slot of each of the `count` best devices; None, and nothing held, if there are too few."""
    free: list[tuple[tuple[float, bool, int], str, IO[str]]] = []
    for one in usable:
        slots = [_locked(folder / f"{one.name}.{slot}.lock") for slot in range(jobs_per_gpu)]
        own = [file for file in slots if file]
        if own:
            known = bool(affinity) and any(file.read() == affinity for file in own)
            free.append(((one.suspect_since, not known, len(slots) - len(own)), one.device, own[0]))
        for file in own[1:]:
            file.close()
    # `sorted` is stable: of equal devices the first of the pool is taken.
    chosen = sorted(free, key=lambda entry: entry[0])[:count]
    for *_, file in free:
        if len(chosen) < count or all(file is not entry[2] for entry in chosen):
            file.close()
    if len(chosen) < count:
        return None
    for *_, file in chosen:
        file.seek(0)
        file.truncate()
        file.write(affinity)
        file.flush()
    return [(device, file) for _, device, file in chosen]


@contextlib.contextmanager
def _gate(folder: Path) -> Iterator[None]:
    """Nobody else looks at slots and marks meanwhile, or changes them."""
    with _open(folder / "allocation.lock") as gate:
        fcntl.flock(gate, fcntl.LOCK_EX)
        yield


def _locked(path: Path) -> IO[str] | None:
    file = _open(path)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def _open(path: Path) -> IO[str]:
    """For reading and writing; made for all users if it is missing.

    A file that is there is opened without O_CREAT: with that the kernel refuses, in a folder like /tmp, another user's file
    (fs.protected_regular).
    """
    return open(path, "r+", encoding="utf-8", opener=_open_or_make)


def _open_or_make(path: str, flags: int) -> int:
    flags |= os.O_NOFOLLOW
    while True:
        try:
            return os.open(path, flags)
        except FileNotFoundError:
            # Somebody else may make it at this moment.
            with contextlib.suppress(FileExistsError), _rights_for_all():
                return os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)


def _mark_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.lost"


def _boot() -> str:
    try:
        return BOOT.read_text().strip()
    except OSError:
        return ""


def _clock(moment: float) -> str:
    return f"{datetime.fromtimestamp(moment, UTC):%H:%M} UTC"
