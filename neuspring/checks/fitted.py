"""Fits, from the records of their runs: springs at a limit of their stiffness."""

from __future__ import annotations

from typing import Any

from neuspring.core.run_record import RunRecord

SHARE_AT_BOUND = 0.05
"""A larger fraction of springs at a limit of their stiffness may limit the fit; used in notes of runs and below tables."""


def at_bound(run: RunRecord) -> float | None:
    """Fraction of springs at the bound of their deviation from the searched stiffness."""
    share = run.params.get("fit.result.at_bound")
    return None if share is None else float(share)


def at_range(run: RunRecord) -> dict[str, Any] | None:
    """Fraction of springs at an end of the stiffness range; `least` and `more`, N: the range with a ten times larger end."""
    share, ends = run.params.get("fit.result.at_stiffness_range"), run.params.get("fit.fit.stiffness_range")
    return None if share is None or not ends else {"value": share, "least": float(ends[0]), "more": 10.0 * ends[1]}
