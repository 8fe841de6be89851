"""What to be careful with in tables: notes on recordings that users filmed, and settings that differ between rows.

No truth stands behind a table of own recordings, and a chain that went wrong still gives numbers. So: is a method better than the
object frozen in frame 0 (`static`)? Do parameters lie at the ends of what was searched? Did training improve anything? Does a hand
hold the object at all?
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from neuspring.baselines import REFERENCES
from neuspring.core.run_record import RunRecord, flat
from neuspring.core.table import Cell, Table
from neuspring.data.sources import SOURCES
from neuspring.scores.metrics import AT_BOUND, METRICS
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
            notes += [f"{scenario} / {method}: {text}" for text in _learning(runs)]
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


def _learning(runs: Iterable[RunRecord]) -> list[str]:
    """What the records of one method's seeds say of search, training and grip."""
    facts = [record.params for record in runs]
    ends = {name.strip() for values in facts for name in str(values.get("search.result.at_ends", "")).split(",") if name.strip()}
    bound = [values for values in facts if values.get("fit.result.at_bound", 0.0) > AT_BOUND]
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
    counts = [held for values in facts if (held := _gripping(values)) is not None]
    if not counts:
        return []
    number = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    if not max(counts):
        return ["no spring joins a hand to the object, so nothing moves it"]
    return [f"{number} springs join the hands to the object"]


def _gripping(values: Mapping[str, Any]) -> int | None:
    for stage in ("fit", "search"):
        springs, inner = values.get(f"{stage}.result.springs"), values.get(f"{stage}.result.object_springs")
        if springs is not None and inner is not None:
            return int(springs - inner)
    return None


def _seeds(count: int, of: int) -> str:
    return f" with {count} of {of} seeds" if of > 1 else ""


NOT_SETTINGS = ("seed", "device", "description", "batch")
"""Recorded beside the settings, without being one of the method."""
STAGES = ("search", "fit", "train", "rollout")
"""Stages whose settings make a prediction. Pictures are drawn the same way for all."""
ABSENT = "–"
ABOUT = "Settings that differ between the rows, as the runs recorded them. A stage that a row does not have is not listed for it."


@dataclass(frozen=True, kw_only=True)
class Differing:
    """A setting that not all rows have alike."""

    setting: str
    """Under its dotted name, with the stage in front."""
    values: Mapping[str, tuple[str, ...]]
    """Value to the labels of the rows that have it."""

    @property
    def text(self) -> str:
        """`value: rows; value: rows`."""
        return "; ".join(f"{value}: {', '.join(labels)}" for value, labels in self.values.items())


def differing(records: Iterable[RunRecord], labels: Mapping[str, str]) -> list[Differing]:
    """Settings that differ between methods; `labels` maps each to its name in the table, in order.

    A setting that differs between scenarios is compared as the set of its values. Of a method without a stage, that alone is said.
    """
    found: dict[str, dict[str, set[str]]] = {}
    stages: dict[str, set[str]] = {}
    for record in records:
        if record.method not in labels:
            continue
        stages.setdefault(record.method, set()).update(name for name in record.settings if name in STAGES)
        for name, value in _settings(record).items():
            found.setdefault(name, {}).setdefault(record.method, set()).add(_text(value))
    methods = [method for method in labels if method in stages]
    rows = [_row("stages", {m: {" + ".join(name for name in STAGES if name in stages[m])} for m in methods}, methods, labels)]
    for name, by_method in found.items():
        stage = name.partition(".")[0]
        have = [method for method in methods if stage == "method" or stage in stages[method]]
        rows.append(_row(name, {method: by_method.get(method, {ABSENT}) for method in have}, have, labels))
    return [row for row in rows if len(row.values) > 1]


def _row(name: str, by_method: Mapping[str, set[str]], methods: Iterable[str], labels: Mapping[str, str]) -> Differing:
    values: dict[str, tuple[str, ...]] = {}
    for method in methods:
        text = " or ".join(sorted(by_method[method]))
        values[text] = (*values.get(text, ()), labels[method])
    return Differing(setting=name, values=values)


def _settings(record: RunRecord) -> dict[str, Any]:
    """Every setting under its dotted name. A section of the name of its stage is not named twice."""
    named: dict[str, Any] = {}
    for stage, settings in record.settings.items():
        if stage in STAGES:
            values = {name.removeprefix(f"{stage}."): value for name, value in flat(settings).items()}
            named |= {f"{stage}.{name}": value for name, value in values.items() if name.split(".")[-1] not in NOT_SETTINGS}
    switches = {name: record.variant[name] for name in ("search",) if name in record.variant}
    return named | {f"method.{name}": value for name, value in switches.items()}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def differing_table(records: Iterable[RunRecord], labels: Mapping[str, str]) -> list[Table]:
    """The settings that differ between methods as a table; none where none does."""
    rows = [[Cell(text=row.setting), Cell(text=row.text, wrap=True)] for row in differing(records, labels)]
    return [Table(caption="Settings that differ", header=["Setting", "Value: rows"], rows=rows, note=ABOUT)] if rows else []
