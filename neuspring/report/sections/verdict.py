"""The verdict: which method is ahead, by how much, and the next command."""

from __future__ import annotations

import shlex

from neuspring.core.job_records import asked
from neuspring.report import tables
from neuspring.report.blocks import Block, Code, Text
from neuspring.report.data import ReportData, ReportSection
from neuspring.report.tables import several


def verdict(material: ReportData) -> list[Block]:
    """The verdict, the command that completes the runs, and the numbers of failed jobs and unreadable files."""
    text = f"Nothing to report yet: the folder {material.results.resolve().name} contains no runs."
    blocks: list[Block] = tables.verdict(material.numbers) if len(material.table.runs) else [Text(text=text, tone="warn")]
    command = asked(material.results).get("command")
    if command and (material.table.runs["status"] != "ok").any():
        blocks += [Text(text="This command makes the missing runs and keeps the finished ones:"), Code(text=shlex.join(command))]
    failed = sum(job.failed for job in material.jobs)
    for count, noun, what in ((failed, "job", "failed"), (len(material.damaged), "file", "cannot be read")):
        if count:
            blocks.append(Text(text=f"{several(count, noun)} {what}; see Failures.", tone="warn"))
    return blocks


section = ReportSection(order=10, title="Verdict", make=verdict, phase=2)
