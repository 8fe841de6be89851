"""Tables of a study next to the paper's numbers: <study>.md and .tex, a .csv with one row per cell, and blocks of the report."""

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
from neuspring.report.tables import (
    COLUMN_LEGEND,
    TONES,
    Compared,
    best,
    breakdown,
    change_text,
    failure_blocks,
    pivot,
    settings_table,
    texts,
)
from neuspring.scores.metrics import DASH, METRICS, Metric
from neuspring.scores.paper import STUDY_KINDS, Study
from neuspring.scores.study import cells, restricted
from neuspring.scores.table import ScoreTable, comparable, mixed_settings, pairs

STUDY_NOTE = (
    "Lengths in mm, PSNR in dB, ± standard deviation over seeds. As in the paper, CD and TE weigh scenarios equally; image scores "
    "weigh scenarios by their frames."
)
VERDICT_NOTE = (
    " Verdict. within: the paper's value is in the 95 % bootstrap interval of our mean, up to half a unit of its last digit; "
    "better or worse: it is outside; partial: fewer than the paper's 22 scenarios; other data: values do not compare, because the "
    "scenarios differ."
)
CHANGE_NOTE = "Errors: ratio to the baseline; image scores: difference; 95 % intervals; all runs that both methods finished."


def blocks_of(name: str, study: Study, table: ScoreTable, results: Path) -> list[Block]:
    """Blocks of a study: the paper's values and ours, comparison with the baseline, scenarios, failures, settings.

    A study with a `kind` makes its own blocks.
    """
    if study.kind:
        return STUDY_KINDS[study.kind].of(name, study, table, results).blocks()
    chosen = restricted(study, table)
    scored = cells(study, chosen)
    labels = {method: label for label, method in study.rows.items()}
    counted, everyone = pairs(comparable(chosen.comparison.finished)), pairs(chosen.runs)
    note = f"{STUDY_NOTE} The means use the {counted} of {everyone} pairs of scenario and seed that every method finished."
    note += VERDICT_NOTE if study.reference else ""
    absent = [f"{label} ({method})" for label, method in study.rows.items() if method not in chosen.methods]
    note += f" Without runs: {', '.join(absent)}." if absent else ""
    blocks: list[Block] = []
    if mixed := mixed_settings(chosen.runs):
        blocks.append(Text(text=f"Runs of the same method have different settings: {', '.join(mixed)}.", tone="warn"))
    title = "The paper's values and ours" if study.reference else "Our values"
    blocks.append(pivot(title, _lines(study, scored), {"label": "Method", "runs": "Runs", "line": ""}, note))
    changed = scored[(scored["label"] != study.baseline) & (scored["change"].notna() | scored["paper_change"].notna())]
    if len(changed):
        lines = {"ours": texts(changed, lambda row, metric: change_text(row, metric, scale=False))}
        lines = {"paper": texts(changed, _paper_change)} | lines if study.values else lines
        blocks.append(pivot(f"Compared with {study.baseline}", _below(lines), {"label": "Method", "line": ""}, CHANGE_NOTE))
    scenarios = chosen.finished.assign(label=chosen.finished["method"].map(labels))
    folds: list[Block] = [breakdown(scenarios, "scenario", "label", scale=False)] if len(scenarios) else []
    folds += failure_blocks(Compared(table=chosen, baseline="", names=labels), scale=False)
    folds += settings_table(chosen.runs, lambda method: labels[method])
    return [*blocks, Fold(summary="Scenarios, failures, settings", blocks=folds)] if folds else blocks


def _lines(study: Study, scored: pd.DataFrame) -> pd.DataFrame:
    """The lines paper, ours and verdict of every label; the best value of a line is marked."""
    rows: list[Any] = list(scored.itertuples())
    failed = [f" ({row.failed} failed)" * bool(row.failed) for row in rows]
    runs = [f"{row.ok}/{row.ok + row.failed + row.missing}" + more for row, more in zip(rows, failed, strict=True)]
    scored = scored.assign(runs=runs)
    ours = texts(_best(scored, "ours"), _ours)
    if not study.reference:
        return ours.assign(line="ours")
    verdicts = scored.assign(
        text=scored["verdict"], tone=scored["verdict"].str.rpartition(" ")[2].map(lambda word: TONES.get(word, "mute"))
    )
    paper = _best(scored, "paper").assign(text=scored["paper"].replace("", DASH))
    return _below({"paper": paper, "ours": ours, "verdict": verdicts})


def _below(lines: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The rows of all lines, grouped by label."""
    named = pd.concat([rows.assign(line=line) for line, rows in lines.items()])
    order = {label: index for index, label in enumerate(dict.fromkeys(named["label"]))}
    named = named.sort_values("label", key=lambda column: column.map(order), kind="stable")
    return named.assign(**{name: named[name].fillna("") for name in ("tone", "mark") if name in named})


def _best(scored: pd.DataFrame, source: str) -> pd.DataFrame:
    """Mark the best value of every column, compared at the printed digits; oracles are not compared."""
    values = pd.to_numeric(scored[source]).where(scored["verdict"] != "oracle")
    digits = [METRICS[name].digits for name in scored["metric"]]
    printed = [round(value, count) for value, count in zip(values, digits, strict=True)]
    return best(scored.assign(printed=printed), "printed")


def _ours(row: Any, metric: Metric) -> str:
    return metric.shown(row.ours) + (f" ± {metric.shown(row.spread)}" if np.isfinite(row.spread) else "")


def _paper_change(row: Any, metric: Metric) -> str:
    number = f"{row.paper_change:.2f}" if metric.relative else metric.shown(row.paper_change, "+")
    return DASH if np.isnan(row.paper_change) else number


def _files(name: str, study: Study, table: ScoreTable, folder: Path) -> list[str]:
    """Write the CSV of cells and the curve over the number of regions; returns the Markdown of the figure."""
    write_text(folder / f"{name}.csv", cells(study, restricted(study, table)).assign(study=name).to_csv(index=False))
    path = folder / f"{name}_curve.png"
    path.unlink(missing_ok=True)
    figure = clusters_figure(comparable(table.of(list(study.rows.values())).comparison.finished))
    return [f"![Chamfer distance against the number of regions K]({save(figure, path).name})"] if figure else []


def write_study(name: str, study: Study, table: ScoreTable, results: Path, folder: Path) -> str:
    """Write all files of a study; returns the Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    blocks = blocks_of(name, study, table, results)
    tables = [
        part for block in blocks for part in (block.blocks if isinstance(block, Fold) else [block]) if isinstance(part, Table)
    ]
    floats = [lay_out(part, "latex", f"{name}-{k}") for k, part in enumerate(tables, 1)]
    write_text(folder / f"{name}.tex", "\n".join(["% Requires \\usepackage{booktabs} and \\usepackage{graphicx}.", *floats]))
    kind = STUDY_KINDS[study.kind].of(name, study, table, results) if study.kind else None
    lines = kind.files(folder) if kind else _files(name, study, table, folder)
    text = "\n".join([f"# {study.title}\n\n{'' if study.kind else COLUMN_LEGEND}\n", *lines, "", markdown(blocks)])
    write_text(folder / f"{name}.md", text)
    return text
