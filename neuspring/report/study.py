"""A study laid out beside the paper's numbers: <study>.md and .tex to read, .csv with a row per cell, and blocks of the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.files import write_text
from neuspring.core.table import Table, lay_out
from neuspring.draw.benchmark import clusters_figure
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Fold, Text, markdown
from neuspring.report.tables import TONES, Compared, breakdown, failure_blocks, pivot, settings_table, texts
from neuspring.scores import paper
from neuspring.scores.metrics import DASH, METRICS, Metric
from neuspring.scores.paper import STUDY_KINDS, Study
from neuspring.scores.study import LEAST_SCENARIOS, cells, released_comparison, restricted
from neuspring.scores.table import ScoreTable, comparable, mixed_settings, pairs

VERDICT_NOTE = (
    "Verdict: within, the paper's value lies in the 95 % bootstrap interval of our mean, half a unit of its last digit allowed; "
    "better, worse: outside; partial: fewer than its 22 scenarios count; other data: these are other scenarios."
)
DIRECTION_NOTE = (
    "Ratio of the error (of pictures the difference) with its 95 % interval. same direction: the interval is on the side of "
    f"the paper's change; opposite: on the other; not resolved: it holds 1 (or 0); too few scenarios: below {LEAST_SCENARIOS}."
)


def blocks_of(name: str, study: Study, table: ScoreTable, results: Path) -> list[Block]:
    """The paper's table with ours; changes; per scenario; failures; settings. A kind of its own lays out its own blocks."""
    if study.kind:
        return STUDY_KINDS[study.kind].of(name, study, table, results).blocks()
    own = restricted(study, table)
    found = cells(study, own)
    labels = {method: label for label, method in study.rows.items()}
    counted, everyone = pairs(comparable(own.comparison.finished)), pairs(own.runs)
    units = (
        "Lengths in mm, PSNR in dB. Ours: mean over scenarios, seeds averaged within each, ± standard deviation over seeds; as the "
    )
    units += "paper does, CD and TE weigh scenarios equally, scores of pictures weigh them by their frames."
    note = f"{units} {counted} of {everyone} pairs of scenario and seed count, those that every method finished."
    note += f" {VERDICT_NOTE}" if study.reference else ""
    absent = [f"{label} ({method})" for label, method in study.rows.items() if method not in own.methods]
    note += f" Not among these runs: {', '.join(absent)}." if absent else ""
    blocks: list[Block] = []
    if mixed := mixed_settings(own.runs):
        blocks.append(Text(text=f"Runs of one method were made with different settings: {', '.join(mixed)}.", tone="warn"))
    title = "Ours beside the paper's" if study.reference else "Ours"
    blocks.append(pivot(title, _lines(study, found), {"label": "Method", "runs": "Runs", "line": ""}, note))
    changed = found[(found["label"] != study.baseline) & found["direction"].ne("")]
    if len(changed):
        lines = [changed.assign(line="paper", text=[_paper_change(row, METRICS[row.metric]) for row in _rows(changed)])] * any(
            study.values
        )
        ours = texts(changed, _change).assign(line="ours", tone=changed["direction"].map(lambda name: TONES.get(name, "")))
        shown = _interleaved(pd.concat([*lines, ours]), study)
        blocks.append(pivot(f"Change against {study.baseline}", shown, {"label": "Method", "line": ""}, DIRECTION_NOTE))
    scenarios = own.finished.assign(label=own.finished["method"].map(labels))
    folds: list[Block] = [breakdown(scenarios, "scenario", "label", scale=False)] if len(scenarios) else []
    if len(released := released_comparison(study, own)):
        parts = [released.assign(line=line, value=released[line]) for line in ("released", "ours")]
        shown = texts(pd.concat(parts).sort_values("scenario", kind="stable"), lambda row, metric: metric.shown(row.value))
        folds.append(pivot("Beside the released PhysTwin", shown, {"scenario": "Scenario", "line": ""}, "mm; mean over seeds."))
    folds += failure_blocks(Compared(table=own, baseline="", names=labels), scale=False)
    folds += settings_table(own.runs, lambda method: labels[method])
    return [*blocks, Fold(summary="Scenarios, failures, settings", blocks=folds)] if folds else blocks


