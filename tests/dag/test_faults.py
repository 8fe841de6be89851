"""Faults in a running workflow: one costs one job, nothing finished is lost, the same command continues."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from neuspring.core.job_records import JobRecord, read_jobs
from tests.support.phystwin_case import write_case
from tests.support.project import ROOT, SCENE, arguments, jobs_in, output_of, run, start

pytestmark = pytest.mark.slow
"""Small versions: retries, causes and killed commands of one job in test_job; a killed run in test_workflow."""
RELEASED = "weird_package"
SABOTAGE = '''
"""Lets chosen `neuspring` commands fail when they are first called; counts the calls of all."""
import json, os, sys
from pathlib import Path
if "neuspring.experiments.jobs.warm" in sys.orig_argv:
    sys.exit()  # without the warm process every job is a new interpreter, which reads this file
if sys.orig_argv[1:3] == ["-m", "neuspring"] and "FAULTS" in os.environ:
    line = " ".join(sys.orig_argv[3:])
    for name, (words, message) in json.loads(os.environ["FAULTS"]).items():
        if all(word in line for word in words):
            calls = Path(os.environ["FAULT_CALLS"], name)
            with calls.open("a") as stream:
                stream.write("x")
            if calls.stat().st_size == 1 and message:
                sys.exit(message)
'''


class Sabotage:
    """Lets `neuspring` commands fail once, and counts the calls of those that it is told about."""

    def __init__(self, folder: Path) -> None:
        self.site, self.calls = folder / "site", folder / "calls"
        self.site.mkdir()
        self.calls.mkdir()
        (self.site / "sitecustomize.py").write_text(SABOTAGE)

    def variables(self, **faults: tuple[list[str], str]) -> dict[str, str]:
        """Of an environment with faults: name = (words of the command line, last words; empty where it only counts)."""
        path = os.pathsep.join([str(self.site), str(ROOT)])
        return {"PYTHONPATH": path, "FAULTS": json.dumps(faults), "FAULT_CALLS": str(self.calls)}

    def count(self, name: str) -> int:
        """How often the command of a fault was called so far."""
        return (self.calls / name).stat().st_size if (self.calls / name).exists() else 0


@pytest.fixture
def sabotage(tmp_path):
    return Sabotage(tmp_path)


def wait_for(condition, process):
    deadline = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < deadline
        time.sleep(0.02)


def wrapper_of(project, rule):
    """The wrapper process of the project's job of a rule; other tests run jobs of that rule at the same time."""
    for process in psutil.process_iter(["cmdline", "cwd"]):
        line = " ".join(process.info["cmdline"] or [])
        if f"neuspring.experiments.jobs.wrapper --log results/logs/{rule}/" in line and process.info["cwd"] == str(project):
            return process
    raise AssertionError(f"no wrapper of {rule} in {project}")


def record(results, name):
    return JobRecord.load(results / "jobs" / f"{name}.json")


def scenarios_with_runs(results):
    return {path.parent.parent.parent.name for path in results.glob("*/*/*/run.json")}


