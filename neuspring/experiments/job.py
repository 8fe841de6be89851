"""The wrapper of every job of the workflow: lease GPUs, run the steps, write the job record.

A step is skipped if its record agrees with its settings, code and inputs. So a changed setting of `lift` does not repeat
`segment`, and a killed job resumes. Nothing heavy is imported before the GPUs are chosen.
"""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuspring.core.errors import InputError, full_disk
from neuspring.core.job_records import ASKED, FAILED, FOLDER, JobRecord, asked
from neuspring.core.lock import try_lock
from neuspring.core.records import now
from neuspring.core.text import duration
from neuspring.experiments import gpus as leases
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph, Unit
from neuspring.experiments.tasks import Tasks
from neuspring.stages.stage import Job, Written

POOL, GIVEN = "NEUSPRING_GPUS", "given"
"""Environment variable: the devices that jobs share, separated by commas; `given`: a cluster has assigned the job's devices."""
JOB_POLL = 0.5
"""Time between two checks whether an earlier execution of a job has ended, s."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def with_gpus(benchmark: Benchmark) -> Benchmark:
    """Set the GPUs that the benchmark's jobs share, from the environment: the plan and all jobs must compute equal batches."""
    pool, config = os.environ.get(POOL, ""), benchmark.config
    benchmark.on_gpu = config.device == "cuda" or (config.device == "auto" and bool(pool))
    benchmark.gpu_slots = len(set(pool.split(",")) - {"", GIVEN}) * config.gpus.jobs_per_gpu
    return benchmark


def run(
    values: Mapping[str, Any],
    root: Path,
    commands: Mapping[str, Callable[..., Any]],
    sweeps: Any,
    rule: str,
    name: str,
    digest: str,
    *,
    threads: int = 1,
    gpus: int = 0,
) -> None:
    """Run a job of the configuration `values`; exits with status 2 for invalid input and 1 for any other error."""
    graph = Graph(with_gpus(Benchmark(values, root)))
    Tasks(graph, commands, sweeps)
    # Writes are atomic, so an interrupted job may end at once, even inside a kernel.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    folder = Path(graph.results) / FOLDER / rule / name
    with logged(folder / f"{digest}.log") as say, alone(folder, say):
        runner = Runner(graph, folder / f"{digest}.log", threads)
        begun, started = time.monotonic(), now()
        try:
            runner.lease(gpus)
            unit = graph.unit(rule, name)
            if unit.digest != digest:
                rule_ = "settings, code and data must not change after the workflow was planned"
                raise InputError(f"job {rule} {name}", rule_, remedy="Rerun the same command.")
            runner.run(unit)
            runner.note()
        except Exception as error:
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                error = full_disk(Path(error.filename or graph.results))
            bad_input = isinstance(error, InputError)
            print(f"neuspring: error: {error}") if bad_input else traceback.print_exc()
            text = str(error) if bad_input else f"{type(error).__name__}: {error}".partition("\n")[0]
            say(f"{rule} {name} failed: {text} (log: {runner.log})")
            runner.note(text)
            runner.save(folder / FAILED, f"{rule}/{name}", started, begun, outcome="failed", message=text[:500])
            sys.exit(2 if bad_input else 1)
        say(f"{_progress(Path(graph.results))}{rule} {name}: {duration(time.monotonic() - begun)}")


def _progress(results: Path) -> str:
    """Text with the number of finished jobs, including this one; the others are counted by Snakemake's benchmark files."""
    plan = results / FOLDER / ASKED
    if not (total := asked(results).get("jobs")):
        return ""
    others = sum(path.stat().st_mtime >= plan.stat().st_mtime for path in (results / FOLDER).rglob("*.tsv"))
    return f"[{others + 1} of {total}] "


@contextlib.contextmanager
def logged(path: Path) -> Iterator[Callable[[str], None]]:
    """Redirect all output to a log; yields a function that prints to the terminal of the workflow."""
    path.parent.mkdir(parents=True, exist_ok=True)
    terminal = os.fdopen(os.dup(2), "w")
    with path.open("a", encoding="utf-8", buffering=1) as file:
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]

    def say(text: str) -> None:
        with contextlib.suppress(OSError):  # a closed terminal must not end the job
            print(text, file=terminal, flush=True)

    yield say


