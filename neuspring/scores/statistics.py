"""Uncertainty of averages: bootstrap intervals of means, paired differences, ratios over objects, and aims.

The bootstrap resamples scenarios, and seeds within each scenario, because runs of one scenario are not independent.

The primary result is the ratio of the errors of two methods. The paired log ratio is averaged over the seeds s of every object o,
and over its scenarios if it has several:

    l_o = mean_s log(error of the method / error of the baseline),    ratio = exp(mean_o l_o),    interval = exp(mean_o l_o ± t SE)

SE is the standard error of the l_o, t is Student's t with n - 1 degrees of freedom. The interval is over objects, because seeds of
one object are not independent evidence. It is a t-interval: logs of ratios are nearly normal, and a percentile bootstrap of few
objects is too narrow (with seven normal values, its 95 % interval contains the mean in 87 % of samples).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import pandas as pd

from neuspring.config.settings import Aim
from neuspring.scores.metrics import METRICS
from neuspring.scores.table import stacked

RESAMPLES = 10_000


def resampled_means(runs: list[np.ndarray], rng: np.random.Generator, weights: np.ndarray | None = None) -> np.ndarray:
    """Weighted means [methods, RESAMPLES] over resampled scenarios, each with resampled seeds.

    `runs` contains one array [methods, seeds] per scenario; `weights` is [methods, scenarios], 1 by default. All methods share the
    resamples, so differences between them are paired. A weighted mean is divided by the sum of the drawn weights.
    """
    counts = np.array([values.shape[1] for values in runs])
    most = counts.max()
    padded = np.stack([np.stack([np.resize(row, most) for row in values]) for values in runs], axis=1)
    weights = np.ones(padded.shape[:2]) if weights is None else weights
    total, weight = np.zeros((2, len(padded), RESAMPLES))
    for _ in runs:
        scenario = rng.integers(len(runs), size=RESAMPLES)
        seed = (rng.random((RESAMPLES, most)) * counts[scenario, None]).astype(int)
        used = np.arange(most) < counts[scenario, None]
        mean = (padded[:, scenario[:, None], seed] * used).sum(axis=2) / counts[scenario]
        total += weights[:, scenario] * mean
        weight += weights[:, scenario]
    return total / weight


def interval(means: np.ndarray) -> tuple[float, float]:
    """The 95 % interval of resampled means; NaN for an empty array."""
    if not len(means):
        return np.nan, np.nan
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def paired_differences(scores: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """Method minus baseline on the same scenarios and seeds, with 95 % intervals: one row per method, task and metric.

    Use it for scores without a meaningful ratio, and `ratios` for errors.
    """
    rows = []
    rng = np.random.default_rng(0)
    for (task, metric), part in scores.groupby(["task", "metric"], sort=False):
        wide = part.pivot_table(index=["scenario", "seed"], columns="method", values="value")
        if baseline not in wide:
            continue
        for method in wide.columns.drop(baseline):
            if not len(both := wide[[method, baseline]].dropna()):
                continue
            difference, low, high = _mean_interval(both[method] - both[baseline], rng)
            row = {"method": method, "baseline": baseline, "task": task, "metric": metric, "difference": difference}
            rows.append(row | {"low": low, "high": high, "scenarios": both.index.get_level_values("scenario").nunique()})
    return pd.DataFrame(rows)


def _mean_interval(values: pd.Series, rng: np.random.Generator) -> tuple[float, float, float]:
    """Mean over scenarios of `values`, indexed by (scenario, seed), and its interval; NaN for one scenario."""
    runs = [part.to_numpy() for _, part in values.groupby("scenario")]
    mean = float(np.mean([part.mean() for part in runs]))
    means = resampled_means([part[None] for part in runs], rng)[0] if len(runs) > 1 else np.empty(0)
    return mean, *interval(means)


Objects = Literal["scenario", "category"]
"""Unit of the intervals: a scenario, or all scenarios of a category (one object with several recordings)."""
BELOW, NOT_RESOLVED, ABOVE, TOO_FEW = "below 1", "not resolved", "above 1", "too few objects"
REACHED, MISSED, NOT_RUN = "reached", "missed", "not run"
RATIO_COLUMNS = ("method", "baseline", "task", "metric", "ratio", "ratio_low", "ratio_high", "n", "objects", "pairs", "verdict")
LEAST_OBJECTS = 3
"""With two objects, the t-interval extends by a factor of exp(12.7 SE) to either side, which is useless."""


def ratios(scores: pd.DataFrame, baseline: str, objects: Objects = "scenario") -> pd.DataFrame:
    """Geometric mean of method/baseline with its 95 % interval over objects: one row per method, task and error.

    `scores` are tidy rows of finished runs. All pairs of scenario and seed that both methods finished are used; `n` is the number
    of objects. Below three objects, the interval is NaN and the verdict "too few objects". A row is left out if an error is zero.
    """
    rows = []
    names = [metric.name for metric in METRICS.values() if metric.is_error]
    for (task, metric), part in scores[scores["metric"].isin(names)].groupby(["task", "metric"], sort=False):
        wide = part.pivot_table(index=["category", "scenario", "seed"], columns="method", values="value")
        if baseline not in wide:
            continue
        for method in (name for name in dict.fromkeys(part["method"]) if name != baseline):
            both = wide[[method, baseline]].dropna()
            if not len(both) or not (both > 0).all(axis=None):
                continue
            logs = np.log(both[method] / both[baseline])
            per_object = logs.groupby(["category", "scenario"]).mean().groupby(objects).mean()
            low, high = t_interval(per_object.to_numpy())
            row = {"method": method, "baseline": baseline, "task": task, "metric": metric, "ratio": math.exp(per_object.mean())}
            row |= {"ratio_low": math.exp(low), "ratio_high": math.exp(high), "n": len(per_object), "objects": objects}
            rows.append(row | {"pairs": len(both), "verdict": verdict(math.exp(low), math.exp(high))})
    return pd.DataFrame(rows, columns=list(RATIO_COLUMNS))


def typical(scores: pd.DataFrame, objects: Objects = "scenario") -> pd.Series:
    """Geometric mean of one error over objects by method, best first; seeds are averaged within each object."""
    values = scores.set_index(["method", "category", "scenario"])["value"].astype(float)
    with np.errstate(divide="ignore"):
        logs = pd.Series(np.log(values.to_numpy()), index=values.index)
    per_object = logs.groupby(level=[0, 1, 2], sort=False).mean().groupby(["method", objects], sort=False).mean()
    means = per_object.groupby(level="method", sort=False).mean()
    return pd.Series(np.exp(means.to_numpy()), index=means.index).sort_values(kind="stable")


def t_interval(values: np.ndarray) -> tuple[float, float]:
    """The 95 % t-interval of a mean; NaN for fewer than `LEAST_OBJECTS` values."""
    from scipy.stats import t

    if len(values) < LEAST_OBJECTS:
        return math.nan, math.nan
    reach = t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return float(values.mean() - reach), float(values.mean() + reach)


def verdict(low: float, high: float) -> str:
    """Verdict for the interval of a ratio: is it below 1, above 1, or does it contain 1?"""
    if math.isnan(low):
        return TOO_FEW
    return BELOW if high < 1 else ABOVE if low > 1 else NOT_RESOLVED


def judged_aims(scores: pd.DataFrame, aims: Iterable[Aim], objects: Objects = "scenario") -> pd.DataFrame:
    """Judge aims, one row each: the ratio as in `ratios`, the target, and reached, missed or not run."""
    rows = []
    for aim in aims:
        part = scores["method"].isin([aim.method, aim.baseline]) & (scores["task"] == aim.task) & (scores["metric"] == aim.metric)
        compared = ratios(scores[part], aim.baseline, objects).to_dict("records")
        identity = {"method": aim.method, "baseline": aim.baseline, "task": aim.task, "metric": aim.metric}
        row: dict[Any, Any] = compared[0] if compared else identity | {"n": 0, "objects": objects, "pairs": 0, "verdict": NOT_RUN}
        reached = bool(compared) and row["ratio"] <= aim.ratio and row["ratio_high"] < aim.below
        verdict_on_aim = (REACHED if reached else MISSED) if compared else NOT_RUN
        rows.append(row | {"aim": aim.ratio, "below": aim.below, "aim_verdict": verdict_on_aim})
    return pd.DataFrame(rows, columns=[*RATIO_COLUMNS, "aim", "below", "aim_verdict"])


def changes(scores: pd.DataFrame, baseline: str, objects: Objects = "scenario") -> pd.DataFrame:
    """Change against the baseline, one row per method, task and metric: `change`, `change_low`, `change_high`, `n`, `verdict`.

    The change of an error is its ratio (`ratios`). For all other metrics it is the difference (`paired_differences`), without a
    verdict.
    """
    errors = ratios(scores, baseline, objects)
    differences = paired_differences(scores[~scores["metric"].map(lambda name: METRICS[name].is_error).astype(bool)], baseline)
    names = ["change", "change_low", "change_high", "n"]
    tables = [
        errors.rename(columns=dict(zip(("ratio", "ratio_low", "ratio_high"), names, strict=False))),
        differences.rename(columns=dict(zip(("difference", "low", "high", "scenarios"), names, strict=True))).assign(verdict=""),
    ]
    return stacked(tables).reindex(columns=["method", "task", "metric", *names, "verdict"])
