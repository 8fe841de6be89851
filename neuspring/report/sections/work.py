"""Time and memory of jobs per rule, and of stages per method."""

from __future__ import annotations

import numpy as np

from neuspring.core.job_records import JobRecord
from neuspring.core.table import Table
from neuspring.core.text import duration
from neuspring.report.blocks import Block
from neuspring.report.data import ReportData, ReportSection
from neuspring.report.tables import cost_table


def work(material: ReportData) -> list[Block]:
    """Table of jobs per rule and table of stages per method; empty if neither was recorded."""
    by_rule: dict[str, list[JobRecord]] = {}
    for job in material.jobs:
        by_rule.setdefault(job.rule, []).append(job)
    rows = []
    for rule, jobs in {**by_rule, "all": material.jobs}.items():
        seconds = [job.seconds for job in jobs]
        peak = max((job.peak_memory_mb for job in jobs), default=0.0)
        times = [duration(float(value)) for value in (np.median(seconds or [0]), max(seconds, default=0), sum(seconds))]
        rows.append([rule, len(jobs), sum(job.failed for job in jobs), *times, f"{peak:.0f} MB"])
    header = ["Rule", "Jobs", "Failed", "Median", "Longest", "Sum", "Peak memory"]
    jobs_table = [Table.of_texts(header, rows, "Jobs")] if material.jobs else []
    return [*jobs_table, *([cost_table(material.numbers)] if len(material.table.task("time")) else [])]


section = ReportSection(order=80, title="Time and memory", make=work)
