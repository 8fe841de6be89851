"""A process that has already imported the heavy libraries. It forks a child per job, which starts in tenths of a second: 3 s saved.

`python -m neuspring.experiments.jobs.warm SOCKET` runs it, for as long as its standard input is open: the workflow holds the other
end, so it ends with the workflow. Jobs of one run use it; where it is not there (yet), the wrapper starts a process of its own. The
results are the same: a child has its own environment, folder and output. Before the fork no library has touched a device, or
started a thread that does not prepare for a fork. Linux alone: elsewhere a fork after these imports is not safe.

`multiprocessing`'s fork server does not fit: it serves the process that started it, and a job's wrapper is another one, which needs
the job's output, its exit status, and its end when the wrapper is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import runpy
import selectors
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from neuspring.experiments.jobs.gpus import VISIBLE

SOCKET = "NEUSPRING_WARM"
"""Environment: the socket of the warm process."""
COMMAND = ("python", "-m", "neuspring")
LIBRARIES = ("numpy", "scipy.spatial", "pandas", "torch", "warp", "cv2", "trimesh", "matplotlib.pyplot", "cma", "mlflow")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SAFE_THREADS = {"jemalloc_bg_thd"}
"""Threads of libraries that prepare for a fork themselves."""
MOST_FILES, REQUEST_PATIENCE = 64, 10.0
"""Open files that a job inherits, at most; s that its request may take."""


def die_with_parent() -> None:
    """A job whose parent was killed must not write on while the next run makes the same files (Linux)."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


# --- the job's side


class WarmProcess:
    """A job in a child of the warm process; has what the wrapper uses of `subprocess.Popen`."""

    def __init__(self, answers: IO[str], pid: int, stdout: IO[str]) -> None:
        self.pid, self.stdout, self._answers = pid, stdout, answers

    def wait(self) -> int:
        """The exit status; -N if signal N ended the job."""
        with self._answers:
            # Without an answer the warm process was killed, and its children with it.
            return int(self._answers.readline() or -signal.SIGKILL)

    def send_signal(self, number: int) -> None:
        """Pass a signal on."""
        if not self._answers.closed:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)


def start(command: Sequence[str], held: Sequence[IO[str]], environment: Mapping[str, str]) -> WarmProcess | None:
    """Start a command in a child of the warm process; None where there is no such process, or it cannot run this command.

    The child inherits the open files `held`, and ends when this process does.
    """
    path = environment.get(SOCKET, "")
    if not path or tuple(command[: len(COMMAND)]) != COMMAND or any(environment.get(name, "1") != "1" for name in THREADS):
        return None
    if environment.get(VISIBLE):
        return None  # CUDA in a forked process was never tried, and a job on a GPU takes longer than its start
    request = {"arguments": list(command[len(COMMAND) :]), "environment": dict(environment), "folder": os.getcwd()}
    reading, writing = os.pipe()
    stdout = os.fdopen(reading, encoding="utf-8", errors="replace", buffering=1)
    answers = None
    try:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(path)
            # The length goes with the files: one message carries them, however long the request is.
            data = json.dumps(request).encode()
            socket.send_fds(connection, [len(data).to_bytes(4)], [writing, *(file.fileno() for file in held)])
            connection.sendall(data)
            answers = connection.makefile("r")
            return WarmProcess(answers, int(answers.readline()), stdout)
    except (OSError, ValueError):
        stdout.close()
        if answers:
            answers.close()
        return None
    finally:
        os.close(writing)


# --- the workflow's side


