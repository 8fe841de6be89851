"""The wrapper of every job: log, record, GPUs, causes, signals."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from neuspring import gpus, job
from neuspring.errors import InputError
from neuspring.job_records import Attempt, JobRecord, failure_lines, read_jobs

NAME = "search/rope/uniform/0"


@pytest.fixture
def results(tmp_path, monkeypatch):
    for name in (job.POOL, job.SHARE, gpus.VISIBLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(gpus.LOCKS, str(tmp_path / "locks"))
    return tmp_path / "results"


def run(results, code, *options, **keywords):
    command = [sys.executable, "-m", "neuspring.job", "--log", str(results / "logs" / f"{NAME}.log"), *options]
    return subprocess.run([*command, "--", sys.executable, "-c", code], capture_output=True, text=True, check=False, **keywords)


def record(results):
    (found,) = read_jobs(results)
    return found


def test_a_job_leaves_its_output_in_the_log_and_a_record(results):
    code = "import time; x = bytearray(50_000_000); print('to see'); time.sleep(0.4)"
    done = run(results, code, "--scenario", "rope", "--work", "88")
    assert (done.returncode, done.stdout) == (0, "to see\n")
    assert (results / "logs" / f"{NAME}.log").read_text().endswith("to see\n")
    found = record(results)
    assert (found.rule, found.name, found.log, found.scenario, found.work) == ("search", NAME, f"logs/{NAME}.log", "rope", 88)
    assert not found.failed
    assert (found.last.outcome, found.last.exit, found.last.devices, found.last.cause) == ("ok", 0, [], "")
    assert found.last.seconds >= 0.4
    assert found.last.peak_memory_mb > 50
    assert all(len(row) == 5 for row in found.last.samples)


def test_a_permanent_failure_is_not_tried_again_but_the_next_run_tries(results):
    code = "import sys; print('neuspring: error: x: no', file=sys.stderr); sys.exit(2)"
    assert run(results, code).returncode == 2
    again = run(results, "print('ran')", "--attempt", "2")
    assert (again.returncode, again.stdout) == (2, "")
    assert "not tried again (bad input): neuspring: error: x: no" in again.stderr
    assert [attempt.outcome for attempt in record(results).attempts] == ["permanent"]
    assert run(results, "print('ran')").returncode == 0
    assert [attempt.outcome for attempt in record(results).attempts] == ["permanent", "ok"]


def test_a_transient_failure_is_tried_again(results):
    assert run(results, "raise MemoryError").returncode == 1
    assert record(results).last.cause == "out of memory"
    assert run(results, "pass", "--attempt", "2").returncode == 0
    assert [attempt.outcome for attempt in record(results).attempts] == ["transient", "ok"]


def test_a_job_sees_the_gpu_that_it_holds_and_no_other(results, monkeypatch):
    monkeypatch.setenv(job.POOL, "3,5")
    code = f"import os; print(os.environ['{gpus.VISIBLE}'], os.environ['CUDA_DEVICE_ORDER'])"
    held = gpus.acquire(1, ("3",))
    assert run(results, code, "--gpus", "1").stdout == "5 PCI_BUS_ID\n"
    held.release()
    assert record(results).last.devices == ["5"]
    assert run(results, f"import os; print(repr(os.environ['{gpus.VISIBLE}']))").stdout == "''\n"


def test_devices_that_a_cluster_chose_are_passed_on(results, monkeypatch):
    monkeypatch.setenv(job.POOL, job.GIVEN)
    monkeypatch.setenv(gpus.VISIBLE, "6")
    assert run(results, f"import os; print(os.environ['{gpus.VISIBLE}'])", "--gpus", "1").stdout == "6\n"
    assert record(results).last.devices == ["6"]
    assert not (results.parent / "locks").exists()


def test_a_job_that_needs_more_gpus_than_there_are_is_refused(results, monkeypatch):
    monkeypatch.setenv(job.POOL, "0")
    done = run(results, "pass", "--gpus", "2")
    assert done.returncode == 2
    assert "a job needs 2 GPUs, more than there are; received 1 (0)" in done.stderr


def wait_for(condition):
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_wrapper_ends_its_command(results, tmp_path, number):
    log = results / "logs" / f"{NAME}.log"
    code = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    wrapper = subprocess.Popen([sys.executable, "-m", "neuspring.job", "--log", str(log), "--", sys.executable, "-c", code])
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    wrapper.send_signal(number)
    wrapper.wait(20)
    child = int((tmp_path / "pid").read_text())
    wait_for(lambda: not os.path.exists(f"/proc/{child}"))
    # Whoever is killed outright cannot say so; the record that is left says that it ran.
    assert record(results).last.outcome == ("killed" if number == signal.SIGTERM else "running")


def test_a_log_outside_the_results_is_refused(tmp_path):
    with pytest.raises(InputError, match="logs of jobs must lie in"):
        JobRecord.of_log(tmp_path / "results", tmp_path / "elsewhere.log")


def test_a_damaged_record_is_named_and_replaced_by_the_next_run(results):
    path = results / "jobs" / f"{NAME}.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"format": 1, "rule": "search"}))
    with pytest.raises(InputError, match="must be a job record"):
        read_jobs(results)
    assert run(results, "pass").returncode == 0
    assert [attempt.outcome for attempt in record(results).attempts] == ["ok"]


def test_records_come_back_as_they_were_written(tmp_path):
    attempt = Attempt(started="2026-01-01T00:00:00+00:00", outcome="transient", cause="x", samples=[[0.1, 2.0, 3.0, None, None]])
    kept = JobRecord(rule="fit", name="fit/a/b/0", log="logs/fit/a/b/0.log", attempts=[attempt], scenario="a", work=3.0)
    kept.save(tmp_path)
    assert read_jobs(tmp_path) == [kept]


def test_a_permanent_failure_of_an_earlier_run_does_not_stop_a_later_attempt(results):
    assert run(results, "import sys; sys.exit(2)").returncode == 2
    started = results / "jobs" / ".started"
    started.touch()
    os.utime(started, (time.time() + 60, time.time() + 60))
    assert run(results, "print('ran')", "--attempt", "2").stdout == "ran\n"


def test_a_full_disk_behind_the_output_does_not_end_the_job(results):
    command = [sys.executable, "-m", "neuspring.job", "--log", str(results / "logs" / f"{NAME}.log"), "--"]
    code = "print('x' * 100_000, flush=True); print('the end')"
    with open("/dev/full", "w") as full:
        done = subprocess.run([*command, sys.executable, "-c", code], stdout=full, check=False)
    assert done.returncode == 0
    assert (results / "logs" / f"{NAME}.log").read_text().endswith("the end\n")


def test_a_job_that_lost_its_wrapper_is_listed(tmp_path):
    vanished = JobRecord(
        rule="fit", name="fit/a", log="logs/fit/a.log", attempts=[Attempt(started="2026-01-01T00:00:00+00:00", host="n1")]
    )
    (line,) = failure_lines([vanished], tmp_path)
    assert line.startswith("fit/a: its wrapper or machine vanished (attempt 1): on n1")


def test_damaged_records_do_not_hide_the_others(tmp_path):
    JobRecord(rule="fit", name="fit/a", log="logs/fit/a.log", attempts=[Attempt(started="2026-01-01T00:00:00+00:00")]).save(
        tmp_path
    )
    (tmp_path / "jobs" / "fit" / "b.json").write_text("{")
    damaged: list[str] = []
    assert [record.name for record in read_jobs(tmp_path, damaged)] == ["fit/a"]
    assert len(damaged) == 1
