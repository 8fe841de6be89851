"""Failures in the averages: how many runs of each method succeeded, averages without and with failed runs, and which pairs of
scenario and seed are missing from the averages of all methods, and why.

A failed run is averaged as if its last finite frame were frozen until the end; `stages.score` scores that prediction.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from neuspring.scores.metrics import METRICS, TASKS, averages, in_order

LeftOut = Mapping[str, Mapping[str, str]]
"""Method to the scenarios to which it does not apply, each with the reason."""
Labels = Mapping[str, str]
"""Method to its name in a table."""
EMPTY_MAP: Mapping[str, Any] = MappingProxyType({})
RUN_KEYS = ["scenario", "method", "seed"]
CELL_KEYS = ["method", "task", "metric"]
MEAN_NAMES = ("own", "own_other", "all", "all_other")
FAILURE_COLUMNS = ("method", "succeeded", "attempted", "unknown", *CELL_KEYS[1:], *MEAN_NAMES)
OWN, ALL = "its successes", "all, failures held"
"""Runs that the two means are over."""
FAILURE_NOTE = (
    "The published numbers of Spring-Gaus cover successful cases only, and an average that leaves failures out can flatter a "
    "method. So here is the mean over its own successful runs, which are other runs for every method, and that over all runs "
    "that ended, where a failed prediction stays at its last finite frame."
)
DASH_NOTE = "A dash in a mean over all runs: a failed run has no such score."


def both_averages(scores: pd.DataFrame, runs: pd.DataFrame, frozen: pd.DataFrame) -> pd.DataFrame:
    """A row per method, task and metric: means over its successful runs and over all of its runs; no row if none has failed.

    `frozen` are the scores of failed runs with the last finite frame frozen. `own` and `all` are in the average that the paper
    takes of the metric, `own_other` and `all_other` in the other one, in the units of `scores`. `attempted` counts successes and
    failures, `unknown` the failures without such scores. A mean over all runs is NaN where a score of a failed run is missing.
    """
    ended = runs[runs["status"].isin(["ok", "failed"])]
    failed = ended.loc[ended["status"] == "failed", RUN_KEYS]
    if not len(failed):
        return pd.DataFrame(columns=list(FAILURE_COLUMNS))
    own = _scores_of(scores, ended.loc[ended["status"] == "ok", RUN_KEYS])
    lost = _scores_of(frozen, failed)
    everything = pd.concat([part for part in (own, lost) if len(part)]) if len(own) or len(lost) else own
    means = [_means(part, name) for part, name in ((own, "own"), (everything, "all")) if len(part)]
    table = means[0] if means else pd.DataFrame(columns=CELL_KEYS)
    for other in means[1:]:
        table = table.merge(other, on=CELL_KEYS, how="outer")
    table = table.reindex(columns=[*CELL_KEYS, *MEAN_NAMES])
    scored = pd.MultiIndex.from_frame(failed).isin(pd.MultiIndex.from_frame(lost[RUN_KEYS]) if len(lost) else [])
    # Failed runs without any score, of each method.
    unknown = failed[~scored].groupby("method").size()
    lacking = _lacking(failed, lost, pd.concat([part for part in (scores, lost) if len(part)]) if len(everything) else scores)
    without = table["method"].isin(unknown[unknown > 0].index) | pd.MultiIndex.from_frame(table[CELL_KEYS]).isin(lacking)
    table.loc[without, ["all", "all_other"]] = np.nan
    counts = ended.groupby("method")["status"].agg(succeeded=lambda status: int((status == "ok").sum()), attempted="size")
    counts["unknown"] = unknown.reindex(counts.index).fillna(0).astype(int)
    table = counts.reset_index().merge(table, on="method", how="left")[list(FAILURE_COLUMNS)]
    return in_order(table, {"method": dict.fromkeys(runs["method"]), "task": TASKS, "metric": METRICS})


def _scores_of(scores: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    if not len(scores):
        return scores
    return scores[pd.MultiIndex.from_frame(scores[RUN_KEYS]).isin(pd.MultiIndex.from_frame(runs[RUN_KEYS]))]


def _means(scores: pd.DataFrame, name: str) -> pd.DataFrame:
    names = {"mean": name, "other": f"{name}_other"}
    return averages(scores)[[*CELL_KEYS, *names]].rename(columns=names)


def _lacking(failed: pd.DataFrame, lost: pd.DataFrame, scores: pd.DataFrame) -> pd.MultiIndex:
    """Method, task and metric of which a failed run has no score, although other runs of its scenario have one."""
    expected = scores[["scenario", "task", "metric"]].drop_duplicates().astype(object)
    wanted = failed.astype(object).merge(expected, on="scenario")
    keys = [*RUN_KEYS, "task", "metric"]
    there = pd.MultiIndex.from_frame(wanted[keys]).isin(pd.MultiIndex.from_frame(lost[keys].astype(object)) if len(lost) else [])
    return pd.MultiIndex.from_frame(wanted.loc[~there, CELL_KEYS].drop_duplicates())


def unknown_lines(table: pd.DataFrame, labels: Labels = EMPTY_MAP) -> list[str]:
    """A sentence for every method with failed runs that have no scores."""
    counts = table.drop_duplicates("method")
    if labels:
        counts = counts.sort_values("method", key=lambda names: names.map(list(labels).index))
    rows: list[Any] = list(counts[counts["unknown"] > 0].itertuples())
    return [
        f"{labels.get(row.method, row.method)}: {row.unknown} of {row.attempted - row.succeeded} failed runs have no scores of a "
        "held prediction (older or damaged records), so there is no mean over all its runs."
        for row in rows
    ]


def removed_lines(runs: pd.DataFrame, left_out: LeftOut = EMPTY_MAP, labels: Labels = EMPTY_MAP) -> list[str]:
    """Why averages do not take every pair of scenario and seed: failed runs, and methods that do not apply to a scenario.

    Empty if neither removes any. A method that finished no run takes no part, here as in the averages.
    """
    finished = list(dict.fromkeys(runs.loc[runs["status"] == "ok", "method"]))
    methods = [name for name in dict.fromkeys([*labels, *finished]) if name in finished]
    if not methods:
        return []
    status = runs[runs["method"].isin(methods)].set_index(["scenario", "seed", "method"])["status"].unstack()
    failed, lacking = status == "failed", (status != "ok").sum(axis=1)
    causes = []
    for method in methods:
        count, alone = int(failed[method].sum()), int((failed[method] & (lacking == 1)).sum())
        if count:
            own = f" ({alone} by its failures alone)" if len(methods) > 1 else ""
            causes.append(f"{labels.get(method, method)} {count}{own}")
    text = "Pairs of scenario and seed that failed runs take from the averages of all methods"
    lines = [f"{text}: {', '.join(causes)}."] if causes else []
    for method in methods:
        without = sorted(set(left_out.get(method, ())) & set(runs["scenario"]))
        if without and len(methods) > 1:
            count = runs["scenario"].nunique() - len(without)
            rest = f"over the other {count}" if count else "empty"
            rest = f"so that averages of all methods are {rest}."
            lines.append(f"{labels.get(method, method)} does not apply to {', '.join(without)}, {rest}")
    return lines


def left_out_lines(left_out: LeftOut, labels: Labels = EMPTY_MAP) -> list[str]:
    """A sentence for every method and reason for which it does not apply to some scenarios."""
    lines = []
    for name, where in left_out.items():
        for why in dict.fromkeys(where.values()):
            places = ", ".join(place for place, reason in where.items() if reason == why)
            lines.append(f"Left out: {labels.get(name, name)} on {places}: {why}.")
    return lines


def applying(left_out: LeftOut, scenarios: Collection[str], methods: Collection[str]) -> dict[str, dict[str, str]]:
    """The part of `left_out` that concerns these scenarios and methods, in their order."""
    absent = {name: {where: why for where in scenarios if (why := left_out.get(name, {}).get(where))} for name in methods}
    return {name: where for name, where in absent.items() if where}
