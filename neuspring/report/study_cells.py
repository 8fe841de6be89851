"""The numbers of a study's table: for every row, task and metric ours beside the paper's, with intervals and verdicts.

Two questions have two verdicts. Is the value the paper's? That can be asked on its 22 scenarios alone. Does the change against
the study's baseline go where the paper's goes? That can be asked on any data. All values are in the units of `Metric.paper_unit`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from neuspring.scores import paper
from neuspring.scores.metrics import IN_PAPER, IN_STUDIES, Metric, averages, present
from neuspring.scores.paper import Printed, Study
from neuspring.scores.runs import Collected, comparable
from neuspring.scores.statistics import interval, resampled_means

NOT_RUN, NOT_COMPUTED, NOTHING_TO_COMPARE = "not run", "not computed", "nothing to compare"
OTHER_DATA, NO_VALUE, NO_INTERVAL = "other data", "not in the paper", "no interval"
WITHIN, BETTER, WORSE = "within", "better", "worse"
BASELINE, CONFIRMED, OPPOSITE = "baseline", "same direction, confirmed", "opposite"
ORACLE, ORACLE_LINE = "oracle", "oracle: fitted on all frames, outside the comparison"
NOT_RESOLVED, UNCHANGED, TOO_FEW = "not resolved", "no change in the paper", "too few scenarios"
LEAST_SCENARIOS = 6
"""A verdict on a change needs so many. All of n scenarios change in one direction by chance once in 2^(n-1) studies, and then the
interval leaves out 0."""
ROUND_OFF = 1e-9
"""Relative rounding error that the comparison with half a unit of the last digit allows."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Ours in one cell. NaN stands for what cannot be said: intervals of one scenario, the spread over one seed."""

    ours: float = np.nan
    """In the average that the paper takes of this metric."""
    other_average: float = np.nan
    spread: float = np.nan
    """Standard deviation over the seeds that have every scenario."""
    low: float = np.nan
    high: float = np.nan
    """95 % bootstrap interval of `ours`, over scenarios and seeds."""
    scenarios: int = 0
    seeds: int = 0
    runs: int = 0
    change: float = np.nan
    """Minus the baseline, on the same scenarios and seeds."""
    change_low: float = np.nan
    change_high: float = np.nan
    relative: float = np.nan
    """The change over the baseline's mean; NaN where a ratio means nothing (dB)."""
    relative_low: float = np.nan
    relative_high: float = np.nan


Estimates = dict[tuple[str, str, str], Estimate]
"""By method, task, metric."""


def restricted(study: Study, collected: Collected) -> Collected:
    """The scores, in the units of studies, and the runs of a study's methods."""
    methods = list(study.rows.values())
    own = collected.of(methods)
    return replace(own, scores=_in_paper_units(own.scores), frozen=_in_paper_units(own.frozen))


def _in_paper_units(scores: pd.DataFrame) -> pd.DataFrame:
    """The scores in the metrics of studies, in their units."""
    scores = scores[scores["metric"].isin(list(IN_STUDIES))]
    factors = scores["metric"].map({name: metric.paper_factor for name, metric in IN_STUDIES.items()}).astype(float)
    return scores.assign(value=scores["value"].astype(float) * factors)


def counted(own: Collected) -> pd.DataFrame:
    """The scores that averages take: of the pairs of scenario and seed that every method finished and has this metric of.

    A method without a finished run takes no part, nor does one without any value of a metric in the averages of that metric.
    Oracles take no part.
    """
    scores = comparable(own.comparison)
    if not len(scores):
        return scores
    here = scores.groupby(["task", "metric", "scenario", "seed"])["method"].transform("nunique")
    return scores[here == scores.groupby(["task", "metric"])["method"].transform("nunique")]


def accounted(study: Study, own: Collected) -> pd.DataFrame:
    """Every run of a study: label, its identity, status, whether it counts, and why not if it does not."""
    labels = {method: label for label, method in study.rows.items()}
    status = {(row.scenario, row.seed, row.method): str(row.status) for row in own.runs.itertuples()}
    finished = list(dict.fromkeys(own.runs.loc[(own.runs["status"] == "ok") & ~own.runs["method"].isin(own.oracles), "method"]))
    rows = []
    for run in own.runs.itertuples():
        lacking = [m for m in finished if status.get((run.scenario, run.seed, m)) != "ok"]
        why = f"{run.status!s}: {run.reason!s}"
        if run.status == "ok":
            absent = {m: "does not apply" if run.scenario in own.left_out.get(m, ()) else "missing" for m in lacking}
            names = ", ".join(f"{labels[m]} ({status.get((run.scenario, run.seed, m), absent[m])})" for m in lacking)
            why = f"not comparable, since without this scenario and seed: {names}" if lacking else ""
            why = ORACLE_LINE if run.method in own.oracles else why
        identity = {"label": labels[str(run.method)], "scenario": run.scenario, "method": run.method, "seed": run.seed}
        rows.append(identity | {"status": run.status, "counted": not why, "why": why, "source": run.source, "run_key": run.run_key})
    columns = ["label", "scenario", "method", "seed", "status", "counted", "why", "source", "run_key"]
    return pd.DataFrame(rows, columns=columns)