def test_each_fault_costs_one_job_and_the_same_command_continues(project, tmp_path, sabotage):
    """Out of GPU memory, a wrapper killed in the middle, corrupt data and a dead tracking server, all in one run."""
    results, data = project / "results", tmp_path / "data"
    case = write_case(data, RELEASED)
    whole = (case / "final_data.pkl").read_bytes()
    (case / "final_data.pkl").write_bytes(whole[:1000])
    changes = {
        "scenarios": [SCENE, RELEASED],
        "methods": ["baseline"],
        "data_root": str(data),
        "fit": {"epochs": 50},  # still at work when its wrapper is killed
        "tracking": {"uri": "http://127.0.0.1:9"},
    }
    faults = {
        "memory": (["search --", f"/{SCENE}/"], "torch.OutOfMemoryError: CUDA out of memory. Tried to allocate 2.00 GiB."),
        "killed": (["fit --", f"/{SCENE}/"], ""),
        "corrupt": (["observe", RELEASED], ""),
    }
    process = start(arguments(project, changes), project, **sabotage.variables(**faults))
    wait_for((results / SCENE / "baseline" / "0" / "fit.partial.npz").exists, process)
    wrapper = wrapper_of(project, "fit")
    (command,) = wrapper.children()
    wrapper.send_signal(signal.SIGKILL)
    output = output_of(process, fails=True)

    # The healthy scenario has its run and is in the table: its search after another attempt, its fit from its checkpoint.
    assert scenarios_with_runs(results) == {SCENE}
    assert "1/2" in output
    assert [attempt.outcome for attempt in record(results, f"search/{SCENE}/uniform/0").attempts] == ["transient", "ok"]
    assert record(results, f"search/{SCENE}/uniform/0").attempts[0].cause == "out of GPU memory"
    assert [attempt.outcome for attempt in record(results, f"fit/{SCENE}/baseline/0").attempts] == ["running", "ok"]
    assert json.loads((results / SCENE / "baseline" / "0" / "fit.json").read_text())["attempts"] == 2
    assert not command.is_running()
    # Bad data are read once, not three times, and named.
    assert sabotage.count("corrupt") == 1
    assert record(results, f"observe/{RELEASED}").last.cause == "bad input"
    assert f"observe/{RELEASED}: bad input (attempt 1)" in output
    assert f"neuspring: error: {case / 'final_data.pkl'}" in output
    assert "not tried again (bad input; said above)" in output
    assert "MissingOutputException" not in output, "the command fails by its status"
    # The server is away: the runs wait on disk.
    assert {path.read_text().split(":")[0] for path in results.glob("*/*/*/mlflow.txt")} == {"unreachable"}
    so_far = (results / "tables" / "so_far" / "summary.md").read_text()
    assert f"PhysTwin (`baseline`), {RELEASED} / seed 0: missing" in so_far
    assert "have not finished" in output
    assert "bad input" in (results / "tables" / "so_far" / "report.html").read_text()

    # With the data repaired the same command does what is missing, and nothing twice. The tables so far are not the tables.
    calls = {name: sabotage.count(name) for name in ("memory", "killed")}
    (case / "final_data.pkl").write_bytes(whole)
    output = run(project, changes, **sabotage.variables(**faults))
    expected = dict.fromkeys(("observe", "search", "fit", "rollout", "score", "log_run", "tables", "report", "all"), 1)
    assert jobs_in(output) == expected
    assert scenarios_with_runs(results) == {SCENE, RELEASED}
    assert {name: sabotage.count(name) for name in calls} == calls
    assert not [job.name for job in read_jobs(results) if job.failed]


def mount(folder: Path, size: str):
    """A small file system of its own; skips where that is not allowed."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        pytest.skip(f"a file system of a chosen size cannot be mounted here: {result.stderr.strip()}")


def remount(folder: Path, option: str):
    subprocess.run(["mount", "-o", f"remount,{option}", str(folder)], check=True)


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a tmpfs")
def test_a_full_and_a_read_only_disk_stop_a_run_that_then_continues(project, tmp_path, sabotage):
    disk = tmp_path / "disk"
    mount(disk, "40k")
    try:
        results = disk / "results"
        changes = {"methods": ["search_only"], "results": str(results), "tracking": {"enabled": False}}
        variables = sabotage.variables(**{name: ([f"{name} --"], "") for name in ("observe", "search", "rollout")})
        # What can fill the disk; the tables come after it.
        target = ("--", f"{results}/{SCENE}/search_only/0/run.json")
        output = run(project, changes, *target, fails=True, **variables)
        assert "no space left on the disk. Free some space; the same command continues." in output
        calls = {job.rule: sabotage.count(job.rule) for job in read_jobs(results) if job.last.outcome == "ok"}
        assert calls and set(calls.values()) == {1}

        remount(disk, "size=100m")
        remount(disk, "ro")
        output = run(project, changes, *target, fails=True, **variables)
        assert "this folder must be writable; received Read-only file system" in output
        remount(disk, "rw")
        run(project, changes, *target, **variables)
        # What had ended before the disk was full was not made again.
        assert {name: sabotage.count(name) for name in calls} == calls
        assert scenarios_with_runs(results) == {SCENE}
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)
