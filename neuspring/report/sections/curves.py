"""Curves of errors over time, search costs and losses: figures with one panel per scenario and one line per method."""

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
    "track_error": "Track error [mm] over time [s], one seed; gray: future frames",
    "track_error_bound": "Bound track error [mm] over time [s]: the tracked points move with the nodes around them",
    "search": "Search: lowest cost over rollouts; methods that share a search have one curve",
    "fit": "Fit: loss [m²] over epochs",
    "train": "Training of baselines: loss; every model has a different loss",
}
MOST_CURVES = 12


def curves(material: ReportData) -> list[Block]:
    """Curves of the displayed methods; empty if no run has a history or trajectory."""
    scenarios = [name for name in material.choice.scenarios if material.first_runs(name)]
    seen = {name: material.observations(name) for name in scenarios[:MOST_CURVES]}
    facts = {name: observed.scenario if observed else None for name, observed in seen.items()}
    blocks: list[Block] = []
    for what, title in PLOTS.items():
        panels = {name: _lines(material, name, what, observed) for name, observed in seen.items()}
        if panels := {name: lines for name, lines in panels.items() if lines}:
            figure = curves_figure(panels, facts if what in CURVE_ERRORS else None)
            blocks.append(Fold(summary=title, blocks=[shown_figure(figure, title)], open=not blocks))
    return blocks


def _lines(material: ReportData, scenario: str, what: str, observed: Observations | None) -> dict[str, pd.Series]:
    """Label -> curve of the first run of every displayed method: an error over seconds, or the history of a stage."""
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
    """Losses or lowest costs by step; None if the run has no history of this stage."""
    path = material.folder(run) / run.histories.get(stage, "")
    lines = material.read(path, lambda path: history_lines(pd.read_parquet(path))) if run.histories.get(stage) else None
    return next(iter(lines.values()), None) if lines else None


def _error(material: ReportData, run: RunRecord, metric: str, observed: Observations | None) -> pd.Series | None:
    """A track error in mm over seconds; None without a trajectory or without tracks."""
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


section = ReportSection(order=90, title="Error and loss curves", make=curves)
