"""Runs as tables: the scores and records of a benchmark, read from a results folder or from a scores.csv.

Only files are read (run.json and scores.parquet beside it), never MLflow.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.core.text import listed
from neuspring.scores.failures import EMPTY_MAP, LeftOut, applying
from neuspring.scores.metrics import SCORE_COLUMNS

RUN_COLUMNS = ("scenario", "method", "seed", "status", "reason", "notes", "images", "source", "run_key", "oracle", "floors")
DAMAGED = "damaged record: "
"""Begin of the reason of a run whose files cannot be read."""
Key = tuple[str, str, int]
"""Scenario, method, seed."""


def stacked(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """One table of scores. Empty tables carry no column types and are left out."""
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame(columns=list(SCORE_COLUMNS))


@dataclass(frozen=True)
class Collected:
    """Scores of all runs that have them, and one row per run with its status (ok, failed or missing)."""

    scores: pd.DataFrame
    runs: pd.DataFrame
    frozen: pd.DataFrame = field(default_factory=lambda: stacked([]))
    """Scores of failed runs whose prediction stays at its last finite frame. Runs of older records have none."""
    left_out: LeftOut = field(default_factory=dict)
    """Method to the scenarios to which it does not apply, so that it has no runs there."""
    records: Mapping[Key, RunRecord] = field(default_factory=dict)
    """The records that could be read."""

    @property
    def parts(self) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
        """Scores, runs, and scores with the last frame frozen, as `failures.both_averages` takes them."""
        return self.scores, self.runs, self.frozen

    @property
    def oracles(self) -> tuple[str, ...]:
        """Methods that have seen all frames, as far as their records tell."""
        if "oracle" not in self.runs:
            return ()
        return tuple(dict.fromkeys(self.runs.loc[self.runs["oracle"].astype(bool), "method"]))

    @property
    def comparison(self) -> Collected:
        """The runs without oracles: what averages, ratios and marks of the best are about."""
        oracles = self.oracles
        return self.of([method for method in dict.fromkeys(self.runs["method"]) if method not in oracles]) if oracles else self

    def of(self, methods: Collection[str]) -> Collected:
        """The runs of these methods."""
        runs, scores, frozen = (table[table["method"].isin(list(methods))] for table in (self.runs, self.scores, self.frozen))
        left_out = {name: where for name, where in self.left_out.items() if name in methods}
        return Collected(scores, runs, frozen, left_out, {key: record for key, record in self.records.items() if key[1] in methods})

    def named(self, **wanted: Collection[str | int]) -> Collected:
        """The runs of these `scenario`s, `method`s and `seed`s, all where none is named. A name without runs is an InputError."""
        runs, scores = self.runs, self.scores
        for column, names in wanted.items():
            known = dict.fromkeys(self.runs[column])
            if absent := [name for name in names if name not in known]:
                raise InputError(f"--{column}s", "must be in the file of --scores", listed(absent), f"There: {listed(known, 40)}.")
            if names:
                runs, scores = (table[table[column].isin(list(names))] for table in (runs, scores))
        return replace(self, scores=scores, runs=runs)


def collect(
    results: Path, scenarios: Iterable[str], methods: Iterable[str], seeds: Iterable[int], left_out: LeftOut = EMPTY_MAP
) -> Collected:
    """Read the records of every (scenario, method, seed).

    A run without a record is missing, one with a damaged record failed. Where `left_out` says that a method does not apply to a
    scenario, there is no run.
    """
    scenarios, methods = tuple(scenarios), tuple(methods)
    absent = applying(left_out, scenarios, methods)
    scores, frozen, rows, records = [], [], [], {}
    for identity, path in _paths(results, scenarios, methods, seeds, RUN_RECORD):
        if identity["scenario"] in absent.get(identity["method"], ()):
            continue
        if not path.is_file():
            rows.append(identity | {"status": "missing", "reason": "no run.json: the run has not finished"})
            continue
        try:
            record = RunRecord.load(path)
            files = (record.scores_file, None if record.ok else record.held_file)
            tables = [pd.read_parquet(path.parent / name)[list(SCORE_COLUMNS)] if name else stacked([]) for name in files]
        except (OSError, ValueError, KeyError) as error:
            rows.append(identity | {"status": "failed", "reason": f"{DAMAGED}{one_line(error)}"})
            continue
        records[tuple(identity.values())] = record
        scores.append(tables[0])
        frozen.append(tables[1])
        rows.append(identity | _facts(record))
    columns = dict.fromkeys([*RUN_COLUMNS, *(name for row in rows for name in row)])
    runs = pd.DataFrame(rows, columns=list(columns))
    runs = _filled(runs.fillna(dict.fromkeys(("notes", "source", "run_key"), "")))
    return Collected(stacked(scores), runs, stacked(frozen), absent, records)


def as_asked(collected: Collected, asked: Mapping[str, Any]) -> tuple[Collected, str]:
    """The runs without those that are missing because the last run of the workflow asked for others, and its `only=...`.

    That is empty where none is left out. `asked` is what `core.job_records.asked` tells of it.
    """
    runs = collected.runs
    if not asked.get("only"):
        return collected, ""
    inside = [runs[name].isin(asked.get(f"{name}s", [])) for name in ("scenario", "method", "seed")]
    kept = (runs["status"] != "missing") | np.logical_and.reduce(inside)
    return replace(collected, runs=runs[kept]), "" if kept.all() else f"only={asked['only']}"


def _filled(runs: pd.DataFrame) -> pd.DataFrame:
    """`oracle` of every run; one without a record is as the others of its method."""
    known = runs["oracle"].astype(str).eq("True")
    return runs.assign(oracle=runs["method"].isin(runs.loc[known, "method"]))


def _paths(
    results: Path, scenarios: Iterable[str], methods: Iterable[str], seeds: Iterable[int], name: str
) -> Iterator[tuple[dict[str, Any], Path]]:
    """(scenario, method and seed; path of its record `name`) for every combination."""
    for scenario, method, seed in product(scenarios, methods, seeds):
        yield {"scenario": scenario, "method": method, "seed": seed}, Path(results) / scenario / method / str(seed) / name


def one_line(error: Exception) -> str:
    """The error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _facts(record: RunRecord) -> dict[str, Any]:
    """Facts that tables need of a record."""
    facts = {name: getattr(record, name) for name in ("status", "reason", "source", "run_key")}
    facts["notes"] = "; ".join(record.notes)
    facts |= {"oracle": record.oracle, "floors": json.dumps(record.floors)}
    facts |= {f"seconds_{name}": value for name, value in record.timings.items()}
    facts |= {f"memory_mb_{name}": value for name, value in record.peak_memory_mb.items()}
    facts |= {"images": json.dumps(record.images)}
    facts["settings"] = json.dumps({name: _digest(values) for name, values in record.settings.items()})
    return facts


