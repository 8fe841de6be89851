"""Leases: no two jobs on one slot, no slot lost to a crash, none idle while somebody waits."""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pynvml  # noqa: F401 - loaded once, not in each of 500 forks
import pytest

from neuspring.core.errors import InputError
from neuspring.experiments.jobs import gpus

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


@pytest.mark.parametrize("holders", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_no_slot_is_given_twice_or_lost_when_holders_are_killed(tmp_path, holders):
    draw = random.Random(0)
    ended, journals = crowd(tmp_path, [draw.uniform(0.05, 0.1) for _ in range(holders)], at_once=16)
    assert ended == [-signal.SIGKILL] * holders
    assert sum(map(len, journals)) == 2 * holders
    assert all(journal[::2] == journal[1::2] for journal in journals)
    held = [gpus.acquire(1, EIGHT, folder=tmp_path, timeout=5) for _ in EIGHT]
    assert sorted(lease.devices[0] for lease in held) == list(EIGHT)


def test_two_jobs_of_two_devices_each_do_not_wait_for_each_other(tmp_path):
    for _ in range(20):
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
    with pytest.raises(TimeoutError, match="no 1 of the GPUs 0, 1 became free"):
        gpus.acquire(1, ("0", "1"), jobs_per_gpu=2, folder=tmp_path, timeout=0)
    first[2].release()
    assert gpus.acquire(1, ("0", "1"), jobs_per_gpu=2, folder=tmp_path, timeout=0).devices == ("0",)


def test_a_job_gets_all_its_devices_or_holds_none(tmp_path):
    one = gpus.acquire(1, ("0", "1"), folder=tmp_path)
    with pytest.raises(TimeoutError):
        gpus.acquire(2, ("0", "1"), folder=tmp_path, timeout=0)
    other = gpus.acquire(1, ("0", "1"), folder=tmp_path, timeout=0)
    assert {*one.devices, *other.devices} == {"0", "1"}
    with pytest.raises(InputError, match="a job needs 3 GPUs, more than there are; received 2"):
        gpus.acquire(3, ("0", "1"), folder=tmp_path)


def test_jobs_of_a_scenario_return_to_its_device(tmp_path):
    for scenario in ("rope", "cloth"):
        gpus.acquire(1, (("0",) if scenario == "rope" else ("1",)), affinity=scenario, folder=tmp_path).release()
    cloth = gpus.acquire(1, ("0", "1"), affinity="cloth", folder=tmp_path)
    assert cloth.devices == ("1",)
    # A wish, not a condition: the other device is taken rather than waited for.
    assert gpus.acquire(1, ("0", "1"), affinity="cloth", folder=tmp_path, timeout=0).devices == ("0",)


def test_a_lease_outlives_its_wrapper_while_the_command_runs(tmp_path):
    lease = gpus.acquire(1, ("0",), folder=tmp_path)
    fd = lease.files[0].fileno()
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=[fd])
    lease.release()
    with pytest.raises(TimeoutError):
        gpus.acquire(1, ("0",), folder=tmp_path, timeout=0)
    child.communicate(b"\n")
    assert gpus.acquire(1, ("0",), folder=tmp_path, timeout=5).devices == ("0",)


def test_the_devices_that_the_user_allows_are_the_pool():
    assert gpus.visible_devices({gpus.VISIBLE: "2, GPU-1a"}) == ("2", "GPU-1a")
    assert gpus.visible_devices({gpus.VISIBLE: ""}) == ()
    assert gpus.visible_devices({gpus.VISIBLE: "-1"}) == ()


def test_a_folder_of_leases_that_cannot_be_used_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(gpus.LOCKS, str(tmp_path / "file"))
    with pytest.raises(InputError, match="Set NEUSPRING_GPU_LOCKS"):
        gpus.lock_folder()


def fail_on(device, folder, *, gone=True):
    """A job that is lost on a device."""
    lease = gpus.acquire(1, (device,), folder=folder, timeout=0)
    lease.lost(gone=gone)
    lease.release()


