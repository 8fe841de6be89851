"""Curves of errors over time, search costs and losses: a figure with a panel per scenario and a line per method."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RunRecord
from neuspring.draw.benchmark import curves_figure
from neuspring.draw.run import history_lines
from neuspring.report.blocks import Block, Fold
from neuspring.report.data import ReportData, ReportSection, shown_figure
from neuspring.scores.metrics import METRICS, bound_track_errors, track_errors

CURVE_ERRORS = {"track_error": track_errors, "track_error_bound": bound_track_errors}
PLOTS = {
    "track_error": "Track error over time [mm over s], one seed; gray: the future",
    "track_error_bound": "Bound track error over time [mm over s]",
    "search": "Search: best cost over candidate rollouts; methods that share a search have one curve",
    "fit": "Fit: loss over epochs [m²]",
    "train": "Training of baselines: loss; every model has its own",
}
MOST_CURVES = 12


def curves(material: ReportData) -> list[Block]:
    """Curves of the shown methods; none where no run has left any."""
    scenarios = [name for name in material.choice.scenarios if material.first_runs(name)]
    seen = {name: material.observations(name) for name in scenarios[:MOST_CURVES]}
    facts = {name: observed.scenario if observed else None for name, observed in seen.items()}
    blocks: list[Block] = []
    for what, title in PLOTS.items():
        panels = {name: _lines(material, name, what, observed) for name, observed in seen.items()}
        if panels := {name: own for name, own in panels.items() if own}:
            figure = curves_figure(panels, facts if what in CURVE_ERRORS else None)
            blocks.append(Fold(summary=title, blocks=[shown_figure(figure, title)], open=not blocks))
    return blocks


def _lines(material: ReportData, scenario: str, what: str, observed: Observations | None) -> dict[str, pd.Series]:
    """Label -> values of the first run of every shown method: an error over seconds, or the history of a stage by step."""
    lines: dict[str, pd.Series] = {}
    for method, run in material.first_runs(scenario).items():
        label = material.numbers.name(method)
        if what == "search":
            parts = Path(run.histories.get("search", "")).parts
            label = next((part for part in parts if part.startswith("search-")), "")
        values = _error(material, run, what, observed) if what in CURVE_ERRORS else _history(material, run, what)
        if values is not None and len(values) and label:
            lines.setdefault(label, values)
    return lines


def _history(material: ReportData, run: RunRecord, stage: str) -> pd.Series | None:
    """Losses or best costs by step; None if the run has none."""
    path = material.folder(run) / run.histories.get(stage, "")
    found = material.read(path, lambda path: history_lines(pd.read_parquet(path))) if run.histories.get(stage) else None
    return next(iter(found.values()), None) if found else None


def _error(material: ReportData, run: RunRecord, metric: str, observed: Observations | None) -> pd.Series | None:
    """A track error over seconds, mm; None if the run has no trajectory or no track is annotated."""
    record = material.file(run, "records", "rollout")
    if record is None or observed is None or not run.ok:
        return None

    def read(path: Path) -> pd.Series | None:
        stage = StageRecord.load(path)
        if "trajectory" not in stage.files:
            return None
        positions = Trajectory.load(path.parent / stage.files["trajectory"][0]).positions
        values = METRICS[metric].factor * CURVE_ERRORS[metric](positions, observed.tracks[: len(positions)])
        return None if np.isnan(values).all() else pd.Series(values, np.arange(len(values)) / observed.scenario.frame_rate)

    return material.read(record, read)


section = ReportSection(order=90, title="Curves", make=curves)