def _digest(settings: Mapping[str, Any]) -> str:
    """SHA-256 of a stage's settings without its seed, shortened."""
    values = {name: value for name, value in settings.items() if name != "seed"}
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def read_scores(path: Path) -> Collected:
    """The runs of a scores.csv of a folder of tables; the runs.csv beside it says how they ended. Raises InputError.

    Without runs.csv a run counts as finished if it has a Chamfer distance of every task that any run has. A diverged run has fewer.
    """
    try:
        scores = pd.read_csv(path)
        scores = scores[list(SCORE_COLUMNS)].astype({"value": float, "seed": int})
    except (OSError, ValueError, KeyError) as error:
        rule = f"must be a scores.csv with the columns {', '.join(SCORE_COLUMNS)}"
        raise InputError(path, rule, one_line(error), "Take the file from a folder of tables.") from error
    runs = scores[["scenario", "method", "seed"]].drop_duplicates(ignore_index=True)
    beside = path.with_name("runs.csv")
    if beside.is_file():
        table = pd.read_csv(beside).reindex(columns=list(RUN_COLUMNS))
        texts = dict.fromkeys(("reason", "notes", "source", "run_key"), "") | {"floors": "{}"}
        return Collected(scores, _filled(table.fillna(texts)))
    errors = scores[scores["metric"] == "chamfer"]
    tasks = runs.merge(errors.groupby(["scenario", "method", "seed"])["task"].nunique().reset_index(), how="left")["task"]
    finished = tasks == errors["task"].nunique()
    runs["status"] = np.where(finished, "ok", "failed")
    runs["reason"] = np.where(finished, "", "its scores are not complete")
    nothing: dict[str, Any] = {"notes": "", "images": "null", "run_key": "", "oracle": False, "floors": "{}"}
    return Collected(scores, runs.assign(source=path.name, **nothing))


