"""Hours and memory of jobs, by rule and by method."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from neuspring.core.job_records import JobRecord
from neuspring.core.table import Cell, Table
from neuspring.core.text import duration
from neuspring.report.blocks import Block, PageSection, Text
from neuspring.report.data import ReportData, ReportSection, hours, memory
from neuspring.report.summary import timing_table
from neuspring.scores.metrics import DASH

ORDER = ("perceive", "search", "fit", "appearance", "train", "run", "tables", "study", "page")
"""Rules in the order of the workflow."""
HEADER = ("Jobs", "Failed", "Median", "Longest", "GPU-hours", "CPU-hours", "Peak memory")


def work(material: ReportData) -> PageSection:
    """Tables of hours."""
    title, jobs = "Time and hardware", material.jobs
    if not jobs:
        note = Text(text="There are no job records: times are those of finished runs alone.", tone="mute")
        times = [timing_table(material.collected.runs)] if material.runs else []
        return PageSection(key="work", title=title, blocks=[note, *times])
    hosts, names = sorted({job.host for job in jobs}), sorted({name for job in jobs for name in job.device_names})
    about = f"Hosts: {', '.join(hosts)}. GPUs: {', '.join(names) or 'none used'}."
    by_rule, by_method = defaultdict[str, list[JobRecord]](list), defaultdict[str, list[JobRecord]](list)
    for job in jobs:
        by_rule[job.rule].append(job)
        if job.rule in ("fit", "train", "run") and job.name.count("/") == 3:
            by_method[job.name.split("/")[2]].append(job)
    rules = sorted(by_rule, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))
    steps = {name: by_rule[name] for name in rules} | ({"all": jobs} if len(rules) > 1 else {})
    methods = {material.numbers.name(name): by_method[name] for name in sorted(by_method)}
    blocks: list[Block] = [_costs("By step", "Step", steps)]
    if methods:
        blocks.append(_costs("By method (without searches and splats, which methods share)", "Method", methods))
    return PageSection(key="work", title=title, about=about, blocks=blocks)


def _costs(caption: str, what: str, groups: Mapping[str, Sequence[JobRecord]]) -> Table:
    rows = [_cost(name, jobs) for name, jobs in groups.items()]
    return Table(caption=caption, header=[what, *HEADER], rows=rows, sortable=what == "Method")


def _cost(name: str, jobs: Sequence[JobRecord]) -> list[Cell]:
    seconds = [job.seconds for job in jobs]
    failed, peak = sum(job.failed for job in jobs), max(job.peak_memory_mb for job in jobs)
    on_gpu, on_cpu = (sum(job.seconds for job in jobs if bool(job.devices) == gpu) for gpu in (True, False))
    values: list[tuple[str, float]] = [
        (f"{len(jobs):,}", len(jobs)),
        (str(failed), failed),
        *((duration(value), value) for value in (float(np.median(seconds)), max(seconds))),
        *((hours(value) if value else DASH, value) for value in (on_gpu, on_cpu)),
        (memory(peak), peak),
    ]
    return [Cell(text=name), *(Cell(text=text, value=value) for text, value in values)]


section = ReportSection(order=90, make=work)
