"""The numbers of a study: our value and the paper's for every label, task and metric, in the units of tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from neuspring.scores import paper, statistics
from neuspring.scores.metrics import TASKS, Metric, averages, present
from neuspring.scores.paper import Printed, Study
from neuspring.scores.statistics import interval, resampled_means
from neuspring.scores.table import ScoreTable, comparable

ROUND_OFF = 1e-9
NO_ESTIMATE = dict.fromkeys(("ours", "spread", "low", "high"), np.nan) | {"scenarios": 0}
UNCHANGED = dict.fromkeys(("change", "change_low", "change_high", "n"), np.nan)


def restricted(study: Study, table: ScoreTable) -> ScoreTable:
    """The runs of a study's methods, with scores converted to the units of tables."""
    own, known = table.of(list(study.rows.values())), paper.in_studies()
    rows = own.rows[own.rows["metric"].isin(list(known))]
    factors = rows["metric"].map({name: metric.factor for name, metric in known.items()}).astype(float)
    rows = rows.assign(value=rows["value"].astype(float) * factors)
    return ScoreTable(rows, own.runs, own.left_out, own.records)


def cells(study: Study, own: ScoreTable) -> pd.DataFrame:
    """One row per label, task and metric of the `restricted` table.

    - paper: the printed text
    - ours: our mean, in the paper's average
    - spread: standard deviation of `ours` over the seeds that have every scenario
    - low, high: 95 % bootstrap interval of `ours` over scenarios and seeds
    - verdict: comparison of `ours` with the paper
    - change, change_low, change_high: ratio to the baseline, for images the difference (`statistics.changes`)
    - paper_change: the paper's change
    """
    scores = comparable(own.comparison.finished)
    scores = scores[scores["task"].isin(TASKS)]
    estimated = dict(_estimates(scores))
    for method in own.oracles:
        alone = own.of([method]).finished
        keys = scores[["scenario", "seed"]].drop_duplicates()
        estimated |= dict(_estimates(alone.merge(keys) if len(scores) else alone))
    changes = statistics.changes(own.comparison.finished, study.rows[study.baseline])
    changed: Any = changes.set_index(["method", "task", "metric"])[list(UNCHANGED)].to_dict("index")
    of_paper = own.runs["scenario"].isin(paper.scenarios()) & own.runs["source"].eq("phystwin")
    foreign = set(scores.loc[~scores["run"].isin(own.runs.loc[of_paper, "run"]), "method"])
    status = own.runs.groupby("method")["status"].value_counts().to_dict()
    available = present(scores) if len(scores) else set()
    wanted = {key[1:] for key in study.values} or {(task, "chamfer") for task in TASKS}
    wanted |= available if not study.reference else {key for key in available if key[1] not in paper.metrics()}
    rows = []
    for label, method in study.rows.items():
        for task, metric in ((task, one) for task in TASKS for one in paper.in_studies().values() if (task, one.name) in wanted):
            key = (method, task, metric.name)
            printed, base = (study.values.get((name, task, metric.name)) for name in (label, study.baseline))
            estimate, change = estimated.get(key, NO_ESTIMATE), np.nan
            if printed and base and label != study.baseline:
                change = printed.value / base.value if metric.relative else printed.value - base.value
            row: dict[str, Any] = {"label": label, "method": method, "task": task, "metric": metric.name, "unit": metric.shown_unit}
            row |= {"average": metric.average, "paper": printed.text if printed else "", **estimate}
            row["difference"] = estimate["ours"] - printed.value if printed and method not in foreign else np.nan
            row["verdict"] = "oracle" if method in own.oracles else _verdict(estimate, printed, metric, method in foreign)
            row |= {"baseline": study.baseline, "paper_change": change, **changed.get(key, UNCHANGED)}
            rows.append(row | {name: status.get((method, name), 0) for name in ("ok", "failed", "missing")})
    return pd.DataFrame(rows)


def _estimates(scores: pd.DataFrame) -> Iterator[tuple[tuple[str, str, str], dict[str, float]]]:
    """Mean, spread and interval of comparable scores, by method, task and metric."""
    if not len(scores):
        return
    mean = averages(scores).set_index(["method", "task", "metric"])["mean"]
    for key, part in scores.groupby(["task", "metric"], sort=False):
        task, name = map(str, key)
        weight = part["frames"].astype(float) if paper.in_studies()[name].average == "frames" else pd.Series(1.0, index=part.index)
        part = part.assign(weight=weight, product=weight * part["value"])
        groups = part.groupby(["method", "seed"])
        seeds = groups.agg(total=("product", "sum"), weight=("weight", "sum"), scenarios=("scenario", "nunique"))
        complete = seeds[seeds["scenarios"] == part["scenario"].nunique()]
        spread = (complete["total"] / complete["weight"]).groupby(level="method").std(ddof=1)
        values = part.pivot(index=["scenario", "seed"], columns="method", values="value")
        weights = part.pivot_table(index="scenario", columns="method", values="weight")[values.columns].to_numpy().T
        runs = [rows.to_numpy().T for _, rows in values.groupby(level="scenario")]
        resampled = resampled_means(runs, np.random.default_rng(0), weights) if len(runs) > 1 else np.empty((len(weights), 0))
        for method, own in zip(map(str, values.columns), resampled, strict=True):
            low, high = interval(own)
            value = {"ours": float(mean[method, task, name]), "spread": float(spread.get(method, np.nan)), "low": low, "high": high}
            yield (method, task, name), value | {"scenarios": part["scenario"].nunique()}


def _verdict(estimate: dict[str, Any], printed: Printed | None, metric: Metric, foreign: bool) -> str:
    """Compare our value with the printed one, within its rounding. One scenario has no interval; its value is compared."""
    if np.isnan(estimate["ours"]):
        return "not run"
    if printed is None or foreign:
        return "other data" if printed else "not in the paper"
    slack = printed.slack + ROUND_OFF * abs(printed.value)
    low, high = (estimate[name] if np.isfinite(estimate[name]) else estimate["ours"] for name in ("low", "high"))
    verdict = "better" if (estimate["ours"] > printed.value) == (metric.better == "higher") else "worse"
    verdict = "within" if low - slack <= printed.value <= high + slack else verdict
    counted, total = estimate["scenarios"], len(paper.scenarios())
    return verdict if counted >= total else f"partial ({counted} of {total}): {verdict}"
