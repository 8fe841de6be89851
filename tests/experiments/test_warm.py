"""Jobs that start in a child of the warm process behave as jobs in a process of their own."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from neuspring import config
from neuspring.experiments.jobs import warm
from neuspring.stages.observe import observe
from tests.support import small
from tests.support.jobs import wait_for


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A warm process without libraries, which take seconds to import."""
    path = tmp_path_factory.mktemp("warm") / "socket"
    code = f"from neuspring.experiments.jobs import warm; warm.LIBRARIES = (); warm.main({str(path)!r})"
    environment = os.environ | dict.fromkeys(warm.THREADS, "1")
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, env=environment)
    deadline = time.monotonic() + 60
    # The socket is there a moment before it listens.
    while not (first := begin(path, "--version")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    first.wait()
    yield path
    process.stdin.close()
    assert process.wait(timeout=60) == 0


def begin(server, *words: str, **environment: str) -> warm.WarmProcess | None:
    return warm.start([*warm.COMMAND, *words], [], os.environ | {warm.SOCKET: str(server), "OMP_NUM_THREADS": "1"} | environment)


def ended(process: warm.WarmProcess) -> tuple[int, str]:
    return process.wait(), process.stdout.read()


def test_output_and_exit_status_are_those_of_the_command(server, tmp_path):
    status, text = ended(begin(server, "--version"))
    assert status == 0 and text.strip().count(".") == 2
    status, text = ended(begin(server, "nothing"))
    assert status == 2 and "command: must be a stage or a tool; received nothing" in text
    output, here = tmp_path / "observations.npz", tmp_path / "here.npz"
    row, settings = json.dumps(small.row().__dict__), '{"toy": {"frames": 5}}'
    status, text = ended(begin(server, "observe", "--scenario", row, "--settings", settings, "--output", str(output)))
    assert status == 0, text
    observe(scenario=small.row(), settings=config.Config(toy=config.Toy(frames=5)), output=here)
    assert output.read_bytes() == here.read_bytes()


def opening(folder: Path) -> list[str]:
    """A command that goes on until it is ended."""
    tracking = {"tracking": {"uri": f"sqlite:///{folder / 'mlflow.db'}"}}
    return ["ui", "--port", "0", "--settings", json.dumps(tracking)]


def test_a_signal_reaches_the_job_and_is_its_status(server, tmp_path):
    process = begin(server, *opening(tmp_path), MLFLOW_DISABLE_TELEMETRY="true")
    process.send_signal(signal.SIGTERM)
    assert process.wait() == -signal.SIGTERM


def test_a_job_ends_with_its_wrapper(server, tmp_path):
    code = (
        "import os, sys, time; from neuspring.experiments.jobs import warm;"
        "process = warm.start([*warm.COMMAND, *sys.argv[1:]], [], dict(os.environ));"
        "print(process.pid, flush=True); time.sleep(600)"
    )
    environment = os.environ | {warm.SOCKET: str(server), "OMP_NUM_THREADS": "1"}
    wrapper = subprocess.Popen([sys.executable, "-c", code, *opening(tmp_path)], env=environment, stdout=subprocess.PIPE, text=True)
    pid = int(wrapper.stdout.readline())
    wrapper.kill()
    wrapper.wait()
    wait_for(lambda: not psutil.pid_exists(pid))


def test_what_the_warm_process_cannot_run_starts_by_itself(server, tmp_path):
    assert warm.start(["ls"], [], os.environ | {warm.SOCKET: str(server)}) is None
    cases = {"OMP_NUM_THREADS": "4"}, {warm.SOCKET: str(tmp_path / "none")}, {warm.SOCKET: ""}, {"CUDA_VISIBLE_DEVICES": "0"}
    assert [begin(server, "--version", **case) for case in cases] == [None] * 4


def test_files_that_a_job_must_hold_are_inherited(server, tmp_path):
    """A lock is free only when wrapper and job have both let it go."""
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as held:
        process = warm.start([*warm.COMMAND, "--version"], [held], os.environ | {warm.SOCKET: str(server), "OMP_NUM_THREADS": "1"})
    assert process.wait() == 0
    # Both ends that could write are closed now: reading ends instead of waiting.
    with os.fdopen(reading) as stream:
        assert stream.read() == ""
