"""Certainty of the scores, with a picture of the ratios."""

from __future__ import annotations

import io

from neuspring.draw.sheet import DPI
from neuspring.report.blocks import Block, PageSection
from neuspring.report.data import ReportData, ReportSection, embedded
from neuspring.report.summary import detail_blocks, figures


def details(material: ReportData) -> PageSection | None:
    """Intervals, spread, failures, notes; None without any run."""
    if not len(material.collected.runs):
        return None
    blocks: list[Block] = []
    for _, caption, figure in figures(material.numbers) if len(material.numbers.usable) else ():
        stream = io.BytesIO()
        figure.savefig(stream, dpi=DPI, format="png")
        blocks.append(embedded(stream.getvalue(), caption))
    return PageSection(key="details", title="How sure the scores are", blocks=[*blocks, *detail_blocks(material.numbers)])


section = ReportSection(order=50, make=details)
