"""Failures: failed jobs and their causes, numerical failures, damaged files; and a table of the runs that there are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import pandas as pd

from neuspring.core.job_records import JobRecord, this_run
from neuspring.core.table import Cell, Chip, Table, Tone
from neuspring.core.text import duration
from neuspring.report.blocks import Block, Fold, PageSection, Text
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection, link, several


def failures(material: ReportData) -> PageSection:
    """Everything that keeps runs out of the tables, and a table of the runs that there are."""
    failed = [job for job in material.jobs if job.failed]
    # Jobs of the run that makes this page, its own among them, may still have no end.
    now = this_run(material.results)
    left = [job for job in material.jobs if job.last.outcome == "running" and not (now and job.last.run == now)]
    runs = material.collected.runs
    broken = runs[runs["status"] == "failed"] if len(runs) else runs
    blocks: list[Block] = []
    if not failed and not len(broken) and not material.damaged:
        blocks.append(Text(text="Nothing has failed.", tone="good"))
    if failed:
        causes = Counter(job.last.cause or "unknown" for job in failed)
        blocks.append(Text(text="Causes: " + ", ".join(f"{cause} ({count})" for cause, count in causes.most_common()) + "."))
        blocks.append(_jobs("Failed jobs", failed, material))
    if len(broken):
        blocks.append(_numerical(broken.assign(method=broken["method"].map(material.numbers.name))))
    if material.damaged:
        rows = [[Cell(text=path), Cell(text=why, wrap=True)] for path, why in list(material.damaged.items())[:MOST_ROWS]]
        note = "Delete a damaged file and run the same command again." + _rest(len(material.damaged))
        blocks.append(Table(caption="Damaged files", header=["File", "Why"], rows=rows, note=note))
    if left:
        about = Text(text="Running now, or their wrapper was killed before it could write more.")
        summary = several(len(left), "job") + " without an end"
        blocks.append(Fold(summary=summary, blocks=[about, _jobs("Jobs", left, material)]))
    retried = [job for job in material.jobs if not job.failed and len(job.attempts) > 1 and job.last.outcome == "ok"]
    if retried:
        summary = f"{several(len(retried), 'job')} that succeeded after another attempt"
        blocks.append(Fold(summary=summary, blocks=[_jobs("Jobs", retried, material)]))
    if len(runs):
        blocks.append(_matrix(runs.assign(method=runs["method"].map(material.numbers.name))))
    return PageSection(key="failures", title="Failures and missing runs", blocks=blocks)


def _rest(count: int) -> str:
    return f" {count - MOST_ROWS} more are not listed." if count > MOST_ROWS else ""


def _jobs(caption: str, jobs: Sequence[JobRecord], material: ReportData) -> Table:
    rows = []
    for job in jobs[:MOST_ROWS]:
        last, log = job.last, material.results / job.log
        causes = dict.fromkeys(attempt.cause for attempt in job.attempts if attempt.cause)
        tone, symbol = {"ok": ("good", "✓"), "transient": ("warn", "!"), "running": ("warn", "!")}.get(last.outcome, ("bad", "✗"))
        outcome = Chip(text=last.outcome, tone=tone, symbol=symbol)  # type: ignore[arg-type]
        target = link(log, material.output.resolve().parent) if log.is_file() else ""
        rows.append(
            [
                Cell(text=job.name),
                Cell(text=", ".join(causes), chips=[outcome]),
                Cell(text=last.message, wrap=True),
                Cell(text=str(len(job.attempts))),
                Cell(text=duration(job.seconds), value=job.seconds),
                Cell(text="log" if target else job.log, link=target),
            ]
        )
    header = ["Job", "Cause", "Message", "Attempts", "Time", "Log"]
    return Table(caption=caption, header=header, rows=rows, sortable=True, note=_rest(len(jobs)).strip())


def _numerical(broken: pd.DataFrame) -> Table:
    runs: list[Any] = list(broken.head(MOST_ROWS).itertuples())
    stubs = [[Cell(text=str(one)) for one in (row.scenario, row.method, row.seed)] for row in runs]
    rows = [[*stub, Cell(text=row.reason, wrap=True)] for stub, row in zip(stubs, runs, strict=True)]
    note = "Results, not crashes: the simulation left its physical range, or the record is damaged." + _rest(len(broken))
    header = ["Scenario", "Method", "Seed", "Reason"]
    return Table(caption="Failed runs", header=header, rows=rows, stub=2, sortable=True, note=note)


def _matrix(runs: pd.DataFrame) -> Fold:
    """A table of scenarios by methods that counts the finished seeds."""
    counts = runs.groupby(["scenario", "method"], sort=False)["status"].value_counts().unstack(fill_value=0)
    counts = counts.reindex(columns=["ok", "failed", "missing"], fill_value=0)
    scenarios, methods = (list(dict.fromkeys(runs[name])) for name in ("scenario", "method"))
    seeds, (done, _, missing) = runs["seed"].nunique(), map(int, counts.sum())

    def cell(ok: int, failed: int, _: int) -> Cell:
        text = f"✓ {ok}" if ok == seeds else f"{ok} of {seeds}" if ok else "" if failed else "–"
        tone: Tone = "bad" if failed else "good" if ok == seeds else "warn" if ok else "mute"
        return Cell(text=f"{text} ✗ {failed}".strip() if failed else text, tone=tone, value=ok)

    own = {key: cell(*map(int, row)) for key, row in zip(counts.index, counts.to_numpy(), strict=True)}
    rows = [[Cell(text=str(name)), *(own.get((name, method), Cell(value=-1)) for method in methods)] for name in scenarios]
    note = f"✓ all {several(seeds, 'seed')} finished; ✗ failed; – missing; empty: does not apply."
    header = ["Scenario", *map(str, methods)]
    table = Table(caption="Finished seeds", header=header, rows=rows, sortable=True, note=note)
    return Fold(summary=f"Runs: {done} of {len(runs)} finished, {missing} missing", blocks=[table], open=len(scenarios) <= 30)


section = ReportSection(order=100, make=failures, phase=2)
