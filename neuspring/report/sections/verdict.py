"""The verdict in words, first of all."""

from __future__ import annotations

from neuspring.report import verdict as words
from neuspring.report.blocks import Block, PageSection, Text
from neuspring.report.data import ReportData, ReportSection, several


def verdict(material: ReportData) -> PageSection:
    """The answer, and how many jobs failed and files cannot be read."""
    blocks: list[Block] = [*words.verdict(material.numbers)] if len(material.collected.runs) else []
    if not blocks:
        text = f"Nothing to report yet: {material.results.resolve().name} holds no run, and none was asked for."
        blocks.append(Text(text=text, tone="warn"))
    failed, damaged = sum(job.failed for job in material.jobs), len(material.damaged)
    for count, noun, what in ((failed, "job", "failed"), (damaged, "file", "cannot be read")):
        if count:
            blocks.append(Text(text=f"{several(count, noun)} {what}: see Failures and missing runs.", tone="warn"))
    return PageSection(key="verdict", title="Verdict", blocks=blocks)


section = ReportSection(order=10, make=verdict, phase=2)
