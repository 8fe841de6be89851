"""The numbers of a study: for every row, task and metric ours beside the paper's, with intervals and verdicts.

Two questions have two verdicts. Is the value the paper's? That can be asked on its 22 scenarios alone. Does the change against
the study's baseline go where the paper's goes? That can be asked on any data. All values are in the units of tables.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from neuspring.scores import metrics, paper
from neuspring.scores.failures import both_averages
from neuspring.scores.metrics import METRICS, TASKS, Metric, averages, present
from neuspring.scores.paper import Printed, Study
from neuspring.scores.runs import Collected, comparable, finished_scores
from neuspring.scores.settings import differing
from neuspring.scores.statistics import interval, resampled_means


class Verdict(StrEnum):
    """The answer of one cell."""

    WITHIN = "within"
    BETTER = "better"
    WORSE = "worse"
    NO_INTERVAL = "no interval"
    OTHER_DATA = "other data"
    NO_VALUE = "not in the paper"
    NOT_RUN = "not run"
    NOT_COMPUTED = "not computed"
    NOTHING_TO_COMPARE = "nothing to compare"
    ORACLE = "oracle"
    BASELINE = "baseline"
    NO_BASELINE = "baseline not run"
    CONFIRMED = "same direction, confirmed"
    OPPOSITE = "opposite"
    NOT_RESOLVED = "not resolved"
    UNCHANGED = "no change in the paper"
    TOO_FEW = "too few scenarios"


ORACLE_LINE = "oracle: fitted on all frames, outside the comparison"
LEAST_SCENARIOS = 6
"""A verdict on a change needs so many. All of n scenarios change in one direction by chance once in 2^(n-1) studies, and then the
interval leaves out 0."""
ROUND_OFF = 1e-9
"""Relative rounding error that the comparison with half a unit of the last digit allows."""
RELEASED_METHODS = ("phystwin", "baseline")
"""Our methods that stand for the released PhysTwin."""
PART = (Verdict.WITHIN, Verdict.BETTER, Verdict.WORSE, Verdict.NO_INTERVAL)
"""Verdicts that are said to be partial where fewer than the paper's scenarios count."""


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


@dataclass(frozen=True, kw_only=True)
class StudyNumbers:
    """A study with its runs; each table is computed once, or was read from the file of numbers."""

    TABLES: ClassVar = ("cells", "runs", "failures", "scenarios", "categories", "released", "settings", "chamfer", "cells_beside")
    name: str
    study: Study
    collected: Collected
    """With runs of other methods, which are ignored."""
    beside: Study | None = None
    """The study that is shown next to this one."""

    @cached_property
    def own(self) -> Collected:
        """The runs of the study's methods, scores in the units of tables."""
        return restricted(self.study, self.collected)

    @cached_property
    def counted(self) -> pd.DataFrame:
        """The scores that averages take."""
        return counted(self.own)

    @cached_property
    def cells(self) -> pd.DataFrame:
        """A row per label, task and metric."""
        return cells(self.study, self.own)

    @cached_property
    def cells_beside(self) -> pd.DataFrame:
        """The cells of the study beside this one."""
        return cells(self.beside, restricted(self.beside, self.collected)) if self.beside else pd.DataFrame()

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Every run, whether it counts, and why not."""
        return accounted(self.study, self.own)

    @cached_property
    def failures(self) -> pd.DataFrame:
        """Averages without and with failed runs."""
        return both_averages(*self.own.comparison.parts)

    @cached_property
    def scenarios(self) -> pd.DataFrame:
        """A row per scenario, row label, task and metric, of all finished runs: mean and spread over seeds, and how many count."""
        runs = self.runs.loc[self.runs["status"] == "ok", ["label", "scenario", "method", "seed", "counted"]]
        groups = self.own.scores.merge(runs).groupby(["scenario", "category", "label", "method", "task", "metric"], sort=False)
        table = groups.agg(value=("value", "mean"), spread=("value", "std"), seeds=("seed", "nunique"), counted=("counted", "sum"))
        return _sorted(self.study, table.reset_index())

    @cached_property
    def categories(self) -> pd.DataFrame:
        """A row per category, row label, task and metric, of the runs that count; `value` in the average that the paper takes."""
        columns = ["category", "label", "method", "task", "metric", "value", "equal", "frames", "seed_std", "scenarios"]
        if not len(self.counted):
            return pd.DataFrame(columns=columns)
        table = averages(self.counted, by=("category", "method", "task", "metric")).rename(columns={"mean": "value"})
        return _sorted(self.study, table.assign(label=table["method"].map(self.labels))[columns])

    @cached_property
    def released(self) -> pd.DataFrame:
        """Every value of the released PhysTwin with ours beside it, mm; none where its method or its scenarios are not here."""
        method = next((method for method in RELEASED_METHODS if method in self.study.rows.values()), None)
        if method is None or not self.own.runs["scenario"].isin(paper.scenarios()).any():
            return pd.DataFrame()
        return released_comparison(self.own, method)

    @cached_property
    def settings(self) -> pd.DataFrame:
        """Settings that differ between the rows."""
        return differing(self.own.records.values(), self.labels)

    @cached_property
    def chamfer(self) -> pd.DataFrame:
        """The Chamfer distances that count, m: what the picture of the number of regions is drawn from."""
        part = self.counted[self.counted["metric"] == "chamfer"]
        return part.assign(value=part["value"] / METRICS["chamfer"].factor)

    @property
    def labels(self) -> dict[str, str]:
        """Method to label."""
        return {method: label for label, method in self.study.rows.items()}


def restricted(study: Study, collected: Collected) -> Collected:
    """The scores, in the units of tables, and the runs of a study's methods."""
    own = collected.of(list(study.rows.values()))
    return replace(own, scores=_in_units_of_tables(own.scores), frozen=_in_units_of_tables(own.frozen))


