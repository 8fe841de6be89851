"""A job runs once at a time, as long as its wrapper or its command lives."""

import errno
import os
import subprocess
import sys

import pytest

from neuspring.core import lock as locks
from neuspring.experiments.jobs import gpus
from neuspring.experiments.jobs import wrapper as job
from neuspring.experiments.jobs.wrapper import alone
from tests.support.jobs import NAME, record, run, start, wait_for


def test_a_job_waits_for_the_end_of_its_earlier_run_before_it_takes_a_gpu(results, monkeypatch, tmp_path):
    """As when Snakemake was killed and started again."""
    monkeypatch.setenv(job.POOL, "0,1")
    trace, end = tmp_path / "trace", tmp_path / "end"
    code = f"""import os, time
def note(text): open({str(trace)!r}, 'a').write(text + os.environ['{gpus.VISIBLE}'] + ' ')
note('begin')
while not os.path.exists({str(end)!r}): time.sleep(0.02)
note('end')"""
    first = start(results, code, "--gpus", "1")
    wait_for(lambda: trace.exists() and trace.read_text())
    # Snakemake removes the log of a job before it starts it.
    (results / "logs" / f"{NAME}.log").unlink()
    second = start(results, code, "--gpus", "1")
    line = second.stderr.readline()
    assert f"an earlier run of this job still goes on (pid {first.pid} on " in line
    # While it waits it holds no GPU.
    gpus.acquire(1, ("1",), timeout=0).release()
    end.touch()
    assert (first.wait(20), second.wait(20)) == (0, 0)
    assert trace.read_text() == "begin0 end0 begin0 end0 "
    assert second.stderr.read() == "", "told once"
    assert [attempt.outcome for attempt in record(results).attempts] == ["ok", "ok"]
    assert [path.name for path in (results / "jobs" / NAME).parent.iterdir()] == ["0.json"], "no lock is left"


def test_a_job_stays_locked_while_its_command_lives_even_without_its_wrapper(results, tmp_path):
    path = results / "jobs" / "fit" / "a.json"
    with alone(path, pytest.fail) as lock:
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=[lock.fileno()])
        # As if the wrapper was killed: its descriptor is closed, its file stays.
        os.link(path.with_name("a.lock"), tmp_path / "kept")
    os.link(tmp_path / "kept", path.with_name("a.lock"))
    messages = []

    def free(text):
        messages.append(text)
        child.communicate(b"\n")

    with alone(path, free) as lock:
        assert lock is not None
    assert len(messages) == 1 and f"pid {os.getpid()} on " in messages[0]


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_command_inherits_the_locks_of_its_job(results, monkeypatch):
    monkeypatch.setenv(job.POOL, "3")
    code = "import glob, os; print(*sorted(os.path.realpath(fd) for fd in glob.glob('/proc/self/fd/*')), sep='\\n')"
    inherited = [line for line in run(results, code, "--gpus", "1").stdout.splitlines() if line.endswith(".lock")]
    assert inherited == [str(results.parent / "locks" / "3.0.lock"), str(results / "jobs" / f"{NAME}.lock")]


def test_a_lock_whose_file_its_last_holder_removed_is_no_lock(tmp_path, monkeypatch):
    lock, calls = tmp_path / "a.lock", []

    def lock_descriptor(*arguments, **options):
        if not calls:
            lock.unlink()  # between our opening the file and locking it
        calls.append(arguments)
        return real(*arguments, **options)

    real = locks.lock_descriptor
    monkeypatch.setattr(locks, "lock_descriptor", lock_descriptor)
    with alone(tmp_path / "a.json", pytest.fail):
        assert lock.exists()
    assert len(calls) == 2


def test_a_lock_that_is_deleted_is_waited_for_no_longer(tmp_path):
    path = tmp_path / "a.json"
    with alone(path, pytest.fail), alone(path, lambda text: path.with_name("a.lock").unlink()) as lock:
        assert lock is not None


def test_a_file_system_without_locks_is_no_obstacle(tmp_path, monkeypatch):
    def unsupported(*_, **__):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(locks, "lock_descriptor", unsupported)
    with alone(tmp_path / "a.json", pytest.fail) as lock:
        assert lock is None
