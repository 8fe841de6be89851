"""Findings: what steps of perception and fits noticed of their own results."""

from __future__ import annotations

from neuspring.core.findings import Level, findings_of
from neuspring.core.table import Cell, Chip, Table, Tone
from neuspring.report.blocks import Block, Fold, PageSection, Text
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection, several
from neuspring.report.notes import of_fits

TONES: dict[Level, Tone] = {"error": "bad", "warning": "warn", "note": "mute"}


def findings(material: ReportData) -> PageSection | None:
    """A table of warnings, and one of notes to unfold; None where nothing was found that is worth saying."""
    found = [(name, one) for name in material.choice.scenarios for one in findings_of(material.results, name)]
    found += of_fits(material.runs)
    if not found:
        return None
    loud, quiet = ([pair for pair in found if (pair[1].level == "note") == noted] for noted in (False, True))
    blocks: list[Block] = []
    for caption, part in (("Warnings", loud), ("Notes", quiet)):
        rows = []
        for name, one in part[:MOST_ROWS]:
            level = Chip(text=one.level, tone=TONES[one.level])
            rows.append([Cell(text=name), Cell(text=one.where), Cell(text=one.name, chips=[level]), Cell(text=one.text, wrap=True)])
        rest = f"{len(part) - MOST_ROWS} more are in the records." if len(part) > MOST_ROWS else ""
        table = Table(caption=caption, header=["Scenario", "Where", "What", "Finding"], rows=rows, stub=1, note=rest)
        if part:
            blocks.append(table if part is loud else Fold(summary=several(len(part), "note"), blocks=[table]))
    if not loud:
        blocks.insert(0, Text(text="Nothing was noticed that makes results worse.", tone="good"))
    about = "Each step looks at its own result: a warning says what may make all methods worse, or one, and what to do."
    return PageSection(key="findings", title="Findings of perception and fits", about=about, blocks=blocks)


section = ReportSection(order=60, make=findings)
