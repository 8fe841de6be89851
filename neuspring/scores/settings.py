"""Settings that differ between the methods of a table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from neuspring.core.run_record import RunRecord, flat
from neuspring.scores.metrics import DASH

NOT_SETTINGS = ("seed", "device", "description", "batch")
"""Recorded beside the settings, without being one of the method."""
PREDICTING_STAGES = ("search", "fit", "train", "rollout")
"""Stages whose settings make a prediction. Pictures are drawn the same way for all."""


def differing(records: Iterable[RunRecord], labels: Mapping[str, str]) -> pd.DataFrame:
    """Settings that differ between methods: setting, its dotted name with the stage in front; rows, `value: rows; value: rows`.

    `labels` maps each method to its name in the table, in order. A setting that differs between scenarios is compared as the set of
    its values. Of a method without a stage, that alone is said.
    """
    found: dict[str, dict[str, set[str]]] = {"stages": {}}
    stages: dict[str, set[str]] = {}
    for record in records:
        if record.method not in labels:
            continue
        stages.setdefault(record.method, set()).update(name for name in record.settings if name in PREDICTING_STAGES)
        for name, value in settings_of(record).items():
            text = value if isinstance(value, str) else json.dumps(value)
            found.setdefault(name, {}).setdefault(record.method, set()).add(text)
    methods = [method for method in labels if method in stages]
    found["stages"] = {method: {" + ".join(name for name in PREDICTING_STAGES if name in stages[method])} for method in methods}
    rows: dict[str, str] = {}
    for name, by_method in found.items():
        stage = name.partition(".")[0]
        values: dict[str, list[str]] = {}
        for method in methods:
            if stage in ("stages", "method") or stage in stages[method]:
                values.setdefault(" or ".join(sorted(by_method.get(method, {DASH}))), []).append(labels[method])
        if len(values) > 1:
            rows[name] = "; ".join(f"{value}: {', '.join(names)}" for value, names in values.items())
    return pd.DataFrame(rows.items(), columns=["setting", "rows"])


def settings_of(record: RunRecord) -> dict[str, Any]:
    """Every setting that makes a run's prediction, by its dotted name; a section of the name of its stage is not named twice."""
    named: dict[str, Any] = {}
    for stage, settings in record.settings.items():
        if stage in PREDICTING_STAGES:
            values = {name.removeprefix(f"{stage}."): value for name, value in flat(settings).items()}
            named |= {f"{stage}.{name}": value for name, value in values.items() if name.split(".")[-1] not in NOT_SETTINGS}
    return named | {f"method.{name}": record.variant[name] for name in ("search",) if name in record.variant}
