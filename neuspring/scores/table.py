"""The long table of a benchmark: one row per run, task and metric (or stage), with frames, value and unit.

All tables of the report, of studies and of README pages are queries on it. It is read from the records of a results folder, or from
scores.csv and runs.csv of `neuspring tables`. Tasks:

- reconstruction, future: scores of finished and failed runs; transfer: means over other recordings of the same object.
- reconstruction_held, future_held: scores of a failed run that keeps its last finite frame until the end.
- start: errors in frame 0, where the prediction is given.
- time [s], memory [MB], epochs, converged (0 or 1): cost; the metric is the stage.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RUN_RECORD, RunRecord, flat
from neuspring.core.text import listed
from neuspring.scores.metrics import METRICS, SCORE_COLUMNS, TASKS

HELD_TASK, TRANSFER = "_held", "transfer"
TABLE_COLUMNS = ("run", "method", "scenario", "category", "seed", "task", "metric", "frames", "value", "unit")
RUN_COLUMNS = (
    "run",
    "scenario",
    "method",
    "seed",
    "status",
    "reason",
    "notes",
    "images",
    "source",
    "run_key",
    "oracle",
    "settings",
)
RUN_KEYS = ["scenario", "method", "seed"]
DAMAGED = "damaged record: "
"""Start of the reason of a run with unreadable files."""
PREDICTING_STAGES = ("search", "fit", "train", "rollout")
"""Stages whose settings affect a prediction."""
NOT_SETTINGS = ("seed", "device", "description", "batch")
LeftOut = Mapping[str, Mapping[str, str]]
"""Method -> scenario to which it does not apply -> reason."""
EMPTY_MAP: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class ScoreTable:
    """The long table `rows` (`TABLE_COLUMNS`) and one row per run in `runs` (`RUN_COLUMNS`), with status ok, failed or missing."""

    rows: pd.DataFrame
    runs: pd.DataFrame
    left_out: LeftOut = field(default_factory=dict)
    records: Mapping[tuple[str, str, int], RunRecord] = field(default_factory=dict)
    """Records by (scenario, method, seed); empty for a table from scores.csv."""

    def of(self, methods: Collection[str]) -> ScoreTable:
        """The runs of these methods."""
        rows, runs = (table[table["method"].isin(list(methods))] for table in (self.rows, self.runs))
        left_out = {name: where for name, where in self.left_out.items() if name in methods}
        return ScoreTable(rows, runs, left_out, {key: record for key, record in self.records.items() if key[1] in methods})

    def named(self, **selected: Collection[str | int]) -> ScoreTable:
        """Select runs by `scenario`, `method` and `seed`; an empty list selects all. Raises InputError for an unknown name."""
        rows, runs = self.rows, self.runs
        for column, names in selected.items():
            known = dict.fromkeys(self.runs[column])
            if absent := [name for name in names if name not in known]:
                raise InputError(f"--{column}s", "must be in the file of --scores", listed(absent), f"Known: {listed(known, 40)}.")
            if names:
                rows, runs = (table[table[column].isin(list(names))] for table in (rows, runs))
        return replace(self, rows=rows, runs=runs)

    @property
    def methods(self) -> list[str]:
        """Methods in the order of the runs."""
        return list(dict.fromkeys(self.runs["method"]))

    @property
    def oracles(self) -> list[str]:
        """Methods that are fitted on all frames; comparisons exclude them."""
        return list(dict.fromkeys(self.runs.loc[self.runs["oracle"].astype(bool), "method"]))

    @property
    def comparison(self) -> ScoreTable:
        """The runs without oracles."""
        return self.of([method for method in self.methods if method not in self.oracles])

    def task(self, *tasks: str) -> pd.DataFrame:
        """Rows of these tasks."""
        return self.rows[self.rows["task"].isin(tasks)]

    @property
    def finished(self) -> pd.DataFrame:
        """Scores of finished runs, and of finished transfers."""
        ended = self.rows["run"].isin(self.runs.loc[self.runs["status"] == "ok", "run"])
        return self.rows[self.rows["task"].eq(TRANSFER) | (self.rows["task"].isin(TASKS) & ended)]

    def save(self, folder: Path) -> None:
        """Write scores.csv and runs.csv."""
        write_text(folder / "scores.csv", self.rows.to_csv(index=False))
        write_text(folder / "runs.csv", self.runs.to_csv(index=False))


def comparable(scores: pd.DataFrame) -> pd.DataFrame:
    """The scores on which averages of methods can be compared.

    Keeps the pairs of scenario and seed that every method finished, and per metric those that every method with this metric has.
    Methods without a finished run are ignored. Transfers are filtered separately.
    """
    parts = []
    for _, part in scores.groupby(scores["task"].eq(TRANSFER), sort=False):
        finished = part.groupby(["scenario", "seed"])["method"].transform("nunique")
        parts.append(part[finished == part["method"].nunique()])
    kept = stacked(parts)
    if not len(kept):
        return kept
    methods = kept.groupby(["task", "metric", "scenario", "seed"])["method"].transform("nunique")
    return kept[methods == kept.groupby(["task", "metric"])["method"].transform("nunique")]


def stacked(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Concatenate long tables; empty tables are skipped, because they have no column types."""
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame(columns=list(TABLE_COLUMNS))


