"""Searches of several budgets, and the comparison of two searches."""

from dataclasses import replace

import pandas as pd

from tests.support import small

LOGARITHMIC = {
    "scales": {"stiffness": "log", "dashpot": "log", "drag": "log"},
    "ranges": {"stiffness": [1e2, 1e5], "dashpot": [0.1, 200.0], "drag": [0.05, 20.0]},
}
"""Variables on logarithmic scales."""


def budget(rollouts, clusters=1):
    """The small search with another budget."""
    problem = small.search_problem(clusters=clusters)
    return replace(problem, search=replace(problem.search, rollouts=rollouts))


def assert_same_trace(trace, expected):
    """Equal bit for bit, but for the time that each candidate took."""
    pd.testing.assert_frame_equal(trace.drop(columns="seconds"), expected.drop(columns="seconds"), check_exact=True)
