"""The primary figure: ratios over objects, aims, the spread over seeds."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from scipy.stats import ttest_1samp

from neuspring.config import parse
from neuspring.config.settings import Aim
from neuspring.scores.metrics import SCORE_COLUMNS
from neuspring.scores.statistics import judged_aims, ratios, t_interval


def table(values: dict[tuple[str, str, int], float], category: str = "", task: str = "future") -> pd.DataFrame:
    """Track errors by (scenario, method, seed); the category is the scenario's first letter unless given."""
    rows = [(s, category or s[0], m, seed, task, "track_error", value, "m", 10) for (s, m, seed), value in values.items()]
    return pd.DataFrame(rows, columns=list(SCORE_COLUMNS))


def logs(changes: dict[str, list[float]]) -> dict[tuple[str, str, int], float]:
    """Errors of y over those of x by scenario, as logs by seed."""
    return {
        (s, m, seed): 0.01 * (math.exp(change) if m == "y" else 1.0)
        for s, each in changes.items()
        for seed, change in enumerate(each)
        for m in ("x", "y")
    }


def test_the_interval_is_that_of_a_t_test_of_the_means_over_seeds():
    changes = {"a": [-0.3, -0.1], "b": [0.1], "c": [-0.4, -0.4, -0.1], "d": [-0.2]}
    row = ratios(table(logs(changes)), "x").iloc[0]
    means = [-0.2, 0.1, -0.3, -0.2]
    expected = ttest_1samp(means, 0).confidence_interval()
    assert row["ratio"] == pytest.approx(math.exp(np.mean(means)))
    assert np.log([row["ratio_low"], row["ratio_high"]]) == pytest.approx([expected.low, expected.high])
    assert row[["n", "pairs", "verdict"]].tolist() == [4, 7, "not resolved"]


def test_recordings_of_one_cable_can_be_one_object():
    changes = {"a1": [0.0], "a2": [0.2], "a3": [0.4], "b1": [-0.1], "c1": [-0.1]}
    alone = ratios(table(logs(changes)), "x", "scenario").iloc[0]
    together = ratios(table(logs(changes)), "x", "category").iloc[0]
    assert (alone["n"], together["n"]) == (5, 3)
    assert math.log(alone["ratio"]) == pytest.approx(0.08)
    assert math.log(together["ratio"]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("center", "count", "verdict"),
    [(-0.3, 6, "below 1"), (0.3, 6, "above 1"), (0.0, 6, "not resolved"), (-0.3, 2, "too few objects")],
)
def test_verdicts(center, count, verdict):
    changes = {f"{name}": [center + 0.05 * (-1) ** index] for index, name in enumerate("abcdef"[:count])}
    row = ratios(table(logs(changes)), "x").iloc[0]
    assert row["verdict"] == verdict
    assert np.isnan(row["ratio_low"]) == (count < 3)


def test_only_the_two_methods_of_a_ratio_must_have_finished():
    values = logs({name: [-0.2] for name in "abcd"}) | {("a", "z", 0): 0.02}
    found = ratios(table(values), "x").set_index("method")
    assert found.loc["y", "n"] == 4
    assert found.loc["z", "n"] == 1


def test_an_error_of_zero_has_no_ratio():
    assert ratios(table(logs({name: [-0.2] for name in "abc"}) | {("c", "y", 0): 0.0}), "x").empty


def test_the_t_interval_holds_its_level_with_few_objects():
    rng = np.random.default_rng(0)
    hits = [low <= 0 <= high for low, high in (t_interval(rng.normal(size=7)) for _ in range(2000))]
    # 2000 trials at 95 %: a standard deviation of 0.5 %.
    assert np.mean(hits) == pytest.approx(0.95, abs=0.02)


def aim(**changes: object) -> Aim:
    return parse(Aim, {"method": "y", "baseline": "x", "ratio": 0.85} | changes, "here")


@pytest.mark.parametrize(
    ("center", "spread", "changes", "verdict"),
    [
        (-0.3, 0.05, {}, "reached"),
        (-0.1, 0.05, {}, "missed"),
        (-0.3, 0.5, {}, "missed"),
        (0.0, 0.02, {"ratio": 1.02, "below": 1.05}, "reached"),
        (0.0, 0.2, {"ratio": 1.02, "below": 1.05}, "missed"),
        (-0.3, 0.05, {"metric": "chamfer"}, "not run"),
    ],
)
def test_an_aim_needs_its_mean_and_its_interval(center, spread, changes, verdict):
    values = logs({name: [center + spread * (-1) ** index] for index, name in enumerate("abcdef")})
    assert judged_aims(table(values), [aim(**changes)]).iloc[0]["aim_verdict"] == verdict


def test_an_aim_of_transfers_is_judged_by_transfers():
    good = logs({name: [-0.3 - 0.01 * index] for index, name in enumerate("abcd")})
    bad = logs({name: [0.3 + 0.01 * index] for index, name in enumerate("abcd")})
    row = judged_aims(pd.concat([table(good), table(bad, task="transfer")]), [aim(task="transfer")]).iloc[0]
    assert row["aim_verdict"] == "missed" and row["ratio"] > 1
