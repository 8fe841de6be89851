"""The tables that `neuspring study` writes."""

from __future__ import annotations

from neuspring.report.blocks import Block, Fold
from neuspring.report.data import ReportData, ReportSection
from neuspring.report.study import blocks_of


def studies(material: ReportData) -> list[Block]:
    """One fold per requested study, and per study of which at least two methods ran on the paper's data."""
    choice, runs = material.choice, material.table.runs
    of_paper = set(runs.loc[(runs["status"] == "ok") & (runs["source"] == "phystwin"), "method"])
    asked = choice.settings.studies if choice.settings else ()
    return [
        Fold(summary=f"{name}: {study.title}", blocks=blocks_of(name, study, material.table, material.results))
        for name, study in choice.studies.items()
        if len(runs) and (name in asked or len(of_paper & set(study.rows.values())) > 1)
    ]


section = ReportSection(order=45, title="The paper's tables", make=studies, about="Scores explains the columns.")
