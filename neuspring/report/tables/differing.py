"""Which settings differ between the rows of a table, from the settings that their runs recorded."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from neuspring.core.run_record import RunRecord, flat
from neuspring.core.text import markdown

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


def differing_markdown(rows: list[Differing], level: str = "##") -> str:
    """The footnote as a section; empty if nothing differs."""
    if not rows:
        return ""
    table = markdown(["Setting", "Value: rows"], [[row.setting, row.text.replace("|", "\\|")] for row in rows])
    return "\n".join([f"{level} Settings that differ\n", f"{ABOUT}\n", *table]) + "\n"
