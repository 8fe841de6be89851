"""Hours and memory of jobs, by step and by method."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from neuspring.core.job_records import JobRecord
from neuspring.core.table import Cell, Table
from neuspring.core.text import duration
from neuspring.report.blocks import Block, PageSection, Text
from neuspring.report.data import METHOD_RULES, ReportData, ReportSection, hours, memory
from neuspring.report.summary import timing_table
from neuspring.scores.metrics import DASH

ORDER = (
    *("capture", "segment", "track", "lift", "judge", "observe", "search", "fits", "fit", "rollout"),
    *("train", "predict", "transfer", "appearance", "render", "score", "tables", "study", "report", "log_run", "track_init"),
)
"""Rules in the order of the workflow."""


def _owner(job: JobRecord) -> str:
    parts = job.name.split("/")
    if len(parts) != 4:
        return ""
    if job.rule == "search":
        return f"search {parts[2]}"
    if job.rule == "appearance":
        return f"splats {parts[2].removeprefix('appearance').removeprefix('-') or 'shared'}"
    return parts[2] if job.rule in (*METHOD_RULES, "transfer") else ""


def work(material: ReportData) -> PageSection:
    """Tables of hours."""
    title = "Time and hardware"
    jobs = material.jobs
    if not jobs:
        note = Text(text="There are no job records: times are those of finished runs alone.", tone="mute")
        times = [timing_table(material.collected.runs)] if material.runs else []
        return PageSection(key="work", title=title, blocks=[note, *times])
    attempts = [attempt for job in jobs for attempt in job.attempts]
    hosts = sorted({a.host for a in attempts if a.host})
    names = sorted({name for a in attempts for name in a.device_names})
    about = f"Hosts: {', '.join(hosts) or 'unknown'}. GPUs: {', '.join(names) or 'none used'}. Times include failed attempts."
    by_rule, by_method = defaultdict[str, list[JobRecord]](list), defaultdict[str, list[JobRecord]](list)
    for job in jobs:
        by_rule[job.rule].append(job)
        by_method[_owner(job)].append(job)
    rules = sorted(by_rule, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))
    steps = {name: by_rule[name] for name in rules} | ({"all": jobs} if len(rules) > 1 else {})
    methods = {material.numbers.name(name): by_method[name] for name in sorted(by_method) if name}
    blocks: list[Block] = [_costs("By step", "Step", steps, sortable=False)]
    if methods:
        caption = "By method (searches and splats apart, since methods share them)"
        blocks.append(_costs(caption, "Method", methods, sortable=True))
    return PageSection(key="work", title=title, about=about, blocks=blocks)


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
    on_gpu = sum(attempt.seconds * len(attempt.devices) for attempt in attempts)
    on_cpu, waited = sum(a.cpu_seconds for a in attempts), sum(a.waited for a in attempts)
    peak = max((a.peak_memory_mb for a in attempts), default=0.0)
    gpu_peak = max((a.peak_gpu_memory_mb for a in attempts if a.peak_gpu_memory_mb is not None), default=None)
    used = [(a.gpu_utilization, a.seconds * len(a.devices)) for a in attempts if a.gpu_utilization is not None and a.seconds > 0]
    weight = sum(weight for _, weight in used)
    use = sum(percent * weight for percent, weight in used) / weight if weight else None
    values: list[tuple[str, float]] = [
        (f"{len(jobs):,}", len(jobs)),
        (str(failed), failed),
        (f"{retries:,}", retries),
        *((duration(value), value) for value in (float(np.median(seconds)), max(seconds))),
        *((hours(value) if value else DASH, value) for value in (on_gpu, on_cpu)),
        (duration(waited) if on_gpu else DASH, waited),
        *((memory(value), value or 0.0) for value in (peak, gpu_peak)),
        (DASH if use is None else f"{use:.0f} %", use or 0.0),
    ]
    tones = {1: "bad"} if failed else {}
    return [Cell(text=name), *(Cell(text=text, value=value, tone=tones.get(k, "")) for k, (text, value) in enumerate(values))]  # type: ignore[arg-type]


section = ReportSection(order=90, make=work)
