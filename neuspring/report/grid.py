"""Numbers laid out: a table has a line per method, scenario or other group, and a column per task and metric."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

import pandas as pd

from neuspring.core.table import Cell, Chip, Table, Tone
from neuspring.scores import statistics
from neuspring.scores.metrics import DASH, METRICS, SHORT, TASKS, Metric, metrics_of
from neuspring.scores.study import Verdict

EMPTY = Cell(text=DASH, value="")
VERDICT_SIGNS: dict[str, tuple[Tone, str]] = {
    Verdict.WITHIN: ("good", "✓"),
    Verdict.BETTER: ("good", "▲"),
    Verdict.WORSE: ("bad", "▼"),
    Verdict.CONFIRMED: ("good", "✓"),
    Verdict.OPPOSITE: ("bad", "✗"),
    Verdict.NO_INTERVAL: ("warn", "~"),
    Verdict.NOT_RESOLVED: ("warn", "~"),
    Verdict.TOO_FEW: ("", "~"),
    Verdict.OTHER_DATA: ("", "◇"),
    statistics.BELOW: ("good", "▲"),
    statistics.ABOVE: ("bad", "▼"),
    statistics.TOO_FEW: ("", "~"),
    statistics.REACHED: ("good", "▲"),
    statistics.MISSED: ("bad", "▼"),
}
"""Verdict to tone and symbol. All others are muted."""
Columns = Sequence[tuple[str, Metric]]
"""Tasks and metrics."""
Show = Callable[[Any, Metric], Cell]
"""Function that gives a line's cell for a row of numbers."""


def chip(verdict: str, text: str = "") -> Chip:
    """A verdict in its color, with its counts in `text`."""
    tone, symbol = VERDICT_SIGNS.get(verdict, ("mute", "○"))
    return Chip(text=text or str(verdict), tone=tone, symbol=symbol)


def columns(table: pd.DataFrame, of: Collection[str] = ("positions",), always: bool = False) -> list[tuple[str, Metric]]:
    """Tasks and metrics that a table has rows of; `always`: also the paper's metrics of positions, in its tasks."""
    there = set(zip(table["task"], table["metric"], strict=True)) if len(table) else set()
    wanted = [metric for kind in of for metric in metrics_of(kind)]  # type: ignore[arg-type]
    shown = there | {(task, metric.name) for task in TASKS for metric in wanted if always and metric.paper_name}
    return [(task, metric) for task in SHORT for metric in wanted if (task, metric.name) in shown]


def rows(
    table: pd.DataFrame,
    columns: Columns,
    keys: Sequence[str],
    lines: Callable[[Any], Sequence[tuple[Sequence[Cell], Show]]],
    empty: Cell = EMPTY,
) -> list[list[Cell]]:
    """Lines of every group of `keys`: `lines` of a group's first row are their headings and what they show of each cell."""
    made: list[list[Cell]] = []
    for _, part in table.groupby(list(keys), sort=False):
        cells = {(row.task, row.metric): row for row in part.itertuples()}
        for stub, show in lines(next(iter(cells.values()))):
            here = [(cells.get((task, metric.name)), metric) for task, metric in columns]
            made.append([*stub, *(show(row, metric) if row is not None else empty for row, metric in here)])
    return made


def flat(caption: str, stub: Sequence[str], columns: Columns, rows: Sequence[Sequence[Cell]], *tail: str, **more: Any) -> Table:
    """A table whose headings name task and metric in one; `tail` are headings of columns behind them."""
    header = [*stub, *(f"{SHORT[task]} {metric.column}" for task, metric in columns), *tail]
    return Table(caption=caption, header=header, rows=rows, stub=len(stub), **more)


def by_method(caption: str, table: pd.DataFrame, columns: Columns, show: Show, note: str = "") -> Table:
    """A line per method."""
    return flat(
        caption, ["Method"], columns, rows(table, columns, ["method"], lambda row: [([Cell(text=row.method)], show)]), note=note,
        sortable=True,
    )  # fmt: skip


def grouped(caption: str, stub: Sequence[str], columns: Columns, rows: Sequence[Sequence[Cell]], note: str = "") -> Table:
    """A table whose columns are grouped by task, as the paper's are; headings have an arrow towards what is better."""
    header = [*stub, *(f"{metric.column} {'↑' if metric.higher_is_better else '↓'}" for _, metric in columns)]
    return Table(caption=caption, note=note, header=header, groups=[SHORT[task] for task, _ in columns], stub=len(stub), rows=rows)


def best(means: Iterable[tuple[str, str, float]]) -> dict[tuple[str, str], float]:
    """Task and metric to the best of the means (task, metric, value), where there are at least two."""
    found: dict[tuple[str, str], list[float]] = {}
    for task, metric, value in means:
        found.setdefault((task, metric), []).append(value)
    choose = {name: max if METRICS[name].higher_is_better else min for _, name in found}
    return {key: choose[key[1]](values) for key, values in found.items() if len(values) > 1}


def ratio_text(row: Any) -> str:
    """The number of a pair of methods wherever it stands: ratio of errors, and its interval where there is one."""
    return f"{row.ratio:.3f} {between(row.ratio_low, row.ratio_high, '{:.3f}'.format)}".rstrip()


def between(low: float, high: float, show: Callable[[float], str]) -> str:
    """An interval; empty where there is none."""
    return "" if pd.isna(low) else f"[{show(low)}, {show(high)}]"