def read_transfers(
    results: Path, sources: Iterable[str], methods: Iterable[str], seeds: Iterable[int]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Scores of transferred twins on each target, with the column `source`; and a row per source, method and seed with a record."""
    tables, rows = [], []
    for identity, path in _paths(results, sources, methods, seeds, "transfer.json"):
        if not path.is_file():
            continue
        try:
            record = StageRecord.load(path)
            table = pd.read_parquet(record.file("scores", path))
        except (OSError, ValueError, KeyError) as error:
            rows.append(identity | {"status": "failed", "reason": f"{DAMAGED}{one_line(error)}", "notes": ""})
            continue
        diverged = record.facts.get("diverged", [])
        reason = record.reason or ", ".join(f"diverged on {name}" for name in diverged)
        status = "ok" if record.status == "ok" and not diverged else "failed"
        rows.append(identity | {"status": status, "reason": reason, "notes": ""})
        tables.append(table.assign(source=identity["scenario"]))
    return stacked(tables), pd.DataFrame(rows, columns=["scenario", "method", "seed", "status", "reason", "notes"])


def collect_transfers(results: Path, sources: Iterable[str], methods: Iterable[str], seeds: Iterable[int]) -> Collected:
    """Transferred twins as runs: `scenario` is the source, and its score the mean over its targets."""
    table, runs = read_transfers(results, sources, methods, seeds)
    if not len(table):
        return Collected(table, runs)
    keys = ["source", "category", "method", "seed", "task", "metric", "unit"]
    mean = table.groupby(keys, sort=False).agg(value=("value", "mean"), frames=("frames", "sum")).reset_index()
    return Collected(mean.rename(columns={"source": "scenario"})[list(SCORE_COLUMNS)], runs)


def pairs(table: pd.DataFrame) -> int:
    """Number of pairs of scenario and seed in a table."""
    return len(table[["scenario", "seed"]].drop_duplicates())


def finished_scores(collected: Collected) -> pd.DataFrame:
    """Scores of the runs that have a result."""
    return collected.scores.merge(collected.runs.loc[collected.runs["status"] == "ok", ["scenario", "method", "seed"]])


def comparable(collected: Collected) -> pd.DataFrame:
    """Scores of the pairs of scenario and seed that every method finished, so that averages compare like with like.

    A method that finished no run takes no part. `failures.removed_lines` says why pairs are missing.
    """
    if not len(collected.scores):
        return collected.scores
    good = collected.runs[collected.runs["status"] == "ok"]
    methods = good["method"].nunique()
    complete = good.groupby(["scenario", "seed"])["method"].nunique()
    common = complete[complete == methods].index
    keep = pd.MultiIndex.from_frame(collected.scores[["scenario", "seed"]]).isin(common)
    return collected.scores[keep & collected.scores["method"].isin(good["method"])]


def mixed_settings(runs: pd.DataFrame) -> str:
    """A warning if finished runs of one method were made with different settings; empty if not."""
    if "settings" not in runs:
        return ""
    mixed: dict[str, list[str]] = {}
    for method, part in runs[runs["status"] == "ok"].groupby("method", sort=False):
        stages = pd.DataFrame([json.loads(text) for text in part["settings"].dropna() if text])
        for stage in (name for name in stages if stages[name].nunique() > 1):
            mixed.setdefault(str(stage), []).append(str(method))
    where = "; ".join(f"{stage} of {', '.join(methods)}" for stage, methods in mixed.items())
    return f"Runs were made with different settings ({where}): make the older ones again before they are compared." if mixed else ""
