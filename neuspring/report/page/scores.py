"""The benchmark's own tables: averages, paired differences, categories, scenarios."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pandas as pd

from neuspring.report.blocks import Block, Cell, Chip, Fold, Items, Section, Table, Text
from neuspring.report.page import frozen
from neuspring.report.page.sources import Material
from neuspring.report.page.words import listed, number, several, signed
from neuspring.report.tables.cells import LEAST_SCENARIOS, ORACLE_LINE
from neuspring.report.tables.honest import honest_notes
from neuspring.report.tables.ratios import Judged, about_ratios, aim_lines
from neuspring.report.tables.summary import compared, floor_lines, image_lines
from neuspring.scores import ratios
from neuspring.scores.metrics import (
    DASH,
    HEADINGS,
    IMAGE_HEADINGS,
    METRICS,
    TRANSFER_HEADINGS,
    Headings,
    Metric,
    averages,
    headings_of,
    present,
    published,
)
from neuspring.scores.runs import Collected, finished_scores, pairs

MOST_NOTES = 100
Best = dict[tuple[str, str], float]
VERDICTS = {
    ratios.BELOW: Chip(text=ratios.BELOW, tone="good", symbol="▲"),
    ratios.ABOVE: Chip(text=ratios.ABOVE, tone="bad", symbol="▼"),
    ratios.NOT_RESOLVED: Chip(text=ratios.NOT_RESOLVED, symbol="~"),
    ratios.TOO_FEW: Chip(text=ratios.TOO_FEW, symbol="~"),
}


def section(material: Material, usable: pd.DataFrame, differences: pd.DataFrame, figures: Judged) -> Section:
    """Averages, ratios and paired differences of the comparable scores, pictures and transfers, breakdowns."""
    everything, baseline = material.collected, material.choice.baseline
    collected = everything.comparison
    coverage = frozen.coverage(collected)
    if not len(usable):
        text = "No run has finished, so there is nothing to average."
        if len(collected.runs) and (collected.runs["status"] == "ok").any():
            text = "No pair of scenario and seed was finished by every method, so nothing can be compared."
        reasons = [Text(text=text, tone="mute"), *([Text(text=coverage)] if coverage else [])]
        return Section(key="scores", title="Scores", blocks=[*reasons, *frozen.averages(collected)])
    blocks: list[Block] = [Text(text=f"{_coverage(collected, usable)} {coverage}".rstrip())]
    blocks.append(_averages("Errors, mm", usable, collected, published(HEADINGS, usable)))
    blocks += [*_oracles(everything, usable), *(Text(text=line) for line in floor_lines(collected.runs) if line)]
    blocks += [*_primary(figures), *frozen.averages(collected)]
    images = {key: text for key, text in IMAGE_HEADINGS.items() if key in present(usable)}
    if images:
        blocks.append(_averages("Pictures: PSNR in dB, SSIM, LPIPS, IoU", usable, collected, images))
    if len(differences):
        blocks.append(_differences(f"Paired difference to {baseline}, mm", differences, published(HEADINGS, usable)))
        if images:
            table = _differences(f"Pictures: paired difference to {baseline}", differences, images)
            blocks.append(Fold(summary="Paired differences of pictures", blocks=[table]))
    blocks += [*_conditions(collected, usable, differences, baseline), *_transfers(material, figures), *_breakdowns(collected)]
    about = "Means weigh scenarios equally, ± standard deviation over seeds; below, the mean weighted by frames. Best in bold."
    return Section(key="scores", title="Scores", about=about, blocks=blocks)


def _coverage(collected: Collected, usable: pd.DataFrame) -> str:
    finished = list(dict.fromkeys(collected.runs.loc[collected.runs["status"] == "ok", "method"]))
    left = [name for name in dict.fromkeys(collected.runs["method"]) if name not in finished]
    text = f"Averages take {pairs(usable)} of {several(pairs(collected.runs), 'pair')} of scenario and seed: "
    text += f"those that each of {several(len(finished), 'method')} finished."
    return text + (f" Without any finished run, and not counted: {listed(left)}." if left else "")


def _averages(caption: str, scores: pd.DataFrame, collected: Collected, headings: Headings, *, marked: bool = True) -> Table:
    rows: list[Any] = list(averages(scores).itertuples())
    means = {(row.method, row.task, row.metric): row for row in rows}
    best = _best((row.task, row.metric, row.equal) for row in rows) if marked else {}
    lines = []
    for method in dict.fromkeys(collected.runs["method"]):
        own = [means.get((str(method), *key)) for key in headings]
        cells = [_average(row, scores["seed"].nunique() > 1, best) for row in own]
        status = collected.runs.loc[collected.runs["method"] == method, "status"].value_counts().to_dict()
        failed = [Chip(text=f"{status['failed']} failed", tone="bad", symbol="✗")] if status.get("failed") else []
        runs = Cell(text=f"{status.get('ok', 0)} of {sum(status.values())}", chips=failed, value=status.get("ok", 0))
        lines.append([Cell(text=str(method)), *cells, runs])
    return Table(caption=caption, header=["Method", *headings.values(), "Runs"], rows=lines, sortable=True)


def _average(row: Any, spread: bool, best: Best) -> Cell:
    if row is None:
        return Cell(text=DASH, value="")
    metric = METRICS[row.metric]
    text = _text(metric, row.equal) + (f" ± {_text(metric, row.seed_std)}" if spread else "")
    top = row.equal == best.get((row.task, row.metric))
    return Cell(text=text, small=[f"by frames {_text(metric, row.frames)}"], value=row.equal, best=top, mark="best")


def _text(metric: Metric, value: float) -> str:
    return number(metric.factor * value, metric.digits)


def _best(means: Iterable[tuple[str, str, float]]) -> Best:
    """Task and metric to the best of the means (task, metric, value), where there are at least two."""
    columns: dict[tuple[str, str], list[float]] = {}
    for task, metric, value in means:
        columns.setdefault((task, metric), []).append(value)
    choose = {name: max if metric.higher_is_better else min for name, metric in METRICS.items()}
    return {key: choose[key[1]](values) for key, values in columns.items() if len(values) > 1}


def _differences(caption: str, differences: pd.DataFrame, headings: Headings) -> Table:
    def cell(row: Any) -> Cell:
        metric = METRICS[row.metric]
        text, low, high = (signed(metric.factor * value, metric.digits) for value in (row.difference, row.low, row.high))
        sure = np.isfinite(row.low)
        interval = [f"[{low}, {high}]"] if sure else []
        relative = [f"{signed(100 * row.relative, 1)} %"] if metric.relative else []
        chips = [_resolved(row, higher=metric.higher_is_better)] if sure else []
        return Cell(text=text, small=[*interval, *relative], chips=chips, value=float(row.difference))

    note = "95 % bootstrap interval over scenarios and seeds, same scenario and seed; none for a single scenario."
    return _by_method(caption, differences, headings, cell, note)


def _resolved(row: Any, *, higher: bool) -> Chip:
    if row.scenarios < LEAST_SCENARIOS:
        return Chip(text="too few scenarios", symbol="~")
    if row.low <= 0 <= row.high:
        return Chip(text="not resolved", symbol="~")
    return Chip(text="better", tone="good", symbol="▲") if (row.low > 0) == higher else Chip(text="worse", tone="bad", symbol="▼")


def _oracles(collected: Collected, usable: pd.DataFrame) -> list[Block]:
    """Methods that have seen all frames: a table of their own, on the pairs that count, without marks."""
    oracles = collected.of(collected.oracles)
    own = finished_scores(oracles) if len(oracles.runs) else oracles.scores
    own = own.merge(usable[["scenario", "seed"]].drop_duplicates(), on=["scenario", "seed"])
    if not len(own):
        return []
    return [_averages(ORACLE_LINE.capitalize(), own, oracles, published(HEADINGS, own), marked=False)]


def _primary(figures: Judged) -> list[Block]:
    """Spread over seeds, ratios with verdicts, aims."""
    blocks: list[Block] = []
    if len(figures.seeds):
        headings = published(HEADINGS, figures.seeds)
        note = "Standard deviation of the log error over seeds, mean over scenarios."
        blocks.append(
            _by_method("Spread over seeds", figures.seeds, headings, lambda row: Cell(text=f"{100 * row.spread:.1f} %"), note)
        )
    if len(figures.ratios):
        blocks.append(_ratios(f"Ratio of the error to that of {figures.baseline}", figures, figures.ratios, HEADINGS))
    lines = aim_lines(figures.aims)
    if lines:
        rows = [[Cell(text=text.strip()) for text in line.strip("| ").split(" | ")] for line in lines[3:]]
        header = [cell.text for cell in rows[0]]
        blocks.append(Table(caption="Aims, declared in the configuration", header=header, rows=rows[2:]))
    return blocks


def _ratios(caption: str, figures: Judged, table: pd.DataFrame, headings: Headings) -> Table:
    def cell(row: Any) -> Cell:
        sure = np.isfinite(row.ratio_low)
        small = [*([f"[{row.ratio_low:.3f}, {row.ratio_high:.3f}]"] if sure else []), f"n = {row.n}"]
        return Cell(text=f"{row.ratio:.3f}", small=small, chips=[VERDICTS[row.verdict]], value=float(row.ratio))

    return _by_method(caption, table, published(headings, table), cell, about_ratios(figures))


def _by_method(caption: str, differences: pd.DataFrame, headings: Headings, cell: Callable[[Any], Cell], note: str) -> Table:
    rows = []
    for method, part in differences.groupby("method", sort=False):
        values = {(row.task, row.metric): row for row in part.itertuples()}
        cells = [cell(values[key]) if key in values else Cell(text=DASH, value="") for key in headings]
        rows.append([Cell(text=str(method)), *cells])
    return Table(caption=caption, header=["Method", *headings.values()], rows=rows, sortable=True, note=note)


def _transfers(material: Material, figures: Judged) -> list[Block]:
    """Twins on other recordings of the same object."""
    collected, baseline = material.transfers, material.choice.baseline
    if not len(collected.runs) or not len(collected.scores):
        return []
    usable, differences = compared(collected, baseline)
    if not len(usable):
        return []
    caption = "Transfer to other recordings of the same object: errors, mm"
    headings = published(TRANSFER_HEADINGS, usable)
    blocks: list[Block] = [_averages(caption, usable, collected, headings)]
    if len(differences):
        blocks.append(_differences(f"Transfer: paired difference to {baseline}, mm", differences, headings))
    if len(figures.transferred):
        blocks.append(_ratios(f"Transfer: ratio to {baseline}", figures, figures.transferred, TRANSFER_HEADINGS))
    return blocks


def _breakdowns(collected: Collected) -> list[Block]:
    """Per category and per scenario, of all finished runs."""
    finished = finished_scores(collected)
    headings = {key: text for key, text in headings_of(finished).items() if key in present(finished)}
    methods, blocks = list(dict.fromkeys(collected.runs["method"])), list[Block]()
    for column, counted in (("category", "Scenarios"), ("scenario", "Seeds")):
        rows = []
        for name, part in finished.groupby(column, sort=True):
            means = part.groupby(["method", "task", "metric", "scenario"])["value"].mean().groupby(level=[0, 1, 2]).mean()
            values: dict[Any, float] = {key: float(value) for key, value in means.items()}
            best = _best((task, metric, value) for (_, task, metric), value in values.items())
            counts = part.groupby("method")[counted.lower().removesuffix("s")].nunique()
            for method in [method for method in methods if method in counts.index]:
                cells = [_mean(values.get((method, *key)), key, best.get(key)) for key in headings]
                rows.append([Cell(text=str(name)), Cell(text=str(method)), *cells, Cell(text=str(counts[method]))])
        table = Table(
            caption=f"Per {column}: errors in mm, seeds averaged",
            header=[column.capitalize(), "Method", *headings.values(), counted],
            rows=rows,
            stub=2,
            sortable=True,
            note=f"All finished runs. Best of each {column} in bold.",
        )
        blocks.append(Fold(summary=f"Per {column}", blocks=[table]))
    return blocks


def _mean(value: float | None, key: tuple[str, str], best: float | None) -> Cell:
    if value is None:
        return Cell(text=DASH, value="")
    return Cell(text=_text(METRICS[key[1]], value), value=value, best=value == best, mark="best")


def _conditions(collected: Collected, usable: pd.DataFrame, differences: pd.DataFrame, baseline: str) -> list[Block]:
    """How pictures were scored, or why they were not, in the words of the summary; and the notes of runs."""
    lines = image_lines(collected, usable, differences, baseline)
    words = [line for line in lines if line and not line.startswith(("|", "Paired"))]
    blocks: list[Block] = [Items(items=words)] if words else []
    if honest := honest_notes(collected):
        blocks += [Text(text="Of your own recordings:", tone="warn"), Items(items=honest)]
    noted: list[Any] = list(collected.runs[collected.runs["notes"] != ""].itertuples())
    if noted:
        notes = [f"{row.scenario} / {row.method} / seed {row.seed}: {row.notes}" for row in noted[:MOST_NOTES]]
        more = [f"{len(noted) - MOST_NOTES} more"] if len(noted) > MOST_NOTES else []
        blocks.append(Fold(summary=f"{several(len(noted), 'run')} with notes", blocks=[Items(items=[*notes, *more])]))
    return blocks
