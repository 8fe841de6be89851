"""The benchmark's own tables, as `neuspring tables` writes them."""

from __future__ import annotations

from neuspring.report.blocks import Block, PageSection, Text
from neuspring.report.data import ReportData, ReportSection
from neuspring.report.summary import score_blocks


def scores(material: ReportData) -> PageSection:
    """Averages, aims, breakdowns, pictures, twins on other recordings."""
    some = len(material.collected.runs)
    blocks: list[Block] = score_blocks(material.numbers) if some else [Text(text="No run has finished.", tone="mute")]
    return PageSection(key="scores", title="Scores", blocks=blocks)


section = ReportSection(order=20, make=scores)
