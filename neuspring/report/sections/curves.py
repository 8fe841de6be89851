"""Curves of errors over time, search costs and losses: a figure with a panel per scenario and a line per method."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt

from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RunRecord
from neuspring.report.blocks import Block, Fold, PageSection, Picture
from neuspring.report.data import ReportData, ReportSection, data_uri
from neuspring.scores.metrics import METRICS, bound_track_errors, track_errors

CURVE_ERRORS = {"track_error": track_errors, "track_error_bound": bound_track_errors}
PLOTS = {
    "track_error": "Track error over time [mm over s], one seed; gray: the future",
    "track_error_bound": "Bound track error over time [mm over s]",
    "search": "Search: best cost over candidate rollouts; methods that share a search have one curve",
    "fit": "Fit: loss over epochs [mm²]",
    "train": "Training of baselines: loss; every model has its own",
}
DIVERGED_COST = 1e3
"""Costs above this are of candidates that could not be simulated."""
MOST_CURVES = 12


def curves(material: ReportData) -> PageSection | None:
    """Curves of the shown methods; None where no run has left any."""
    scenarios = [name for name in material.choice.scenarios if material.first_runs(name)]
    seen = {name: _observations(material, name) for name in scenarios[:MOST_CURVES]}
    blocks: list[Block] = []
    for what, title in PLOTS.items():
        lines = {name: _lines(material, name, what, observed) for name, observed in seen.items()}
        if lines := {name: own for name, own in lines.items() if own}:
            blocks.append(
                Fold(summary=title, blocks=[_figure(lines, title, seen if what in CURVE_ERRORS else {})], open=not blocks)
            )
    return PageSection(key="curves", title="Curves", blocks=blocks) if blocks else None


def _observations(material: ReportData, scenario: str) -> Observations | None:
    path = material.results / scenario / "observations.npz"
    return material.read(path, Observations.load) if path.is_file() else None


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

    def read(path: Path) -> pd.Series:
        table = pd.read_parquet(path, columns=["step", "metric", "value"])
        own = table["metric"] == ("best_cost" if stage == "search" else "loss")
        values = table.loc[own].set_index("step")["value"].astype(float)
        return values[values < DIVERGED_COST] if stage == "search" else 1e6 * values if stage == "fit" else values

    return material.read((material.folder(run) / run.histories[stage]).resolve(), read) if run.histories.get(stage) else None


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
        seconds = np.arange(len(values)) / observed.scenario.frame_rate
        return None if np.isnan(values).all() else pd.Series(values, index=seconds)

    return material.read(record, read)


def _figure(lines: Mapping[str, Mapping[str, pd.Series]], title: str, seen: Mapping[str, Observations | None]) -> Picture:
    """One SVG with a panel per scenario, all with the same colors; the future is gray where observations are given."""
    labels = list(dict.fromkeys(label for own in lines.values() for label in own))
    columns = min(len(lines), 3)
    rows = -(-len(lines) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.6 * columns, 2.3 * rows + 0.4), layout="constrained", squeeze=False)
    for axis in axes.flat[len(lines) :]:
        axis.set_visible(False)
    for axis, (scenario, own) in zip(axes.flat, lines.items(), strict=False):
        axis.set_title(scenario, fontsize=9)
        for label, values in own.items():
            place = labels.index(label)
            style = ("-", "--", ":")[place // 10 % 3]
            axis.plot(values.index, values.to_numpy(), color=f"C{place % 10}", ls=style, lw=1.4, label=label.replace("`", ""))
        if observed := seen.get(scenario):
            facts = observed.scenario
            axis.axvspan(facts.train_end / facts.frame_rate, facts.frame_count / facts.frame_rate, color="0.9", lw=0)
        low, high = min(values.min() for values in own.values()), max(values.max() for values in own.values())
        if not seen and 0 < 2 * low <= high:
            axis.set_yscale("log")
        else:
            axis.set_ylim(0, None)
        axis.tick_params(labelsize=8)
    handles = {text: handle for axis in axes.flat for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    stream = io.BytesIO()
    with plt.rc_context({"svg.hashsalt": title}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    return Picture(caption="", alt=title, data=data_uri("image/svg+xml", stream.getvalue()), wide=True, paper=True)


section = ReportSection(order=90, make=curves)
