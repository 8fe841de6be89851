"""The tables that `neuspring tables` writes, and the figure of the ratios."""

from __future__ import annotations

from neuspring.report.blocks import Block, Text
from neuspring.report.data import ReportData, ReportSection, shown_figure
from neuspring.report.tables import ratios_drawn, summary_blocks


def scores(material: ReportData) -> list[Block]:
    """Averages, breakdowns, ratios, aims."""
    if not len(material.table.finished):
        return [Text(text="No run has finished.", tone="mute")]
    blocks = summary_blocks(material.numbers)
    if drawn := ratios_drawn(material.numbers):
        blocks.append(shown_figure(drawn[1], drawn[0]))
    return blocks


section = ReportSection(order=40, title="Scores", make=scores)