def test_a_lost_device_is_passed_over_and_not_waited_for(tmp_path):
    fail_on("0", tmp_path)
    told = []
    lease = gpus.acquire(1, ("0", "1"), affinity="rope", folder=tmp_path, passing=told.append)
    assert lease.devices == ("1",)
    assert [list(marks) for marks in told] == [["0"]]
    assert "lost at" in str(told[0]["0"]) and "tried again from" in str(told[0]["0"])
    # Device 0 has no holder; one waits for the other all the same.
    with pytest.raises(TimeoutError):
        gpus.acquire(1, ("0", "1"), folder=tmp_path, timeout=0)
    lease.release()
    assert gpus.acquire(1, ("0", "1"), folder=tmp_path, timeout=0).devices == ("1",)


@pytest.mark.parametrize(("boot", "age", "passed_over"), [("a", 60, True), ("b", 60, False), ("a", gpus.LOST_FOR + 60, False)])
def test_a_loss_counts_until_the_machine_starts_again_or_for_a_while(tmp_path, monkeypatch, boot, age, passed_over):
    start = tmp_path / "boot_id"
    start.write_text("a")
    monkeypatch.setattr(gpus, "BOOT", start)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now - age)
    fail_on("0", tmp_path)
    monkeypatch.setattr(time, "time", lambda: now)
    start.write_text(boot)
    assert gpus.acquire(1, ("0", "1"), folder=tmp_path).devices == (("1",) if passed_over else ("0",))


def test_a_device_that_works_again_is_no_longer_passed_over(tmp_path):
    fail_on("0", tmp_path)
    mark = next(tmp_path.glob("*.lost"))
    held = gpus.Lease(("0",), (), 0.0, (mark,))
    held.worked()
    assert gpus.acquire(1, ("0", "1"), folder=tmp_path).devices == ("0",)


def test_too_few_devices_that_are_not_lost_are_an_error_and_no_endless_wait(tmp_path):
    fail_on("0", tmp_path)
    with pytest.raises(
        InputError, match=r"a job needs 2 of the GPUs 0, 1, and too few are left; received GPU 0 \(lost at .*nvidia-smi"
    ):
        gpus.acquire(2, ("0", "1"), folder=tmp_path)
    fail_on("1", tmp_path)
    with pytest.raises(InputError, match=r"received GPU 0 \(lost at .*, GPU 1 \(lost at .*delete .*\*\.lost"):
        gpus.acquire(1, ("0", "1"), folder=tmp_path)
    for mark in tmp_path.glob("*.lost"):
        mark.unlink()
    assert gpus.acquire(1, ("0", "1"), folder=tmp_path).devices == ("0",)


def test_a_device_lost_while_others_wait_for_it_ends_their_wait(tmp_path):
    lease = gpus.acquire(1, ("0",), folder=tmp_path)

    def lose():
        lease.lost(gone=True)
        lease.release()

    with pytest.raises(InputError, match="too few are left"):
        gpus.acquire(1, ("0",), folder=tmp_path, timeout=20, waiting=lose)


def test_a_job_s_own_errors_do_not_take_all_devices_from_the_others(tmp_path):
    fail_on("0", tmp_path, gone=False)
    second = gpus.acquire(1, ("0", "1"), folder=tmp_path)
    assert second.devices == ("1",)
    with pytest.raises(TimeoutError):
        gpus.acquire(1, ("0", "1"), folder=tmp_path, timeout=0)
    second.release()
    fail_on("1", tmp_path, gone=False)
    # None is beyond doubt: the one whose failure is longest ago comes first.
    first = gpus.acquire(1, ("1", "0"), folder=tmp_path)
    assert first.devices == ("0",)
    first.worked()
    first.release()
    assert [gpus.acquire(1, ("1", "0"), folder=tmp_path).devices for _ in range(2)] == [("0",), ("0",)]


def test_of_two_jobs_on_a_lost_device_the_one_that_knows_is_believed(tmp_path):
    first, second = (gpus.acquire(1, ("0",), jobs_per_gpu=2, folder=tmp_path) for _ in range(2))
    first.lost(gone=True)
    second.lost(gone=False)
    with pytest.raises(InputError, match="too few are left"):
        gpus.acquire(1, ("0",), jobs_per_gpu=2, folder=tmp_path)


def test_a_damaged_mark_counts_for_nothing(tmp_path):
    for text in ("", "{", "[]", '{"time": "x"}'):
        (tmp_path / "0.lost").write_text(text)
        gpus.acquire(1, ("0",), folder=tmp_path, timeout=0).release()


