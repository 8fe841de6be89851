"""Causes of failure: which are tried again."""

import signal

import pytest

from neuspring.experiments.jobs import faults


@pytest.mark.parametrize(
    ("status", "output", "outcome", "cause"),
    [
        (1, ["torch.OutOfMemoryError: CUDA out of memory. Tried to allocate 2.00 GiB"], "transient", "out of GPU memory"),
        (1, ["Warp CUDA error 2: out of memory (in function wp_alloc)"], "transient", "out of GPU memory"),
        (1, ["RuntimeError: CUDA error: device-side assert triggered"], "permanent", "the program failed"),
        (1, ["Warp CUDA error 719: unspecified launch failure (in function wp_launch)"], "transient", faults.LOST_DEVICE.cause),
        (1, ["RuntimeError: CUDA error: CUDA-capable device(s) is/are busy or unavailable"], "transient", faults.LOST_DEVICE.cause),
        (2, ["neuspring: error: device: this machine has 0 CUDA devices; received cuda."], "transient", faults.LOST_DEVICE.cause),
        (1, ["numpy._core._exceptions._ArrayMemoryError: Unable to allocate 9 GiB"], "transient", "out of memory"),
        (-signal.SIGTERM, ["OSError: connection refused"], "killed", "stopped from outside"),
        (1, ["warning: tracking: unreachable: Connection refused", "ValueError: no"], "permanent", "the program failed"),
        (-signal.SIGKILL, [], "transient", "killed by the system, most likely out of memory"),
        (137, [], "transient", "killed by the system, most likely out of memory"),
        (-signal.SIGSEGV, [], "transient", "the process crashed (SIGSEGV)"),
        (1, ["psycopg2.OperationalError: connection to server failed: Connection refused"], "transient", faults.UNREACHABLE.cause),
        (1, ["sqlite3.OperationalError: database is locked"], "transient", faults.UNREACHABLE.cause),
        (1, ["OSError: [Errno 28] No space left on device"], "permanent", "no space left on the disk"),
        (2, ["error: must be writable; received Read-only file system."], "permanent", faults.READ_ONLY.cause),
        (1, ["OSError: [Errno 116] Stale file handle"], "transient", "the storage failed"),
        (2, ["neuspring: error: x.npz: must be an artifact."], "permanent", "bad input"),
        (1, ["Traceback", "AssertionError"], "permanent", "the program failed"),
    ],
)  # fmt: skip
def test_the_cause_is_read_off_status_and_output(status, output, outcome, cause):
    fault = faults.diagnose(status, output)
    assert fault is not None
    assert (fault.outcome, fault.cause) == (outcome, cause)


@pytest.mark.parametrize(
    ("line", "device"),
    [
        ("RuntimeError: No CUDA GPUs are available", "lost"),
        ("neuspring: error: device: this machine has 0 CUDA devices; received cuda.", "lost"),
        ("RuntimeError: CUDA error: uncorrectable ECC error encountered", "lost"),
        ("Unable to determine the device handle for GPU0000:01:00.0: GPU is lost", "lost"),
        # A kernel of the job's own can end like these, on a GPU that is sound.
        ("RuntimeError: CUDA error: an illegal memory access was encountered", "suspect"),
        ("Warp CUDA error 719: unspecified launch failure (in function wp_launch)", "suspect"),
        ("torch.OutOfMemoryError: CUDA out of memory", ""),
        ("ValueError: no", ""),
    ],
)
def test_an_error_tells_whether_the_gpu_itself_is_lost(line, device):
    assert faults.diagnose(1, [line]).device == device


def test_success_is_no_fault_whatever_was_printed():
    assert faults.diagnose(0, ["CUDA out of memory (handled)"]) is None


def test_only_the_end_of_the_output_names_a_cause():
    long_ago = ["warning: Connection refused, trying again"] + ["epoch"] * faults.CAUSE_LINES + ["ValueError: no"]
    assert faults.diagnose(1, long_ago) == faults.UNKNOWN_FAULT


def test_last_words_are_the_error_or_else_the_last_line():
    assert faults.last_words(["ValueError: no\n", "  at exit\n", "\n"]) == "ValueError: no"
    assert faults.last_words(["one\n", "two\n"]) == "two"
    assert faults.last_words(["ValueError: no\n", "warning: on the CPU; cuda makes this an error\n"]) == "ValueError: no"
    assert faults.last_words([]) == ""
