"""Failures in the averages: the means of every method without and with its failed runs, whose last finite frame is frozen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from neuspring.report.blocks import Block, Cell, Fold, Table, Text
from neuspring.report.page.words import number
from neuspring.report.tables.cells import of_study
from neuspring.report.tables.render import failures_grid
from neuspring.scores.failures import (
    DASHES,
    WHY,
    both_averages,
    left_out_lines,
    mean_rows,
    removed_lines,
    unknown_lines,
)
from neuspring.scores.metrics import DASH, METRICS, headings_of
from neuspring.scores.runs import Collected
from neuspring.scores.studies import Study


def coverage(collected: Collected) -> str:
    """Which pairs are missing from all averages because of failures, and which methods do not apply where; empty if none."""
    return " ".join([*removed_lines(collected.comparison.runs, collected.left_out), *left_out_lines(collected.left_out)])


def averages(collected: Collected) -> list[Block]:
    """The means without and with failed runs; nothing where no run has failed."""
    means = both_averages(*collected.comparison.parts)
    if not len(means):
        return []
    headings = headings_of(means)
    table = Table(
        caption="Without and with failed runs (errors in mm)",
        header=["Method", "Succeeded", "Mean over", *headings.values()],
        rows=[row for _, part in means.groupby("method", sort=False) for row in _rows(part, list(headings))],
        note=f"{WHY} {DASHES}",
    )
    unknown = [Text(text=text, tone="warn") for text in unknown_lines(means)]
    return [Fold(summary="Failures in the averages", blocks=[table, *unknown], open=True)]


def _rows(part: pd.DataFrame, keys: list[tuple[str, str]]) -> list[list[Cell]]:
    values: dict[Any, Any] = {(row.task, row.metric): row for row in part.itertuples()}
    first: Any = part.iloc[0]
    count = f"{first['succeeded']} of {first['attempted']}"
    stub = [Cell(text=str(first["method"])), Cell(text=count, tone="bad" if first["succeeded"] < first["attempted"] else "")]
    rows = []
    for over, column in mean_rows(part):
        rows.append([*stub, Cell(text=over), *(_value(values.get(key), key[1], column) for key in keys)])
        stub = [Cell(), Cell()]
    return rows


def _value(row: Any, name: str, column: str) -> Cell:
    if row is None or not np.isfinite(getattr(row, column)):
        return Cell(text=DASH)
    metric = METRICS[name]
    mean, by_frames = (number(metric.factor * getattr(row, key), metric.digits) for key in (column, f"{column}_frames"))
    return Cell(text=mean, small=[f"by frames {by_frames}"])


def of_table(study: Study, collected: Collected) -> list[Block]:
    """The footnote of a study's table: both means of the rows that failed somewhere, in its units; nothing without failures."""
    own = of_study(study, collected)
    labels = {method: label for label, method in study.rows.items()}
    means = both_averages(*own.comparison.parts)
    grid = failures_grid(study, means)
    blocks: list[Block] = []
    if grid.lines:
        rows = [[*(Cell(text=text) for text in stub), *(Cell(text=cell.text) for cell in cells)] for stub, cells in grid.lines]
        header = [*grid.stub, *grid.headings]
        blocks.append(Table(caption="Rows with failed runs", header=header, rows=rows, note=f"{WHY} {DASHES}"))
    lines = [
        *unknown_lines(means, labels),
        *removed_lines(own.comparison.runs, own.left_out, labels),
        *left_out_lines(own.left_out, labels),
    ]
    return [*blocks, *(Text(text=text) for text in lines)]
