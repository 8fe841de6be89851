"""The benchmark's tables, as `neuspring tables` writes them, with the figure of ratios."""

from __future__ import annotations

import io

from neuspring.draw.sheet import DPI
from neuspring.report.blocks import Block, PageSection, Picture, Text
from neuspring.report.data import ReportData, ReportSection, data_uri
from neuspring.report.tables import figures, summary_blocks


def scores(material: ReportData) -> PageSection:
    """Averages, breakdowns, ratios, aims."""
    if not len(material.table.finished):
        return PageSection(key="scores", title="Scores", blocks=[Text(text="No run has finished.", tone="mute")])
    blocks: list[Block] = summary_blocks(material.numbers)
    for _, caption, figure in figures(material.numbers):
        stream = io.BytesIO()
        figure.savefig(stream, dpi=DPI, format="png")
        blocks.append(Picture(caption=caption, alt=caption, data=data_uri("image/png", stream.getvalue()), wide=True, paper=True))
    return PageSection(key="scores", title="Scores", blocks=blocks)


section = ReportSection(order=40, make=scores)
