"""Findings of perception, searches and fits on their own results."""

from __future__ import annotations

from neuspring.core.findings import findings_of
from neuspring.core.table import Cell, Table, Tone
from neuspring.report.blocks import Block, Fold
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection
from neuspring.report.notes import of_runs
from neuspring.report.tables import several

LEVEL_TONES: dict[str, Tone] = {"error": "bad", "warning": "warn", "note": "mute"}


def findings(material: ReportData) -> list[Block]:
    """A table of warnings, and a folded one of notes; none where nothing was found."""
    found = [(name, one) for name in material.choice.scenarios for one in findings_of(material.results, name)]
    found += of_runs(material.runs)
    blocks: list[Block] = []
    for caption, noted in (("Warnings", False), ("Notes", True)):
        part = [pair for pair in found if (pair[1].level == "note") == noted]
        rows = []
        for name, one in part[:MOST_ROWS]:
            texts = [Cell(text=text) for text in (name, one.where, one.name)]
            rows.append([*texts, Cell(text=one.text, wrap=True), Cell(text=one.level, tone=LEVEL_TONES[one.level])])
        table = Table(caption=caption, header=["Scenario", "Where", "What", "Finding", "Level"], rows=rows)
        blocks += [Fold(summary=several(len(part), "note"), blocks=[table]) if noted else table] if part else []
    return blocks


section = ReportSection(order=60, title="Findings of perception and fits", make=findings)
