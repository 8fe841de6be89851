"""The bootstrap: 95 % intervals of means over scenarios and seeds, and paired differences between methods.

Scenarios are resampled, and within each of them its seeds, because runs of one scenario are not independent.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

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

    `relative` is the mean difference over the baseline's mean on the same pairs. `ratio` is the geometric mean of method/baseline,
    in which scenarios of large errors weigh no more than others; it is NaN where an error is zero.
    """
    rows = []
    rng = np.random.default_rng(0)
    for (task, metric), part in scores.groupby(["task", "metric"], sort=False):
        wide = part.pivot_table(index=["scenario", "seed"], columns="method", values="value")
        if baseline not in wide:
            continue
        for method in wide.columns.drop(baseline):
            both = wide[[method, baseline]].dropna()
            if not len(both):
                continue
            difference, low, high = _mean_interval(both[method] - both[baseline], rng)
            base = both[baseline].groupby("scenario").mean()
            row = {"method": method, "baseline": baseline, "task": task, "metric": metric, "difference": difference}
            row |= {"low": low, "high": high, "relative": difference / base.mean(), "scenarios": len(base)}
            positive = bool((both > 0).all(axis=None))
            ratios = np.exp(_mean_interval((both[method] / both[baseline]).map(math.log), rng)) if positive else [np.nan] * 3
            rows.append(row | dict(zip(("ratio", "ratio_low", "ratio_high"), ratios, strict=True)))
    return pd.DataFrame(rows)


def _mean_interval(values: pd.Series, rng: np.random.Generator) -> tuple[float, float, float]:
    """Mean over scenarios of `values` by (scenario, seed), and its interval (NaN for one scenario)."""
    runs = [part.to_numpy() for _, part in values.groupby("scenario")]
    mean = float(np.mean([part.mean() for part in runs]))
    means = resampled_means([part[None] for part in runs], rng)[0] if len(runs) > 1 else np.empty(0)
    return mean, *interval(means)
