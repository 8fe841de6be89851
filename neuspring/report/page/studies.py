"""Did it reproduce? The paper's tables beside ours, and one answer for each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from neuspring.report.page import held
from neuspring.report.page.blocks import Block, Cell, Chip, Fold, Section, Table, Text, Tone, Verdict
from neuspring.report.page.sources import Material
from neuspring.report.page.words import number, several, signed
from neuspring.report.tables import cells as tables_cells
from neuspring.report.tables.cells import BETTER, CONFIRMED, OPPOSITE, WITHIN, WORSE
from neuspring.scores import paper
from neuspring.scores.paper import MEASURES, Measure
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
"""Verdict -> tone and symbol; all others are muted."""
ANSWERED = (WITHIN, BETTER, WORSE)
WITHOUT_DIRECTION = (tables_cells.NOT_RUN, tables_cells.NOT_COMPUTED, tables_cells.NOTHING_TO_COMPARE, tables_cells.NO_VALUE, ")")
"""Directions that are none; those in brackets are of runs that failed."""


def kind(verdict: str) -> str:
    """The verdict without how much of the data it rests on."""
    return re.sub(r" \(\d+ failed\)$", "", re.sub(r"^partial \([^)]*\): ", "", verdict))


def study_cells(material: Material) -> dict[str, pd.DataFrame]:
    """Study -> its cells (`tables_cells.cells`): a row per label, task and metric."""
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
    directed = {found: count for found, count in directions.most_common() if not found.endswith(WITHOUT_DIRECTION)}
    small = (
        [f"Change against {study.baseline}: {', '.join(f'{found} ({count})' for found, count in directed.items())}"]
        if directed
        else []
    )
    if printed["verdict"].str.startswith("partial").any():
        small.append(f"Partial: fewer than the paper's {len(paper.scenarios())} scenarios are finished.")
    answer, tone = _answer(counts, len(printed))
    chips = [_chip(found, f"{count} {found}") for found, count in counts.most_common()]
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
    """The tables of the studies; those that nothing was run of are folded."""
    blocks: list[Block] = []
    for name, study in material.studies.items():
        inner = [*_tables(study, cells[name]), *held.of_table(study, material.collected)]
        begun = bool(cells[name]["ours"].notna().any()) if len(cells[name]) else False
        blocks.append(
            Fold(summary=f"{name}: {study.title}" + ("" if begun else " (not run)"), blocks=inner, open=begun, key=f"study-{name}")
        )
    about = (
        "In every cell: ours, ± standard deviation over seeds, [95 % bootstrap interval over scenarios and seeds]; the paper's "
        "value; whether that lies within the interval. Best of ours in bold. CD and TE in m, means over scenarios; pictures "
        "weighted by frames, as in the paper. The command neuspring explain STUDY/ROW/TASK/METRIC says what a cell is made of."
    )
    if not blocks:
        return Section(key="studies", title="The paper's tables", blocks=[Text(text="No table of studies was given.", tone="mute")])
    return Section(key="studies", title="The paper's tables", blocks=blocks, about=about)


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
    columns = [MEASURES[name] for name in dict.fromkeys(cells["metric"])]
    best = {measure.name: _best(cells.loc[cells["metric"] == measure.name, "ours"], measure) for measure in columns}
    rows = []
    for label, part in cells.groupby("label", sort=False):
        own = {cell.metric: cell for cell in part.itertuples()}
        first: Any = next(iter(own.values()))
        runs = _runs(first)
        rows.append(
            [
                Cell(text=str(label), small=(first.method, runs)),
                *(_value(own[measure.name], measure, best[measure.name], bool(study.reference)) for measure in columns),
            ]
        )
    return Table(caption=title, header=["Method", *(_heading(measure) for measure in columns)], rows=rows)


def _runs(cell: Any) -> str:
    total = cell.ok + cell.failed + cell.missing
    if not total:
        return ""
    wrong = [f"{count} {name}" for name, count in (("failed", cell.failed), ("missing", cell.missing)) if count]
    return f"{cell.ok} of {several(total, 'run')}" + (f", {', '.join(wrong)}" if wrong else "")


def _heading(measure: Measure) -> str:
    return f"{measure.heading} {'↑' if measure.higher else '↓'}"


def _best(values: pd.Series, measure: Measure) -> float:
    """The best of at least two, as far as the printed digits tell."""
    known = values.dropna().round(measure.digits)
    if len(known) < 2:
        return np.nan
    return float(known.max() if measure.higher else known.min())


def _value(cell: Any, measure: Measure, best: float, referenced: bool) -> Cell:
    chips = [_chip(cell.verdict)] if referenced else []
    printed = [f"paper {cell.paper}"] if cell.paper else []
    if np.isnan(cell.ours):
        return Cell(text="–", small=printed, chips=chips)
    spread = f" ± {number(cell.spread, measure.digits)}" if np.isfinite(cell.spread) else ""
    interval = [f"[{number(cell.low, measure.digits)}, {number(cell.high, measure.digits)}]"] if np.isfinite(cell.low) else []
    text = f"{number(cell.ours, measure.digits)}{spread}"
    is_best = bool(round(cell.ours, measure.digits) == best)
    return Cell(text=text, small=[*interval, *printed], chips=chips, best=is_best, mark="best of ours")


def _changes(study: Study, cells: pd.DataFrame, title: str) -> Table:
    columns = [MEASURES[name] for name in dict.fromkeys(cells["metric"])]
    rows = []
    for label, part in cells[cells["label"] != study.baseline].groupby("label", sort=False):
        own = {cell.metric: cell for cell in part.itertuples()}
        rows.append([Cell(text=str(label)), *(_change(own[measure.name], measure) for measure in columns)])
    return Table(caption=title, header=["Method", *(_heading(measure) for measure in columns)], rows=rows)


def _change(cell: Any, measure: Measure) -> Cell:
    relative = measure.relative
    scale, digits, unit = (100.0, 1, " %") if relative else (1.0, measure.digits, f" {measure.unit}")
    printed = cell.paper_relative if relative else cell.paper_change
    small = [f"paper {signed(scale * printed, digits)}{unit}"] if np.isfinite(printed) else []
    ours, low, high = (
        (cell.relative, cell.relative_low, cell.relative_high) if relative else (cell.change, cell.change_low, cell.change_high)
    )
    if not np.isfinite(ours):
        return Cell(text="–", small=small, chips=[_chip(cell.direction)])
    interval = [f"[{signed(scale * low, digits)}, {signed(scale * high, digits)}]"] if np.isfinite(low) else []
    return Cell(text=f"{signed(scale * ours, digits)}{unit}", small=[*interval, *small], chips=[_chip(cell.direction)])
