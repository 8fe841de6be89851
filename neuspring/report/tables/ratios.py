"""The primary figure in tables: ratios to another method with intervals over objects, aims, the spread over seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from neuspring.config.settings import Aim
from neuspring.core.text import markdown
from neuspring.scores.metrics import DASH, HEADINGS, METRICS, SHORT, TRANSFER_HEADINGS, Headings, published
from neuspring.scores.ratios import LEAST_OBJECTS, Objects, judged_aims, ratios, seed_spread
from neuspring.scores.runs import Collected, finished_scores


@dataclass(frozen=True, kw_only=True)
class Judging:
    """How methods are compared: what an object is, and what was aimed at."""

    objects: Objects = "scenario"
    aims: tuple[Aim, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Ratios, aims and spreads of a benchmark, as tables; `transferred` are ratios of twins on other recordings."""

    objects: Objects
    baseline: str
    ratios: pd.DataFrame
    transferred: pd.DataFrame
    aims: pd.DataFrame
    seeds: pd.DataFrame


def judged(collected: Collected, baseline: str, judging: Judging, transfers: Collected | None = None) -> Judged:
    """Ratios of every method of the comparison to `baseline`, aims, and spreads, from all finished runs."""
    scores = finished_scores(collected.comparison)
    moved = collected.scores[:0]
    if transfers is not None and len(transfers.runs):
        kept = [method for method in dict.fromkeys(transfers.runs["method"]) if method not in collected.oracles]
        moved = finished_scores(transfers.of(kept))
    return Judged(
        objects=judging.objects,
        baseline=baseline,
        ratios=ratios(scores, baseline, judging.objects),
        transferred=ratios(moved, baseline, judging.objects),
        aims=judged_aims(scores, moved, judging.aims, judging.objects),
        seeds=seed_spread(scores),
    )


def about_ratios(judged: Judged) -> str:
    """What the table of ratios shows, in words."""
    what = {"scenario": "scenarios", "category": "categories"}[judged.objects]
    return (
        f"Ratio of the error to that of {judged.baseline}: geometric mean over objects of the paired log ratio, seeds averaged "
        f"within an object; 95 % t-interval over objects ({what}), none below {LEAST_OBJECTS}; n objects. Every row takes all "
        "pairs of scenario and seed that both methods finished."
    )


def ratio_lines(judged: Judged) -> list[str]:
    """The sections of the summary: spread over seeds, ratios with verdicts, aims."""
    lines = _seed_lines(judged.seeds)
    if len(judged.ratios):
        lines += ["", f"{about_ratios(judged)}", "", *by_method(judged.ratios, published(HEADINGS, judged.ratios), _ratio)]
    return lines + aim_lines(judged.aims)


def transfer_lines(judged: Judged) -> list[str]:
    """The same of twins on other recordings."""
    rows = judged.transferred
    return ["", about_ratios(judged), "", *by_method(rows, published(TRANSFER_HEADINGS, rows), _ratio)] if len(rows) else []


def aim_lines(aims: pd.DataFrame) -> list[str]:
    """A line per aim: what was aimed at, what was measured, reached or missed. Nothing without aims."""
    if not len(aims):
        return []
    rows = []
    for row in aims.itertuples():
        what = f"{SHORT.get(str(row.task), 'Transfer')} {METRICS[str(row.metric)].heading}"
        wanted = f"<= {row.aim:.2f}, interval below {row.below:g}"
        rows.append([str(row.method), str(row.baseline), what, wanted, _interval(row), str(row.n), str(row.aim_verdict)])
    header = ["Method", "Against", "What", "Aim", "Ratio [95 % interval]", "n", "Verdict"]
    return ["", "Aims, declared in the configuration:", "", *markdown(header, rows)]


def _seed_lines(seeds: pd.DataFrame) -> list[str]:
    if not len(seeds):
        return []
    about = "Spread over seeds: standard deviation of the log error, in per cent, mean over scenarios."
    cells = published(HEADINGS, seeds)
    return ["", about, "", *by_method(seeds, cells, lambda row: f"{100 * row.spread:.1f} %")]


def by_method(table: pd.DataFrame, headings: Headings, cell: Callable[[Any], str]) -> list[str]:
    """A Markdown table with a line per method: `cell` of each task and metric in `headings`, a dash where it has no row."""
    rows = []
    for method, part in table.groupby("method", sort=False):
        values = {(row.task, row.metric): row for row in part.itertuples()}
        rows.append([str(method), *(cell(values[key]) if key in values else DASH for key in headings)])
    return markdown(["Method", *headings.values()], rows)


def _ratio(row: Any) -> str:
    return f"{_interval(row)}, n = {row.n}: {row.verdict}"


def _interval(row: Any) -> str:
    if not np.isfinite(row.ratio):
        return DASH
    return f"{row.ratio:.3f}" + (f" [{row.ratio_low:.3f}, {row.ratio_high:.3f}]" if np.isfinite(row.ratio_low) else "")
