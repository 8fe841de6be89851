"""Queries on the long table: averages, duels of methods, failures."""

from __future__ import annotations

import numpy as np
import pandas as pd

from neuspring.scores import statistics
from neuspring.scores.metrics import TASKS, averages, present
from neuspring.scores.table import HELD_TASK, ScoreTable, comparable, stacked

JUDGES = tuple((task, name) for task in ("future", "reconstruction") for name in ("track_error", "chamfer", "image_error"))
"""Task and metric that decide who is ahead: the first pair that the runs have."""
CELL_KEYS = ["method", "task", "metric"]


def means(table: ScoreTable) -> pd.DataFrame:
    """`metrics.averages` of every method on the pairs that count; oracles on the same pairs."""
    scores = comparable(table.comparison.finished)
    if len(oracles := table.of(table.oracles).finished):
        counted = scores[["scenario", "seed"]].drop_duplicates()
        scores = stacked([scores, oracles.merge(counted) if len(scores) else oracles])
    return averages(scores) if len(scores) else pd.DataFrame(columns=[*CELL_KEYS, "equal", "frames", "seed_std", "mean"])


def duels(table: ScoreTable, baseline: str, objects: statistics.Objects = "scenario") -> pd.DataFrame:
    """Every method against its rival by the error that decides, the best first; empty where nothing can be compared.

    The rival is `baseline` where it has scores, else the best method; its own row has no ratio. Columns: method, rival, task,
    metric, error (mean over scenarios, stored unit), ratio, ratio_low, ratio_high, n, verdict (`statistics.ratios`); the error is
    smaller in `better` of `of` scenarios, seeds averaged; `worst` scenario and `worst_error`.
    """
    finished = table.comparison.finished
    usable = comparable(finished)
    there = present(usable)
    key = next((key for key in JUDGES if key in there), None)
    if key is None:
        return pd.DataFrame()
    usable, finished = (rows[(rows["task"] == key[0]) & (rows["metric"] == key[1])] for rows in (usable, finished))
    order = list(statistics.typical(usable, objects).index)
    rival = baseline if baseline in order else order[0]
    ratios = statistics.ratios(finished, rival, objects).set_index("method")
    each = finished.groupby(["method", "scenario"], sort=False)["value"].mean().unstack("method")
    errors = averages(usable).set_index("method")["equal"]
    rows = []
    for method in order:
        both, worst = each[[method, rival]].dropna(), each[method].idxmax()
        row = {"method": method, "rival": "" if method == rival else rival, "task": key[0], "metric": key[1]}
        row |= {"error": errors[method], "ratio": np.nan, "ratio_low": np.nan, "ratio_high": np.nan, "n": 0, "verdict": ""}
        if method != rival:
            row["verdict"] = statistics.TOO_FEW
            row |= {"better": int((both[method] < both[rival]).sum()), "of": len(both)}
        if method in ratios.index:
            row |= {name: ratios.loc[method, name] for name in ("ratio", "ratio_low", "ratio_high", "n", "verdict")}
        rows.append(row | {"worst": worst, "worst_error": each.loc[worst, method]})
    return pd.DataFrame(rows)


def with_failures(table: ScoreTable) -> pd.DataFrame:
    """Means of methods with failed runs: `own` over their successes, `all` over all runs that ended.

    A failed run counts with its last finite frame held until the end. `all` is NaN where such a score is missing although other
    runs of the scenario have the metric.
    """
    runs = table.runs[table.runs["status"].isin(["ok", "failed"])]
    failed = runs[runs["status"] == "failed"]
    finished = table.finished[table.finished["task"].isin(TASKS)]
    held = table.task(*(task + HELD_TASK for task in TASKS))
    held = held[held["run"].isin(failed["run"])].assign(task=held["task"].str.removesuffix(HELD_TASK))
    everything = stacked([finished, held])
    everything = everything[everything["method"].isin(failed["method"])]
    if not len(everything):
        return pd.DataFrame(columns=[*CELL_KEYS, "own", "all"])
    found = averages(everything).set_index(CELL_KEYS)["mean"].rename("all").to_frame()
    own = finished[finished["method"].isin(failed["method"])]
    found["own"] = averages(own).set_index(CELL_KEYS)["mean"] if len(own) else np.nan
    counts, scored = (
        everything.groupby(CELL_KEYS).size(),
        stacked([finished, held]).groupby(["task", "metric"])["scenario"].unique(),
    )
    for method, task, metric in found.index:
        wanted = runs[(runs["method"] == method) & runs["scenario"].isin(scored[task, metric])]
        if counts[method, task, metric] < len(wanted):
            found.loc[(method, task, metric), "all"] = np.nan
    return found.reset_index()