def _in_units_of_tables(scores: pd.DataFrame) -> pd.DataFrame:
    metrics = paper.in_studies()
    scores = scores[scores["metric"].isin(list(metrics))]
    factors = scores["metric"].map({name: metric.factor for name, metric in metrics.items()}).astype(float)
    return scores.assign(value=scores["value"].astype(float) * factors)


def counted(own: Collected) -> pd.DataFrame:
    """The scores that averages take: of the pairs of scenario and seed that every method finished and has this metric of.

    A method without a finished run takes no part, nor does one without any value of a metric in the averages of that metric.
    Oracles take no part.
    """
    if not len(scores := comparable(own.comparison)):
        return scores
    here = scores.groupby(["task", "metric", "scenario", "seed"])["method"].transform("nunique")
    return scores[here == scores.groupby(["task", "metric"])["method"].transform("nunique")]


def accounted(study: Study, own: Collected) -> pd.DataFrame:
    """Every run of a study: label, its identity, status, whether it counts, and why not if it does not."""
    labels = {method: label for label, method in study.rows.items()}
    status = {(row.scenario, row.seed, row.method): str(row.status) for row in own.runs.itertuples()}
    finished = list(dict.fromkeys(own.runs.loc[(own.runs["status"] == "ok") & ~own.runs["method"].isin(own.oracles), "method"]))
    reasons = []
    for run in own.runs.itertuples():
        lacking = [m for m in finished if status.get((run.scenario, run.seed, m)) != "ok"]
        why = f"{run.status!s}: {run.reason!s}"
        if run.status == "ok":
            absent = {m: "does not apply" if run.scenario in own.left_out.get(m, ()) else "missing" for m in lacking}
            names = ", ".join(f"{labels[m]} ({status.get((run.scenario, run.seed, m), absent[m])})" for m in lacking)
            why = f"not comparable, since without this scenario and seed: {names}" if lacking else ""
            why = ORACLE_LINE if run.method in own.oracles else why
        reasons.append(why)
    table = own.runs.assign(label=own.runs["method"].map(labels), why=reasons, counted=[not why for why in reasons])
    return table[["label", "scenario", "method", "seed", "status", "counted", "why", "source", "run_key"]]


