"""What a check of data found, for assertions."""

from __future__ import annotations

from pathlib import Path

from neuspring.core.findings import Finding


def of_level(findings: list[Finding], *levels: str) -> list[str]:
    """Texts of the findings with one of these levels."""
    return [f"{Path(d.where).name}: {d.message}" for d in findings if d.level in levels]


def serious(findings: list[Finding]) -> list[str]:
    """Texts of errors and warnings."""
    return of_level(findings, "error", "warning")


def holds(findings: list[Finding], level: str, file: str, *words: str) -> bool:
    """Whether one finding of this level and file has all `words` in its message."""
    return any(d.level == level and Path(d.where).name == file and all(w in d.message for w in words) for d in findings)
