"""Queries on the long table: averages, duels of methods, failures."""

from __future__ import annotations

import numpy as np
import pandas as pd

from neuspring.scores import statistics
from neuspring.scores.metrics import TASKS, averages, present
from neuspring.scores.table import HELD_TASK, ScoreTable, comparable, stacked

JUDGES = tuple((task, name) for task in ("future", "reconstruction") for name in ("track_error", "chamfer", "image_error"))
"""Pairs of task and metric that rank methods, in order of preference: `duels` uses the first pair that the runs have."""
CELL_KEYS = ["method", "task", "metric"]


def means(table: ScoreTable) -> pd.DataFrame:
    """`metrics.averages` of every method on the comparable pairs (`table.comparable`); oracles are averaged on the same pairs."""
    scores = comparable(table.comparison.finished)
    if len(oracles := table.of(table.oracles).finished):
        counted = scores[["scenario", "seed"]].drop_duplicates()
        scores = stacked([scores, oracles.merge(counted) if len(scores) else oracles])
    return averages(scores) if len(scores) else pd.DataFrame(columns=[*CELL_KEYS, "equal", "frames", "seed_std", "mean"])


def duels(table: ScoreTable, baseline: str, objects: statistics.Objects = "scenario") -> pd.DataFrame:
    """Compare every method with its rival by the first error of `JUDGES` that the runs have; best first, empty without one.

    The rival is `baseline` if it has scores, else the best method. The row of the rival itself has no rival and no ratio.

    - method, rival, task, metric
    - error, rival_error: means over the scenarios that all methods finished, stored unit
    - ratio, ratio_low, ratio_high, n, verdict: as in `statistics.ratios`
    - better, of: in `better` of `of` scenarios the error is below the rival's, seeds averaged
    - worst, worst_error: the scenario with the largest error
    """
    finished = table.comparison.finished
    usable = comparable(finished)
    there = present(usable)
    key = next((key for key in JUDGES if key in there), None)
    if key is None:
        return pd.DataFrame()
    task, metric = key
    usable, finished = (rows[(rows["task"] == task) & (rows["metric"] == metric)] for rows in (usable, finished))
    order = list(statistics.typical(usable, objects).index)
    rival = baseline if baseline in order else order[0]
    ratios = statistics.ratios(finished, rival, objects).set_index("method")
    each = finished.groupby(["method", "scenario"], sort=False)["value"].mean().unstack("method")
    errors = averages(usable).set_index("method")["equal"]
    rows = []
    for method in order:
        both, worst = each[[method, rival]].dropna(), each[method].idxmax()
        row = {"method": method, "rival": "", "task": task, "metric": metric, "error": errors[method], "n": 0, "verdict": ""}
        row |= dict.fromkeys(("rival_error", "ratio", "ratio_low", "ratio_high"), np.nan)
        if method != rival:
            row |= {"rival": rival, "rival_error": errors[rival], "verdict": statistics.TOO_FEW}
            row |= {"better": int((both[method] < both[rival]).sum()), "of": len(both)}
        if method in ratios.index:
            row |= {name: ratios.loc[method, name] for name in ("ratio", "ratio_low", "ratio_high", "n", "verdict")}
        rows.append(row | {"worst": worst, "worst_error": each.loc[worst, method]})
    return pd.DataFrame(rows)


def with_failures(table: ScoreTable) -> pd.DataFrame:
    """Average the methods that have failed runs: column `own` over their successful runs, `all` over all runs that ended.

    A failed run keeps its last finite frame until the end. `all` is NaN if a run lacks a score although other runs of its scenario
    have the metric.
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
    result = averages(everything).set_index(CELL_KEYS)["mean"].rename("all").to_frame()
    own = finished[finished["method"].isin(failed["method"])]
    result["own"] = averages(own).set_index(CELL_KEYS)["mean"] if len(own) else np.nan
    counts, scored = (
        everything.groupby(CELL_KEYS).size(),
        stacked([finished, held]).groupby(["task", "metric"])["scenario"].unique(),
    )
    for method, task, metric in result.index:
        expected = runs[(runs["method"] == method) & runs["scenario"].isin(scored[task, metric])]
        if counts[method, task, metric] < len(expected):
            result.loc[(method, task, metric), "all"] = np.nan
    return result.reset_index()
