"""What to be careful with in tables of recordings that users filmed: notes from the scores and records of their runs.

No truth stands behind such a table, and a chain that went wrong still gives numbers. So: is a method better than the object frozen
in frame 0 (`static`)? Do parameters lie at the ends of what was searched? Did training improve anything? Does a hand hold the
object at all?
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from neuspring.baselines import REFERENCES
from neuspring.core.run_record import RunRecord
from neuspring.data.sources import SOURCES
from neuspring.scores.metrics import METRICS
from neuspring.scores.runs import Collected, finished_scores

STATIC = "static"
JUDGED = ("chamfer", "track_error")
HELD = 0.01
"""Share of springs at the bound of their stiffness that is worth a note."""


def honest_notes(collected: Collected) -> list[str]:
    """Notes on the scenarios that users filmed, in the order of scenarios and methods; none for others."""
    own = {key: record for key, record in collected.records.items() if record.source in SOURCES and SOURCES[record.source].own}
    scores, notes = finished_scores(collected) if own else pd.DataFrame(), list[str]()
    for scenario in dict.fromkeys(scenario for scenario, _, _ in own):
        records = {key: record for key, record in own.items() if key[0] == scenario}
        notes += _against_static(scenario, scores[scores["scenario"] == scenario])
        for method in dict.fromkeys(method for _, method, _ in records):
            runs = [record for key, record in records.items() if key[1] == method]
            notes += [f"{scenario} / {method}: {text}" for text in _of_runs(runs)]
    return notes


def _against_static(scenario: str, scores: pd.DataFrame) -> list[str]:
    """Methods whose mean future error is not below that of `static`."""
    future = scores[(scores["task"] == "future") & scores["metric"].isin(JUDGED)]
    means = future.groupby(["method", "metric"], sort=False)["value"].mean()
    if STATIC not in means.index.get_level_values("method"):
        return [f"{scenario}: static has no scores, so nothing says whether a method learned anything"] if len(future) else []
    notes = []
    for method in dict.fromkeys(future["method"]):
        if method in REFERENCES:
            continue
        pairs = [(METRICS[name], means.get((method, name)), means.get((STATIC, name))) for name in JUDGED]
        worse = [
            f"{metric.heading} {metric.text(own)} against {metric.text(frozen)} mm"
            for metric, own, frozen in pairs
            if own is not None and frozen is not None and own >= frozen
        ]
        if worse:
            notes.append(f"{scenario} / {method}: on future frames no better than static ({', '.join(worse)})")
    return notes


def _of_runs(runs: Iterable[RunRecord]) -> list[str]:
    """What the records of one method's seeds say of search, training and grip."""
    facts = [record.params for record in runs]
    ends = {name.strip() for values in facts for name in str(values.get("search.result.at_ends", "")).split(",") if name.strip()}
    bound = [values for values in facts if values.get("fit.result.at_bound", 0.0) > HELD]
    first = [values for values in facts if values.get("fit.result.best_epoch", 1) <= 0]
    texts = []
    if ends:
        texts.append(f"the search ended at an end of its range in {', '.join(sorted(ends))} (search.variables)")
    if bound:
        most = max(values["fit.result.at_bound"] for values in bound)
        texts.append(f"up to {most:.0%} of the springs lie at the bound of their stiffness (fit.output_bound)")
    if first:
        texts.append(f"training improved nothing: the best epoch is the first{_seeds(len(first), len(facts))}")
    return texts + _grip(facts)


def _grip(facts: list[dict[str, Any]]) -> list[str]:
    """How many springs hold the hands; the fit's, else the search's."""
    counts = [held for values in facts if (held := _held(values)) is not None]
    if not counts:
        return []
    number = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    if not max(counts):
        return ["no spring joins a hand to the object, so nothing moves it"]
    return [f"{number} springs join the hands to the object"]


def _held(values: Mapping[str, Any]) -> int | None:
    for stage in ("fit", "search"):
        springs, inner = values.get(f"{stage}.result.springs"), values.get(f"{stage}.result.object_springs")
        if springs is not None and inner is not None:
            return int(springs - inner)
    return None


def _seeds(count: int, of: int) -> str:
    return f" with {count} of {of} seeds" if of > 1 else ""
