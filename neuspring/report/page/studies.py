"""Did it reproduce? The paper's tables beside ours, and one answer for each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from neuspring.report.blocks import Block, Cell, Chip, Fold, Section, Table, Text, Tone, Verdict
from neuspring.report.page import frozen
from neuspring.report.page.sources import Material
from neuspring.report.page.words import number, several, signed
from neuspring.report.tables import cells as tables_cells
from neuspring.report.tables import differing
from neuspring.report.tables.cells import BETTER, CONFIRMED, OPPOSITE, WITHIN, WORSE
from neuspring.report.tables.render import both_trainings
from neuspring.scores import paper
from neuspring.scores.metrics import DASH, IN_STUDIES, Metric
from neuspring.scores.studies import Study

TASKS = {"reconstruction": "Reconstruction and resimulation", "future": "Future prediction"}
SIGNS: dict[str, tuple[Tone, str]] = {
    WITHIN: ("good", "✓"),
    BETTER: ("good", "▲"),
    WORSE: ("bad", "▼"),
    CONFIRMED: ("good", "✓"),
    OPPOSITE: ("bad", "✗"),
    tables_cells.NO_INTERVAL: ("warn", "~"),
    tables_cells.NOT_RESOLVED: ("warn", "~"),
    tables_cells.TOO_FEW: ("", "~"),
    tables_cells.OTHER_DATA: ("", "◇"),
    tables_cells.NOT_RUN: ("mute", "○"),
}
"""Verdict to tone and symbol. All others are muted."""
ANSWERED = (WITHIN, BETTER, WORSE)
WITHOUT_DIRECTION = (tables_cells.NOT_RUN, tables_cells.NOT_COMPUTED, tables_cells.NOTHING_TO_COMPARE, tables_cells.NO_VALUE, ")")
"""Ends of verdicts on a change that name no direction; a bracket counts failed runs."""


def kind(verdict: str) -> str:
    """The verdict without the count of scenarios or failures that it depends on."""
    return re.sub(r" \(\d+ failed\)$", "", re.sub(r"^partial \([^)]*\): ", "", verdict))


def study_cells(material: Material) -> dict[str, pd.DataFrame]:
    """Study to its cells (`tables_cells.cells`): a row per label, task and metric."""
    return {
        name: tables_cells.cells(study, tables_cells.of_study(study, material.collected))
        for name, study in material.studies.items()
    }


def verdicts(material: Material, cells: Mapping[str, pd.DataFrame]) -> list[Block]:
    """One line per study of the paper."""
    referenced = {name: study for name, study in material.studies.items() if study.reference}
    return [_verdict(name, study, cells[name]) for name, study in referenced.items()]


def _verdict(name: str, study: Study, cells: pd.DataFrame) -> Verdict:
    printed = cells[cells["paper"] != ""]
    kinds = printed["verdict"].map(kind)
    counts = Counter(kinds)
    directions = Counter(printed.loc[printed["label"] != study.baseline, "direction"])
    changes = [f"{name} ({count})" for name, count in directions.most_common() if not name.endswith(WITHOUT_DIRECTION)]
    small = [f"Change against {study.baseline}: {', '.join(changes)}"] if changes else []
    if printed["verdict"].str.startswith("partial").any():
        small.append(f"Partial: fewer than the paper's {len(paper.scenarios())} scenarios are finished.")
    answer, tone = _answer(counts, len(printed))
    chips = [_chip(verdict, f"{count} {verdict}") for verdict, count in counts.most_common()]
    return Verdict(title=f"{name}: {study.title}", answer=answer, tone=tone, chips=chips, small=small, target=f"study-{name}")


def _answer(counts: Counter[str], total: int) -> tuple[str, Tone]:
    answered = sum(counts[name] for name in ANSWERED)
    agree = counts[WITHIN] + counts[BETTER]
    if not answered:
        if counts[tables_cells.OTHER_DATA]:
            return "Cannot be said: these are not the paper's data.", "mute"
        return ("Cannot be said yet: no interval.", "warn") if counts[tables_cells.NO_INTERVAL] else ("Not run yet.", "mute")
    tone: Tone = "good" if not counts[WORSE] and answered == total else "bad" if counts[WORSE] > agree else "warn"
    if agree == total:
        return f"Reproduced: all {total} cells are within the interval or better.", tone
    return f"{agree} of {total} cells within the interval or better, {counts[WORSE]} worse, {total - answered} open.", tone


def _chip(name: str, text: str = "") -> Chip:
    tone, symbol = SIGNS.get(kind(name), ("mute", "○"))
    return Chip(text=text or name, tone=tone, symbol=symbol)


def section(material: Material, cells: Mapping[str, pd.DataFrame]) -> Section:
    """The tables of the studies; those without any run are folded."""
    blocks: list[Block] = []
    for name, study in material.studies.items():
        labels = {method: label for label, method in study.rows.items()}
        inner = [
            *_tables(study, cells[name]),
            *_beside(study, material, cells, name),
            *_footnote(material, labels),
            *frozen.of_table(study, material.collected),
        ]
        has_runs = len(cells[name]) > 0 and bool(cells[name]["ours"].notna().any())
        summary = f"{name}: {study.title}" + ("" if has_runs else " (not run)")
        blocks.append(Fold(summary=summary, blocks=inner, open=has_runs, key=f"study-{name}"))
    about = (
        "In every cell: ours, ± standard deviation over seeds, [95 % bootstrap interval over scenarios and seeds]; the paper's "
        "value; whether that lies within the interval. Best of ours in bold. CD and TE in m, means over scenarios; pictures "
        "weighted by frames, as in the paper. The command neuspring explain STUDY/ROW/TASK/METRIC says what a cell is made of."
    )
    if not blocks:
        return Section(key="studies", title="The paper's tables", blocks=[Text(text="No table of studies was given.", tone="mute")])
    return Section(key="studies", title="The paper's tables", blocks=blocks, about=about)


def _beside(study: Study, material: Material, cells: Mapping[str, pd.DataFrame], name: str) -> list[Block]:
    """The same rows in another training, next to these."""
    other = study.beside
    if other is None or other not in cells or not len(cells[name]) or not len(cells[other]):
        return []
    grids = both_trainings(study, cells[name], material.studies[other], cells[other])
    blocks: list[Block] = []
    for grid in grids:
        rows = [[Cell(text=text) for text in (*stub, *(cell.text for cell in texts))] for stub, texts in grid.lines]
        blocks.append(Table(caption=grid.title, header=[*grid.stub, *grid.headings], rows=rows, note=grid.note, stub=2))
    return [Fold(summary=f"Beside {other}", blocks=blocks)] if blocks else []


def _footnote(material: Material, labels: Mapping[str, str]) -> list[Block]:
    """Which settings differ between the rows; nothing if none does."""
    rows = differing.differing(material.collected.records.values(), labels)
    if not rows:
        return []
    cells = [[Cell(text=row.setting), Cell(text=row.text)] for row in rows]
    table = Table(caption="Settings that differ", header=["Setting", "Value: rows"], rows=cells, note=differing.ABOUT)
    return [Fold(summary="Settings that differ between the rows", blocks=[table])]


def _tables(study: Study, cells: pd.DataFrame) -> list[Block]:
    if not len(cells):
        return [Text(text="Nothing to show.", tone="mute")]
    blocks: list[Block] = []
    if not study.reference:
        blocks.append(Text(text=paper.CLUSTER_CLAIM))
    tasks = [task for task in TASKS if (cells["task"] == task).any()]
    blocks += [_values(study, cells[cells["task"] == task], TASKS[task]) for task in tasks]
    changes = [_changes(study, cells[cells["task"] == task], TASKS[task]) for task in tasks]
    about = Text(
        text=f"Against {study.baseline} on the same scenarios and seeds, in per cent of its mean (PSNR: in dB), with the paired "
        "95 % interval. This can be asked of any data."
    )
    return [*blocks, Fold(summary=f"Change against {study.baseline}", blocks=[about, *changes])]


def _values(study: Study, cells: pd.DataFrame, title: str) -> Table:
    def first(cell: Any) -> Cell:
        return Cell(text=str(cell.label), small=(cell.method, _runs(cell), *([tables_cells.ORACLE_LINE] if cell.oracle else [])))

    others = cells[~cells["oracle"]]
    best = {name: _best(part["ours"], IN_STUDIES[str(name)]) for name, part in others.groupby("metric")}
    cells = pd.concat([others, cells[cells["oracle"]]])
    return _table(cells, title, first, lambda cell, metric: _value(cell, metric, best[metric.name], bool(study.reference)))


def _table(cells: pd.DataFrame, title: str, first: Callable[[Any], Cell], value: Callable[[Any, Metric], Cell]) -> Table:
    """A line per label: its heading by `first`, then a cell per metric by `value`."""
    metrics = [IN_STUDIES[name] for name in dict.fromkeys(cells["metric"])]
    rows = []
    for _, part in cells.groupby("label", sort=False):
        own: dict[Any, Any] = {cell.metric: cell for cell in part.itertuples()}
        rows.append([first(own[metrics[0].name]), *(value(own[metric.name], metric) for metric in metrics)])
    return Table(caption=title, header=["Method", *(metric.paper_column for metric in metrics)], rows=rows)


def _runs(cell: Any) -> str:
    total = cell.ok + cell.failed + cell.missing
    if not total:
        return ""
    wrong = [f"{count} {name}" for name, count in (("failed", cell.failed), ("missing", cell.missing)) if count]
    return f"{cell.ok} of {several(total, 'run')}" + (f", {', '.join(wrong)}" if wrong else "")


def _best(values: pd.Series, metric: Metric) -> float:
    """The best of at least two, as far as the printed digits tell."""
    rounded = values.dropna().round(metric.paper_digits)
    if len(rounded) < 2:
        return np.nan
    return float(rounded.max() if metric.higher_is_better else rounded.min())


def _value(cell: Any, metric: Metric, best: float, referenced: bool) -> Cell:
    digits = metric.paper_digits
    chips = [_chip(cell.verdict)] if referenced else []
    printed = [f"paper {cell.paper}"] if cell.paper else []
    if np.isnan(cell.ours):
        return Cell(text=DASH, small=printed, chips=chips)
    spread = f" ± {number(cell.spread, digits)}" if np.isfinite(cell.spread) else ""
    interval = [f"[{number(cell.low, digits)}, {number(cell.high, digits)}]"] if np.isfinite(cell.low) else []
    text = f"{number(cell.ours, digits)}{spread}"
    is_best = bool(round(cell.ours, digits) == best) and not cell.oracle
    return Cell(text=text, small=[*interval, *printed], chips=chips, best=is_best, mark="best of ours")


def _changes(study: Study, cells: pd.DataFrame, title: str) -> Table:
    others = cells[(cells["label"] != study.baseline) & ~cells["oracle"]]
    return _table(others, title, lambda cell: Cell(text=str(cell.label)), _change)


def _change(cell: Any, metric: Metric) -> Cell:
    scale, digits, unit = (100.0, 1, " %") if metric.relative else (1.0, metric.paper_digits, f" {metric.paper_unit}")
    values = (cell.relative, cell.relative_low, cell.relative_high, cell.paper_relative)
    values = values if metric.relative else (cell.change, cell.change_low, cell.change_high, cell.paper_change)
    ours, low, high, printed = (signed(scale * value, digits) for value in values)
    small = [f"paper {printed}{unit}"] if np.isfinite(values[3]) else []
    if not np.isfinite(values[0]):
        return Cell(text=DASH, small=small, chips=[_chip(cell.direction)])
    interval = [f"[{low}, {high}]"] if np.isfinite(values[1]) else []
    return Cell(text=f"{ours}{unit}", small=[*interval, *small], chips=[_chip(cell.direction)])
