"""A Slurm of one node with two stand-ins for GPUs: started by a test, as root, without systemd, cgroups or accounting."""

import ctypes
import fcntl
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

SETTINGS = Path("/etc/slurm")
"""Snakemake's plugin takes SLURM_CONF away from its job steps, so the configuration must lie where Slurm looks by itself."""
MARK = "# Written by a test of NeuSpring, which removes it.\n"
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "sinfo", "scontrol", "scancel")
PATIENCE = 30
"""s for the node to become idle; it takes 1."""


class NoSlurmError(Exception):
    """Why there can be no Slurm here."""


@contextmanager
def one_node() -> Iterator[None]:
    """A node that claims 8 CPUs, 64 GB and two GPUs, which jobs see as 0 and 1. Raises NoSlurmError where there can be none."""
    _check()
    with ExitStack() as stack:
        stack.enter_context(_own_settings())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="slurm-")))
        _write(folder)
        munge = {name: folder / f"munge.{name}" for name in ("key", "socket", "pid", "seed", "log")}
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "seed-file": "seed", "log-file": "log"}
        options = [f"--{option}={munge[name]}" for option, name in files.items()]
        stack.enter_context(_daemon("munged", "--foreground", "--force", *options))
        _wait(munge["socket"].exists, folder, "munged opened no socket")
        stack.enter_context(_daemon("slurmctld", "-D"))
        stack.enter_context(_daemon("slurmd", "-D", "-N", _host()))
        _wait(lambda: _output("sinfo", "-h", "-o", "%T").strip() == "idle", folder, "the node did not become idle")
        stack.callback(_cancel_all)
        yield


def submissions() -> list[dict[str, str]]:
    """All jobs so far, oldest first, as scontrol describes them: JobId, JobState, Comment, MinMemoryNode, TresPerJob, ..."""
    lines = _output("scontrol", "--oneliner", "show", "job").splitlines()
    jobs = [dict(item.split("=", 1) for item in line.split() if "=" in item) for line in lines if line.startswith("JobId=")]
    return sorted(jobs, key=lambda job: int(job["JobId"]))


def _check():
    if os.geteuid() != 0:
        raise NoSlurmError("needs root, to start the daemons of Slurm")
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        raise NoSlurmError(f"needs Debian's packages slurm-wlm and munge; missing: {', '.join(missing)}")
    if importlib.util.find_spec("snakemake_executor_plugin_slurm") is None:
        raise NoSlurmError("needs snakemake-executor-plugin-slurm: make install")
    if "SLURM_CONF" in os.environ:
        raise NoSlurmError("SLURM_CONF names another Slurm")


@contextmanager
def _own_settings() -> Iterator[None]:
    """Claim the files in /etc/slurm unless they belong to another Slurm; removed at the end."""
    paths = [SETTINGS / name for name in ("slurm.conf", "gres.conf")]
    for path in paths:
        if path.exists() and not path.read_text().startswith(MARK):
            raise NoSlurmError(f"{path} exists: this machine has a Slurm of its own")
    SETTINGS.mkdir(exist_ok=True)
    with paths[0].open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise NoSlurmError("another run of this test has its Slurm here") from None
        try:
            yield
        finally:
            for path in paths:
                path.unlink(missing_ok=True)


def _write(folder: Path):
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o600)
    host, (control, node) = _host(), _free_ports(2)
    # Slurm wants character devices, and only looks whether they exist; every machine has these.
    (SETTINGS / "gres.conf").write_text(f"{MARK}Name=gpu File=/dev/null\nName=gpu File=/dev/zero\n")
    (SETTINGS / "slurm.conf").write_text(
        f"""{MARK}ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmctldPort={control}
SlurmdPort={node}
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
MailProg=/bin/true
ReturnToService=2
MinJobAge=3600
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
GresTypes=gpu
NodeName={host} NodeAddr=127.0.0.1 CPUs=8 RealMemory=64000 Gres=gpu:2 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
    )


def _host() -> str:
    return socket.gethostname().split(".")[0]


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [each.getsockname()[1] for each in sockets]


@contextmanager
def _daemon(*command: str) -> Iterator[None]:
    """A daemon in the foreground, which ends with this process even if that is killed."""
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, preexec_fn=_end_with_parent
    )
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _end_with_parent():
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _wait(done, folder: Path, complaint: str):
    deadline = time.monotonic() + PATIENCE
    while not done():
        if time.monotonic() > deadline:
            logs = "\n".join(f"{path.name}: {path.read_text(errors='replace')[-500:]}" for path in folder.glob("*.log"))
            raise NoSlurmError(f"Slurm does not start: {complaint} within {PATIENCE} s\n{logs}")
        time.sleep(0.1)


def _output(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=30).stdout


def _cancel_all():
    """Jobs that a failed test left running, so that no job outlives its node."""
    subprocess.run(["scancel", "--user=root"], check=False, timeout=30)
    deadline = time.monotonic() + PATIENCE
    while _output("squeue", "--noheader") and time.monotonic() < deadline:
        time.sleep(0.1)