def serve_while_running(path: Path) -> subprocess.Popen[bytes]:
    """Start the warm process; it ends when this process does. The folder of the socket must be private."""
    environment = os.environ | dict.fromkeys(THREADS, "1") | {VISIBLE: ""}
    command = [sys.executable, "-m", __name__, str(path)]
    return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def main(path: str) -> None:
    """Import the libraries, then serve jobs until standard input is closed and no job is left."""
    if sys.platform != "linux":
        return
    # Here, because every job imports this module for its own side.
    from neuspring.experiments.tracking.store import ENVIRONMENT

    # MLflow reads some of these when it is imported: no telemetry, no tracebacks.
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    for library in LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(library)
    from neuspring.core.provenance import code_digest
    from neuspring.stages import STAGES

    # Every job's record holds the digest of its code: here it is computed once for all.
    for stage in STAGES.values():
        code_digest(stage.function.__module__)
    # Threads of this process beside the first.
    tasks = [task.read_text().strip() for task in Path("/proc/self/task").glob("*/comm") if task.parent.name != str(os.getpid())]
    if threading.active_count() > 1 or set(tasks) - SAFE_THREADS:
        return  # a fork of several threads is not safe: every job starts a process of its own
    gc.collect()
    gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C also reaches the jobs' wrappers, which end them
    jobs: dict[int, socket.socket] = {}  # id of a job's process -> the connection to its wrapper
    with socket.socket(socket.AF_UNIX) as server, selectors.DefaultSelector() as watched:
        server.bind(path)
        server.listen(64)
        for file in (server, sys.stdin):
            watched.register(file, selectors.EVENT_READ)
        while jobs or sys.stdin in watched.get_map():
            for key, _ in watched.select():
                if key.fileobj is sys.stdin:
                    watched.unregister(sys.stdin)
                    watched.unregister(server)
                    server.close()
                elif key.fileobj is server:
                    with contextlib.suppress(OSError, ValueError):  # no more files, or its wrapper has gone: others go on
                        pid, ended, connection = _begin(server, jobs)
                        jobs[pid] = connection
                        for file in (ended, connection):
                            watched.register(file, selectors.EVENT_READ, pid)
                elif key.data in jobs and key.fileobj is jobs[key.data]:
                    # The wrapper says nothing more: its connection is readable when it has gone, and then its job ends too.
                    os.kill(key.data, signal.SIGKILL)
                    watched.unregister(key.fileobj)
                elif key.data in jobs:
                    status = os.waitstatus_to_exitcode(os.waitpid(key.data, 0)[1])
                    with jobs.pop(key.data) as connection:
                        if connection in watched.get_map():
                            watched.unregister(connection)
                        with contextlib.suppress(OSError):
                            connection.sendall(f"{status}\n".encode())
                    watched.unregister(key.fileobj)
                    os.close(key.fd)


def _begin(server: socket.socket, jobs: Mapping[int, socket.socket]) -> tuple[int, int, socket.socket]:
    """Fork the process of a job that is asked for, and tell its id: the id, a file that is readable when it has ended, and the
    connection to its wrapper. Raises OSError, ValueError."""
    connection, _ = server.accept()
    with contextlib.ExitStack() as begun:
        begun.enter_context(connection)
        connection.settimeout(REQUEST_PATIENCE)
        length, files, *_ = socket.recv_fds(connection, 4, MOST_FILES)
        for file in files:
            begun.callback(os.close, file)
        with connection.makefile("rb") as stream:
            request = json.loads(stream.read(int.from_bytes(length)))
        if (pid := os.fork()) == 0:
            # A wrapper must see that this process has closed its end, whatever jobs of others go on.
            for inherited in (server, connection, *jobs.values()):
                inherited.close()
            _run(request, *files)
        try:
            ended = os.pidfd_open(pid)
        except OSError:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            raise
        kept = connection.dup()
    with contextlib.suppress(OSError):
        kept.sendall(f"{pid}\n".encode())
    return pid, ended, kept


def _run(request: Mapping[str, Any], output: int, *held: int) -> None:
    """In the job's own process: run the command and end. The files `held` stay open."""
    status = 1
    try:
        die_with_parent()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(source, target)
        os.close(nothing)
        os.close(output)
        os.chdir(request["folder"])
        os.environ.clear()
        os.environ.update(request["environment"])
        sys.argv = ["neuspring", *request["arguments"]]
        runpy.run_module("neuspring", run_name="__main__")
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        # Skip the exit handlers that were inherited from the parent.
        os._exit(status)


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    finally:
        # The folder is this socket's alone; one that holds anything else stays.
        with contextlib.suppress(OSError):
            Path(sys.argv[1]).unlink(missing_ok=True)
            Path(sys.argv[1]).parent.rmdir()