def estimates(scores: pd.DataFrame, baseline: str) -> Estimates:
    """Ours in every cell from scores that are `counted`; changes are against the method `baseline`, where it has scores."""
    cells: Estimates = {}
    means = {(row["method"], row["task"], row["metric"]): row for row in averages(scores).to_dict("records")} if len(scores) else {}
    for key, part in scores.groupby(["task", "metric"], sort=False):
        task, metric = str(key[0]), IN_STUDIES[str(key[1])]
        resamples, spreads = _resamples(part, metric), _spreads(part, metric)
        for method, resampled in resamples.items():
            mean = means[method, task, metric.name]
            ours, (low, high) = float(mean[metric.average]), interval(resampled)
            change: dict[str, float] = {}
            if baseline in resamples and method != baseline:
                base = float(means[baseline, task, metric.name][metric.average])
                change = _change(ours, base, resampled, resamples[baseline], metric)
            cells[method, task, metric.name] = Estimate(
                ours=ours,
                other_average=float(mean[metric.other_average]),
                spread=spreads[method],
                low=low,
                high=high,
                scenarios=part["scenario"].nunique(),
                seeds=part["seed"].nunique(),
                runs=int((part["method"] == method).sum()),
                **change,
            )
    return cells


def _change(ours: float, base: float, resampled: np.ndarray, resampled_base: np.ndarray, metric: Metric) -> dict[str, float]:
    difference = resampled - resampled_base
    low, high = interval(difference)
    values = {"change": ours - base, "change_low": low, "change_high": high}
    if not metric.relative or base == 0 or not np.all(resampled_base):
        return values
    low, high = interval(difference / resampled_base)
    return values | {"relative": (ours - base) / base, "relative_low": low, "relative_high": high}


def _weights(scores: pd.DataFrame, metric: Metric) -> pd.Series:
    return scores["frames"].astype(float) if metric.average == "frames" else pd.Series(1.0, index=scores.index)


def _spreads(part: pd.DataFrame, metric: Metric) -> dict[str, float]:
    """Method to the standard deviation over seeds of the mean over scenarios, of the seeds that have every scenario."""
    weights = _weights(part, metric)
    weighted = part.assign(weight=weights, product=weights * part["value"])
    per_seed = weighted.groupby(["method", "seed"]).agg(
        total=("product", "sum"), weight=("weight", "sum"), scenarios=("scenario", "nunique")
    )
    complete = per_seed[per_seed["scenarios"] == part["scenario"].nunique()]
    spread = (complete["total"] / complete["weight"]).groupby(level="method").std(ddof=1)
    return {str(method): float(spread.get(method, np.nan)) for method in part["method"].unique()}


def _resamples(part: pd.DataFrame, metric: Metric) -> dict[str, np.ndarray]:
    """Method to its mean in every resample; empty arrays for a single scenario, which says nothing of others."""
    values = part.pivot(index=["scenario", "seed"], columns="method", values="value")
    weights = part.assign(weight=_weights(part, metric)).pivot_table(index="scenario", columns="method", values="weight")
    runs = [rows.to_numpy().T for _, rows in values.groupby(level="scenario")]
    if len(runs) == 1:
        return {str(method): np.empty(0) for method in values.columns}
    means = resampled_means(runs, np.random.default_rng(0), weights[values.columns].to_numpy().T)
    return dict(zip(map(str, values.columns), means, strict=True))


def columns_of(study: Study, scores: pd.DataFrame) -> list[tuple[str, Metric]]:
    """The columns of a study's table: the paper's, and metrics of ours that have scores.

    Without a reference: the Chamfer distance and all metrics that have scores.
    """
    there = present(scores) if len(scores) else set()
    of_paper = {key[1:] for key in study.values}
    ours = {(task, metric) for task, metric in there if metric not in IN_PAPER}
    return in_order(of_paper | ours if study.reference else there | {(task, "chamfer") for task in paper.TASKS})


def in_order(columns: Collection[tuple[str, str]]) -> list[tuple[str, Metric]]:
    """Columns in the paper's order."""
    return [(task, metric) for task in paper.TASKS for metric in IN_STUDIES.values() if (task, metric.name) in columns]


def cells(study: Study, own: Collected) -> pd.DataFrame:
    """One row per label, task and metric: the paper's value, ours (`Estimate`), their difference, and both verdicts."""
    scores = counted(own)
    ours = estimates(scores, study.rows[study.baseline]) | _oracle_estimates(own, scores)
    columns = columns_of(study, scores)
    return pd.DataFrame([_cell(study, own, scores, ours, label, *column) for label in study.rows for column in columns])


