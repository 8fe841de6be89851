"""The wrapper of every job: log, record, GPUs, causes, signals."""

import errno
import json
import os
import signal
import subprocess
import sys

import pytest

from neuspring.core import lock as locks
from neuspring.core.errors import InputError
from neuspring.core.job_records import GPU_NOTES, Attempt, JobRecord, begin_run, failure_lines, read_jobs
from neuspring.core.records import RECORD_FORMAT
from neuspring.experiments.jobs import gpus
from neuspring.experiments.jobs import wrapper as job
from neuspring.experiments.jobs.wrapper import alone
from tests.support.jobs import NAME, record, run, start, wait_for, wrapped


def test_a_job_leaves_its_output_in_the_log_and_a_record(results):
    code = "import time; x = bytearray(50_000_000); print('to see'); time.sleep(0.4)"
    done = run(results, code, "--scenario", "rope")
    assert (done.returncode, done.stdout) == (0, "to see\n")
    assert (results / "logs" / f"{NAME}.log").read_text().endswith("to see\n")
    job_record = record(results)
    assert (job_record.rule, job_record.name, job_record.log) == ("search", NAME, f"logs/{NAME}.log")
    assert job_record.scenario == "rope"
    assert not job_record.failed
    last = job_record.last
    assert (last.outcome, last.exit, last.devices, last.cause) == ("ok", 0, [], "")
    assert last.seconds >= 0.4
    assert last.peak_memory_mb > 50
    assert all(len(row) == 5 for row in last.samples)


def test_a_permanent_failure_is_not_tried_again_but_the_next_run_tries(results):
    code = "import sys; print('neuspring: error: x: no', file=sys.stderr); sys.exit(2)"
    assert run(results, code).returncode == 2
    again = run(results, "print('ran')")
    assert (again.returncode, again.stdout) == (2, "")
    assert "not tried again (bad input; said above)" in again.stderr
    assert [attempt.outcome for attempt in record(results).attempts] == ["permanent"]
    begin_run(results)
    assert run(results, "raise MemoryError").returncode == 1
    assert record(results).last.cause == "out of memory"
    assert run(results, "print('ran')").returncode == 0, "what was transient is tried again"
    assert [attempt.outcome for attempt in record(results).attempts] == ["permanent", "transient", "ok"]


def test_a_job_sees_the_gpu_that_it_holds_and_no_other(results, monkeypatch):
    monkeypatch.setenv(job.POOL, "3,5")
    code = f"import os; print(os.environ['{gpus.VISIBLE}'], os.environ['CUDA_DEVICE_ORDER'])"
    lease = gpus.acquire(1, ("3",))
    assert run(results, code, "--gpus", "1").stdout == "5 PCI_BUS_ID\n"
    lease.release()
    assert record(results).last.devices == ["5"]
    assert run(results, f"import os; print(repr(os.environ['{gpus.VISIBLE}']))").stdout == "''\n"


def test_devices_that_a_cluster_chose_are_passed_on(results, monkeypatch):
    monkeypatch.setenv(job.POOL, job.GIVEN)
    monkeypatch.setenv(gpus.VISIBLE, "6")
    assert run(results, f"import os; print(os.environ['{gpus.VISIBLE}'])", "--gpus", "1").stdout == "6\n"
    assert record(results).last.devices == ["6"]
    assert not (results.parent / "locks").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_wrapper_ends_its_command(results, tmp_path, number):
    code = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    wrapper = subprocess.Popen([*wrapped(results), sys.executable, "-c", code])
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    wrapper.send_signal(number)
    wrapper.wait(20)
    child = int((tmp_path / "pid").read_text())
    wait_for(lambda: not os.path.exists(f"/proc/{child}"))
    # Whoever is killed outright cannot say so; the record that is left says that it ran.
    assert record(results).last.outcome == ("killed" if number == signal.SIGTERM else "running")


def test_a_damaged_record_is_named_and_replaced_by_the_next_run(results):
    path = results / "jobs" / f"{NAME}.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"format": RECORD_FORMAT, "rule": "search"}))
    with pytest.raises(InputError, match="must be a job record"):
        read_jobs(results)
    damaged: list[str] = []
    assert (read_jobs(results, damaged), len(damaged)) == ([], 1)
    assert run(results, "pass").returncode == 0
    assert [attempt.outcome for attempt in record(results).attempts] == ["ok"]


def test_a_job_by_itself_runs_whenever_it_is_asked_to(results):
    by_hand = results.with_name("by_hand")
    assert run(by_hand, "import sys; sys.exit(2)").returncode == 2
    assert run(by_hand, "print('ran')").stdout == "ran\n"


def test_a_full_disk_behind_the_output_does_not_end_the_job(results):
    code = "print('x' * 100_000, flush=True); print('the end')"
    with open("/dev/full", "w") as full:
        done = subprocess.run([*wrapped(results), sys.executable, "-c", code], stdout=full, check=False)
    assert done.returncode == 0
    assert (results / "logs" / f"{NAME}.log").read_text().endswith("the end\n")


