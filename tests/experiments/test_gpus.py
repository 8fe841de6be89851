"""Leases: one job per slot, no slot is lost to a crash, no slot is idle while a job waits."""

import contextlib
import functools
import multiprocessing
import multiprocessing.connection
import os
import random
import signal
import tempfile
import time
from pathlib import Path

import pynvml  # noqa: F401 - loaded once, not in each fork
import pytest

from neuspring.config.settings import Gpus
from neuspring.core.errors import InputError
from neuspring.core.lock import try_lock
from neuspring.experiments import gpus

EIGHT = tuple(map(str, range(8)))
FORK = multiprocessing.get_context("fork")


def hold_until_killed(folder, seconds):
    """Lease a device, note the beginning and the end of it in the journal of its slot, and end by SIGKILL."""
    lease = gpus.acquire(1, EIGHT, folder=folder)
    journal = os.open(folder / f"{os.path.basename(lease.files[0].name)}.journal", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(journal, f"{os.getpid()}\n".encode())
    time.sleep(seconds)
    # Both notes are written while the slot is held, so that those of two holders alternate only if both held it.
    os.write(journal, f"{os.getpid()}\n".encode())
    os.kill(os.getpid(), signal.SIGKILL)


def crowd(folder, durations, at_once):
    """Run a holder for each duration, s, `at_once` at a time; returns their exit codes and the journals of the slots."""
    # Started and awaited by one thread: two that wait for children can take each other's exit codes.
    waiting, running, ended = list(durations), [], []
    while waiting or running:
        while waiting and len(running) < at_once:
            running.append(FORK.Process(target=hold_until_killed, args=(folder, waiting.pop())))
            running[-1].start()
        multiprocessing.connection.wait([process.sentinel for process in running])
        alive = [process for process in running if process.is_alive()]
        ended += [process.exitcode for process in running if process not in alive]
        running = alive
    return ended, [path.read_text().split() for path in folder.glob("*.journal")]


@pytest.mark.parametrize("holders", [20, pytest.param(500, marks=pytest.mark.slow)])
def test_no_slot_is_given_twice_or_lost_when_holders_are_killed(tmp_path, holders):
    random_time = random.Random(0)
    ended, journals = crowd(tmp_path, [random_time.uniform(0.05, 0.1) for _ in range(holders)], at_once=16)
    assert ended == [-signal.SIGKILL] * holders
    assert sum(map(len, journals)) == 2 * holders
    assert all(journal[::2] == journal[1::2] for journal in journals)
    leases = [gpus.acquire(1, EIGHT, folder=tmp_path, timeout=5) for _ in EIGHT]
    assert sorted(lease.devices[0] for lease in leases) == list(EIGHT)


def test_two_jobs_of_two_devices_each_do_not_wait_for_each_other(tmp_path):
    for _ in range(8):
        together = [FORK.Process(target=take_two, args=(tmp_path,)) for _ in range(4)]
        for process in together:
            process.start()
        for process in together:
            process.join(30)
        assert [process.exitcode for process in together] == [0] * 4


def take_two(folder):
    gpus.acquire(2, ("0", "1"), folder=folder, timeout=20).release()


def test_several_jobs_share_a_device_only_where_that_is_allowed(tmp_path):
    first = [gpus.acquire(1, ("0", "1"), jobs_per_gpu=2, folder=tmp_path) for _ in range(4)]
    # Spread before shared.
    assert [lease.devices[0] for lease in first] == ["0", "1", "0", "1"]
    with pytest.raises(TimeoutError, match="fewer than 1 of the GPUs 0, 1 became free"):
        gpus.acquire(1, ("0", "1"), jobs_per_gpu=2, folder=tmp_path, timeout=0)
    first[2].release()
    assert gpus.acquire(1, ("0", "1"), jobs_per_gpu=2, folder=tmp_path, timeout=0).devices == ("0",)


def test_a_job_gets_all_its_devices_or_holds_none(tmp_path):
    one = gpus.acquire(1, ("0", "1"), folder=tmp_path)
    with pytest.raises(TimeoutError):
        gpus.acquire(2, ("0", "1"), folder=tmp_path, timeout=0)
    other = gpus.acquire(1, ("0", "1"), folder=tmp_path, timeout=0)
    assert {*one.devices, *other.devices} == {"0", "1"}
    with pytest.raises(InputError, match="the job requires 3 GPUs, more than this run may use; received 2"):
        gpus.acquire(3, ("0", "1"), folder=tmp_path)


def test_the_devices_that_the_user_allows_are_the_pool():
    assert gpus.visible_devices({gpus.VISIBLE: "2, GPU-1a"}) == ("2", "GPU-1a")
    assert gpus.visible_devices({gpus.VISIBLE: "MIG-2b,0,-1,1"}) == ("MIG-2b", "0")
    assert all(gpus.visible_devices({gpus.VISIBLE: none}) == () for none in ("", "-1", "NoDevFiles"))


@pytest.fixture
def run(tmp_path):
    """`acquire` as the jobs of one run of the workflow call it."""
    return functools.partial(gpus.acquire, folder=tmp_path, notes=tmp_path / "notes")


def fail_on(device, run, failure=gpus.LOST_GPU):
    """A job that fails by an error of its device."""
    lease = run(1, (device,), timeout=0)
    lease.note(failure)
    lease.release()


def test_a_lost_device_is_passed_over_and_not_waited_for(run):
    fail_on("0", run)
    messages = []
    lease = run(1, ("0", "1"), say=messages.append)
    assert lease.devices == ("1",)
    assert messages == ["skipped: GPU 0 (lost)"]
    # Device 0 has no holder; the next job waits for the other one all the same.
    with pytest.raises(TimeoutError):
        run(1, ("0", "1"), timeout=0)
    lease.release()
    assert run(1, ("0", "1"), timeout=0).devices == ("1",)


def test_too_few_devices_that_are_not_lost_are_an_error_and_no_endless_wait(run):
    fail_on("0", run)
    with pytest.raises(InputError, match=r"requires 2 working GPUs of 0, 1; received GPU 0 \(lost\).*nvidia-smi"):
        run(2, ("0", "1"))
    fail_on("1", run)
    with pytest.raises(InputError, match=r"received GPU 0 \(lost\), GPU 1 \(lost\)"):
        run(1, ("0", "1"))


def test_a_device_lost_while_others_wait_for_it_ends_their_wait(run):
    lease = run(1, ("0",))

    def lose(text):
        lease.note(gpus.LOST_GPU)
        lease.release()

    with pytest.raises(InputError, match="requires 1 working GPUs of 0"):
        run(1, ("0",), timeout=20, say=lose)


def test_a_job_s_own_errors_do_not_take_all_devices_from_the_others(run):
    fail_on("0", run, gpus.SUSPECT_GPU)
    second = run(1, ("0", "1"))
    assert second.devices == ("1",)
    with pytest.raises(TimeoutError):
        run(1, ("0", "1"), timeout=0)
    second.release()
    fail_on("1", run, gpus.SUSPECT_GPU)
    # None is beyond doubt: the one whose failure is longest ago comes first.
    first = run(1, ("1", "0"))
    assert first.devices == ("0",)
    first.note(gpus.WORKS)
    first.release()
    assert run(1, ("1", "0")).devices == ("0",)


@pytest.mark.parametrize(
    ("error", "failure"),
    [
        ("RuntimeError: CUDA error: unspecified launch failure", gpus.SUSPECT_GPU),
        ("Warp error: this machine has 0 CUDA devices", gpus.LOST_GPU),
        ("torch.OutOfMemoryError: CUDA out of memory", ""),
        ("ValueError: shapes differ", ""),
    ],
)
def test_an_error_says_whether_the_device_failed(error, failure):
    assert gpus.failure_of(error) == failure


@pytest.mark.parametrize(("pool", "limit", "slots"), [(("0", "1"), None, 4), (("0", "1"), 3, 3), ((), None, 0)])
def test_jobs_that_hold_a_gpu_at_once_are_all_slots_or_the_limit(pool, limit, slots):
    assert gpus.slots_of(pool, 2, limit) == slots


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gpus.slots_of(("0", "1"), 1, 3), "--resources gpu: must be 1 to 2"),
        (lambda: gpus.slots_of((), 1, 1), "--resources gpu: this run has no GPU"),
        (lambda: gpus.pool_of(Gpus(devices=(5,)), "auto"), r"gpus\.devices: must be GPUs that this run may use; received 5"),
        (lambda: gpus.pool_of(Gpus(), "cuda"), "device: device: cuda requires a GPU"),
    ],
)
def test_gpus_that_are_not_there_are_refused_before_any_job(call, message, monkeypatch):
    monkeypatch.setenv(gpus.VISIBLE, "0" if "devices" in message else "")
    with pytest.raises(InputError, match=message):
        call()
    assert gpus.pool_of(Gpus(), "cuda", plan_only=True) == gpus.visible_devices()


