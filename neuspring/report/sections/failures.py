"""Failures: failed jobs, damaged files, runs outside the averages."""

from __future__ import annotations

from neuspring.core.table import Cell, Table
from neuspring.core.text import duration
from neuspring.report.blocks import Block, Text
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection, link
from neuspring.report.tables import failure_blocks


def failures(material: ReportData) -> list[Block]:
    """Failed jobs, damaged files and runs outside the averages, with their reasons."""
    blocks: list[Block] = []
    if failed := [job for job in material.jobs if job.failed]:
        folder = material.output.resolve().parent
        rows = []
        for job in failed[:MOST_ROWS]:
            log = material.results / job.log
            target = link(log, folder) if log.is_file() else ""
            rows.append(
                [
                    Cell(text=job.name),
                    Cell(text=job.message, wrap=True),
                    Cell(text=duration(job.seconds), value=job.seconds),
                    Cell(text="log" if target else job.log, link=target),
                ]
            )
        blocks.append(Table(caption="Failed jobs", header=["Job", "Message", "Time", "Log"], rows=rows))
    if material.damaged:
        damaged = [[Cell(text=path), Cell(text=reason, wrap=True)] for path, reason in list(material.damaged.items())[:MOST_ROWS]]
        note = "Delete the damaged files, then rerun the same command."
        blocks.append(Table(caption="Damaged files", header=["File", "Reason"], rows=damaged, note=note))
    blocks += failure_blocks(material.numbers)
    return blocks or [Text(text="Nothing has failed.", tone="good")]


section = ReportSection(order=70, title="Failures", make=failures, phase=2)
