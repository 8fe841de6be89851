"""Findings of data checks, for assertions."""

from pathlib import Path


def of_level(findings, *levels):
    """Texts of the findings with one of these levels."""
    return [f"{Path(d.where).name}: {d.message}" for d in findings if d.level in levels]


def serious(findings):
    """Texts of errors and warnings."""
    return of_level(findings, "error", "warning")


def holds(findings, level, file, *words):
    """Whether one finding of this level and file has all `words` in its message."""
    return any(d.level == level and Path(d.where).name == file and all(w in d.message for w in words) for d in findings)
