"""Perception against the truth of synthetic captures."""

from __future__ import annotations

from neuspring.report.blocks import PageSection
from neuspring.report.data import ReportData, ReportSection, prose


def perception(material: ReportData) -> PageSection | None:
    """Perception against the truth of synthetic captures; None where it was not judged."""
    text = prose(material, material.results / material.choice.tables / "perception.md")
    return PageSection(key="perception", title="Perception", blocks=[text]) if text else None


section = ReportSection(order=70, make=perception)