@contextlib.contextmanager
def alone(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Lock a job, because the same job of a killed workflow may still run and write the same files."""
    file = reported = None
    with contextlib.suppress(OSError):  # some network file systems have no locks
        while (file := try_lock(folder / "lock")) is None:
            if not reported:
                reported = True
                say(f"{folder.name}: an earlier execution of this job is still running; waiting for its end")
            time.sleep(JOB_POLL)
    try:
        yield
    finally:
        if file:
            file.close()


@contextlib.contextmanager
def _error_of(unit: Unit, errors: dict[str, Exception]) -> Iterator[None]:
    """Print an error and store it, so that it does not stop other members of a batch."""
    try:
        yield
    except Exception as error:
        traceback.print_exc()
        errors[unit.name] = error


class Runner:
    """Runs the units of one job."""

    def __init__(self, graph: Graph, log: Path, threads: int) -> None:
        self.graph, self.config, self.log = graph, graph.config, log
        for name in THREADS:
            # A search starts its own threads.
            os.environ[name] = "1" if f"/{FOLDER}/search/" in log.as_posix() else str(threads)
        self.devices: list[str] = []
        self.notes = Path(graph.results) / FOLDER / leases.NOTES
        self.places = {"device": self.config.device, "threads": threads, "twins_per_launch": self.config.twins_per_launch}

    def lease(self, count: int) -> None:
        """Lease `count` GPUs until this process ends (on a cluster, the scheduler has assigned them); 0: hide all GPUs."""
        pool = os.environ.get(POOL, "")
        if count and pool == GIVEN:
            self.devices = list(leases.visible_devices())
            return
        environment = {leases.VISIBLE: ""}
        if count:
            names, share = [name for name in pool.split(",") if name] or leases.visible_devices(), self.config.gpus.jobs_per_gpu
            held = self.held = leases.acquire(count, names, jobs_per_gpu=share, notes=self.notes, say=print)
            self.devices, environment = list(held.devices), held.environment()
        os.environ.update(environment)

    def note(self, error: str = "") -> None:
        """Write to the notes whether the GPUs of this job work."""
        if self.devices and os.environ.get(POOL) != GIVEN and (failure := leases.failure_of(error) if error else leases.WORKS):
            with contextlib.suppress(OSError):
                self.held.note(failure)

    def run(self, unit: Unit) -> None:
        """Run a unit, or the members of a batch.

        Raises every exception of a step. The error of a member does not fail the batch: the member's own job raises it.
        """
        begun, started = time.monotonic(), now()
        if not unit.members:
            self._finish(unit, self._files(unit), started, begun)
            return
        waiting = [member for member in unit.members if not self.graph.finished(member)]
        errors = self._together(waiting)
        for member in waiting:
            if member.name not in errors:
                step = member.steps[0]
                self._finish(member, [Path(self.graph.output_of(step.stage, step.job))], started, begun)
                continue
            text = str(errors[member.name])[:500]
            print(f"{member.rule} {member.name} failed: {text}", flush=True)
            path = self.graph.folder(member) / FAILED
            self.save(path, f"{member.rule}/{member.name}", started, begun, outcome="failed", message=text)
        self._finish(unit, [self.graph.record(member) for member in unit.members], started, begun)

    def _together(self, units: Sequence[Unit]) -> dict[str, Exception]:
        """Run the members of a batch; returns errors by name. A member that fails in the batch is repeated once, alone."""
        ready, errors = list[Job](), dict[str, Exception]()
        for unit in units:
            with _error_of(unit, errors):
                job = self.graph.job(unit.steps[0], **self.places)
                if not (job.finished or job.failed) and job.arguments:
                    ready.append(job)
        many = units[0].steps[0].stage.many if units else None
        if many and len(ready) > 1:
            for job in ready:
                job.record.sharers = len(ready)
            with _error_of(units[0], {}):
                for job, made in zip(ready, many(ready), strict=True):
                    if isinstance(made, Written):
                        job.keep(made)
                    else:
                        traceback.print_exception(made)
        for unit in [unit for unit in units if unit.name not in errors]:
            with _error_of(unit, errors):
                job = self.graph.job(unit.steps[0], **self.places)
                if not job.finished:
                    job.run()
        return errors

    def _files(self, unit: Unit) -> list[Path]:
        """Run the steps of a unit in order; returns its output files."""
        if unit.run:
            return list(unit.run(self.places))
        files = []
        for step in unit.steps:
            job = self.graph.job(step, **self.places)
            begun = time.monotonic()
            finished = job.finished
            if not finished:
                job.run()
            print(f"{step.stage.name}: {'already finished' if finished else duration(time.monotonic() - begun)}", flush=True)
            files.append(job.output)
        if unit.rule == "run" and self.config.tracking.enabled:
            files.append(self._log_run(files))
        return files

    def _log_run(self, files: Sequence[Path]) -> Path:
        """Log a run to MLflow; errors of MLflow do not fail the run."""
        from neuspring.core.files import write_text
        from neuspring.core.run_record import RUN_RECORD
        from neuspring.experiments.tracking import log

        record = next(path for path in files if path.name == RUN_RECORD)
        outcome = record.with_name(log.OUTCOME)
        write_text(outcome, log.log_run(record, Path(self.graph.results), self.config.tracking) + "\n")
        return outcome

    def _finish(self, unit: Unit, files: Sequence[Path], started: str, begun: float) -> None:
        """Write the record of a finished unit and delete older records and logs of it."""
        record = self.graph.record(unit)
        for path in record.parent.glob("*.json"):
            path.unlink()
        for path in record.parent.glob("*.log"):
            if path != self.log:
                path.unlink()
        results = Path(self.graph.results)
        names = [path.relative_to(results).as_posix() for path in files]
        self.save(record, f"{unit.rule}/{unit.name}", started, begun, files=names, made_of=dict(unit.made_of))

    def save(self, path: Path, name: str, started: str, begun: float, **ended: Any) -> None:
        """Write a job record; `ended` contains its outcome or results."""
        peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        JobRecord(
            rule=name.partition("/")[0],
            name=name,
            log=self.log.relative_to(self.graph.results).as_posix(),
            started=started,
            seconds=round(time.monotonic() - begun, 3),
            host=platform.node(),
            devices=self.devices,
            device_names=leases.names_of(self.devices),
            peak_memory_mb=round(peak / (1024 if sys.platform != "darwin" else 1024**2), 1),
            **ended,
        ).save(path)
