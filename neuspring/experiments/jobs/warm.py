"""A process that has already imported the heavy libraries. It forks one child per job, which then starts in tenths of a second.

`python -m neuspring.experiments.jobs.warm SOCKET` runs it, for as long as its standard input is open: the workflow holds the other
end, so it ends with the workflow. Jobs of one run use it; where it is not there (yet), the wrapper starts a process of its own. The
results are the same: a child has its own environment, folder and output. Before the fork no library has touched a device, or
started a thread that does not prepare for a fork. Linux alone: elsewhere a fork after these imports is not safe.
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
MESSAGE = 1 << 20
"""Most bytes of a request."""
FILES = 64
"""Most open files that a job inherits."""


def die_with_parent() -> None:
    """A job whose parent was killed must not write on while the next run makes the same files (Linux)."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


# --- the job's side


class WarmProcess:
    """A job in a child of the warm process; has what the wrapper uses of `subprocess.Popen`."""

    def __init__(self, connection: socket.socket, pid: int, stdout: IO[str]) -> None:
        self.pid, self.stdout = pid, stdout
        self._connection = connection
        self._status: int | None = None

    def wait(self) -> int:
        """The exit status; -N if signal N ended the job."""
        answer = self._connection.makefile("r").readline()
        self._connection.close()
        # Without an answer the warm process was killed, and its children with it.
        status = int(json.loads(answer)["status"]) if answer else -signal.SIGKILL
        self._status = status
        return status

    def send_signal(self, number: int) -> None:
        """Pass a signal on."""
        if self._status is None:
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
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.connect(path)
    except OSError:
        connection.close()
        return None
    reading, writing = os.pipe()
    request = {"arguments": list(command[len(COMMAND) :]), "environment": dict(environment), "folder": os.getcwd()}
    try:
        files = [writing, *(file.fileno() for file in held)]
        socket.send_fds(connection, [json.dumps(request).encode() + b"\n"], files)
        answer = connection.recv(64)
    except OSError:
        answer = b""
    os.close(writing)
    if not answer:
        os.close(reading)
        connection.close()
        return None
    stdout = os.fdopen(reading, encoding="utf-8", errors="replace", buffering=1)
    return WarmProcess(connection, json.loads(answer)["pid"], stdout)


# --- the workflow's side


def serve_while_running(path: Path) -> subprocess.Popen[bytes]:
    """Start the warm process; it ends when this process does. The folder of the socket must be private."""
    environment = os.environ | dict.fromkeys(THREADS, "1") | {VISIBLE: ""}
    command = [sys.executable, "-m", __name__, str(path)]
    return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def main(path: str) -> None:
    """Import the libraries, then fork a child per request until standard input is closed and no job is left."""
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
    if threading.active_count() > 1 or set(_native_threads()) - SAFE_THREADS:
        return  # a fork of several threads is not safe: every job starts a process of its own
    gc.collect()
    gc.freeze()
    wake, wakened = socket.socketpair()
    for end in (wake, wakened):
        end.setblocking(False)
    signal.set_wakeup_fd(wakened.fileno())
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C also reaches the jobs' wrappers, which end them
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(64)
    _Server(listener, wake).run()


def _native_threads() -> list[str]:
    """Names of the threads of this process beside the first, where the system tells (Linux)."""
    own = str(os.getpid())
    return [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm") if path.parent.name != own]


class _Server:
    """Children by process id and by connection."""

    def __init__(self, listener: socket.socket, wake: socket.socket) -> None:
        self._listener, self._wake = listener, wake
        self._connections: dict[int, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._stdin = sys.stdin.fileno()
        for file in (listener, wake, self._stdin):
            self._selector.register(file, selectors.EVENT_READ)

    def run(self) -> None:
        open_for_jobs = True
        while open_for_jobs or self._connections:
            for key, _ in self._selector.select():
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._wake:
                    with contextlib.suppress(BlockingIOError):
                        self._wake.recv(4096)
                    self._reap()
                elif key.fileobj == self._stdin:
                    open_for_jobs = bool(os.read(self._stdin, 1))
                    if not open_for_jobs:
                        self._selector.unregister(self._stdin)
                        self._selector.unregister(self._listener)
                else:
                    self._wrapper_gone(int(key.data))

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        try:
            data, files, _, _ = socket.recv_fds(connection, MESSAGE, FILES)
            while not data.endswith(b"\n"):
                part = connection.recv(MESSAGE)
                if not part:
                    raise ConnectionError("the request ended early")
                data += part
            request = json.loads(data)
        except (OSError, ValueError):
            connection.close()
            return
        pid = os.fork()
        if pid == 0:
            self._run_child(request, connection, files)
        for file in files:
            os.close(file)
        self._connections[pid] = connection
        self._selector.register(connection, selectors.EVENT_READ, pid)
        with contextlib.suppress(OSError):
            connection.sendall(json.dumps({"pid": pid}).encode() + b"\n")

    def _wrapper_gone(self, pid: int) -> None:
        """The wrapper of a job has gone: its job ends too."""
        if pid not in self._connections:
            return  # the job ended in the same moment
        self._selector.unregister(self._connections[pid])
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)

    def _reap(self) -> None:
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                pid, status = ended
                connection = self._connections.pop(pid)
                with contextlib.suppress(KeyError):
                    self._selector.unregister(connection)
                with contextlib.suppress(OSError):
                    connection.sendall(json.dumps({"status": os.waitstatus_to_exitcode(status)}).encode() + b"\n")
                connection.close()

    def _run_child(self, request: Mapping[str, Any], connection: socket.socket, files: Sequence[int]) -> None:
        """In the child: run the command and end."""
        status = 1
        try:
            die_with_parent()
            signal.set_wakeup_fd(-1)
            for number in (signal.SIGCHLD, signal.SIGINT):
                signal.signal(number, signal.SIG_DFL if number == signal.SIGCHLD else signal.default_int_handler)
            self._selector.close()
            for other in (self._listener, self._wake, connection, *self._connections.values()):
                other.close()
            nothing = os.open(os.devnull, os.O_RDONLY)
            for source, target in ((nothing, 0), (files[0], 1), (files[0], 2)):
                os.dup2(source, target)
            os.close(nothing)
            os.close(files[0])
            os.chdir(request["folder"])
            os.environ.clear()
            os.environ.update(request["environment"])
            status = _run(request["arguments"])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            # Skip the exit handlers that were inherited from the parent.
            os._exit(status)


def _run(arguments: Sequence[str]) -> int:
    """`python -m neuspring`; its exit status, as the interpreter would have it."""
    sys.argv = ["neuspring", *arguments]
    try:
        runpy.run_module("neuspring", run_name="__main__")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    finally:
        # The folder is this socket's alone; one that holds anything else stays.
        with contextlib.suppress(OSError):
            Path(sys.argv[1]).unlink(missing_ok=True)
            Path(sys.argv[1]).parent.rmdir()
