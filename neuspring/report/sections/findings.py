"""Findings: what perception, searches and fits report about their own results."""

from __future__ import annotations

from neuspring.core.findings import findings_of
from neuspring.core.table import Cell, Table, Tone
from neuspring.report.blocks import Block, Fold
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection
from neuspring.report.notes import of_runs
from neuspring.report.tables import several

LEVEL_TONES: dict[str, Tone] = {"error": "bad", "warning": "warn", "note": "mute"}


def findings(material: ReportData) -> list[Block]:
    """A table of warnings and a folded table of notes; empty without findings."""
    pairs = [(name, finding) for name in material.choice.scenarios for finding in findings_of(material.results, name)]
    pairs += of_runs(material.runs)
    blocks: list[Block] = []
    for caption, are_notes in (("Warnings", False), ("Notes", True)):
        part = [pair for pair in pairs if (pair[1].level == "note") == are_notes]
        rows = []
        for name, finding in part[:MOST_ROWS]:
            texts = [Cell(text=text) for text in (name, finding.where, finding.name)]
            rows.append([*texts, Cell(text=finding.text, wrap=True), Cell(text=finding.level, tone=LEVEL_TONES[finding.level])])
        table = Table(caption=caption, header=["Scenario", "Subject", "Check", "Finding", "Level"], rows=rows)
        blocks += [Fold(summary=several(len(part), "note"), blocks=[table]) if are_notes else table] if part else []
    return blocks


section = ReportSection(order=60, title="Warnings and notes", make=findings)
