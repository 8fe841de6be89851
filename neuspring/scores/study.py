"""The numbers of a study: for every label, task and metric ours beside the paper's, in the units of tables.

Two questions have two verdicts. Is the value the paper's? That can be asked on its 22 scenarios alone. Does the change against
the study's baseline go where the paper's goes? That can be asked on any data.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from neuspring.scores import paper, statistics
from neuspring.scores.metrics import TASKS, Metric, averages, present
from neuspring.scores.paper import Printed, Study
from neuspring.scores.statistics import interval, resampled_means
from neuspring.scores.table import ScoreTable, comparable, of_kind

LEAST_SCENARIOS = 6
"""A verdict on a change needs so many: all of n scenarios change in one direction by chance once in 2^(n-1) studies."""
ROUND_OFF = 1e-9
RELEASED_METHODS = ("phystwin", "baseline")
"""Our methods that stand for the released PhysTwin."""


def restricted(study: Study, table: ScoreTable) -> ScoreTable:
    """The runs of a study's methods, scores in the units of tables."""
    own, known = table.of(list(study.rows.values())), paper.in_studies()
    rows = own.rows[own.rows["metric"].isin(list(known))]
    factors = rows["metric"].map({name: metric.factor for name, metric in known.items()}).astype(float)
    rows = rows.assign(value=rows["value"].astype(float) * factors)
    return ScoreTable(rows, own.runs, own.left_out, own.records)


def cells(study: Study, own: ScoreTable) -> pd.DataFrame:
    """A row per label, task and metric of the `restricted` table.

    `paper` is the printed text; `ours` our mean in the paper's average, `spread` its standard deviation over the seeds that have
    every scenario, `low`, `high` its 95 % bootstrap interval over scenarios and seeds; `verdict` compares ours with the
    paper. `change` with its interval is the ratio to the baseline, of pictures the difference; `direction` compares it with
    `paper_change`.
    """
    scores = comparable(own.comparison.finished)
    scores = scores[scores["task"].isin(TASKS)]
    estimated = dict(_estimates(scores))
    for method in own.oracles:
        alone = own.of([method]).finished
        keys = scores[["scenario", "seed"]].drop_duplicates()
        estimated |= dict(_estimates(alone.merge(keys) if len(scores) else alone))
    changes = _changes(study, own)
    there = present(scores) if len(scores) else set()
    wanted = {key[1:] for key in study.values} or {(task, "chamfer") for task in TASKS}
    wanted |= there if not study.reference else {key for key in there if key[1] not in paper.metrics()}
    columns = [(task, metric) for task in TASKS for metric in paper.in_studies().values() if (task, metric.name) in wanted]
    rows = [_cell(study, own, scores, estimated, changes, label, *column) for label in study.rows for column in columns]
    return pd.DataFrame(rows)


def _cell(
    study: Study, own: ScoreTable, scores: pd.DataFrame, estimated: Any, changes: Any, label: str, task: str, metric: Metric
) -> dict[str, Any]:
    method = study.rows[label]
    printed, of_base = (study.values.get((name, task, metric.name)) for name in (label, study.baseline))
    nothing = {"ours": np.nan, "spread": np.nan, "low": np.nan, "high": np.nan, "scenarios": 0}
    found = estimated.get((method, task, metric.name), nothing)
    nothing = {"change": np.nan, "change_low": np.nan, "change_high": np.nan, "n": 0}
    changed = changes.get((method, task, metric.name), nothing)
    released = own.runs.loc[(own.runs["source"] == "phystwin") & own.runs["scenario"].isin(paper.scenarios()), "run"]
    part = scores[(scores["task"] == task) & (scores["metric"] == metric.name) & (scores["method"] == method)]
    foreign = bool((~part["run"].isin(released)).any())
    status = own.runs.loc[own.runs["method"] == method, "status"]
    oracle = method in own.oracles
    change = np.nan
    if printed and of_base and label != study.baseline:
        change = printed.value / of_base.value if metric.relative else printed.value - of_base.value
    verdict = "oracle" if oracle else _verdict(found, printed, metric, foreign)
    if np.isnan(found["ours"]):
        mine = own.of([method]).finished
        verdict = "not run" if not (status == "ok").any() else "not computed"
        verdict = "nothing to compare" if (mine["metric"] == metric.name).any() else verdict
    elif verdict in ("within", "better", "worse", "no interval") and found["scenarios"] < len(paper.scenarios()):
        verdict = f"partial ({found['scenarios']} of {len(paper.scenarios())}): {verdict}"
    return {
        **{"label": label, "method": method, "task": task, "metric": metric.name, "unit": metric.shown_unit},
        **{"average": metric.average, "paper": printed.text if printed else "", **found},
        "difference": np.nan if foreign or not printed else found["ours"] - printed.value,
        "verdict": verdict,
        **{"baseline": study.baseline, "paper_change": change, **changed},
        "direction": "" if label == study.baseline or oracle else _direction(changed, change, metric),
        **{name: int((status == name).sum()) for name in ("ok", "failed", "missing")},
    }


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
        whole = seeds[seeds["scenarios"] == part["scenario"].nunique()]
        spread = (whole["total"] / whole["weight"]).groupby(level="method").std(ddof=1)
        values = part.pivot(index=["scenario", "seed"], columns="method", values="value")
        weights = part.pivot_table(index="scenario", columns="method", values="weight")[values.columns].to_numpy().T
        runs = [rows.to_numpy().T for _, rows in values.groupby(level="scenario")]
        resampled = resampled_means(runs, np.random.default_rng(0), weights) if len(runs) > 1 else np.empty((len(weights), 0))
        for method, own in zip(map(str, values.columns), resampled, strict=True):
            low, high = interval(own)
            found = {"ours": float(mean[method, task, name]), "spread": float(spread.get(method, np.nan)), "low": low, "high": high}
            yield (method, task, name), found | {"scenarios": part["scenario"].nunique()}