def collect(
    results: Path,
    scenarios: Iterable[str],
    methods: Iterable[str],
    seeds: Iterable[int],
    left_out: LeftOut = EMPTY_MAP,
    transfers: Iterable[str] = (),
) -> ScoreTable:
    """Read the records of every scenario, method and seed, and the transfers of the scenarios `transfers`.

    The status is missing without a record, failed with a damaged record. Pairs of method and scenario in `left_out` have no run.
    """
    scenarios, methods, seeds = tuple(scenarios), tuple(methods), tuple(seeds)
    tables, rows, records = [], [], {}
    for scenario, method, seed in product(scenarios, methods, seeds):
        path = Path(results) / scenario / method / str(seed) / RUN_RECORD
        row: dict[str, Any] = {"run": f"{scenario}/{method}/{seed}", "scenario": scenario, "method": method, "seed": seed}
        if scenario in left_out.get(method, ()):
            continue
        rows.append(row)
        if not path.is_file():
            row |= {"status": "missing", "reason": "no run.json: the run has not finished"}
            continue
        try:
            record = RunRecord.load(path)
            tables.append(_rows_of(record, path.parent))
        except (OSError, ValueError, KeyError) as error:
            row |= {"status": "failed", "reason": f"{DAMAGED}{one_line(error)}"}
            continue
        records[scenario, method, seed] = record
        row |= {name: getattr(record, name) for name in ("status", "reason", "source", "run_key", "oracle")}
        row |= {"notes": "; ".join(record.notes), "images": json.dumps(record.images), "settings": settings_of(record)}
    transferred, ended = read_transfers(results, transfers, methods, seeds)
    if len(transferred):
        keys = ["source", "category", "method", "seed", "task", "metric", "unit"]
        kept = transferred.merge(ended.loc[ended["status"] == "ok", RUN_KEYS].rename(columns={"scenario": "source"}))
        mean = kept.groupby(keys, sort=False).agg(value=("value", "mean"), frames=("frames", "sum")).reset_index()
        tables.append(_with_run(mean.rename(columns={"source": "scenario"})))
    failed = ended[ended["status"] != "ok"].set_index(RUN_KEYS)["reason"].to_dict()
    for row in rows:
        if reason := failed.get((row["scenario"], row["method"], row["seed"])):
            row["notes"] = "; ".join(filter(None, [row.get("notes", ""), f"transfer: {reason}"]))
    varied = _varied([row.get("settings", {}) for row in rows])
    for row in rows:
        own = row.get("settings", {})
        row["settings"] = json.dumps({name: own[name] for name in varied if name in own})
    inapplicable = {name: {where: why for where, why in own.items() if where in scenarios} for name, own in left_out.items()}
    inapplicable = {name: where for name, where in inapplicable.items() if name in methods and where}
    return ScoreTable(stacked(tables), _filled(pd.DataFrame(rows, columns=list(RUN_COLUMNS))), inapplicable, records)


