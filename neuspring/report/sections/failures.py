"""Failures: failed jobs and their causes, numerical failures, damaged files; and a table of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from neuspring.core.job_records import JobRecord
from neuspring.core.table import Cell, Table, Tone
from neuspring.core.text import duration
from neuspring.report.blocks import Block, Fold, PageSection, Text
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection, link, several


def failures(material: ReportData) -> PageSection:
    """Everything that keeps runs out of the tables, and a table of the runs that there are."""
    failed = [job for job in material.jobs if job.failed]
    runs = material.collected.runs
    broken = runs[runs["status"] == "failed"] if len(runs) else runs
    blocks: list[Block] = []
    if not failed and not len(broken) and not material.damaged:
        blocks.append(Text(text="Nothing has failed.", tone="good"))
    if failed:
        blocks.append(_jobs("Failed jobs", failed, material))
    if len(broken):
        blocks.append(_numerical(broken.assign(method=broken["method"].map(material.numbers.name))))
    if material.damaged:
        rows = [[Cell(text=path), Cell(text=why, wrap=True)] for path, why in list(material.damaged.items())[:MOST_ROWS]]
        note = "Delete a damaged file and run the same command again." + _rest(len(material.damaged))
        blocks.append(Table(caption="Damaged files", header=["File", "Why"], rows=rows, note=note))
    if len(runs):
        blocks.append(_matrix(runs.assign(method=runs["method"].map(material.numbers.name))))
    return PageSection(key="failures", title="Failures and missing runs", blocks=blocks)


def _rest(count: int) -> str:
    return f" {count - MOST_ROWS} more are not listed." if count > MOST_ROWS else ""


def _jobs(caption: str, jobs: Sequence[JobRecord], material: ReportData) -> Table:
    rows = []
    for job in jobs[:MOST_ROWS]:
        log = material.results / job.log
        target = link(log, material.output.resolve().parent) if log.is_file() else ""
        time = Cell(text=duration(job.seconds), value=job.seconds)
        cells = [Cell(text=job.name), Cell(text=job.message, wrap=True), time, Cell(text="log" if target else job.log, link=target)]
        rows.append(cells)
    header = ["Job", "Message", "Time", "Log"]
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