def _changes(study: Study, own: ScoreTable) -> dict[tuple[str, str, str], dict[str, float]]:
    """Ratios of errors, and differences of pictures, to the study's baseline."""
    scores, base = own.comparison.finished, study.rows[study.baseline]
    pictures = of_kind(scores, "pictures", "marks")
    tables = [
        statistics.ratios(scores, base).rename(columns={"ratio": "change", "ratio_low": "change_low", "ratio_high": "change_high"}),
        statistics.paired_differences(pictures, base).rename(
            columns={"difference": "change", "low": "change_low", "high": "change_high", "scenarios": "n"}
        ),
    ]
    return {
        (row["method"], row["task"], row["metric"]): {name: row[name] for name in ("change", "change_low", "change_high", "n")}
        for table in tables
        for row in table.to_dict("records")
    }


def _verdict(found: dict[str, float], printed: Printed | None, metric: Metric, foreign: bool) -> str:
    """The answer to: is ours the paper's value, within the rounding of the latter?"""
    if printed is None:
        return "not in the paper"
    if foreign:
        return "other data"
    slack = printed.slack + ROUND_OFF * abs(printed.value)
    alone = not np.isfinite(found["low"])
    low, high = (found["ours"], found["ours"]) if alone else (found["low"], found["high"])
    if low - slack <= printed.value <= high + slack:
        return "within"
    return "no interval" if alone else "better" if (found["ours"] > printed.value) == metric.higher_is_better else "worse"


def resolved(low: float, high: float, scenarios: int, metric: Metric) -> str:
    """The answer to: does the interval of a difference leave out 0, and on which side?"""
    if scenarios < LEAST_SCENARIOS:
        return "too few scenarios"
    if not (low > 0 or high < 0):
        return "not resolved"
    return "better" if (low > 0) == metric.higher_is_better else "worse"


def _direction(changed: dict[str, float], paper_change: float, metric: Metric) -> str:
    """The answer to: does the change go where the paper's goes? Without a number of the paper: is it better?"""
    same = 1.0 if metric.of == "positions" else 0.0
    if np.isnan(changed["change"]):
        return "not run"
    found = resolved(changed["change_low"] - same, changed["change_high"] - same, int(changed["n"]), metric)
    if np.isnan(paper_change) or found not in ("better", "worse"):
        return found
    # The paper gives pictures' SSIM and IoU as ratios too.
    unchanged = 1.0 if metric.relative else 0.0
    if paper_change == unchanged:
        return "no change in the paper"
    return "same direction" if (changed["change"] > same) == (paper_change > unchanged) else "opposite"


def released_comparison(study: Study, own: ScoreTable) -> pd.DataFrame:
    """Every score of the released PhysTwin with ours beside it, mm; empty without its method or its scenarios."""
    method = next((method for method in RELEASED_METHODS if method in study.rows.values()), None)
    mine = own.finished[own.finished["method"] == method]
    mine = mine[mine["run"].isin(own.runs.loc[own.runs["source"] == "phystwin", "run"])]
    keys = ["scenario", "task", "metric"]
    ours = mine.groupby(keys)["value"].mean().rename("ours").reset_index()
    released = paper.released().assign(released=1e3 * paper.released()["value"]).drop(columns="value")
    return released.merge(ours, on=keys)
