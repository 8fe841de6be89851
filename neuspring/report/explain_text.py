"""An explanation of a cell for people; see `neuspring.report.explain`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from neuspring.core.records import canonical
from neuspring.core.text import markdown
from neuspring.report.explain import Behind, Explanation
from neuspring.report.study import our_change, paper_change
from neuspring.scores.failures import left_out_lines
from neuspring.scores.metrics import DASH, IN_STUDIES, Metric

SHORT = 12
"""Characters of a digest; --json has all."""

COMMANDS = """Commands make the run and all its stages again and replace these files: check out the commit of the run first.
To keep the files, give another folder: --config results=... The commands need the --configfile and --config of the
benchmark; give --configfile to this command too. The same seed on the same type of device gives the same run_key."""


def text(explanation: Explanation) -> str:
    """The value, the runs behind it, the runs left out, and what is not as recorded."""
    metric = IN_STUDIES[explanation.row["metric"]]
    lines = [f"{explanation.cell} (method {explanation.row['method']})", "", *_value(explanation, metric), ""]
    lines += _runs(explanation.runs)
    if explanation.not_applying:
        lines += ["", *left_out_lines({explanation.row["method"]: explanation.not_applying})]
    elif not explanation.runs and not explanation.left_out:
        lines.append(f"{explanation.row['method']} was not among the methods of the benchmark.")
    if explanation.left_out:
        lines += ["", f"Left out: {len(explanation.left_out)}", ""]
        lines += [f"- {run.scenario} / seed {run.seed}: {run.why}{_command(run)}" for run in explanation.left_out]
    if explanation.runs:
        lines += ["", 'In MLflow (`neuspring ui`), a run has the tag run_key: search for tags.run_key = "...".']
        lines.append(COMMANDS)
    checked = sum(run.files for run in explanation.runs)
    lines += ["", f"{checked} files compared with their digests; {len(explanation.problems) or 'nothing'} not as recorded"]
    lines += [f"- {problem}" for problem in explanation.problems]
    return "\n".join(lines) + "\n"


def _value(explanation: Explanation, metric: Metric) -> list[str]:
    cell: Any = SimpleNamespace(**{name: np.nan if value is None else value for name, value in explanation.row.items()})
    unit = f" {metric.paper_unit}" * bool(metric.paper_unit)
    kind = "scenarios weigh equally" if metric.average == "equal" else "scenarios weigh by their frames"
    ours = f"ours     {metric.paper_text(cell.ours)}{unit}"
    lines = [ours]
    if np.isfinite(cell.ours):
        lines = [f"{ours} ({cell.ours!r}): {cell.scenarios} scenarios, {cell.seeds} seeds, {kind}"]
        lines.append(f"         the other average: {metric.paper_text(cell.other_average)}{unit}")
    if np.isfinite(cell.spread):
        lines.append(f"         ± {metric.paper_text(cell.spread)} over seeds")
    if np.isfinite(cell.low):
        lines.append(f"         95 % bootstrap interval: [{metric.paper_text(cell.low)}, {metric.paper_text(cell.high)}]")
    difference = metric.paper_text(cell.difference, "+")
    lines.append(f"paper    {cell.paper or DASH}{unit * bool(cell.paper)}; ours - paper: {difference}")
    lines.append(f"verdict  {cell.verdict}")
    if cell.label != cell.baseline:
        change = f"paper {paper_change(cell, metric)}, ours {our_change(cell, metric)}"
        lines.append(f"change   against {cell.baseline}: {change}: {cell.direction}")
    return lines


def _runs(runs: Sequence[Behind]) -> list[str]:
    if not runs:
        return ["No run counts."]
    header = ["Scenario", "Seed", "Value", "Frames", "Status", "Commit", "Device", "Data", "Settings", "Files"]
    groups = {canonical(run.settings): run for run in runs}
    rows = [
        [
            run.scenario,
            str(run.seed),
            repr(run.value),
            str(run.frames),
            run.status,
            _commit(str(run.facts.get("commit", ""))),
            str(run.facts.get("device", "?")),
            str(run.facts.get("data_digest", "?"))[:SHORT],
            _digest(run),
            f"{len(run.problems)} not as recorded" if run.problems else "as recorded",
        ]
        for run in runs
    ]
    lines = [f"{len(runs)} runs behind it:", "", *markdown(header, rows)]
    for run in groups.values():
        changed = [f"  {name}: {json.dumps(value)}" for name, value in run.settings.items()]
        lines += ["", f"Settings {_digest(run)} that differ from the defaults:", *(changed or ["  none"])]
    lines.append("")
    for run in runs:
        lines += [f"{run.record}", f"  run_key {run.facts.get('run_key', '?')}, {run.facts.get('machine', '?')}{_command(run)}"]
    return lines


def _command(run: Behind) -> str:
    return f"\n  {run.command}" if run.command else ""


def _commit(name: str) -> str:
    digest, dash, dirty = name.partition("-")
    return f"{digest[:SHORT]}{dash}{dirty}" or "unknown"


def _digest(run: Behind) -> str:
    return hashlib.sha256(canonical(run.settings).encode()).hexdigest()[:SHORT]
