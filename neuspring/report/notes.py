"""Notes of caution below tables: on on recordings that users filmed, and settings that differ between rows.

No truth stands behind a table of own recordings, and a chain that went wrong still gives numbers. So: is a method better than the
object frozen in frame 0 (`static`)? Do parameters lie at the ends of what was searched? Did training improve anything? Does a hand
hold the object at all?
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from neuspring.baselines import REFERENCES
from neuspring.checks import examine
from neuspring.core.findings import Finding
from neuspring.core.run_record import RunRecord
from neuspring.scenes.sources import SOURCES
from neuspring.scores.metrics import METRICS
from neuspring.scores.runs import Collected, finished_scores

STATIC = "static"
JUDGED = ("chamfer", "track_error")


def honest_notes(collected: Collected) -> list[str]:
    """Notes on the scenarios that users filmed, in the order of scenarios and methods; none for others."""
    own = {key: record for key, record in collected.records.items() if record.source in SOURCES and SOURCES[record.source].own}
    scores, notes = finished_scores(collected) if own else pd.DataFrame(), list[str]()
    for scenario in dict.fromkeys(scenario for scenario, _, _ in own):
        records = {key: record for key, record in own.items() if key[0] == scenario}
        notes += _against_static(scenario, scores[scores["scenario"] == scenario])
        for method in dict.fromkeys(method for _, method, _ in records):
            runs = [record for key, record in records.items() if key[1] == method]
            notes += [f"{scenario} / {method}: {text}" for text, _ in [*causes(runs), *_grip(runs)]]
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


def causes(runs: Iterable[RunRecord]) -> list[tuple[str, str]]:
    """Evidence in the records of one method's seeds against search and training, each with the next move."""
    runs = list(runs)
    facts = [record.params for record in runs]
    ends = {name.strip() for values in facts for name in str(values.get("search.result.at_ends", "")).split(",") if name.strip()}
    first = [values for values in facts if values.get("fit.result.best_epoch", 1) <= 0]
    found = []
    if not max((held for values in facts if (held := _gripping(values)) is not None), default=1):
        found.append(("no spring joins a hand to the object, so nothing moves it", "Look at the hands in lifted.png."))
    limited = {one.name: one for _, one in sorted(of_fits(runs), key=lambda pair: pair[1].value)}
    found += [(one.text.removesuffix(one.remedy).rstrip(" ."), one.remedy) for one in limited.values()]
    if ends:
        names = ", ".join(sorted(ends))
        found.append((f"the search ended at an end of its range in {names}", f"Widen search.variables for {names}."))
    if first:
        of = f" with {len(first)} of {len(facts)} seeds" if len(facts) > 1 else ""
        found.append((f"training improved nothing: the best epoch is the first{of}", "Lower fit.learning_rate."))
    return found


def of_fits(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding of all fits: springs at a limit of their stiffness, with the command that widens it."""
    return [(run.scenario, one) for run in runs for one in examine("fit", f"{run.method}/{run.seed}", run)]


def _grip(runs: Iterable[RunRecord]) -> list[tuple[str, str]]:
    """Number of springs that hold the hands, if any do."""
    counts = [held for record in runs if (held := _gripping(record.params))]
    number = f"{min(counts)}" if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}" if counts else ""
    return [(f"{number} springs join the hands to the object", "")] if counts else []


def _gripping(values: Mapping[str, Any]) -> int | None:
    """Number of springs that hold the hands: the fit's, else the search's. None where clamps hold it."""
    for stage in ("fit", "search"):
        if f"{stage}.result.vertices" in values:
            return None
        springs, inner = values.get(f"{stage}.result.springs"), values.get(f"{stage}.result.object_springs")
        if springs is not None and inner is not None:
            return int(springs - inner)
    return None
