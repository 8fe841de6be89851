"""Fits, as records of runs tell of them: springs at a limit of their stiffness, where a wider limit may predict better."""

from __future__ import annotations

import math
from typing import Any

from neuspring.core.checks import Check
from neuspring.core.run_record import RunRecord

SHARE_AT_BOUND = 0.05
"""A share of springs at the bound of their stiffness above this says that the bound was in training's way: in notes of runs and
below tables alike."""
WIDER_ROWS = {"baseline_ten_frames": "springs_wide", "model_b_pooled": "model_b_wide_pooled"} | {
    name: f"{name}_wide" for name in ("model_b", "shuffled", "neuspring")
}
"""Row of the method table -> the row that differs from it by a wider `fit.output_bound` alone."""


def at_bound(run: RunRecord) -> dict[str, Any] | None:
    """Share of springs at the bound of their deviation from the searched stiffness, and the command that widens it."""
    share, bound, wider = run.params.get("fit.result.at_bound"), run.params.get("fit.fit.output_bound"), WIDER_ROWS.get(run.method)
    if share is None:
        return None
    remedy = f"Raise output_bound in the settings of the row {run.method} of the method table."
    if wider:
        options = f"`--config 'extra_rows={{ours: config/rows/ours.yaml}}' 'methods=[{run.method},{wider}]'`"
        remedy = "Compare with a wider bound: add " + options + " to the command."
    factor = f", {math.exp(bound):.1f} times the searched one or less by as much" if bound else ""
    return {"value": share, "factor": factor, "remedy": remedy}


def at_range(run: RunRecord) -> dict[str, Any] | None:
    """Share of springs at an end of the range of stiffness, N, and ten times its upper end."""
    share, ends = run.params.get("fit.result.at_stiffness_range"), run.params.get("fit.fit.stiffness_range")
    if share is None or not ends:
        return None
    return {"value": share, "least": float(ends[0]), "most": float(ends[1]), "more": 10.0 * ends[1]}


# fmt: off
checks = (
    Check("springs at their bound", "fit", at_bound, (0, SHARE_AT_BOUND), "warning",
          "{value:.0%} of the springs lie at the bound of their stiffness{factor} (fit.output_bound).", "{remedy}"),
    Check("springs at the end of the range", "fit", at_range, (0, SHARE_AT_BOUND), "warning",
          "{value:.0%} of the springs lie at an end of the range of stiffness, {least:g} to {most:g} N (fit.stiffness_range).",
          "Widen it: add `--config 'fit={{stiffness_range: [{least}, {more}]}}'` to the command."),
)
