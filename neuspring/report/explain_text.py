"""An explanation of a cell for people; see `neuspring.report.explain`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from neuspring.core.markdown import markdown
from neuspring.core.records import canonical
from neuspring.report.explain import Behind, Explanation
from neuspring.report.tables.render import number, our_change, paper_change
from neuspring.scores.failures import left_out_lines
from neuspring.scores.paper import MEASURES, Measure

SHORT = 12
"""Characters of a digest; --json has all."""


def text(found: Explanation) -> str:
    """The value, the runs behind it, those left out, and what does not hold."""
    measure = MEASURES[found.row["metric"]]
    lines = [f"{found.cell} (method {found.row['method']})", "", *_value(found, measure), ""]
    lines += _runs(found.runs)
    if found.not_applying:
        lines += ["", *left_out_lines({found.row["method"]: found.not_applying})]
    elif not found.runs and not found.left_out:
        lines.append(f"{found.row['method']} was not among the methods of the benchmark.")
    if found.left_out:
        lines += ["", f"Left out: {len(found.left_out)}", ""]
        lines += [f"- {run.scenario} / seed {run.seed}: {run.why}{_command(run)}" for run in found.left_out]
    if found.runs:
        lines += ["", 'In MLflow (`neuspring ui`), a run has the tag run_key: search for tags.run_key = "...".']
        lines.append(
            "Commands make the run and all its stages again, in place of these: check out the commit of the run first, and"
        )
        lines.append("to keep these give another folder, --config results=... They need the --configfile and --config of the")
        lines.append("benchmark; name them to this command too (--configfile). The same seed on the same type of device gives the")
        lines.append("same run_key.")
    checked = sum(run.files for run in found.runs)
    lines += ["", f"{checked} files compared with their digests; {len(found.problems) or 'nothing'} not as recorded"]
    lines += [f"- {problem}" for problem in found.problems]
    return "\n".join(lines) + "\n"


def _value(found: Explanation, measure: Measure) -> list[str]:
    row = {name: np.nan if value is None else value for name, value in found.row.items()}
    cell: Any = SimpleNamespace(**row)
    unit = f" {measure.unit}" * bool(measure.unit)
    kind = "scenarios weigh equally" if measure.average == "equal" else "scenarios weigh by their frames"
    lines = [f"ours     {number(cell.ours, measure)}{unit}"]
    if np.isfinite(cell.ours):
        lines = [
            f"ours     {number(cell.ours, measure)}{unit} ({cell.ours!r}): {cell.scenarios} scenarios, {cell.seeds} seeds, {kind}"
        ]
        lines.append(f"         the other average: {number(cell.other_average, measure)}{unit}")
    if np.isfinite(cell.spread):
        lines.append(f"         ± {number(cell.spread, measure)} over seeds")
    if np.isfinite(cell.low):
        lines.append(f"         95 % bootstrap interval: [{number(cell.low, measure)}, {number(cell.high, measure)}]")
    lines.append(f"paper    {cell.paper or '–'}{unit * bool(cell.paper)}; ours - paper: {number(cell.difference, measure, '+')}")
    lines.append(f"verdict  {cell.verdict}")
    if cell.label != cell.baseline:
        change = f"paper {paper_change(cell, measure)}, ours {our_change(cell, measure)}"
        lines.append(f"change   against {cell.baseline}: {change}: {cell.direction}")
    return lines


def _runs(runs: Sequence[Behind]) -> list[str]:
    if not runs:
        return ["No run counts."]
    header = ["Scenario", "Seed", "Value", "Frames", "Status", "Commit", "Device", "Data", "Settings", "Files"]
    groups = {canonical(run.settings): run for run in runs}
    rows = [
        [
            *(run.scenario, str(run.seed), f"{run.value!r}", str(run.frames), run.status),
            *(_commit(str(run.facts.get("commit", ""))), str(run.facts.get("device", "?"))),
            *(str(run.facts.get("data_digest", "?"))[:SHORT], _digest(run)),
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
