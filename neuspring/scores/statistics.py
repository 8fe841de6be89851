"""Certainty of an average: intervals of means, paired differences, and the primary figure, ratios over objects, with aims.

The bootstrap resamples scenarios, and within each of them its seeds, because runs of one scenario are not independent.

The primary figure says how many times the error of one method is that of another. For every object o the paired log ratio is
averaged over its seeds s, and over its scenarios where an object has several:

    l_o = mean_s log(error of the method / error of the baseline),    ratio = exp(mean_o l_o),    interval = exp(mean_o l_o ± t SE)

with the standard error SE of the l_o and Student's t of n - 1 degrees of freedom. Objects are what the result is to hold for, so
the interval is over them: seeds of an object are no independent evidence. It is a t-interval, because a percentile bootstrap of few
objects is too narrow (of seven normal values, its 95 % interval holds the mean in 87 % of samples), and logs of ratios are close to
normal.
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
    """Weighted means over resampled scenarios, each with its own resampled seeds [methods, RESAMPLES].

    `runs` has one array [methods, seeds] per scenario, `weights` [methods, scenarios] is 1 unless given. All methods see the same
    resamples, so that differences between them are paired. A weighted mean is divided by the weights that were drawn.
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
    """Method minus baseline on the same scenarios and seeds: a row per method, task and metric, with 95 % intervals.

    It is for scores of which a ratio means nothing; errors have `ratios`.
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
    """Mean over scenarios of `values` by (scenario, seed), and its interval (NaN for one scenario)."""
    runs = [part.to_numpy() for _, part in values.groupby("scenario")]
    mean = float(np.mean([part.mean() for part in runs]))
    means = resampled_means([part[None] for part in runs], rng)[0] if len(runs) > 1 else np.empty(0)
    return mean, *interval(means)


Objects = Literal["scenario", "category"]
"""Objects that intervals are over: a scenario, or all scenarios of a category (an object with several recordings)."""
BELOW, NOT_RESOLVED, ABOVE, TOO_FEW = "below 1", "not resolved", "above 1", "too few objects"
REACHED, MISSED, NOT_RUN = "reached", "missed", "not run"
RATIO_COLUMNS = ("method", "baseline", "task", "metric", "ratio", "ratio_low", "ratio_high", "n", "objects", "pairs", "verdict")
LEAST_OBJECTS = 3
"""With two objects, the t-interval spans a factor of exp(12.7 SE) on either side: it says nothing."""


def ratios(scores: pd.DataFrame, baseline: str, objects: Objects = "scenario") -> pd.DataFrame:
    """A row per method, task and distance: geometric mean of method/baseline and its 95 % interval over objects.

    `scores` are tidy rows of finished runs. Pairs of scenario and seed count that both methods finished, whatever others did; `n`
    counts objects. Interval and verdict are NaN and "too few objects" below three objects. There is no row where an error is zero.
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
            each = logs.groupby(["category", "scenario"]).mean().groupby(objects).mean()
            low, high = t_interval(each.to_numpy())
            row = {"method": method, "baseline": baseline, "task": task, "metric": metric, "ratio": math.exp(each.mean())}
            row |= {"ratio_low": math.exp(low), "ratio_high": math.exp(high), "n": len(each), "objects": objects}
            rows.append(row | {"pairs": len(both), "verdict": verdict(math.exp(low), math.exp(high))})
    return pd.DataFrame(rows, columns=list(RATIO_COLUMNS))


def typical(scores: pd.DataFrame, objects: Objects = "scenario") -> pd.Series:
    """Method to the geometric mean of one error over objects, seeds averaged within each, the best first: the order of `ratios`."""
    values = scores.set_index(["method", "category", "scenario"])["value"].astype(float)
    with np.errstate(divide="ignore"):
        logs = pd.Series(np.log(values.to_numpy()), index=values.index)
    each = logs.groupby(level=[0, 1, 2], sort=False).mean().groupby(["method", objects], sort=False).mean()
    means = each.groupby(level="method", sort=False).mean()
    return pd.Series(np.exp(means.to_numpy()), index=means.index).sort_values(kind="stable")


def t_interval(values: np.ndarray) -> tuple[float, float]:
    """The 95 % t-interval of a mean; NaN below `LEAST_OBJECTS` values."""
    from scipy.stats import t

    if len(values) < LEAST_OBJECTS:
        return math.nan, math.nan
    reach = t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return float(values.mean() - reach), float(values.mean() + reach)


def verdict(low: float, high: float) -> str:
    """Place of an interval with respect to 1."""
    if math.isnan(low):
        return TOO_FEW
    return BELOW if high < 1 else ABOVE if low > 1 else NOT_RESOLVED


def judged_aims(scores: pd.DataFrame, aims: Iterable[Aim], objects: Objects = "scenario") -> pd.DataFrame:
    """A row per aim: its ratio as in `ratios`, what was aimed at, and whether it is reached, missed or not run."""
    rows = []
    for aim in aims:
        part = scores["method"].isin([aim.method, aim.baseline]) & (scores["task"] == aim.task) & (scores["metric"] == aim.metric)
        found = ratios(scores[part], aim.baseline, objects).to_dict("records")
        identity = {"method": aim.method, "baseline": aim.baseline, "task": aim.task, "metric": aim.metric}
        row: dict[Any, Any] = found[0] if found else identity | {"n": 0, "objects": objects, "pairs": 0, "verdict": NOT_RUN}
        reached = bool(found) and row["ratio"] <= aim.ratio and row["ratio_high"] < aim.below
        verdict_on_aim = (REACHED if reached else MISSED) if found else NOT_RUN
        rows.append(row | {"aim": aim.ratio, "below": aim.below, "aim_verdict": verdict_on_aim})
    return pd.DataFrame(rows, columns=[*RATIO_COLUMNS, "aim", "below", "aim_verdict"])


def changes(scores: pd.DataFrame, baseline: str, objects: Objects = "scenario") -> pd.DataFrame:
    """A row per method, task and metric: `change` against the baseline with `change_low`, `change_high`, `n`, `verdict`.

    Errors have their ratio (`ratios`); all others have the difference (`paired_differences`), without a verdict.
    """
    errors = ratios(scores, baseline, objects)
    others = paired_differences(scores[~scores["metric"].map(lambda name: METRICS[name].is_error).astype(bool)], baseline)
    names = ["change", "change_low", "change_high", "n"]
    tables = [
        errors.rename(columns=dict(zip(("ratio", "ratio_low", "ratio_high"), names, strict=False))),
        others.rename(columns=dict(zip(("difference", "low", "high", "scenarios"), names, strict=True))).assign(verdict=""),
    ]
    return stacked(tables).reindex(columns=["method", "task", "metric", *names, "verdict"])
