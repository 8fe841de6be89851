"""Fits, by the records of their runs: springs at a limit of their stiffness."""

from __future__ import annotations

from typing import Any

from neuspring.core.run_record import RunRecord

SHARE_AT_BOUND = 0.05
"""A share of springs at the bound of their stiffness above this may limit the fit: in notes of runs and below tables alike."""


def at_bound(run: RunRecord) -> float | None:
    """Share of springs at the bound of their deviation from the searched stiffness."""
    share = run.params.get("fit.result.at_bound")
    return None if share is None else float(share)


def at_range(run: RunRecord) -> dict[str, Any] | None:
    """Share of springs at an end of the range of stiffness, N, and ten times its upper end."""
    share, ends = run.params.get("fit.result.at_stiffness_range"), run.params.get("fit.fit.stiffness_range")
    return None if share is None or not ends else {"value": share, "least": float(ends[0]), "more": 10.0 * ends[1]}
