"""A study laid out beside the paper's numbers: <study>.md and .tex to read, .csv with a row per cell, and blocks of the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.files import write_text
from neuspring.core.table import Table, lay_out
from neuspring.draw.benchmark import clusters_figure
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Fold, Text, markdown
from neuspring.report.tables import TONES, Compared, best, breakdown, change_text, failure_blocks, pivot, settings_table, texts
from neuspring.scores.metrics import DASH, METRICS, Metric
from neuspring.scores.paper import STUDY_KINDS, Study
from neuspring.scores.study import cells, restricted
from neuspring.scores.table import ScoreTable, comparable, mixed_settings, pairs

STUDY_NOTE = (
    "Lengths in mm, PSNR in dB. Ours: mean over scenarios, seeds averaged within each, ± standard deviation over seeds; as the "
    "paper does, CD and TE weigh scenarios equally, scores of pictures weigh them by their frames."
)
VERDICT_NOTE = (
    " Verdict: within, the paper's value lies in the 95 % bootstrap interval of our mean, half a unit of its last digit allowed; "
    "better, worse: outside; partial: fewer than its 22 scenarios count; other data: these are other scenarios."
)
CHANGE_NOTE = "Ratio of the error (of pictures the difference) with its 95 % interval, on the pairs that both methods finished."


def blocks_of(name: str, study: Study, table: ScoreTable, results: Path) -> list[Block]:
    """The paper's table with ours; changes; per scenario; failures; settings. A kind of its own lays out its own blocks."""
    if study.kind:
        return STUDY_KINDS[study.kind].of(name, study, table, results).blocks()
    own = restricted(study, table)
    found = cells(study, own)
    labels = {method: label for label, method in study.rows.items()}
    counted, everyone = pairs(comparable(own.comparison.finished)), pairs(own.runs)
    note = f"{STUDY_NOTE} {counted} of {everyone} pairs of scenario and seed count, those that every method finished."
    note += VERDICT_NOTE if study.reference else ""
    absent = [f"{label} ({method})" for label, method in study.rows.items() if method not in own.methods]
    note += f" Not among these runs: {', '.join(absent)}." if absent else ""
    blocks: list[Block] = []
    if mixed := mixed_settings(own.runs):
        blocks.append(Text(text=f"Runs of one method were made with different settings: {', '.join(mixed)}.", tone="warn"))
    title = "Ours beside the paper's" if study.reference else "Ours"
    blocks.append(pivot(title, _lines(study, found), {"label": "Method", "runs": "Runs", "line": ""}, note))
    changed = found[(found["label"] != study.baseline) & (found["change"].notna() | found["paper_change"].notna())]
    if len(changed):
        lines = {"ours": texts(changed, lambda row, metric: change_text(row, metric, scale=False))}
        lines = {"paper": texts(changed, _paper_change)} | lines if study.values else lines
        blocks.append(pivot(f"Change against {study.baseline}", _below(lines), {"label": "Method", "line": ""}, CHANGE_NOTE))
    scenarios = own.finished.assign(label=own.finished["method"].map(labels))
    folds: list[Block] = [breakdown(scenarios, "scenario", "label", scale=False)] if len(scenarios) else []
    folds += failure_blocks(Compared(table=own, baseline="", names=labels), scale=False)
    folds += settings_table(own.runs, lambda method: labels[method])
    return [*blocks, Fold(summary="Scenarios, failures, settings", blocks=folds)] if folds else blocks


def _lines(study: Study, found: pd.DataFrame) -> pd.DataFrame:
    """Paper, ours, verdict as three lines of every label; the best of a line is marked."""
    rows: list[Any] = list(found.itertuples())
    failed = [f" ({row.failed} failed)" * bool(row.failed) for row in rows]
    runs = [f"{row.ok}/{row.ok + row.failed + row.missing}" + more for row, more in zip(rows, failed, strict=True)]
    found = found.assign(runs=runs)
    ours = texts(_best(found, "ours"), _ours)
    if not study.reference:
        return ours.assign(line="ours")
    verdicts = found.assign(
        text=found["verdict"], tone=found["verdict"].str.rpartition(" ")[2].map(lambda one: TONES.get(one, "mute"))
    )
    paper = _best(found, "paper").assign(text=found["paper"].replace("", DASH))
    return _below({"paper": paper, "ours": ours, "verdict": verdicts})


def _below(lines: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The lines of each label below each other."""
    named = pd.concat([rows.assign(line=line) for line, rows in lines.items()])
    order = {label: place for place, label in enumerate(dict.fromkeys(named["label"]))}
    named = named.sort_values("label", key=lambda column: column.map(order), kind="stable")
    return named.assign(**{name: named[name].fillna("") for name in ("tone", "mark") if name in named})


def _best(found: pd.DataFrame, source: str) -> pd.DataFrame:
    """The best of every column marked, as far as the printed digits tell; oracles take no part."""
    values = pd.to_numeric(found[source]).where(found["verdict"] != "oracle")
    digits = [METRICS[name].digits for name in found["metric"]]
    printed = [round(value, count) for value, count in zip(values, digits, strict=True)]
    return best(found.assign(printed=printed), "printed")


def _ours(row: Any, metric: Metric) -> str:
    return metric.shown(row.ours) + (f" ± {metric.shown(row.spread)}" if np.isfinite(row.spread) else "")


def _paper_change(row: Any, metric: Metric) -> str:
    number = f"{row.paper_change:.2f}" if metric.relative else metric.shown(row.paper_change, "+")
    return DASH if np.isnan(row.paper_change) else number


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
    inner = [one for block in blocks for one in (block.blocks if isinstance(block, Fold) else [block]) if isinstance(one, Table)]
    floats = [lay_out(one, "latex", f"{name}-{k}") for k, one in enumerate(inner, 1)]
    write_text(folder / f"{name}.tex", "\n".join(["% Needs \\usepackage{booktabs} and \\usepackage{graphicx}.", *floats]))
    own = STUDY_KINDS[study.kind].of(name, study, table, results) if study.kind else None
    lines = own.files(folder) if own else _files(name, study, table, folder)
    text = "\n".join([f"# {study.title}", "", *lines, "", markdown(blocks)])
    write_text(folder / f"{name}.md", text)
    return text