def _oracle_estimates(own: Collected, scores: pd.DataFrame) -> Estimates:
    """Oracles on the scenarios and seeds that count, each alone, so that they take nothing from the others."""
    cells: Estimates = {}
    for method in own.oracles:
        alone = counted(replace(own.of([method]), runs=own.of([method]).runs.assign(oracle=False)))
        keys = ["scenario", "seed"]
        cells |= estimates(alone.merge(scores[keys].drop_duplicates(), on=keys) if len(scores) else alone, "")
    return cells


def _cell(
    study: Study, own: Collected, scores: pd.DataFrame, ours: Estimates, label: str, task: str, metric: Metric
) -> dict[str, Any]:
    method, base = study.rows[label], study.rows[study.baseline]
    estimate = ours.get((method, task, metric.name), Estimate())
    printed = study.values.get((label, task, metric.name))
    part = scores[(scores["task"] == task) & (scores["metric"] == metric.name) & (scores["method"] == method)]
    foreign = is_foreign(own.runs, part)
    absent = _absent(own, method, metric.name) if np.isnan(estimate.ours) else ""
    verdict = absent or _verdict(estimate, printed, metric, foreign)
    if verdict in (WITHIN, BETTER, WORSE, NO_INTERVAL) and estimate.scenarios < len(paper.scenarios()):
        verdict = f"partial ({estimate.scenarios} of {len(paper.scenarios())}): {verdict}"
    of_base = study.values.get((study.baseline, task, metric.name))
    change = printed.value - of_base.value if printed and of_base else np.nan
    oracle = method in own.oracles
    verdict = ORACLE if oracle and not absent else verdict
    lacking = absent or (ORACLE if oracle else "") or ("baseline not run" if np.isnan(estimate.change) else "")
    status = own.runs.loc[own.runs["method"] == method, "status"].value_counts()
    return {
        "label": label,
        "method": method,
        "task": task,
        "metric": metric.name,
        "unit": metric.paper_unit,
        "average": metric.average,
        "paper": printed.text if printed else "",
        **asdict(estimate),
        "difference": np.nan if foreign or not printed else estimate.ours - printed.value,
        "verdict": verdict,
        "baseline": study.baseline,
        "paper_change": change,
        "paper_relative": change / of_base.value if of_base and metric.relative else np.nan,
        "oracle": oracle,
        "direction": BASELINE if method == base else lacking or _direction(estimate, change, metric),
        **{name: int(status.get(name, 0)) for name in ("ok", "failed", "missing")},
    }


def is_foreign(runs: pd.DataFrame, scores: pd.DataFrame) -> bool:
    """Whether some of the scores are not of the paper's 22 scenarios, read from the released data."""
    released = runs.loc[(runs["source"] == "phystwin") & runs["scenario"].isin(paper.scenarios()), "scenario"]
    return bool((~scores["scenario"].isin(released)).any())


def _absent(own: Collected, method: str, metric: str) -> str:
    """Why a cell has no value of ours."""
    runs = own.runs[own.runs["method"] == method]
    finished = runs[runs["status"] == "ok"]
    failed = int((runs["status"] == "failed").sum())
    if not len(finished):
        return f"{NOT_RUN} ({failed} failed)" if failed else NOT_RUN
    mine = own.scores[(own.scores["method"] == method) & (own.scores["metric"] == metric)]
    return NOTHING_TO_COMPARE if len(mine.merge(finished[["scenario", "seed"]])) else NOT_COMPUTED


def _verdict(estimate: Estimate, printed: Printed | None, metric: Metric, foreign: bool) -> str:
    """Whether ours is the paper's value, within the rounding of the latter."""
    if printed is None:
        return NO_VALUE
    if foreign:
        return OTHER_DATA
    slack = printed.slack + ROUND_OFF * abs(printed.value)
    low, high = (estimate.low, estimate.high) if np.isfinite(estimate.low) else (estimate.ours, estimate.ours)
    if low - slack <= printed.value <= high + slack:
        return WITHIN
    if not np.isfinite(estimate.low):
        return NO_INTERVAL
    return BETTER if (estimate.ours > printed.value) == metric.higher_is_better else WORSE


def _direction(estimate: Estimate, change: float, metric: Metric) -> str:
    """Whether the change against the baseline goes where the paper's goes; without a number of the paper, whether it is better."""
    if estimate.scenarios < LEAST_SCENARIOS:
        return TOO_FEW
    low, high = estimate.change_low, estimate.change_high
    if not (low > 0 or high < 0):
        return NOT_RESOLVED
    if np.isnan(change):
        return BETTER if (low > 0) == metric.higher_is_better else WORSE
    if change == 0:
        return UNCHANGED
    return CONFIRMED if (low > 0) == (change > 0) else OPPOSITE