@pytest.mark.skipif(os.getuid() != 0, reason="acts as two users")
def test_two_users_share_devices(monkeypatch):
    # pytest's own folders are closed to other users.
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o1777)
        monkeypatch.setenv(gpus.LOCKS, folder)
        locks = Path(folder)
        for user, expected in ((1001, ("0",)), (1002, ("0",)), (1001, ("0",))):
            process = FORK.Process(target=lease_as, args=(user, expected))
            process.start()
            process.join(20)
            assert process.exitcode == 0, (user, expected)
        with try_lock(locks / "0.0.lock"):
            process = FORK.Process(target=lease_as, args=(1002, ("1",)))
            process.start()
            process.join(20)
            assert process.exitcode == 0


def lease_as(user, expected):
    """Lease a device as another user."""
    os.setuid(user)
    assert gpus.acquire(1, ("0", "1")).devices == expected


class Driver:
    """NVML of a machine with two GPUs."""

    def nvmlDeviceGetHandleByIndex(self, index):
        return index

    def nvmlDeviceGetHandleByUUID(self, name):
        return name.removeprefix("GPU-")

    def nvmlDeviceGetUUID(self, handle):
        return f"GPU-{handle}"


def test_index_and_uuid_of_a_device_are_one_slot(tmp_path, monkeypatch):
    monkeypatch.setattr(gpus, "nvml", lambda: contextlib.nullcontext(Driver()))
    lease = gpus.acquire(1, ("0",), folder=tmp_path)
    with pytest.raises(TimeoutError):
        gpus.acquire(1, ("GPU-0",), folder=tmp_path, timeout=0.1)
    lease.release()
