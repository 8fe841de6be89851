"""What ran and what went wrong: hours and memory, failed jobs and their causes, numerical failures, findings of perception."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.findings import Level, findings_of
from neuspring.core.job_records import JobRecord
from neuspring.core.table import Cell, Chip, Table, Tone
from neuspring.report.benchmark import timing_table
from neuspring.report.blocks import Block, Fold, Section, Text
from neuspring.report.sections.data import METHOD_RULES, ReportData, duration, hours, memory, several
from neuspring.report.sections.pictures import link
from neuspring.scores.metrics import DASH

ORDER = (
    *("capture", "segment", "track", "lift", "judge", "observe", "search", "fits", "fit", "rollout"),
    *("train", "predict", "transfer", "appearance", "render", "score", "tables", "study", "report", "log_run", "track_init"),
)
"""Rules in the order of the workflow."""


def _grouped(jobs: Iterable[JobRecord], key: Callable[[JobRecord], str]) -> dict[str, list[JobRecord]]:
    groups: dict[str, list[JobRecord]] = defaultdict(list)
    for job in jobs:
        groups[key(job)].append(job)
    return groups


def _owner(job: JobRecord) -> str:
    parts = job.name.split("/")
    if len(parts) != 4:
        return ""
    if job.rule == "search":
        return f"search {parts[2]}"
    if job.rule == "appearance":
        return f"splats {parts[2].removeprefix('appearance').removeprefix('-') or 'shared'}"
    return parts[2] if job.rule in (*METHOD_RULES, "transfer") else ""


def gpu_hours(jobs: Sequence[JobRecord]) -> float:
    """GPU-hours of jobs, failed attempts included."""
    return sum(attempt.seconds * len(attempt.devices) for job in jobs for attempt in job.attempts) / 3600


def work_section(material: ReportData) -> Section:
    """Tables of hours."""
    title = "Time and hardware"
    jobs = material.jobs
    if not jobs:
        note = Text(text="There are no job records: times are those of finished runs alone.", tone="mute")
        return Section(key="work", title=title, blocks=[note, timing_table(material.collected.runs)] if material.runs else [note])
    attempts = [attempt for job in jobs for attempt in job.attempts]
    hosts = sorted({a.host for a in attempts if a.host})
    names = sorted({name for a in attempts for name in a.device_names})
    about = f"Hosts: {', '.join(hosts) or 'unknown'}. GPUs: {', '.join(names) or 'none used'}. Times include failed attempts."
    by_rule, by_method = _grouped(jobs, lambda job: job.rule), _grouped(jobs, _owner)
    rules = sorted(by_rule, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))
    steps = {name: by_rule[name] for name in rules} | ({"all": jobs} if len(rules) > 1 else {})
    methods = {name: by_method[name] for name in sorted(by_method) if name}
    blocks: list[Block] = [_costs("By step", "Step", steps, sortable=False)]
    if methods:
        caption = "By method (searches and splats apart, since methods share them)"
        blocks.append(_costs(caption, "Method", methods, sortable=True))
    return Section(key="work", title=title, about=about, blocks=blocks)


def _costs(caption: str, what: str, groups: Mapping[str, Sequence[JobRecord]], *, sortable: bool) -> Table:
    header = [what, "Jobs", "Failed", "Retries", "Median", "Longest", "GPU-hours", "CPU-hours", "Waited", "Peak memory"]
    header += ["GPU memory", "GPU use"]
    rows = [_cost(name, jobs) for name, jobs in groups.items()]
    used = [k for k in range(len(header)) if any(row[k].text != DASH for row in rows)]
    header, rows = [header[k] for k in used], [[row[k] for k in used] for row in rows]
    on_gpu = any(attempt.devices for jobs in groups.values() for job in jobs for attempt in job.attempts)
    note = "Waited: for a GPU. A GPU that two jobs share counts for both." if on_gpu else ""
    return Table(caption=caption, header=header, rows=rows, sortable=sortable, note=note)


def _cost(name: str, jobs: Sequence[JobRecord]) -> list[Cell]:
    """The cost of some jobs, their failed attempts included."""
    attempts = [attempt for job in jobs for attempt in job.attempts]
    failed, retries = sum(job.failed for job in jobs), sum(len(job.attempts) - 1 for job in jobs)
    seconds = [job.seconds for job in jobs]
    median, longest = float(np.median(seconds)), max(seconds)
    on_gpu, waited = 3600 * gpu_hours(jobs), sum(a.waited for a in attempts)
    peak = max((a.peak_memory_mb for a in attempts), default=0.0)
    gpu_peak = max((a.peak_gpu_memory_mb for a in attempts if a.peak_gpu_memory_mb is not None), default=None)
    used = [(a.gpu_utilization, a.seconds * len(a.devices)) for a in attempts if a.gpu_utilization is not None and a.seconds > 0]
    weight = sum(weight for _, weight in used)
    use = sum(percent * weight for percent, weight in used) / weight if weight else None
    return [
        Cell(text=name),
        _number(len(jobs)),
        Cell(text=str(failed), tone="bad" if failed else "", value=failed),
        _number(retries),
        Cell(text=duration(median), value=median),
        Cell(text=duration(longest), value=longest),
        _hours(on_gpu),
        _hours(sum(a.cpu_seconds for a in attempts)),
        Cell(text=duration(waited) if on_gpu else DASH, value=waited),
        Cell(text=memory(peak), value=peak),
        Cell(text=memory(gpu_peak), value=gpu_peak or 0.0),
        Cell(text=DASH if use is None else f"{use:.0f} %", value=use or 0.0),
    ]


def _number(value: int) -> Cell:
    return Cell(text=f"{value:,}", value=value)


def _hours(seconds: float) -> Cell:
    return Cell(text=hours(seconds) if seconds else DASH, value=seconds)


MOST_ROWS = 400
"""At most so many failures of a kind are listed; the rest is counted."""


def failures_section(material: ReportData) -> Section:
    """Everything that keeps runs out of the tables, and a table of the runs that there are."""
    failed = [job for job in material.jobs if job.failed]
    left = [job for job in material.jobs if job.last.outcome == "running"]
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
        blocks.append(_numerical(broken))
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
        blocks.append(_matrix(runs))
    return Section(key="failures", title="Failures and missing runs", blocks=blocks)


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
    rows = [
        [*(Cell(text=str(one)) for one in (row.scenario, row.method, row.seed)), Cell(text=row.reason, wrap=True)] for row in runs
    ]
    note = "Results, not crashes: the simulation left its physical range, or the record is damaged." + _rest(len(broken))
    header = ["Scenario", "Method", "Seed", "Reason"]
    return Table(caption="Failed runs", header=header, rows=rows, stub=2, sortable=True, note=note)


def _matrix(runs: pd.DataFrame) -> Fold:
    """A table of scenarios by methods that counts the finished seeds."""
    counts = runs.groupby(["scenario", "method", "status"]).size().to_dict()
    asked = set(zip(runs["scenario"], runs["method"], strict=True))
    scenarios, methods = (list(dict.fromkeys(runs[name])) for name in ("scenario", "method"))
    seeds, rows = runs["seed"].nunique(), []
    for scenario in scenarios:
        row = [Cell(text=str(scenario))]
        for method in methods:
            ok, failed = (counts.get((scenario, method, status), 0) for status in ("ok", "failed"))
            wrong = f" ✗ {failed}" if failed else ""
            if (scenario, method) not in asked:
                row.append(Cell(text="", value=-1))
                continue
            text = (f"✓ {ok}" if ok == seeds else f"{ok} of {seeds}" if ok else "" if failed else "–") + wrong
            tone = "bad" if failed else "good" if ok == seeds else "warn" if ok else "mute"
            row.append(Cell(text=text.strip(), tone=tone, value=ok))  # type: ignore[arg-type]
        rows.append(row)
    missing = int((runs["status"] == "missing").sum())
    table = Table(
        caption="Finished seeds",
        header=["Scenario", *map(str, methods)],
        rows=rows,
        sortable=True,
        note=f"✓ all {several(seeds, 'seed')} finished; ✗ failed; – missing; empty: does not apply.",
    )
    done = int((runs["status"] == "ok").sum())
    return Fold(summary=f"Runs: {done} of {len(runs)} finished, {missing} missing", blocks=[table], open=len(scenarios) <= 30)


TONES: dict[Level, Tone] = {"error": "bad", "warning": "warn", "note": "mute"}


def findings_section(material: ReportData) -> Section | None:
    """A table of warnings, and one of notes to unfold; None where perception found nothing worth saying, or did not run."""
    found = [(name, one) for name in material.choice.scenarios for one in findings_of(material.results, name)]
    if not found:
        return None
    loud = [(name, one) for name, one in found if one.level != "note"]
    quiet = [(name, one) for name, one in found if one.level == "note"]
    blocks: list[Block] = []
    for caption, part in (("Warnings", loud), ("Notes", quiet)):
        rows = [
            [
                Cell(text=name),
                Cell(text=one.where),
                Cell(text=one.name, chips=[Chip(text=one.level, tone=TONES[one.level])]),
                Cell(text=one.text, wrap=True),
            ]
            for name, one in part[:MOST_ROWS]
        ]
        rest = f"{len(part) - MOST_ROWS} more are in the records." if len(part) > MOST_ROWS else ""
        table = Table(caption=caption, header=["Scenario", "Where", "What", "Finding"], rows=rows, stub=1, note=rest)
        if part:
            blocks.append(table if part is loud else Fold(summary=several(len(part), "note"), blocks=[table]))
    if not loud:
        blocks.insert(0, Text(text="Perception noticed nothing that makes results worse.", tone="good"))
    about = "Each step looks at its own result: a warning says what may make all methods worse, and what to do."
    return Section(key="findings", title="Findings of perception", about=about, blocks=blocks)
