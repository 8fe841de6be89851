"""Run records of trials and of a whole sweep; `neuspring sync` sends them to MLflow like those of any run.

A trial's record is made from the sweep's storage alone, so one that a killed worker did not write is made later.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring.config.tuning import Tune
from neuspring.core.files import write_table
from neuspring.core.records import canonical
from neuspring.core.run_record import RUN_RECORD, RunRecord, key_of
from neuspring.experiments.tuning.space import Plan
from neuspring.experiments.tuning.store import Slot

FACTS, VALUES = "facts", "values"
"""Attributes of a trial: how it went, and its values. The baseline's include those that the space cannot hold."""
SOURCE = "tune"
KEYED = ("scenario", "source", "category", "method", "variant", "seed", "status", "reason", "data_digest", "params")
"""Fields that the key of a record is made of, beside its scores and results."""
UNKNOWN = "0" * 8
"""Stands for a key until the record is complete."""


def label(value: Any) -> Any:
    """A setting's value as one plain value: JSON text for lists and mappings."""
    return value if value is None or isinstance(value, bool | int | float | str) else canonical(value)


def labels(values: Mapping[str, Any]) -> dict[str, Any]:
    """Setting -> value as one plain value."""
    return {name: label(value) for name, value in values.items()}


def write_trial(plan: Plan, definition: Mapping[str, Any], slot: Slot, folder: Path) -> None:
    """Write trials/<slot>/run.json and the files that it names, unless they are there."""
    trial, tune = slot.trials[-1], plan.tune
    facts, values = trial.user_attrs.get(FACTS, {}), trial.user_attrs.get(VALUES, {})
    scores = {"loss": trial.value} if slot.state == "complete" else {}
    scores |= {f"loss/{name}": value for name, value in facts.get("losses", {}).items()}
    steps = sorted(trial.intermediate_values.items())
    history = pd.DataFrame([(step, "tail_loss", value) for step, value in steps], columns=["step", "metric", "value"])
    record = RunRecord(
        run_key=UNKNOWN,
        scenario=f"trial-{slot.number}",
        variant={"study": tune.study, "method": tune.method, "state": slot.state, **labels(values)},
        status="failed" if slot.state == "failed" else "ok",
        reason=slot.reason,
        params=labels(plan.flat(values)),
        attempt=len(slot.trials),
        commit=facts.get("commit", ""),
        device=facts.get("device", ""),
        started=facts.get("started", _utc(trial.datetime_start)),
        ended=facts.get("ended", _utc(trial.datetime_complete or trial.datetime_start)),
        timings=facts.get("seconds", {}),
        histories={"steps": "history.parquet"},
        **_common(tune, definition),
    )
    _write(record, scores, steps, folder / "trials" / str(slot.number), {"history.parquet": history})


def write_sweep(
    tune: Tune,
    definition: Mapping[str, Any],
    slots: Sequence[Slot],
    scores: Mapping[str, float],
    files: Sequence[Path],
    folder: Path,
) -> None:
    """Write the run.json of a sweep. `files`, its tables and pictures, lie in `folder`."""
    facts = [slot.trials[-1].user_attrs[FACTS] for slot in slots if slot.trials[-1].user_attrs.get(FACTS)]
    facts = facts or [{"started": _utc(None), "ended": _utc(None), "seconds": {}}]
    complete = any(slot.state == "complete" for slot in slots)
    record = RunRecord(
        run_key=UNKNOWN,
        scenario="study",
        variant={"study": tune.study, "method": tune.method, "pruner": tune.pruner},
        status="ok" if complete else "failed",
        reason="" if complete else "no trial has finished",
        params={"trials": tune.trials, "workers": tune.workers, "startup_trials": tune.startup_trials},
        attempt=1,
        commit=facts[-1].get("commit", ""),
        device=facts[-1].get("device", ""),
        started=min(fact["started"] for fact in facts),
        ended=max(fact["ended"] for fact in facts),
        timings={name: sum(fact["seconds"].get(name, 0.0) for fact in facts) for name in ("search", "fit")},
        artifacts={
            "tables": [path.name for path in files if path.suffix != ".png"],
            "plots": [path.name for path in files if path.suffix == ".png"],
        },
        **_common(tune, definition),
    )
    states = [[slot.number, slot.state, slot.trials[-1].value] for slot in slots]
    _write(record, scores, states, folder, {})


def _common(tune: Tune, definition: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "source": SOURCE,
        "category": SOURCE,
        "method": f"tune-{tune.study}",
        "seed": tune.seed,
        "data_digest": hashlib.sha256(canonical(definition.get("frames", {})).encode()).hexdigest(),
        "scores_file": "scores.parquet",
    }


def _write(record: RunRecord, scores: Mapping[str, Any], results: Any, folder: Path, tables: Mapping[str, pd.DataFrame]) -> None:
    """Write a record under its key, with its scores and tables, unless a record of that key is there."""
    path = folder / RUN_RECORD
    # Without timings: the same results have the same key.
    key = key_of({name: getattr(record, name) for name in KEYED}, scores, results)
    if path.is_file() and RunRecord.load(path).run_key == key:
        return
    table = pd.DataFrame([("tail", name, value) for name, value in scores.items()], columns=["task", "metric", "value"])
    for name, values in {"scores.parquet": table, **tables}.items():
        write_table(values.astype({"value": "float64"}), folder / name)
    replace(record, run_key=key).save(path)


def _utc(time: datetime | None) -> str:
    """A time of Optuna's, which is local and names no zone, in UTC, ISO 8601; now if there is none."""
    return (time or datetime.now()).astimezone(UTC).isoformat(timespec="seconds")
