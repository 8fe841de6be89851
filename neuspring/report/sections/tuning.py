"""The sweeps of a results folder."""

from __future__ import annotations

from neuspring.report.blocks import Block, Fold, PageSection
from neuspring.report.data import ReportData, ReportSection, prose


def tuning(material: ReportData) -> PageSection | None:
    """The sweeps under results/tune; None without any."""
    texts = {path.parent.name: prose(material, path) for path in sorted((material.results / "tune").glob("*/summary.md"))}
    folds: list[Block] = [Fold(summary=name, blocks=[text]) for name, text in texts.items() if text]
    return PageSection(key="tuning", title="Tuning", blocks=folds) if folds else None


section = ReportSection(order=80, make=tuning)
