"""Messages to a user while the workflow runs, and after it."""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

from neuspring.config import plain
from neuspring.core.errors import InputError
from neuspring.core.findings import warnings_of
from neuspring.core.job_records import FOLDER, RUN_FILE, JobRecord, failure_lines, read_jobs, this_run
from neuspring.core.run_record import RunRecord
from neuspring.core.text import duration, listed, program
from neuspring.experiments.freshness import told
from neuspring.experiments.graph import Graph

MOST_FINDINGS = 20
"""Warnings that are printed at the end of a run."""


LITTLE = 2_000_000
"""Bytes; with less a disk counts as full."""
LOOK_EVERY = 1.0
"""s between two looks at the records of jobs."""


class Overview:
    """Progress of a quiet run: a line when a job has succeeded, with how many have, and for how long the run has lasted.

    It watches the records of the run's jobs, in a thread of its own, from `start` to `stop`.
    """

    def __init__(self, results: Path, logs: Iterable[Path], stream: IO[str] | None = None) -> None:
        self._stream, self._run = stream or sys.stdout, this_run(results)
        records = [JobRecord.of_log(results, log) for log in logs]
        self._waiting = {record.path(results): record for record in records}
        self._count, self._begun = len(records), time.monotonic()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Say how many jobs there are, and begin to watch."""
        print(f"{self._count} job{'s' * (self._count != 1)} to do; a line tells when one is done.", file=self._stream, flush=True)
        self._thread.start()

    def stop(self) -> None:
        """Tell what has ended since the last look, and end."""
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stopped.wait(LOOK_EVERY):
            self._look()
        self._look()

    def _look(self) -> None:
        for path in [path for path in self._waiting if self._ended(path)]:
            record = self._waiting.pop(path)
            done, passed = self._count - len(self._waiting), duration(time.monotonic() - self._begun)
            name = record.name.removeprefix(f"{record.rule}/")
            print(f"[{done} of {self._count}, {passed}] {record.rule} {name}", file=self._stream, flush=True)

    def _ended(self, path: Path) -> bool:
        """True where a job of this run has succeeded."""
        try:
            last = JobRecord.load(path).last
        except (InputError, IndexError):
            return False
        return last.run == self._run and last.outcome == "ok"


def replaced(jobs: Iterable[tuple[str, Any, tuple[str, ...]]]) -> str:
    """Text on results that are made again although they are there, of (rule, wildcards, departures); empty for no job."""
    rows = [(rule, str(getattr(w, "method", getattr(w, "search", ""))), why) for rule, w, why in jobs]
    if not rows:
        return ""
    head = "Made again, and replaced, because what is there was made with something else:"
    keep = "To keep what is there, give another folder: --config results=...; to take it as it is: --rerun-triggers mtime"
    return "\n".join([head, *told(rows), keep, ""])


def failed(graph: Graph) -> None:
    """After a failure or an interruption: tables and report of what is finished, what failed and why, how to continue."""
    results, damaged = Path(graph.config.results), list[str]()
    jobs = read_jobs(results, damaged)
    if shutil.disk_usage(results).free < LITTLE:
        # Then records of jobs say nothing: they could not be written.
        print(f"\n{results}: no space left on the disk. Free some space; the same command continues.", flush=True)
        return
    own = [record for record in jobs if record.last.run == this_run(results) and record.last.outcome != "ok"]
    if all(record.last.outcome in ("killed", "running") for record in own) and not damaged and own:
        print(f"\nStopped, with {len(own)} job{'s' * (len(own) > 1)} at work: {listed([record.name for record in own], 6)}.")
        print("What is finished is kept. The same command continues; searches and fits go on from their checkpoints.", flush=True)
        return
    print("\nThe run did not finish. What is finished is kept.", flush=True)
    if any(Path(path).exists() for path in graph.runs()):
        # In a folder of their own: otherwise Snakemake would take the tables as finished.
        command, page = [sys.executable, "-m", "neuspring"], f"{graph.folder}/so_far/report.html"
        subprocess.run([*command, "tables", *graph.tables(f"{graph.folder}/so_far"), "--brief"], check=False)
        quiet: Any = {"check": False, "stdout": subprocess.DEVNULL}
        for study in graph.whole.studies:
            subprocess.run([*command, "study", *graph.study(study, "so_far")], **quiet)
        subprocess.run([*command, "report", *graph.report(page)], **quiet)
        print(f"Report so far: {page}")
    lines = failure_lines(own, results) + damaged
    print("\n".join(["Failed:", *(f"  {line}" for line in lines)] if lines else []))
    if earlier := len(failure_lines(jobs, results)) + len(damaged) - len(lines):
        print(f"{earlier} jobs that failed in earlier runs have not been run again.")
    print("Mend the cause; the same command continues where this one stopped.", flush=True)


def finished(graph: Graph, seconds: float) -> None:
    """After success: the verdict, a table, what to open, where the runs are in MLflow, how long it took."""
    from neuspring.report.verdict import headline

    config, folder, neuspring = graph.config, graph.folder, program("neuspring")
    begun = (Path(config.results) / FOLDER / RUN_FILE).stat().st_mtime
    summary = Path(folder) / "summary.md"
    if summary.exists():
        print(f"\n{headline(summary.read_text())}\n")
        tell_findings(graph)
        pages = {f"{folder}/report.html": "everything", f"{folder}/pictures.html": "films of every method"}
        there = [f"{page} ({what})" for page, what in pages.items() if Path(page).exists()]
        print(f"Open in a browser: {', '.join(there)}" if there else "The report is made by the target `all`.")
        print(f"All tables: {summary}. Scores, trajectories, plots: {config.results}/<scenario>/<method>/<seed>/")
    for study in graph.benchmark.studies:
        path = Path(folder) / "studies" / f"{study}.md"
        if path.exists() and path.stat().st_mtime >= begun:
            print(f"{study}: {path}")
    if not summary.exists():
        return
    print(f"What is behind a number: {neuspring} explain --results {shlex.quote(config.results)}")
    if config.tracking.enabled:
        tracking = json.dumps({"tracking": plain(config.tracking)}, sort_keys=True)
        place = ["--results", config.results, *(["--settings", tracking] if config.tracking.uri else [])]
        waiting = [path for path in map(Path, graph.logged_runs()) if path.exists() and "logged" not in path.read_text()]
        if waiting:
            reason = waiting[0].read_text().strip()
            print(f"{len(waiting)} runs could not be logged ({reason}). Their records wait on disk; send them:")
            print(f"  {neuspring} sync {shlex.join(place)}")
        print(f"Look at the runs in MLflow: {neuspring} ui {shlex.join(place)}", flush=True)
    print(f"It took {duration(seconds)}.", flush=True)


def tell_findings(graph: Graph) -> None:
    """Warnings of the steps of perception on all scenarios, and of each method's fits the worst; notes are in the report."""
    from neuspring.report.notes import of_fits

    found = [*warnings_of(Path(graph.config.results), graph.config.scenarios)]
    runs = list[RunRecord]()
    for path in graph.runs():
        with contextlib.suppress(InputError):  # the tables say which are damaged
            runs.append(RunRecord.load(Path(path)))
    fits = sorted(of_fits(runs), key=lambda pair: pair[1].value)
    found += {(one.where.partition("/")[0], one.name): (name, one) for name, one in fits}.values()
    if found:
        print(f"Perception and fits noticed {len(found)} thing{'s' * (len(found) > 1)} that may make results worse:")
        print("\n".join(f"  {name}: {one}" for name, one in found[:MOST_FINDINGS]))
        if len(found) > MOST_FINDINGS:
            print(f"  {len(found) - MOST_FINDINGS} more are in the report.")
        print()