@pytest.fixture
def private():
    before = os.umask(0o077)
    yield
    os.umask(before)


def mode(path):
    return path.stat().st_mode & 0o7777


@pytest.mark.usefixtures("private")
def test_a_folder_that_is_made_for_sharing_is_open_to_all_users_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "chmod", lambda *_: None)  # another user may come before it
    monkeypatch.setenv(gpus.LOCKS, str(tmp_path / "locks"))
    assert mode(gpus.lock_folder()) == 0o1777
    lease = gpus.acquire(1, ("0",))
    lease.lost(gone=True)
    assert {path.name: mode(path) for path in (tmp_path / "locks").iterdir()} == dict.fromkeys(
        ("allocation.lock", "names.json", "0.0.lock", "0.lost"), 0o666
    )
    assert os.umask(0o077) == 0o077, "the user's own files stay private"


def test_a_folder_that_was_there_keeps_its_rights(tmp_path, monkeypatch):
    (tmp_path / "locks").mkdir(mode=0o750)
    monkeypatch.setenv(gpus.LOCKS, str(tmp_path / "locks"))
    assert mode(gpus.lock_folder()) == 0o750


def test_another_user_s_file_is_opened_as_the_kernel_allows_it_in_a_shared_folder(tmp_path, monkeypatch):
    """With O_CREAT it does not, even where the file may be written to (fs.protected_regular, which is off on some machines)."""
    gpus.acquire(1, ("0",), folder=tmp_path).release()
    opened = []

    def watched(path, flags, *rest):
        opened.append(flags)
        return os_open(path, flags, *rest)

    os_open = os.open
    monkeypatch.setattr(os, "open", watched)
    gpus.acquire(1, ("0",), folder=tmp_path).release()
    assert opened and not any(flags & os.O_CREAT for flags in opened)


@pytest.mark.skipif(os.getuid() != 0, reason="acts as two users")
def test_two_users_share_devices(monkeypatch):
    # pytest's own folders are closed to other users.
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        monkeypatch.setenv(gpus.LOCKS, str(Path(folder) / "locks"))
        for user, expected in ((1001, ("0",)), (1002, ("1",)), (1001, ("1",))):
            process = FORK.Process(target=lose_as, args=(user, expected))
            process.start()
            process.join(20)
            assert process.exitcode == 0, (user, expected)


def lose_as(user, expected):
    """Lose device 0, if it is free to be lost, as another user with a private umask."""
    os.umask(0o077)
    os.setuid(user)
    lease = gpus.acquire(1, ("0", "1"))
    assert lease.devices == expected
    if expected == ("0",):
        lease.lost(gone=True)


class Driver:
    """NVML of a machine with two GPUs, of which those in `gone` have fallen off the bus."""

    gone: tuple[str, ...] = ()

    def nvmlDeviceGetHandleByIndex(self, index):
        if str(index) in self.gone:
            raise RuntimeError("GPU is lost")
        return index

    def nvmlDeviceGetUUID(self, handle):
        return f"GPU-{handle}"


def test_a_lost_device_keeps_its_name_where_the_driver_no_longer_tells_it(tmp_path, monkeypatch):
    driver = Driver()
    monkeypatch.setattr(gpus, "nvml", lambda: contextlib.nullcontext(driver))
    lease = gpus.acquire(1, ("0", "1"), folder=tmp_path)
    driver.gone = lease.devices
    lease.lost(gone=True)
    lease.release()
    passed = {}
    assert gpus.acquire(1, ("0", "1"), folder=tmp_path, passing=passed.update).devices == ("1",)
    assert list(passed) == ["0"]
    # Where NVML does not start at all, a slot that is held under one name is not free under another.
    monkeypatch.setattr(gpus, "nvml", lambda: contextlib.nullcontext(None))
    (other := tmp_path / "other").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(gpus, "nvml", lambda: contextlib.nullcontext(Driver()))
        second = gpus.acquire(1, ("0",), folder=other)
    with pytest.raises(TimeoutError):
        gpus.acquire(1, ("0",), folder=other, timeout=0.1)
    second.release()
