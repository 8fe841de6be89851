"""Messages to the user during a run of the workflow and at its end."""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
import signal
import sys
import time
from datetime import datetime
from pathlib import Path
from types import FrameType

from neuspring.config import plain
from neuspring.core.errors import InputError
from neuspring.core.findings import warnings_of
from neuspring.core.job_records import FOLDER, keep_asked, read_jobs
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.core.text import duration, program
from neuspring.experiments.claim import claim
from neuspring.experiments.gpus import NOTES
from neuspring.experiments.graph import Graph, digest_of
from neuspring.experiments.tasks import Tasks
from neuspring.experiments.tracking.log import OUTCOME

LITTLE = 2_000_000
"""Free space, bytes, below which a disk counts as full."""
MOST_FINDINGS = 20
"""Maximum number of warnings at the end of a run."""
INTERRUPTS: list[int] = []
"""Interrupt signals that this run has received."""


def begin(graph: Graph, jobs: int, *, local: bool, cores: int | None, cluster: bool) -> None:
    """Before the first job: claim the results folder and store what was asked. Raises InputError for --cores on a cluster."""
    if not (local or cluster):
        # With --cores, jobs are planned for the GPUs of this machine.
        reason = "must not be set on a cluster, whose scheduler assigns cores and GPUs"
        raise InputError("--cores", reason, cores, "Omit it; --jobs limits the number of simultaneous jobs.")
    config = graph.config
    claim(Path(config.results), digest_of(plain(config)))

    def interrupt(signal_: int, frame: FrameType | None) -> None:
        INTERRUPTS.append(signal_)
        signal.default_int_handler(signal_, frame)

    signal.signal(signal.SIGINT, interrupt)
    (Path(config.results) / FOLDER / NOTES).unlink(missing_ok=True)
    chosen = {name: list(getattr(config, name)) for name in ("scenarios", "methods", "seeds")}
    keep_asked(
        Path(config.results), {"command": [program("snakemake"), *sys.argv[1:]], "only": config.only, "jobs": jobs, **chosen}
    )


def failed(graph: Graph, tasks: Tasks, begun: float) -> None:
    """After a failure or an interruption: print the failed jobs with their errors, and report on the finished runs."""
    results = Path(graph.config.results)
    if INTERRUPTS:
        done = sum(not job.failed for job in read_jobs(results, damaged=[]))
        print(f"\nInterrupted. {done} finished jobs are kept in {results}. Rerun the same command to resume.", flush=True)
        return
    if shutil.disk_usage(results).free < LITTLE:
        print(f"\n{results}: no space left on the disk. Free some space, then rerun the same command to resume.", flush=True)
        return
    lines = [
        f"  {job.name}: {job.message}; {results / job.log}"
        for job in read_jobs(results, damaged=[])
        if job.outcome == "failed" and datetime.fromisoformat(job.started).timestamp() >= begun - 1
    ]
    print("\nThe run did not finish. Finished results are kept.", flush=True)
    if lines and any(graph.finished(unit) for unit in graph.runs()):
        try:
            print(f"Report so far: {tasks.so_far(Path(graph.results) / graph.config.tables / 'so_far')}")
        except InputError as error:
            print(f"No report so far: {error}")
    print("\n".join(["Failed:", *lines] if lines else []))
    print("Rerun the same command to resume." if not lines else "Fix the cause, then rerun the same command to resume.", flush=True)


def finished(graph: Graph, begun: float) -> None:
    """After success: print the verdict, a table, the paths of results, the MLflow command, and the duration."""
    config, folder, neuspring = graph.config, f"{graph.results}/{graph.config.tables}", program("neuspring")
    summary = Path(folder) / "summary.md"
    if summary.exists():
        print("\n" + summary.read_text().partition("\n## ")[0].removeprefix("# Scores").strip() + "\n")
        tell_findings(graph)
        page = f"{folder}/report.html"
        print(f"Open in a browser: {page}" if Path(page).exists() else "The target `all` makes the report.")
        print(f"All tables: {summary}. Scores, trajectories, plots: {config.results}/<scenario>/<method>/<seed>/")
    for study in graph.benchmark.studies:
        path = Path(folder) / "studies" / f"{study}.md"
        if path.exists() and path.stat().st_mtime >= begun:
            print(f"{study}: {path}")
    if not summary.exists():
        return
    print(f"Explain a number: {neuspring} explain METHOD/future/TE --results {shlex.quote(config.results)}")
    if config.tracking.enabled:
        tracking = json.dumps({"tracking": plain(config.tracking)}, sort_keys=True)
        options = ["--results", config.results, *(["--settings", tracking] if config.tracking.uri else [])]
        waiting = [path for path in run_files(graph, OUTCOME) if "logged" not in path.read_text()]
        if waiting:
            reason = waiting[0].read_text().strip()
            print(f"{len(waiting)} runs were not logged to MLflow ({reason}). Log them later:")
            print(f"  {neuspring} sync {shlex.join(options)}")
        print(f"View the runs in MLflow: {neuspring} ui {shlex.join(options)}", flush=True)
    print(f"Total time: {duration(time.time() - begun)}.", flush=True)


def run_files(graph: Graph, name: str) -> list[Path]:
    """Existing files of this name in all runs of the configuration."""
    paths = (Path(graph.results) / unit.name / name for unit in graph.runs())
    return [path for path in paths if path.exists()]


def tell_findings(graph: Graph) -> None:
    """Print the warnings of perception on all scenarios, and the worst warning of each method's fits."""
    from neuspring.report.notes import of_fits

    warnings = [*warnings_of(Path(graph.config.results), graph.config.scenarios)]
    runs = list[RunRecord]()
    for path in run_files(graph, RUN_RECORD):
        with contextlib.suppress(InputError):  # the tables report damaged records
            runs.append(RunRecord.load(path))
    fits = sorted(of_fits(runs), key=lambda pair: pair[1].value)
    warnings += {(item.where.partition("/")[0], item.name): (name, item) for name, item in fits}.values()
    if warnings:
        print(f"Perception and fits report {len(warnings)} warning{'s' * (len(warnings) > 1)} that may affect results:")
        print("\n".join(f"  {name}: {item}" for name, item in warnings[:MOST_FINDINGS]))
        if len(warnings) > MOST_FINDINGS:
            print(f"  {len(warnings) - MOST_FINDINGS} more are in the report.")
        print()