def test_a_job_that_lost_its_wrapper_is_listed(tmp_path):
    begun = Attempt(started="2026-01-01T00:00:00+00:00", host="n1")
    vanished = JobRecord(rule="fit", name="fit/a", log="logs/fit/a.log", attempts=[begun])
    (line,) = failure_lines([vanished], tmp_path)
    assert line.startswith("fit/a: its wrapper or machine vanished (attempt 1): on n1")


def test_a_dead_gpu_costs_one_job_one_attempt(results, monkeypatch, tmp_path):
    monkeypatch.setenv(job.POOL, "0,1")
    uses = tmp_path / "uses"
    code = f"""import os, sys, time
device = os.environ['{gpus.VISIBLE}']
open({str(uses)!r}, 'a').write(device)
time.sleep(0.05)
if device == '0': sys.exit('RuntimeError: No CUDA GPUs are available')"""

    def start_job(number):
        log = results / "logs" / "fit" / f"{number}.log"
        options = ["--log", str(log), "--gpus", "1", "--scenario", "rope"]
        command = [sys.executable, "-m", "neuspring.experiments.jobs.wrapper", *options, "--", sys.executable, "-c", code]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    jobs = 5
    running = [start_job(number) for number in range(jobs)]
    messages = [process.communicate(timeout=60)[1] for process in running]
    failed = [number for number, process in enumerate(running) if process.returncode]
    assert len(failed) == 1
    again = start_job(failed[0])
    messages.append(again.communicate(timeout=60)[1])
    assert again.returncode == 0
    assert (uses.read_text().count("0"), uses.read_text().count("1")) == (1, jobs)
    assert "passed over: GPU 0 (lost)" in messages[-1]
    outcomes = [[attempt.outcome for attempt in each.attempts] for each in read_jobs(results)]
    assert sorted(outcomes) == [["ok"]] * (jobs - 1) + [["transient", "ok"]]


def test_where_all_gpus_are_lost_the_next_job_says_so_and_the_next_run_tries_again(results, monkeypatch):
    monkeypatch.setenv(job.POOL, "0")
    assert run(results, "import sys; sys.exit('GPU is lost')", "--gpus", "1").returncode == 1
    again = run(results, "print('ran')", "--gpus", "1")
    assert (again.returncode, again.stdout) == (2, "")
    assert "too few are left; received GPU 0 (lost)" in again.stderr and "nvidia-smi" in again.stderr
    assert (record(results).last.outcome, record(results).last.cause) == ("permanent", "no GPU")
    begin_run(results)
    assert run(results, "print('ran')", "--gpus", "1").stdout == "ran\n", "the next run tries the GPU again"


def test_an_error_of_the_gpu_that_may_be_the_job_s_own_does_not_stop_the_next_job(results, monkeypatch):
    monkeypatch.setenv(job.POOL, "0")
    code = "import sys; sys.exit('CUDA error: an illegal memory access was encountered')"
    assert run(results, code, "--gpus", "1").returncode == 1
    assert run(results, "print('ran')", "--gpus", "1").stdout == "ran\n"
    # It worked, so nothing is left against it.
    assert gpus.failures(results / "jobs" / GPU_NOTES) == {}


def test_a_command_that_cannot_be_started_ends_with_its_cause_and_is_not_tried_again(results, tmp_path):
    there = tmp_path / "there"
    there.write_text("no program")
    for command, status, cause in (
        (str(tmp_path / "nowhere"), 127, "the command was not found"),
        (str(there), 126, "the command cannot be executed"),
    ):
        begin_run(results)
        done = subprocess.run([*wrapped(results), command], capture_output=True, text=True, check=False)
        last = record(results).last
        assert (done.returncode, last.exit, last.outcome, last.cause) == (status, status, "permanent", cause)
        assert command in last.message and cause in done.stderr and "Traceback" not in done.stderr
        assert command in (results / "logs" / f"{NAME}.log").read_text().splitlines()[-1]
    again = run(results, "print('ran')")
    assert (again.returncode, again.stdout) == (126, "")


@pytest.mark.parametrize(("held", "device", "told"), [("1", "auto", True), ("", "auto", False), ("1", "cpu", False)])
def test_a_job_with_a_gpu_that_computes_on_the_cpu_says_so(monkeypatch, capsys, held, device, told):
    import torch

    from neuspring.core import device as devices

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setenv(gpus.VISIBLE, held)
    devices._warn_of_idle_gpu.cache_clear()
    assert [devices.resolve_device(device) for _ in range(2)] == ["cpu", "cpu"]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == told
    assert all("holds GPU 1, but this torch is a build for the CPU alone" in line for line in lines)
    with pytest.raises(InputError, match="this torch is a build for the CPU alone"):
        devices.resolve_device("cuda")
    # A torch that could use the GPU and does not find it: it is lost, and no reason to compute for hours without it.
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    for wanted in {"cuda", device if held else "cuda"} - {"cpu"}:
        with pytest.raises(InputError, match="this machine has 0 CUDA devices"):
            devices.resolve_device(wanted)


# A job runs once at a time, as long as its wrapper or its command lives.


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
    assert "an earlier run of this job still goes on; waiting for its end" in second.stderr.readline()
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
    assert len(messages) == 1 and "still goes on" in messages[0]


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
