"""A benchmark that is killed, interrupted, started twice, copied or out of disk ends like an undisturbed benchmark."""

import contextlib
import os
import random
import re
import shutil
import signal
import subprocess
import time

import pandas as pd
import psutil
import pytest

from tests.support.project import PATIENCE, arguments, copy_workflow, environment, output_of, plan, run, start

SCENES = ["toy_rope_lift_smooth", "toy_rope_shake_smooth", "toy_rope_lift_two_region"]
CHANGES = {"scenarios": SCENES, "methods": ["static", "search_only", "baseline"], "tracking": {"enabled": False}}
DISK = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
"""A shell whose mounts are its own."""
pytestmark = pytest.mark.slow


def jobs_of(process):
    """The processes that run a job now."""
    with contextlib.suppress(psutil.Error):
        return [one for one in psutil.Process(process.pid).children(recursive=True) if "job.py" in " ".join(one.cmdline()[1:2])]
    return []


def at_work(process):
    """Wait until a job runs. Asserts that the run does not end before."""
    deadline = time.monotonic() + PATIENCE
    while not jobs_of(process):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)


def begun(project, stdout=subprocess.DEVNULL):
    """A run in a session of its own, which can be killed whole."""
    ways = {"stdout": stdout, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    return subprocess.Popen(arguments(project, CHANGES), cwd=project, env=environment(), **ways)


def table(project):
    """The long table of scores, without times, memory and paths."""
    scores = pd.read_csv(project / "results" / "tables" / "scores.csv")
    return scores[~scores["unit"].isin(["s", "MB"])].reset_index(drop=True)


def steps_made(project):
    """How often each job's log says that a step was made."""
    logs = (project / "results" / "jobs").rglob("*.log")
    return {path: len(re.findall(r"^(?:observe|search|fit|rollout|score): [\d.]+ ", path.read_text(), re.M)) for path in logs}


def kill(project, draw, *, whole):
    """Run, and kill all processes, or the jobs alone, at a random moment."""
    process = begun(project)
    at_work(process)
    time.sleep(draw.uniform(0, 8))
    for _ in range(0 if whole else 3):
        for job in jobs_of(process):
            with contextlib.suppress(psutil.Error):
                job.kill()
        time.sleep(draw.uniform(0, 2))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def test_a_run_that_is_disturbed_in_every_way_ends_with_the_table_of_an_undisturbed_one(tmp_path):
    undisturbed, project = (copy_workflow(tmp_path / name) for name in ("undisturbed", "disturbed"))
    run(undisturbed, CHANGES)
    draw = random.Random(0)
    # A disk of 4 kB holds no observations.
    if subprocess.run([*DISK, "true"], capture_output=True).returncode == 0:
        small = project / "results" / SCENES[0]
        small.mkdir(parents=True)
        command = f'mount -t tmpfs -o size=4k tmpfs "{small}" && exec "$@"'
        output = output_of(start([*DISK, command, "sh", *arguments(project, CHANGES, "--until", "perceive")], project), fails=True)
        assert "no space left" in output and "Traceback" not in output
    for _ in range(7):
        kill(project, draw, whole=True)

    process = begun(project)
    at_work(process)
    assert f"process {process.pid} on " in run(project, CHANGES, fails=True)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()

    interrupted = begun(project, subprocess.PIPE)
    at_work(interrupted)
    moment = time.monotonic()
    os.killpg(interrupted.pid, signal.SIGINT)
    output, _ = interrupted.communicate(timeout=PATIENCE)
    assert time.monotonic() - moment < 20 and "Rerun the same command to resume." in output

    for _ in range(4):
        kill(project, draw, whole=False)
    copied = tmp_path / "copied"
    shutil.copytree(project, copied, copy_function=shutil.copyfile)
    run(copied, CHANGES)
    assert plan(copied, CHANGES) == {}
    pd.testing.assert_frame_equal(table(copied), table(undisturbed), check_exact=True)
    made = steps_made(copied)
    assert made and max(made.values()) <= max(steps_made(undisturbed).values()), made
