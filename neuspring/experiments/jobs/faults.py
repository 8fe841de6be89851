"""Why a command failed, and whether trying again can help.

The exit status and the end of the output decide: most causes (CUDA, the system's out-of-memory killer, a database) end a process
from outside Python.
"""

from __future__ import annotations

import errno
import re
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

CAUSE_LINES = 40
"""Lines of output that are searched for a cause."""
WARNING = re.compile(r"\s*warning\b", re.IGNORECASE)
"""A warning did not end the command, so it names no cause."""
BAD_INPUT = 2
"""Exit status of `neuspring` for input that it cannot use."""


@dataclass(frozen=True)
class Fault:
    """A cause of failure."""

    outcome: Literal["transient", "permanent", "killed"]
    cause: str
    remedy: str = ""
    device: Literal["", "suspect", "lost"] = ""
    """Meaning of the failure for the job's GPUs. suspect: an error of the job itself can look like this on a sound GPU."""


FULL = Fault("permanent", "no space left on the disk", "Free some space; the same command continues.")
READ_ONLY = Fault("permanent", "the file system is read-only", "Make it writable; the same command continues.")
GPU_MEMORY = Fault("transient", "out of GPU memory")
LOST_DEVICE = Fault("transient", "the GPU was lost or failed", device="lost")
FAILED_DEVICE = replace(LOST_DEVICE, device="suspect")
MEMORY = Fault("transient", "out of memory")
UNREACHABLE = Fault("transient", "a store or host could not be reached")
STORAGE = Fault("transient", "the storage failed")
INPUT = Fault("permanent", "bad input")
UNKNOWN_FAULT = Fault("permanent", "the program failed")
CRASH = Fault("transient", "the process crashed")
STOPPED = Fault("killed", "stopped from outside")
MISSING = Fault("permanent", "the command was not found", "Install it, or correct PATH.")
NOT_EXECUTABLE = Fault("permanent", "the command cannot be executed")

PATTERNS = (
    (r"no space left on device|disk quota exceeded|database or disk is full", FULL),
    (r"read-only file system", READ_ONLY),
    (r"cuda out of memory|OutOfMemoryError|CUDA_ERROR_OUT_OF_MEMORY|CUDA error 2: out of memory", GPU_MEMORY),
    (r"failed to allocate \d+ bytes on device 'cuda|CUBLAS_STATUS_ALLOC_FAILED", GPU_MEMORY),
    (
        r"GPU is lost|GPU requires reset|fallen off the bus|no CUDA-capable device is detected|No CUDA GPUs are available",
        LOST_DEVICE,
    ),
    (r"this machine has 0 CUDA devices|CUDA error(?: \d+)?: uncorrectable ECC|CUDA_ERROR_ECC_UNCORRECTABLE", LOST_DEVICE),
    (r"CUDA error(?: \d+)?: (unspecified launch failure|the launch timed out|unknown error)", FAILED_DEVICE),
    (r"CUDA error(?: \d+)?: (an illegal memory access|.*is/are busy or unavailable)", FAILED_DEVICE),
    (r"CUDA_ERROR_(DEVICE_UNAVAILABLE|LAUNCH_TIMEOUT|UNKNOWN)|all CUDA-capable devices are busy", FAILED_DEVICE),
    (r"MemoryError|Unable to allocate|cannot allocate memory|std::bad_alloc", MEMORY),
    (r"DefaultCPUAllocator: (can't|not enough memory)|can't start new thread|resource temporarily unavailable", MEMORY),
    (r"connection (refused|reset|timed out|aborted)|ConnectionError|RemoteDisconnected|could not connect", UNREACHABLE),
    (r"could not translate host name|name or service not known|temporary failure in name resolution", UNREACHABLE),
    (r"server closed the connection|too many clients|AdminShutdown|database is locked|TimeoutError|timed out", UNREACHABLE),
    (r"stale file handle|input/output error|transport endpoint is not connected", STORAGE),
)


def diagnose(status: int, output: Sequence[str]) -> Fault | None:
    """The cause of exit status `status` (negative: a signal), from the last lines of the output; None for success."""
    if status == 0:
        return None
    # A shell reports the signal that ended its command as 128 + n.
    number = -status if status < 0 else status - 128 if 128 < status < 160 else 0
    if number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        return STOPPED
    text = "\n".join(line for line in output[-CAUSE_LINES:] if not WARNING.match(line))
    for pattern, fault in PATTERNS:
        if re.search(pattern, text, re.IGNORECASE):
            return fault
    if status == BAD_INPUT:
        return INPUT
    if number == signal.SIGKILL:
        return Fault("transient", "killed by the system, most likely out of memory")
    if number:
        return Fault(CRASH.outcome, f"{CRASH.cause} ({signal.Signals(number).name})")
    return UNKNOWN_FAULT


def not_started(error: OSError) -> tuple[int, Fault]:
    """(exit status as a shell gives it, cause) of a command that could not be started."""
    if isinstance(error, FileNotFoundError):
        return 127, MISSING
    if error.errno in (errno.ENOMEM, errno.EAGAIN):
        return 1, MEMORY
    return 126, NOT_EXECUTABLE


def last_words(output: Sequence[str]) -> str:
    """The last line of the output that names an error, else the last line; shortened."""
    lines = [line.strip() for line in output if line.strip()]
    words = [line for line in lines if not WARNING.match(line)]
    errors = [line for line in words if "error" in line.lower() or "exception" in line.lower()]
    return (errors or lines or [""])[-1][:500]
