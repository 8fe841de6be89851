"""The benchmark's own tables: averages, paired differences, categories, scenarios."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from neuspring.report.page import held
from neuspring.report.page.blocks import Block, Cell, Chip, Fold, Items, Section, Table, Text
from neuspring.report.page.sources import Material
from neuspring.report.page.words import DASH, listed, number, several, signed
from neuspring.report.tables import summary as tables
from neuspring.report.tables.cells import LEAST_SCENARIOS
from neuspring.report.tables.summary import Collected, comparable
from neuspring.scores.layout import HEADINGS, IMAGE_HEADINGS, SHOWN, TRANSFER_HEADINGS
from neuspring.scores.metrics import averages
from neuspring.scores.paper import MEASURES

Headings = Mapping[tuple[str, str], str]
MOST_NOTES = 100
Best = dict[tuple[str, str], float]


def section(material: Material, differences: pd.DataFrame) -> Section:
    """Averages and paired differences of everything, pictures and transfers, breakdowns."""
    collected, baseline = material.collected, material.choice.baseline
    usable = comparable(collected) if len(collected.scores) else collected.scores
    if not len(usable):
        finished = (collected.runs["status"] == "ok").any() if len(collected.runs) else False
        text = "No run has finished, so there is nothing to average."
        text = "No pair of scenario and seed was finished by every method, so nothing can be compared." if finished else text
        told = [Text(text=text, tone="mute"), *([Text(text=why)] if (why := held.coverage(collected)) else [])]
        return Section(key="scores", title="Scores", blocks=[*told, *held.averages(collected)])
    blocks: list[Block] = [Text(text=f"{_coverage(collected, usable)} {held.coverage(collected)}".rstrip())]
    blocks += _averages("Errors, mm", usable, collected, HEADINGS)
    blocks += held.averages(collected)
    images = {key: text for key, text in IMAGE_HEADINGS.items() if key in _present(usable)}
    if images:
        blocks += _averages("Pictures: PSNR in dB, SSIM, LPIPS, IoU", usable, collected, images)
    if len(differences):
        blocks.append(_differences(f"Paired difference to {baseline}, mm", differences, HEADINGS))
        blocks.append(Fold(summary="Ratios", blocks=[_ratios(f"Ratio of the error to that of {baseline}", differences)]))
        if images:
            table = _differences(f"Pictures: paired difference to {baseline}", differences, images)
            blocks.append(Fold(summary="Paired differences of pictures", blocks=[table]))
    blocks += _conditions(collected, usable, differences, baseline)
    blocks += _transfers(material)
    blocks += _breakdowns(collected)
    about = "Means weigh scenarios equally, ± standard deviation over seeds; below, the mean weighted by frames. Best in bold."
    return Section(key="scores", title="Scores", about=about, blocks=blocks)


def _present(scores: pd.DataFrame) -> set[tuple[str, str]]:
    return set(zip(scores["task"], scores["metric"], strict=True))


def _coverage(collected: Collected, usable: pd.DataFrame) -> str:
    pairs, kept = (len(table[["scenario", "seed"]].drop_duplicates()) for table in (collected.runs, usable))
    begun = list(dict.fromkeys(collected.runs.loc[collected.runs["status"] == "ok", "method"]))
    left = [name for name in dict.fromkeys(collected.runs["method"]) if name not in begun]
    text = f"Averages take {kept} of {several(pairs, 'pair')} of scenario and seed: "
    text += f"those that each of {several(len(begun), 'method')} finished."
    return text + (f" Without any finished run, and not counted: {listed(left)}." if left else "")


def _averages(caption: str, scores: pd.DataFrame, collected: Collected, headings: Headings) -> list[Block]:
    rows: list[Any] = list(averages(scores).itertuples())
    means = {(row.method, row.task, row.metric): row for row in rows}
    best = _best((row.task, row.metric, row.equal) for row in rows)
    lines = []
    for method in dict.fromkeys(collected.runs["method"]):
        found = [means.get((str(method), *key)) for key in headings]
        cells = [_average(row, scores["seed"].nunique() > 1, best) for row in found]
        status = collected.runs.loc[collected.runs["method"] == method, "status"].value_counts().to_dict()
        failed = [Chip(text=f"{status['failed']} failed", tone="bad", symbol="✗")] if status.get("failed") else []
        runs = Cell(text=f"{status.get('ok', 0)} of {sum(status.values())}", chips=failed, value=status.get("ok", 0))
        lines.append([Cell(text=str(method)), *cells, runs])
    return [Table(caption=caption, header=["Method", *headings.values(), "Runs"], rows=lines, sortable=True)]


def _average(row: Any, spread: bool, best: Best) -> Cell:
    if row is None:
        return Cell(text=DASH, value="")
    factor, digits = SHOWN[row.metric]
    text = number(factor * row.equal, digits) + (f" ± {number(factor * row.seed_std, digits)}" if spread else "")
    top = row.equal == best.get((row.task, row.metric))
    return Cell(text=text, small=[f"by frames {number(factor * row.frames, digits)}"], value=row.equal, best=top, mark="best")


def _best(means: Iterable[tuple[str, str, float]]) -> Best:
    """(task, metric) -> the best of the means (task, metric, value), where there are at least two."""
    found: dict[tuple[str, str], list[float]] = {}
    for task, metric, value in means:
        found.setdefault((task, metric), []).append(value)
    return {key: (max if MEASURES[key[1]].higher else min)(values) for key, values in found.items() if len(values) > 1}


def _differences(caption: str, differences: pd.DataFrame, headings: Headings) -> Table:
    def cell(row: Any) -> Cell:
        factor, digits = SHOWN[row.metric]
        sure = np.isfinite(row.low)
        interval = [f"[{signed(factor * row.low, digits)}, {signed(factor * row.high, digits)}]"] if sure else []
        relative = [f"{signed(100 * row.relative, 1)} %"] if MEASURES[row.metric].relative else []
        chips = [_resolved(row, higher=MEASURES[row.metric].higher)] if sure else []
        text = signed(factor * row.difference, digits)
        return Cell(text=text, small=[*interval, *relative], chips=chips, value=float(row.difference))

    note = "95 % bootstrap interval over scenarios and seeds, same scenario and seed; none for a single scenario."
    return _by_method(caption, differences, headings, cell, note)


def _resolved(row: Any, *, higher: bool) -> Chip:
    if row.scenarios < LEAST_SCENARIOS:
        return Chip(text="too few scenarios", symbol="~")
    if row.low <= 0 <= row.high:
        return Chip(text="not resolved", symbol="~")
    return Chip(text="better", tone="good", symbol="▲") if (row.low > 0) == higher else Chip(text="worse", tone="bad", symbol="▼")


def _ratios(caption: str, differences: pd.DataFrame) -> Table:
    def cell(row: Any) -> Cell:
        if not np.isfinite(row.ratio):
            return Cell(text=DASH, value="")
        small = [f"[{row.ratio_low:.3f}, {row.ratio_high:.3f}]"] if np.isfinite(row.ratio_low) else []
        return Cell(text=f"{row.ratio:.3f}", small=small, value=float(row.ratio))

    note = "Geometric mean and 95 % interval; below 1 is better. No single scenario of large errors decides it."
    return _by_method(caption, differences, HEADINGS, cell, note)


def _by_method(caption: str, differences: pd.DataFrame, headings: Headings, cell: Any, note: str) -> Table:
    rows = []
    for method, part in differences.groupby("method", sort=False):
        known = {(row.task, row.metric): row for row in part.itertuples()}
        cells = [cell(known[key]) if key in known else Cell(text=DASH, value="") for key in headings]
        rows.append([Cell(text=str(method)), *cells])
    return Table(caption=caption, header=["Method", *headings.values()], rows=rows, sortable=True, note=note)


def _transfers(material: Material) -> list[Block]:
    """Twins on other recordings of the same object."""
    collected = material.transfers
    if not len(collected.runs) or not len(collected.scores):
        return []
    usable = comparable(collected)
    if not len(usable):
        return []
    blocks = _averages("Transfer to other recordings of the same object: errors, mm", usable, collected, TRANSFER_HEADINGS)
    differences = tables.paired_differences(usable, material.choice.baseline)
    if len(differences):
        caption = f"Transfer: paired difference to {material.choice.baseline}, mm"
        blocks.append(_differences(caption, differences, TRANSFER_HEADINGS))
    return blocks


def _breakdowns(collected: Collected) -> list[Block]:
    """Per category and per scenario, of all finished runs."""
    finished = collected.scores.merge(collected.runs.loc[collected.runs["status"] == "ok", ["scenario", "method", "seed"]])
    headings = {key: text for key, text in (HEADINGS | IMAGE_HEADINGS).items() if key in _present(finished)}
    methods, blocks = list(dict.fromkeys(collected.runs["method"])), list[Block]()
    for column in ("category", "scenario"):
        rows = []
        for name, part in finished.groupby(column, sort=True):
            means = part.groupby(["method", "task", "metric", "scenario"])["value"].mean().groupby(level=[0, 1, 2]).mean()
            known: dict[Any, float] = {key: float(value) for key, value in means.items()}
            best = _best((task, metric, value) for (_, task, metric), value in known.items())
            counts = part.groupby("method")["seed" if column == "scenario" else "scenario"].nunique()
            for method in [method for method in methods if method in counts.index]:
                cells = [_mean(known.get((method, *key)), key, best.get(key)) for key in headings]
                rows.append([Cell(text=str(name)), Cell(text=str(method)), *cells, Cell(text=str(counts[method]))])
        last = "Seeds" if column == "scenario" else "Scenarios"
        table = Table(
            caption=f"Per {column}: errors in mm, seeds averaged",
            header=[column.capitalize(), "Method", *headings.values(), last],
            rows=rows,
            stub=2,
            sortable=True,
            note="All finished runs. Best of each " + column + " in bold.",
        )
        blocks.append(Fold(summary=f"Per {column}", blocks=[table]))
    return blocks


def _mean(value: float | None, key: tuple[str, str], best: float | None) -> Cell:
    if value is None:
        return Cell(text=DASH, value="")
    factor, digits = SHOWN[key[1]]
    return Cell(text=number(factor * value, digits), value=value, best=value == best, mark="best")


def _conditions(collected: Collected, usable: pd.DataFrame, differences: pd.DataFrame, baseline: str) -> list[Block]:
    """How pictures were scored, or why they were not, in the words of the summary; and what runs noted."""
    told = tables.image_lines(collected, usable, differences, baseline)
    words = [line for line in told if line and not line.startswith(("|", "Paired"))]
    blocks: list[Block] = [Items(items=words)] if words else []
    noted: list[Any] = list(collected.runs[collected.runs["notes"] != ""].itertuples())
    if noted:
        notes = [f"{row.scenario} / {row.method} / seed {row.seed}: {row.notes}" for row in noted[:MOST_NOTES]]
        more = [f"{len(noted) - MOST_NOTES} more"] if len(noted) > MOST_NOTES else []
        blocks.append(Fold(summary=f"{several(len(noted), 'run')} with notes", blocks=[Items(items=[*notes, *more])]))
    return blocks