def _lines(study: Study, found: pd.DataFrame) -> pd.DataFrame:
    """Paper, ours, verdict as three lines of every label; the best of a line is marked, and the second as in the paper."""
    shown = [
        f"{row.ok}/{row.ok + row.failed + row.missing}" + (f" ({row.failed} failed)" if row.failed else "") for row in _rows(found)
    ]
    found = found.assign(runs=shown)
    ours = texts(found, _ours).assign(line="ours", mark=_marks(study, found, "ours"))
    if not study.reference:
        return ours
    paper_line = found.assign(line="paper", text=found["paper"].replace("", DASH), mark=_marks(study, found, "paper"))
    verdicts = found.assign(line="verdict", text=found["verdict"], mark="")
    verdicts = verdicts.assign(tone=verdicts["text"].str.rpartition(" ")[2].map(lambda name: TONES.get(name, "mute")))
    return _interleaved(pd.concat([paper_line, ours, verdicts]), study)


def _interleaved(lines: pd.DataFrame, study: Study) -> pd.DataFrame:
    order = {label: place for place, label in enumerate(study.rows)}
    return lines.sort_values("label", key=lambda column: column.map(order), kind="stable").fillna({"tone": "", "mark": ""})


def _marks(study: Study, found: pd.DataFrame, source: str) -> list[str]:
    """Best and, where the paper marks it, second best of every column, as far as the printed digits tell."""
    marks = pd.Series("", index=found.index)
    names = ("best", "second") if study.reference in paper.UNDERLINED else ("best",)
    for (_, name), part in found.groupby(["task", "metric"], sort=False):
        metric = METRICS[str(name)]
        values = pd.to_numeric(part.loc[part["verdict"] != "oracle", source]).round(metric.digits).dropna()
        ranked = sorted(values.unique(), reverse=metric.higher_is_better)
        for value, mark in zip(ranked, names, strict=False) if len(values) > 1 else ():
            marks[values.index[values == value]] = mark
    return list(marks)


def _ours(row: Any, metric: Metric) -> str:
    return metric.shown(row.ours) + (f" ± {metric.shown(row.spread)}" if np.isfinite(row.spread) else "")


def _change(row: Any, metric: Metric) -> str:
    if np.isnan(row.change):
        return str(row.direction)
    show = "{:.3f}".format if metric.of == "positions" else lambda value: metric.shown(value, "+")
    interval = f" [{show(row.change_low)}, {show(row.change_high)}]" if np.isfinite(row.change_low) else ""
    return f"{show(row.change)}{interval}: {row.direction}"


def _paper_change(row: Any, metric: Metric) -> str:
    return (
        DASH
        if np.isnan(row.paper_change)
        else f"{row.paper_change:.2f}"
        if metric.relative
        else metric.shown(row.paper_change, "+")
    )


def _rows(table: pd.DataFrame) -> list[Any]:
    return list(table.itertuples())


def _files(name: str, study: Study, table: ScoreTable, folder: Path) -> list[str]:
    """The CSV of cells, and the curve over the number of regions."""
    own = restricted(study, table)
    write_text(folder / f"{name}.csv", cells(study, own).assign(study=name).to_csv(index=False))
    path = folder / f"{name}_curve.png"
    path.unlink(missing_ok=True)
    figure = clusters_figure(comparable(table.of(list(study.rows.values())).comparison.finished))
    return [f"![Chamfer distance against the number of regions K]({save(figure, path).name})"] if figure else []


def write_study(name: str, study: Study, table: ScoreTable, results: Path, folder: Path) -> str:
    """Write all files of a study; returns the Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    blocks = blocks_of(name, study, table, results)
    flat = [inner for block in blocks for inner in (block.blocks if isinstance(block, Fold) else [block])]
    floats = [lay_out(one, "latex", f"{name}-{k}") for k, one in enumerate((one for one in flat if isinstance(one, Table)), 1)]
    write_text(folder / f"{name}.tex", "\n".join(["% Needs \\usepackage{booktabs} and \\usepackage{graphicx}.", *floats]))
    own = STUDY_KINDS[study.kind].of(name, study, table, results) if study.kind else None
    lines = own.files(folder) if own else _files(name, study, table, folder)
    text = "\n".join([f"# {study.title}", "", *lines, "", markdown(blocks)])
    write_text(folder / f"{name}.md", text)
    return text
