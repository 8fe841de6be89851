"""Findings of finished runs: springs at a limit, a search at the end of its range, a training that improved nothing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from neuspring.checks import examine
from neuspring.core.findings import Finding
from neuspring.core.run_record import RunRecord
<<<<<<< HEAD
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
=======
>>>>>>> 0d0e3e2f (One long table of scores: summary, studies, failures, costs and the report are queries on it, laid out by one function)


def of_fits(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding of all fits: springs at a limit of their stiffness, with the setting that widens it."""
    return [(run.scenario, one) for run in runs for one in examine("fit", f"{run.method}/{run.seed}", run)]


def of_runs(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding of searches and fits, those of `of_fits` included."""
    runs = list(runs)
    found = of_fits(runs)
    for run in runs:
        facts: dict[str, Any] = run.params
        ends = str(facts.get("search.result.at_ends") or "")
        springs, inner = (
            facts.get(f"fit.result.{name}", facts.get(f"search.result.{name}")) for name in ("springs", "object_springs")
        )
        of_rods = "fit.result.vertices" in facts or "search.result.vertices" in facts
        cases = [
            (bool(ends), "search at an end of its range", ends, f"Widen search.variables for {ends}."),
            (facts.get("fit.result.best_epoch", 1) <= 0, "training improved nothing", "best epoch 0", "Lower fit.learning_rate."),
            (
                springs is not None and springs == inner and not of_rods,
                "no spring joins a controller to the object",
                "nothing moves it",
                "Look at the controllers in lifted.png.",
            ),
        ]
        where = f"{run.method}/{run.seed}"
        found += [
            (run.scenario, Finding(name=name, level="warning", where=where, text=f"{text}. {remedy}", remedy=remedy))
            for is_so, name, text, remedy in cases
            if is_so
        ]
    return found