def _rows_of(record: RunRecord, folder: Path) -> pd.DataFrame:
    """The long table of one run."""
    tables = [pd.read_parquet(folder / record.scores_file)[list(SCORE_COLUMNS)]] if record.scores_file else []
    if not record.ok and record.held_file:
        held = pd.read_parquet(folder / record.held_file)[list(SCORE_COLUMNS)]
        tables.append(held.assign(task=held["task"] + HELD_TASK))
    facts = [("start", name, value, "m", 1) for name, value in record.floors.items()]
    facts += [("time", stage, value, "s", 0) for stage, value in record.timings.items()]
    facts += [("memory", stage, value, "MB", 0) for stage, value in record.peak_memory_mb.items()]
    ends = {name: record.params.get(f"fit.result.{name}") for name in ("epochs", "converged")}
    facts += [(name, "fit", float(value), "", 0) for name, value in ends.items() if value is not None]
    identity = {name: getattr(record, name) for name in ("scenario", "category", "method", "seed")}
    tables.append(pd.DataFrame(facts, columns=["task", "metric", "value", "unit", "frames"]).assign(**identity))
    return _with_run(stacked(tables))


def _named(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with a column `run`."""
    return rows.assign(run=rows["scenario"] + "/" + rows["method"] + "/" + rows["seed"].astype(str))


def _with_run(rows: pd.DataFrame) -> pd.DataFrame:
    return _named(rows)[list(TABLE_COLUMNS)]


def _filled(runs: pd.DataFrame) -> pd.DataFrame:
    """Fill missing values of `RUN_COLUMNS`; a run without a record is an oracle if another run of its method is."""
    oracles = runs.loc[runs["oracle"].astype(str).eq("True"), "method"]
    texts = dict.fromkeys(("reason", "notes", "source", "run_key"), "") | {"images": "null", "settings": "{}"}
    return runs.fillna(texts).assign(oracle=runs["method"].isin(oracles))


def settings_of(record: RunRecord) -> dict[str, Any]:
    """The settings of all stages under dotted names; a section with the name of its stage is not repeated in them."""
    named = {"stages": " + ".join(name for name in PREDICTING_STAGES if name in record.settings)}
    for stage, settings in record.settings.items():
        values = {name.removeprefix(f"{stage}."): value for name, value in flat(settings).items()}
        named |= {f"{stage}.{name}": value for name, value in values.items() if name.split(".")[-1] not in NOT_SETTINGS}
    return named | ({"method.search": record.variant["search"]} if "search" in record.variant else {})


def _varied(settings: Iterable[Mapping[str, Any]]) -> list[str]:
    """Sorted names of the settings that differ between runs."""
    values: dict[str, set[str]] = {}
    for own in settings:
        for name, value in own.items():
            values.setdefault(name, set()).add(json.dumps(value, sort_keys=True))
    return sorted(name for name, seen in values.items() if len(seen) > 1)


def recorded(runs: pd.DataFrame) -> dict[str, dict[str, list[str]]]:
    """Setting that affects predictions -> method -> the sorted values in its runs' records."""
    values_of: dict[str, dict[str, set[str]]] = {}
    for method, text in set(zip(runs["method"], runs["settings"], strict=True)):
        for name, value in json.loads(text).items():
            if name.split(".")[0] in (*PREDICTING_STAGES, "stages", "method"):
                shown = value if isinstance(value, str) else json.dumps(value)
                values_of.setdefault(name, {}).setdefault(method, set()).add(shown)
    return {name: {method: sorted(values) for method, values in own.items()} for name, own in sorted(values_of.items())}


def differing(runs: pd.DataFrame) -> dict[str, dict[str, str]]:
    """Settings that differ between methods: setting -> method -> its value, or several joined by "or"."""
    joined = {name: {method: " or ".join(values) for method, values in own.items()} for name, own in recorded(runs).items()}
    return {name: own for name, own in joined.items() if len(set(own.values())) > 1}


def mixed_settings(runs: pd.DataFrame) -> list[str]:
    """`stage of method` for every method whose finished runs have different settings."""
    by_setting = recorded(runs[runs["status"] == "ok"])
    mixed = [
        f"{name.split('.')[0]} of {method}" for name, own in by_setting.items() for method, values in own.items() if len(values) > 1
    ]
    return list(dict.fromkeys(mixed))


def as_asked(table: ScoreTable, asked: Mapping[str, Any]) -> ScoreTable:
    """Drop missing runs outside of the last workflow run's selection (`only=...`)."""
    if not asked.get("only"):
        return table
    inside = [table.runs[name].isin(asked.get(f"{name}s", [])) for name in RUN_KEYS]
    return replace(table, runs=table.runs[(table.runs["status"] != "missing") | np.logical_and.reduce(inside)])


def one_line(error: Exception) -> str:
    """The error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def read_scores(path: Path) -> ScoreTable:
    """Read scores.csv, and the status of runs from runs.csv in the same folder. Raises InputError.

    Without runs.csv, every run counts as finished.
    """
    try:
        rows = pd.read_csv(path)
        rows = _with_run(rows[list(SCORE_COLUMNS)].astype({"value": float, "seed": int}))
    except (OSError, ValueError, KeyError) as error:
        rule = f"must be a scores.csv with the columns {', '.join(SCORE_COLUMNS)}"
        remedy = "Rerun the command that wrote it (fits are reused), or name scores.csv of another folder of tables."
        raise InputError(path, rule, one_line(error), remedy) from error
    status = path.with_name("runs.csv")
    if status.is_file():
        runs = _named(pd.read_csv(status))
    else:
        runs = rows[["run", *RUN_KEYS]].drop_duplicates(ignore_index=True).assign(status="ok", source=path.name)
    return ScoreTable(rows, _filled(runs.reindex(columns=list(RUN_COLUMNS))))


def read_transfers(
    results: Path, sources: Iterable[str], methods: Iterable[str], seeds: Iterable[int]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Scores of transferred twins on each target (column `source`), and one row per source, method and seed with its status."""
    tables, rows = [], []
    for scenario, method, seed in product(sources, methods, seeds):
        path = Path(results) / scenario / method / str(seed) / "transfer.json"
        if not path.is_file():
            continue
        row = {"scenario": scenario, "method": method, "seed": seed, "notes": ""}
        try:
            record = StageRecord.load(path)
            table = pd.read_parquet(record.file("scores", path))
        except (OSError, ValueError, KeyError) as error:
            rows.append(row | {"status": "failed", "reason": f"{DAMAGED}{one_line(error)}"})
            continue
        diverged = record.facts.get("diverged", [])
        reason = record.reason or ", ".join(f"diverged on {name}" for name in diverged)
        rows.append(row | {"status": "ok" if record.status == "ok" and not diverged else "failed", "reason": reason})
        tables.append(table.assign(source=scenario))
    return stacked(tables), pd.DataFrame(rows, columns=["scenario", "method", "seed", "status", "reason", "notes"])


def pairs(table: pd.DataFrame) -> int:
    """The number of pairs of scenario and seed."""
    return len(table[["scenario", "seed"]].drop_duplicates())


def of_kind(rows: pd.DataFrame, *kinds: str) -> pd.DataFrame:
    """Rows of the metrics of these kinds (`metrics.Of`): positions, pictures, marks."""
    return rows[rows["metric"].isin([name for name, metric in METRICS.items() if metric.of in kinds])]
