"""Failures in the averages: both means of every method, and what failures and scenarios left out take from the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from neuspring.report.page.blocks import Block, Cell, Fold, Table, Text
from neuspring.report.page.words import DASH, number
from neuspring.report.tables.cells import of_study
from neuspring.report.tables.render import SHORT, held_grid
from neuspring.report.tables.summary import Collected
from neuspring.scores.failures import DASHES, WHY, both_averages, left_out_lines, removed_lines, unknown_lines
from neuspring.scores.layout import HEADINGS, IMAGE_HEADINGS, SHOWN
from neuspring.scores.studies import Study


def coverage(collected: Collected) -> str:
    """Whose failures take how many pairs from all averages, and which methods do not apply where; empty if none."""
    lines = [*removed_lines(collected.runs, collected.left_out), *left_out_lines(collected.left_out)]
    return " ".join(lines)


def averages(collected: Collected) -> list[Block]:
    """The means without and with the failed runs; nothing where none has failed."""
    means = both_averages(collected.scores, collected.runs, collected.held)
    if not len(means):
        return []
    known = set(zip(means["task"], means["metric"], strict=True))
    headings = {key: text for key, text in (HEADINGS | IMAGE_HEADINGS).items() if key in known}
    rows = [row for _, part in means.groupby("method", sort=False) for row in _rows(part, list(headings))]
    table = Table(
        caption="Without and with failed runs (errors in mm)",
        header=["Method", "Succeeded", "Mean over", *headings.values()],
        rows=rows,
        note=f"{WHY} {DASHES}",
    )
    unknown = [Text(text=text, tone="warn") for text in unknown_lines(means)]
    return [Fold(summary="Failures in the averages", blocks=[table, *unknown], open=True)]


def _rows(part: pd.DataFrame, keys: list[tuple[str, str]]) -> list[list[Cell]]:
    """One line for a method that never failed, else one for each mean."""
    known: dict[Any, Any] = {(row.task, row.metric): row for row in part.itertuples()}
    first: Any = part.iloc[0]
    failed = int(first["attempted"] - first["succeeded"])
    head = [
        Cell(text=str(first["method"])),
        Cell(text=f"{first['succeeded']} of {first['attempted']}", tone="bad" if failed else ""),
    ]
    own = [_value(known.get(key), key[1], "own") for key in keys]
    if not failed:
        return [[*head, Cell(text="all"), *own]]
    held = [_value(known.get(key), key[1], "all") for key in keys]
    return [[*head, Cell(text="its successes"), *own], [Cell(), Cell(), Cell(text="all, failures held"), *held]]


def _value(row: Any, metric: str, name: str) -> Cell:
    if row is None or not np.isfinite(getattr(row, name)):
        return Cell(text=DASH)
    factor, digits = SHOWN[metric]
    by_frames = number(factor * getattr(row, f"{name}_frames"), digits)
    return Cell(text=number(factor * getattr(row, name), digits), small=[f"by frames {by_frames}"])


def of_table(study: Study, collected: Collected) -> list[Block]:
    """The footnote of a study's table: both means of the rows that failed somewhere, in its units; nothing without failures."""
    own = of_study(study, collected)
    labels = {method: label for label, method in study.rows.items()}
    means = both_averages(own.scores, own.runs, own.held)
    grid = held_grid(study, means)
    blocks: list[Block] = []
    if grid.lines:
        header = [*grid.stub, *(f"{SHORT[task]} {measure.heading}" for task, measure in grid.columns)]
        rows = [[*(Cell(text=text) for text in stub), *(Cell(text=cell.text) for cell in cells)] for stub, cells in grid.lines]
        blocks.append(Table(caption="Rows with failed runs", header=header, rows=rows, note=f"{WHY} {DASHES}"))
    told = [*unknown_lines(means, labels), *removed_lines(own.runs, own.left_out, labels), *left_out_lines(own.left_out, labels)]
    return [*blocks, *(Text(text=text) for text in told)]
