"""Jobs of a test: the real wrapper around a piece of Python."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neuspring.core.job_records import JobRecord, read_jobs

NAME = "search/rope/uniform/0"


def wrapped(results: Path, *options: str) -> list[str]:
    """The wrapper's command line, up to the command of the job."""
    log = results / "logs" / f"{NAME}.log"
    return [sys.executable, "-m", "neuspring.experiments.jobs.wrapper", "--log", str(log), *options, "--"]


def run(results: Path, code: str, *options: str, **keywords: Any) -> subprocess.CompletedProcess[str]:
    """Run a job to its end."""
    command = [*wrapped(results, *options), sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False, **keywords)


def start(results: Path, code: str, *options: str) -> subprocess.Popen[str]:
    """Start a job."""
    command = [*wrapped(results, *options), sys.executable, "-c", code]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def record(results: Path) -> JobRecord:
    """The record of the only job."""
    (only,) = read_jobs(results)
    return only


def wait_for(condition: Callable[[], Any]) -> None:
    """Wait for 20 s at most."""
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
