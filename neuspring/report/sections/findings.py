"""Findings of perception, searches and fits on their own results; perception against the truth; sweeps."""

from __future__ import annotations

from neuspring.core.findings import findings_of
from neuspring.core.table import Cell, Table, Tone
from neuspring.report.blocks import Block, Fold, PageSection
from neuspring.report.data import MOST_ROWS, ReportData, ReportSection, prose
from neuspring.report.notes import of_runs
from neuspring.report.tables import several

LEVEL_TONES: dict[str, Tone] = {"error": "bad", "warning": "warn", "note": "mute"}


def findings(material: ReportData) -> PageSection | None:
    """A table of warnings, and a folded one of notes; None where nothing was found."""
    found = [(name, one) for name in material.choice.scenarios for one in findings_of(material.results, name)]
    found += of_runs(material.runs)
    blocks: list[Block] = []
    for noted in (False, True):
        part = [pair for pair in found if (pair[1].level == "note") == noted]
        rows = [
            [
                Cell(text=name),
                Cell(text=one.level, tone=LEVEL_TONES[one.level]),
                Cell(text=one.where),
                Cell(text=one.name),
                Cell(text=one.text, wrap=True),
            ]
            for name, one in part[:MOST_ROWS]
        ]
        table = Table(caption="Notes" if noted else "Warnings", header=["Scenario", "Level", "Where", "What", "Finding"], rows=rows)
        blocks += [Fold(summary=several(len(part), "note"), blocks=[table]) if noted else table] if part else []
    texts = {"Perception against the truth": material.results / material.choice.tables / "perception.md"}
    texts |= {f"Sweep {path.parent.name}": path for path in sorted((material.results / "tune").glob("*/summary.md"))}
    blocks += [Fold(summary=name, blocks=[text]) for name, path in texts.items() if (text := prose(material, path))]
    return PageSection(key="findings", title="Findings of perception and fits", blocks=blocks) if blocks else None


section = ReportSection(order=60, make=findings)
