"""Failures in the averages: how many runs of each method succeeded, the averages without and with the failed ones, and which
pairs of scenario and seed failures and scenarios that a method leaves out take from all methods.

A failed run is averaged as if its prediction stayed at its last finite frame, which `stages.score` scores over all frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from neuspring.scores.layout import HEADINGS, IMAGE_HEADINGS, SHOWN, markdown
from neuspring.scores.metrics import averages

LeftOut = Mapping[str, Collection[str]]
"""Method -> scenarios to which it does not apply."""
NOTHING: LeftOut = MappingProxyType({})
REASON = "it needs images"
"""Why a method does not apply to a scenario."""
RUN = ["scenario", "method", "seed"]
CELL = ["method", "task", "metric"]
MEANS = ("own", "own_frames", "own_scenarios", "all", "all_frames", "all_scenarios")
COLUMNS = ("method", "succeeded", "attempted", "unknown", *CELL[1:], *MEANS)
WHY = (
    "The published numbers of Spring-Gaus cover successful cases only, and an average that leaves failures out can flatter a "
    "method. So here is the mean over its own successful runs, which are other runs for every method, and that over all runs "
    "that ended, where a failed prediction stays at its last finite frame."
)
DASHES = "A dash in a mean over all runs: a failed run has no such score."


def both_averages(scores: pd.DataFrame, runs: pd.DataFrame, held: pd.DataFrame) -> pd.DataFrame:
    """A row per method, task and metric: means over its successful runs and over all of its runs; no row if none has failed.

    `held` are the scores of failed runs whose prediction stays at its last finite frame. `own` and `all` weigh scenarios equally,
    `own_frames` and `all_frames` by their frames, in the units of `scores`. `attempted` are successes and failures, `unknown` the
    failures without held scores. A mean over all runs is NaN where one of the method's failures has no score to put into it.
    """
    ended = runs[runs["status"].isin(["ok", "failed"])]
    failed = ended.loc[ended["status"] == "failed", RUN]
    if not len(failed):
        return pd.DataFrame(columns=list(COLUMNS))
    own = _of(scores, ended.loc[ended["status"] == "ok", RUN])
    lost = _of(held, failed)
    everything = pd.concat([part for part in (own, lost) if len(part)]) if len(own) or len(lost) else own
    means = [_means(part, name) for part, name in ((own, "own"), (everything, "all")) if len(part)]
    table = means[0] if means else pd.DataFrame(columns=CELL)
    for other in means[1:]:
        table = table.merge(other, on=CELL, how="outer")
    table = table.reindex(columns=[*CELL, *MEANS])
    unknown = _unknown(failed, lost)
    lacking = _lacking(failed, lost, pd.concat([part for part in (scores, lost) if len(part)]) if len(everything) else scores)
    without = table["method"].isin(unknown[unknown > 0].index) | pd.MultiIndex.from_frame(table[CELL]).isin(lacking)
    table.loc[without, ["all", "all_frames", "all_scenarios"]] = np.nan
    counts = ended.groupby("method")["status"].agg(succeeded=lambda status: int((status == "ok").sum()), attempted="size")
    counts["unknown"] = unknown.reindex(counts.index).fillna(0).astype(int)
    table = counts.reset_index().merge(table, on="method", how="left")[list(COLUMNS)]
    return _in_order(table, list(dict.fromkeys(runs["method"])))


def _of(scores: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """The scores of these runs."""
    if not len(scores):
        return scores
    return scores[pd.MultiIndex.from_frame(scores[RUN]).isin(pd.MultiIndex.from_frame(runs[RUN]))]


def _means(scores: pd.DataFrame, name: str) -> pd.DataFrame:
    names = {"equal": name, "frames": f"{name}_frames", "scenarios": f"{name}_scenarios"}
    return averages(scores).rename(columns=names)[[*CELL, *names.values()]]


def _unknown(failed: pd.DataFrame, lost: pd.DataFrame) -> pd.Series:
    """Method -> its failed runs without any held score."""
    known = pd.MultiIndex.from_frame(failed).isin(pd.MultiIndex.from_frame(lost[RUN]) if len(lost) else [])
    return failed[~known].groupby("method").size()


def _lacking(failed: pd.DataFrame, lost: pd.DataFrame, scores: pd.DataFrame) -> pd.MultiIndex:
    """Method, task and metric of which a failed run has no held score, although other runs of its scenario have one."""
    expected = scores[["scenario", "task", "metric"]].drop_duplicates().astype(object)
    wanted = failed.astype(object).merge(expected, on="scenario")
    keys = [*RUN, "task", "metric"]
    there = pd.MultiIndex.from_frame(wanted[keys]).isin(pd.MultiIndex.from_frame(lost[keys].astype(object)) if len(lost) else [])
    return pd.MultiIndex.from_frame(wanted.loc[~there, CELL].drop_duplicates())


def _in_order(table: pd.DataFrame, methods: list[str]) -> pd.DataFrame:
    ranks = {"method": methods, "metric": list(SHOWN)}
    places = pd.DataFrame({name: table[name].map({key: rank for rank, key in enumerate(keys)}) for name, keys in ranks.items()})
    places["task"] = table["task"].map({"reconstruction": 0, "future": 1})
    return table.loc[places.sort_values(["method", "task", "metric"]).index].reset_index(drop=True)


def held_text(table: pd.DataFrame) -> str:
    """The section of the summary on `both_averages`; nothing if no run has failed."""
    if not len(table):
        return ""
    known = set(zip(table["task"], table["metric"], strict=True))
    headings = HEADINGS | {key: text for key, text in IMAGE_HEADINGS.items() if key in known}
    rows = []
    for method, part in table.groupby("method", sort=False):
        first = part.iloc[0]
        count = f"{first['succeeded']}/{first['attempted']}"
        own = [_cell(part, key, "own") for key in headings]
        if first["succeeded"] == first["attempted"]:
            rows.append([str(method), count, "all", *own])
        else:
            rows.append([str(method), count, "its successes", *own])
            rows.append(["", "", "all, failures held", *(_cell(part, key, "all") for key in headings)])
    lines = ["", "## Failures", "", f"{WHY} Errors in mm; in brackets the frame-weighted mean. {DASHES}", ""]
    lines += markdown(["Method", "Succeeded", "Mean over", *headings.values()], rows)
    lines += [line for text in unknown_lines(table) for line in ("", text)]
    return "\n".join(lines) + "\n"


def _cell(part: pd.DataFrame, key: tuple[str, str], name: str) -> str:
    found = part[(part["task"] == key[0]) & (part["metric"] == key[1])]
    if not len(found) or not np.isfinite(found.iloc[0][name]):
        return "–"
    factor, digits = SHOWN[key[1]]
    row = found.iloc[0]
    return f"{factor * row[name]:.{digits}f} ({factor * row[f'{name}_frames']:.{digits}f})"


def unknown_lines(table: pd.DataFrame, labels: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """A sentence for every method that has failures of which nothing is known; `labels` are names for methods."""
    counts = table.drop_duplicates("method")
    if labels:
        counts = counts.sort_values("method", key=lambda names: names.map(list(labels).index))
    rows: list[Any] = list(counts[counts["unknown"] > 0].itertuples())
    return [
        f"{labels.get(row.method, row.method)}: {row.unknown} of {row.attempted - row.succeeded} failed runs have no scores of a "
        "held prediction (older or damaged records), so there is no mean over all its runs."
        for row in rows
    ]


def removed_lines(runs: pd.DataFrame, left_out: LeftOut = NOTHING, labels: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Why averages do not take every pair of scenario and seed: whose failures removed how many, and who does not apply where.

    Empty if neither removed any. A method that finished no run takes no part, here as in the averages.
    """
    finished = list(dict.fromkeys(runs.loc[runs["status"] == "ok", "method"]))
    begun = [name for name in dict.fromkeys([*labels, *finished]) if name in finished]
    if not begun:
        return []
    status = runs[runs["method"].isin(begun)].set_index(["scenario", "seed", "method"])["status"].unstack()
    failed, lacking = status == "failed", (status != "ok").sum(axis=1)
    causes = []
    for method in begun:
        count, alone = int(failed[method].sum()), int((failed[method] & (lacking == 1)).sum())
        if count:
            causes.append(f"{labels.get(method, method)} {count}" + (f" ({alone} by its failures alone)" if len(begun) > 1 else ""))
    lines = (
        [f"Pairs of scenario and seed that failed runs take from the averages of all methods: {', '.join(causes)}."]
        if causes
        else []
    )
    for method in begun:
        without = sorted(set(left_out.get(method, ())) & set(runs["scenario"]))
        if without and len(begun) > 1:
            count = runs["scenario"].nunique() - len(without)
            rest = f"over the other {count}" if count else "empty"
            lines.append(
                f"{labels.get(method, method)} does not apply to {', '.join(without)}, so that averages of all methods are {rest}."
            )
    return lines


def kept_line(scores: pd.DataFrame, runs: pd.DataFrame) -> str:
    """How many pairs of scenario and seed averages take, of `scores` that can be compared."""
    kept, pairs = (len(table[["scenario", "seed"]].drop_duplicates()) for table in (scores, runs))
    if not kept:
        return "No pair of scenario and seed was finished by every method, so there is no average of all methods."
    return f"Averages take {kept} of {pairs} pairs of scenario and seed, those that every method finished."


def left_out_lines(left_out: LeftOut, labels: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """A sentence for every method that does not apply to some scenarios."""
    return [f"Left out: {labels.get(name, name)} on {', '.join(where)}: {REASON}." for name, where in left_out.items() if where]


def applying(left_out: LeftOut, scenarios: Collection[str], methods: Collection[str]) -> dict[str, tuple[str, ...]]:
    """What of `left_out` concerns these scenarios and methods, in their order."""
    found = {name: tuple(where for where in scenarios if where in left_out.get(name, ())) for name in methods}
    return {name: where for name, where in found.items() if where}
