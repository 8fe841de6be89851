"""Leases: no two jobs on one slot, no slot lost to a crash, none idle while somebody waits."""

import fcntl
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pynvml  # noqa: F401 - loaded once, not in each of 500 forks
import pytest

from neuspring import gpus
from neuspring.errors import InputError

EIGHT = tuple(map(str, range(8)))
DYING = 0.03
"""s, far below the time for which slots are held here."""
FORK = multiprocessing.get_context("fork")


def hold(folder, jobs_per_gpu, seconds, crash, violations):
    """Lease a device, look whether its last holder still is there, sleep, and end by SIGKILL or in good order."""
    lease = gpus.acquire(1, EIGHT, jobs_per_gpu=jobs_per_gpu, folder=folder)
    # A holder locks a file of its own for its slot, so that another holder can see it.
    with open(folder / f"{os.path.basename(lease.files[0].name)}.holder", "a") as mark:
        if not locked(mark):
            # The kernel lets go of a killed process's files one by one; whoever is still there after this time is alive.
            time.sleep(DYING)
            if not locked(mark):
                violations.put(mark.name)
        time.sleep(seconds)
        if crash:
            os.kill(os.getpid(), signal.SIGKILL)
    lease.release()


def locked(file):
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def crowd(folder, jobs, at_once, seconds, crash, jobs_per_gpu=1):
    """Run `jobs` holders, `at_once` at a time; returns the number of those that found a live holder on their slot."""
    violations, room = FORK.Queue(), threading.Semaphore(at_once)

    def one(duration):
        process = FORK.Process(target=hold, args=(folder, jobs_per_gpu, duration, crash, violations))
        process.start()
        process.join()
        room.release()

    threads = []
    for duration in seconds(jobs):
        room.acquire()
        threads.append(threading.Thread(target=one, args=(duration,)))
        threads[-1].start()
    for thread in threads:
        thread.join()
    return violations.qsize()


def test_no_slot_is_given_twice_or_lost_when_500_holders_are_killed(tmp_path):
    draw = random.Random(0)
    assert crowd(tmp_path, 500, 16, lambda n: (draw.uniform(0.05, 0.1) for _ in range(n)), crash=True) == 0
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