def estimates(scores: pd.DataFrame, baseline: str) -> Estimates:
    """Ours in every cell from scores that are `counted`; changes are against the method `baseline`, where it has scores."""
    found: Estimates = {}
    means = {(row["method"], row["task"], row["metric"]): row for row in averages(scores).to_dict("records")} if len(scores) else {}
    for key, part in scores.groupby(["task", "metric"], sort=False):
        task, metric = str(key[0]), paper.in_studies()[str(key[1])]
        resamples, spreads = _resamples(part, metric), _spreads(part, metric)
        for method, resampled in resamples.items():
            mean, other = (float(means[method, task, metric.name][name]) for name in ("mean", "other"))
            low, high = interval(resampled)
            change: dict[str, float] = {}
            if baseline in resamples and method != baseline:
                base = float(means[baseline, task, metric.name]["mean"])
                change = _change(mean, base, resampled, resamples[baseline], metric)
            found[method, task, metric.name] = Estimate(
                ours=mean,
                other_average=other,
                spread=spreads[method],
                low=low,
                high=high,
                scenarios=part["scenario"].nunique(),
                seeds=part["seed"].nunique(),
                runs=int((part["method"] == method).sum()),
                **change,
            )
    return found


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
    groups = part.assign(weight=weights, product=weights * part["value"]).groupby(["method", "seed"])
    per_seed = groups.agg(total=("product", "sum"), weight=("weight", "sum"), scenarios=("scenario", "nunique"))
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


def in_order(columns: Collection[tuple[str, str]]) -> list[tuple[str, Metric]]:
    """Columns in the paper's order."""
    return [(task, metric) for task in TASKS for metric in paper.in_studies().values() if (task, metric.name) in columns]


def cells(study: Study, own: Collected) -> pd.DataFrame:
    """One row per label, task and metric: the paper's value, ours (`Estimate`), their difference, and both verdicts."""
    scores = counted(own)
    ours = estimates(scores, study.rows[study.baseline]) | _oracle_estimates(own, scores)
    there = present(scores) if len(scores) else set()
    ours_alone = {(task, metric) for task, metric in there if metric not in paper.metrics()}
    # The paper's, and metrics of ours that have scores. Without a reference: the Chamfer distance, and all that have scores.
    of_paper = {key[1:] for key in study.values} | ours_alone
    columns = in_order(of_paper if study.reference else there | {(task, "chamfer") for task in TASKS})
    return pd.DataFrame([_cell(study, own, scores, ours, label, *column) for label in study.rows for column in columns])


def _oracle_estimates(own: Collected, scores: pd.DataFrame) -> Estimates:
    """Oracles on the scenarios and seeds that count, each alone, so that they take nothing from the others."""
    found: Estimates = {}
    for method in own.oracles:
        alone = counted(replace(own.of([method]), runs=own.of([method]).runs.assign(oracle=False)))
        keys = ["scenario", "seed"]
        found |= estimates(alone.merge(scores[keys].drop_duplicates(), on=keys) if len(scores) else alone, "")
    return found


def _cell(
    study: Study, own: Collected, scores: pd.DataFrame, ours: Estimates, label: str, task: str, metric: Metric
) -> dict[str, Any]:
    method, base = study.rows[label], study.rows[study.baseline]
    estimate = ours.get((method, task, metric.name), Estimate())
    printed, of_base = (study.values.get((name, task, metric.name)) for name in (label, study.baseline))
    part = scores[(scores["task"] == task) & (scores["metric"] == metric.name) & (scores["method"] == method)]
    ran = own.runs[(own.runs["source"] == "phystwin") & own.runs["scenario"].isin(paper.scenarios())]
    # Some of the scores are not of the paper's 22 scenarios, read from the released data.
    foreign, oracle = bool((~part["scenario"].isin(ran["scenario"])).any()), method in own.oracles
    absent = _absent(own, method, metric.name) if np.isnan(estimate.ours) else None
    verdict = absent or (Verdict.ORACLE if oracle else _verdict(estimate, printed, metric, foreign))
    change = printed.value - of_base.value if printed and of_base else np.nan
    lacking = absent or (Verdict.ORACLE if oracle else Verdict.NO_BASELINE if np.isnan(estimate.change) else None)
    status = own.runs.loc[own.runs["method"] == method, "status"].value_counts()
    return {
        "label": label,
        "method": method,
        "task": task,
        "metric": metric.name,
        "unit": metric.shown_unit,
        "average": metric.average,
        "paper": printed.text if printed else "",
        **asdict(estimate),
        "difference": np.nan if foreign or not printed else estimate.ours - printed.value,
        "verdict": verdict,
        "partial": verdict in PART and estimate.scenarios < len(paper.scenarios()),
        "baseline": study.baseline,
        "paper_change": change,
        "paper_relative": change / of_base.value if of_base and metric.relative else np.nan,
        "oracle": oracle,
        "direction": Verdict.BASELINE if method == base else lacking or _direction(estimate, change, metric),
        **{name: int(status.get(name, 0)) for name in ("ok", "failed", "missing")},
    }


