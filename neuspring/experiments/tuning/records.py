"""Records of trials and of a whole study, in the form of run records: `neuspring sync` sends them to MLflow as they are.

A trial's record is made from the study's storage alone, so one that a killed worker did not write is made later.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring.config.tuning import Tune
from neuspring.core.files import write_table, write_text
from neuspring.core.records import RECORD_FORMAT, canonical, read_json
from neuspring.experiments.tuning.space import Plan
from neuspring.experiments.tuning.store import Slot

RECORD = "run.json"
FACTS, VALUES = "facts", "values"
"""Attributes of a trial: how it went, and its values, of the baseline those too that the space cannot hold."""
SOURCE = "tune"


def label(value: Any) -> Any:
    """A setting's value as one plain value: JSON text for lists and mappings."""
    return value if value is None or isinstance(value, bool | int | float | str) else canonical(value)


def labels(values: Mapping[str, Any]) -> dict[str, Any]:
    """Setting -> value as one plain value."""
    return {name: label(value) for name, value in values.items()}


def write_trial(plan: Plan, definition: Mapping[str, Any], slot: Slot, folder: Path) -> Path:
    """Write trials/<slot>/run.json and what it names, unless it is there; returns its path."""
    trial, tune = slot.trials[-1], plan.tune
    facts, values = trial.user_attrs.get(FACTS, {}), trial.user_attrs.get(VALUES, {})
    losses = facts.get("losses", {})
    rows = {"loss": trial.value} if slot.state == "complete" else {}
    rows |= {f"loss/{name}": value for name, value in losses.items()}
    steps = sorted(trial.intermediate_values.items())
    content = {
        "scenario": f"trial-{slot.number}",
        "variant": {"study": tune.study, "method": tune.method, "state": slot.state, **labels(values)},
        "status": "failed" if slot.state == "failed" else "ok",
        "reason": slot.reason,
        "params": labels(plan.flat(values)),
        **_common(tune, definition),
    }
    place = folder / "trials" / str(slot.number)
    ended = trial.datetime_complete or trial.datetime_start
    record = content | {
        "attempt": len(slot.trials),
        "commit": facts.get("commit", ""),
        "device": facts.get("device", ""),
        "started": facts.get("started", _utc(trial.datetime_start)),
        "ended": facts.get("ended", _utc(ended)),
        "timings": facts.get("seconds", {}),
        "histories": {"steps": "history.parquet"},
        "artifacts": {},
    }
    history = pd.DataFrame([(step, "tail_loss", value) for step, value in steps], columns=["step", "metric", "value"])
    return _write(place, record, [content, rows, steps], rows, {"history.parquet": history})


def write_study(
    tune: Tune, definition: Mapping[str, Any], slots: Sequence[Slot], rows: Mapping[str, float], files: Sequence[Path], folder: Path
) -> Path:
    """Write the run.json of a study: `rows` are its figures, `files` its tables and pictures, which lie in `folder`."""
    facts = [slot.trials[-1].user_attrs.get(FACTS, {}) for slot in slots]
    known = [fact for fact in facts if fact] or [{"started": _utc(None), "ended": _utc(None), "seconds": {}}]
    states = [slot.state for slot in slots]
    content = {
        "scenario": "study",
        "variant": {"study": tune.study, "method": tune.method, "pruner": tune.pruner},
        "status": "ok" if "complete" in states else "failed",
        "reason": "" if "complete" in states else "no trial has finished",
        "params": {"trials": tune.trials, "workers": tune.workers, "startup_trials": tune.startup_trials},
        **_common(tune, definition),
    }
    record = content | {
        "attempt": 1,
        "commit": known[-1].get("commit", ""),
        "device": known[-1].get("device", ""),
        "started": min(fact["started"] for fact in known),
        "ended": max(fact["ended"] for fact in known),
        "timings": {name: sum(fact["seconds"].get(name, 0.0) for fact in known) for name in ("search", "fit")},
        "histories": {},
        "artifacts": {
            "tables": [path.name for path in files if path.suffix != ".png"],
            "plots": [path.name for path in files if path.suffix == ".png"],
        },
    }
    decided = [[slot.number, slot.state, slot.trials[-1].value] for slot in slots]
    return _write(folder, record, [content, rows, decided], rows, {})


def _common(tune: Tune, definition: Mapping[str, Any]) -> dict[str, Any]:
    digest = hashlib.sha256(canonical(definition.get("frames", {})).encode()).hexdigest()
    return {"source": SOURCE, "category": SOURCE, "method": f"tune-{tune.study}", "seed": tune.seed, "data_digest": digest}


def _write(
    folder: Path, record: Mapping[str, Any], content: Any, rows: Mapping[str, Any], tables: Mapping[str, pd.DataFrame]
) -> Path:
    path = folder / RECORD
    # The content without timings: the same results have the same key.
    key = hashlib.sha256(canonical(content).encode()).hexdigest()
    if path.is_file() and read_json(path, RECORD_FORMAT)["run_key"] == key:
        return path
    scores = pd.DataFrame([("tail", name, value) for name, value in rows.items()], columns=["task", "metric", "value"])
    for name, table in {"scores.parquet": scores, **tables}.items():
        write_table(table.astype({"value": "float64"}), folder / name)
    whole = {"format": RECORD_FORMAT, "run_key": key, "scores_file": "scores.parquet", **record}
    write_text(path, json.dumps(whole, indent=1, sort_keys=True, allow_nan=False) + "\n")
    return path


def _utc(moment: datetime | None) -> str:
    """A time of Optuna's, which has none of the zone, in UTC, ISO 8601; now if there is none."""
    return (moment or datetime.now()).astimezone(UTC).isoformat(timespec="seconds")