def _absent(own: Collected, method: str, metric: str) -> Verdict:
    """The reason why a cell has no value of ours."""
    mine = finished_scores(own.of([method]))
    if not ((own.runs["method"] == method) & (own.runs["status"] == "ok")).any():
        return Verdict.NOT_RUN
    return Verdict.NOTHING_TO_COMPARE if (mine["metric"] == metric).any() else Verdict.NOT_COMPUTED


def _verdict(estimate: Estimate, printed: Printed | None, metric: Metric, foreign: bool) -> Verdict:
    """The answer to: is ours the paper's value, within the rounding of the latter?"""
    if printed is None:
        return Verdict.NO_VALUE
    if foreign:
        return Verdict.OTHER_DATA
    slack = printed.slack + ROUND_OFF * abs(printed.value)
    low, high = (estimate.low, estimate.high) if np.isfinite(estimate.low) else (estimate.ours, estimate.ours)
    if low - slack <= printed.value <= high + slack:
        return Verdict.WITHIN
    if not np.isfinite(estimate.low):
        return Verdict.NO_INTERVAL
    return Verdict.BETTER if (estimate.ours > printed.value) == metric.higher_is_better else Verdict.WORSE


def resolved(low: float, high: float, scenarios: int, metric: Metric) -> Verdict:
    """The answer to: does the interval of a change leave out 0, and on which side?"""
    if scenarios < LEAST_SCENARIOS:
        return Verdict.TOO_FEW
    if not (low > 0 or high < 0):
        return Verdict.NOT_RESOLVED
    return Verdict.BETTER if (low > 0) == metric.higher_is_better else Verdict.WORSE


def _direction(estimate: Estimate, change: float, metric: Metric) -> Verdict:
    """The answer to: does the change go where the paper's goes? Without a number of the paper: is it better?"""
    found = resolved(estimate.change_low, estimate.change_high, estimate.scenarios, metric)
    if found in (Verdict.TOO_FEW, Verdict.NOT_RESOLVED) or np.isnan(change):
        return found
    if change == 0:
        return Verdict.UNCHANGED
    return Verdict.CONFIRMED if (estimate.change_low > 0) == (change > 0) else Verdict.OPPOSITE


def verdict_text(cell: Mapping[str, Any]) -> str:
    """The verdict on a value in words, with the counts that it depends on."""
    if cell["verdict"] == Verdict.NOT_RUN and cell["failed"]:
        return f"{cell['verdict']} ({cell['failed']} failed)"
    part = f"partial ({cell['scenarios']} of {len(paper.scenarios())}): " if cell["partial"] else ""
    return f"{part}{cell['verdict']}"


def released_comparison(own: Collected, method: str) -> pd.DataFrame:
    """Every value of the released PhysTwin with ours beside it, mm; NaN where there is no finished run on the released data."""
    mine = (own.runs["status"] == "ok") & (own.runs["source"] == "phystwin") & (own.runs["method"] == method)
    finished = own.runs.loc[mine, ["scenario", "method", "seed"]]
    keys = ["scenario", "task", "metric"]
    ours = own.scores.merge(finished).groupby(keys)["value"].agg(ours="mean", spread="std", seeds="count").reset_index()
    released = paper.released().assign(released=1e3 * paper.released()["value"]).drop(columns="value")
    table = released.merge(ours, on=keys, how="left")
    table["seeds"] = table["seeds"].fillna(0).astype(int)
    return table.assign(method=method, difference=table["ours"] - table["released"], ratio=table["ours"] / table["released"])


def _sorted(study: Study, table: pd.DataFrame) -> pd.DataFrame:
    """The table in the order of the study; scenarios or categories keep theirs."""
    first = str(table.columns[0])
    ranks: Any = {first: dict.fromkeys(table[first]), "label": study.rows, "task": TASKS, "metric": paper.in_studies()}
    return metrics.in_order(table, ranks)
