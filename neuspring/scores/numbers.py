"""The numbers of a benchmark: averages, intervals, verdicts. Each is computed once, and all are kept in one file, numbers.json.

The tables, the studies, the report and `explain` are selections of them. The file has `tables` of the benchmark (""), of its twins
on other recordings (moved) and of its studies (their names), each with columns and rows; NaN is null.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from neuspring.config import Method, parse
from neuspring.config.parse import read_rows
from neuspring.config.settings import Aim
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.findings import Finding
from neuspring.core.records import read_json
from neuspring.scores import failures, statistics
from neuspring.scores.metrics import METRICS, averages, metrics_of
from neuspring.scores.paper import STUDY_KINDS, OwnStudy, Study
from neuspring.scores.runs import Collected, comparable, finished_scores, stacked
from neuspring.scores.settings import differing
from neuspring.scores.study import StudyNumbers, resolved

NUMBERS = "numbers.json"
NUMBERS_FORMAT = 1
SUMMARY = "summary"
"""Stands for a study where the benchmark's own table is meant."""
JUDGES = tuple((task, name) for task in ("future", "reconstruction") for name in ("track_error", "chamfer", "image_error"))
"""Task and metric that decide who is best: the first one that the runs have."""


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """The numbers of a benchmark; a table is computed when it is first asked for, the bootstrap takes seconds."""

    TABLES: ClassVar = ("averages", "held", "differences", "ratios", "seeds", "floors", "aimed", "lead", "settings")
    everything: Collected
    baseline: str
    objects: statistics.Objects = "scenario"
    """Objects that intervals of ratios are over."""
    aims: tuple[Aim, ...] = ()
    """Ratios that are aimed at."""
    transfers: Collected | None = None
    """Twins on other recordings of the same object, as runs."""
    studies: Mapping[str, Study] = field(default_factory=dict)
    """The studies that are shown."""
    known_studies: Mapping[str, Study] = field(default_factory=dict)
    """Those and the ones that may stand beside them."""
    results: Path | None = None
    """The folder of the runs, for videos, how the runs were asked for, and where to look; None where none holds them."""
    warnings: tuple[tuple[str, Finding], ...] = ()
    """Scenarios, and what steps of perception warned of."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Method to its name for people, of those that have one (`shown_names`)."""
    asked: str = ""
    """The part of the configuration that was asked for (`only=...`), where other runs are therefore not there."""

    @cached_property
    def collected(self) -> Collected:
        """The runs without oracles."""
        return self.everything.comparison

    def name(self, method: str) -> str:
        """A method as people read it."""
        return self.names.get(method, method)

    @property
    def labels(self) -> dict[str, str]:
        """All methods and their names for people."""
        return {method: self.name(method) for method in dict.fromkeys(self.everything.runs["method"])}

    @cached_property
    def usable(self) -> pd.DataFrame:
        """The scores that can be compared."""
        return comparable(self.collected)

    @cached_property
    def finished(self) -> pd.DataFrame:
        """Scores of all finished runs without oracles."""
        return finished_scores(self.collected)

    @cached_property
    def moved(self) -> Numbers | None:
        """The same numbers of twins on other recordings, without oracles; None where there are none."""
        if self.transfers is None or not len(self.transfers.runs):
            return None
        own = self.transfers.of([m for m in dict.fromkeys(self.transfers.runs["method"]) if m not in self.everything.oracles])
        return Numbers(everything=own, baseline=self.baseline, objects=self.objects, names=self.names)

    @cached_property
    def averages(self) -> pd.DataFrame:
        """Both averages of every method, on the pairs that count; oracles on the same pairs, each alone."""
        scores = self.usable
        if len(self.everything.oracles):
            keys = ["scenario", "seed"]
            own = finished_scores(self.everything.of(self.everything.oracles))
            scores = pd.concat([scores, own.merge(scores[keys].drop_duplicates(), on=keys) if len(scores) else own])
        columns = ["method", "task", "metric", "equal", "frames", "seed_std"]
        return averages(scores) if len(scores) else pd.DataFrame(columns=columns)

    @cached_property
    def held(self) -> pd.DataFrame:
        """Averages without and with failed runs."""
        return failures.both_averages(*self.collected.parts)

    @cached_property
    def differences(self) -> pd.DataFrame:
        """Paired differences of every method's scores of pictures to the baseline's, and whether they are resolved."""
        scores = self.usable[self.usable["metric"].isin([metric.name for metric in metrics_of("pictures")])]
        table = statistics.paired_differences(scores, self.baseline) if len(scores) else pd.DataFrame()
        rows: list[Any] = list(table.itertuples())
        return table.assign(verdict=[resolved(row.low, row.high, row.scenarios, METRICS[row.metric]) for row in rows])

    @cached_property
    def ratios(self) -> pd.DataFrame:
        """Ratios of errors to the baseline's, over objects."""
        return statistics.ratios(self.finished, self.baseline, self.objects)

    @cached_property
    def seeds(self) -> pd.DataFrame:
        """The spread of the log error over seeds."""
        return statistics.seed_spread(self.finished)

    @cached_property
    def floors(self) -> pd.DataFrame:
        """Errors in frame 0, which is given: scenario, metric, value. Methods of a scenario begin with the same nodes."""
        runs, rows = self.everything.runs, dict[tuple[str, str], float]()
        for row in runs.itertuples() if "floors" in runs else ():
            values = json.loads(row.floors) if isinstance(row.floors, str) else {}
            rows |= {(str(row.scenario), name): value for name, value in values.items()}
        return pd.DataFrame([(*key, value) for key, value in rows.items()], columns=["scenario", "metric", "value"])

    @cached_property
    def aimed(self) -> pd.DataFrame:
        """Aims and whether they are reached."""
        moved = self.moved.finished if self.moved else self.finished[:0]
        return statistics.judged_aims(self.finished, moved, self.aims, self.objects)

    @cached_property
    def lead(self) -> pd.DataFrame:
        """The best method by the geometric mean of the error that decides, and its rival: what it is compared with, or the
        second best.

        One row of `statistics.ratios`, the same as in the table of ratios, so that a pair has one number; beside it `best` and
        `rival` ("" without one). None where nothing can be compared.
        """
        there = set(zip(self.usable["task"], self.usable["metric"], strict=True))
        key = next((key for key in JUDGES if key in there), None)
        if key is None:
            return pd.DataFrame()
        judged = self.usable[(self.usable["task"] == key[0]) & (self.usable["metric"] == key[1])]
        best, *others = statistics.typical(judged, self.objects).index
        rival = self.baseline if self.baseline in others else next(iter(others), "")
        method, base = (rival, best) if best == self.baseline else (best, rival)
        part = self.finished[self.finished["method"].isin([best, rival]) & (self.finished["task"] == key[0])]
        found = statistics.ratios(part[part["metric"] == key[1]], base, self.objects).to_dict("records")
        row: dict[str, Any] = {"best": best, "rival": rival, "method": method, "baseline": base, "task": key[0], "metric": key[1]}
        row |= {"ratio": np.nan, "n": 0, "objects": self.objects}
        return pd.DataFrame([row | {"verdict": statistics.TOO_FEW} | (found[0] if found else {})])  # type: ignore[arg-type]

    def means(self, task: str, metric: str) -> dict[str, float]:
        """Method to its mean over scenarios, m, the best first."""
        table = self.averages[~self.averages["method"].isin(self.everything.oracles)]
        own = table[(table["task"] == task) & (table["metric"] == metric)].sort_values("equal", kind="stable")
        return dict(zip(own["method"], map(float, own["equal"]), strict=True))

    @cached_property
    def settings(self) -> pd.DataFrame:
        """Settings that differ between the methods."""
        return differing(self.everything.records.values(), self.labels)

    @cached_property
    def by_study(self) -> dict[str, StudyNumbers | OwnStudy]:
        """The numbers of every study."""
        return {name: self._of_study(name, study) for name, study in self.studies.items()}

    def _of_study(self, name: str, study: Study) -> StudyNumbers | OwnStudy:
        if study.kind:
            return STUDY_KINDS[study.kind].of(name, study, self)
        beside = self.known_studies.get(study.beside or "")
        return StudyNumbers(name=name, study=study, collected=self.everything, beside=beside)

    @cached_property
    def key(self) -> str:
        """A digest of what the numbers are made of: numbers of other runs, or against another method, have another one."""
        parts = [found for found in (self.everything, self.transfers) if found]
        runs = [found.runs.reindex(columns=["scenario", "method", "seed", "status", "run_key"]) for found in parts]
        told = [self.baseline, self.objects, self.names, [asdict(aim) for aim in self.aims], [table.to_csv() for table in runs]]
        told += [found.scores.to_csv(index=False) for found in parts]
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()

    @property
    def _parts(self) -> dict[str, Numbers | StudyNumbers | OwnStudy]:
        """The names of tables' owners in the file: "" is this one, "moved" twins on other recordings, others are studies."""
        return {"": self, **({"moved": self.moved} if self.moved else {}), **self.by_study}

    def save(self, folder: Path) -> None:
        """Write numbers.json. Studies that it has and that are not made now stay in it, as their tables beside it do."""
        earlier = read_json(folder / NUMBERS, NUMBERS_FORMAT) if (folder / NUMBERS).is_file() else {"shown": []}
        kept = [name for name in earlier["shown"] if name not in self.studies]
        tables = {name: {table: _as_json(getattr(part, table)) for table in part.TABLES} for name, part in self._parts.items()}
        values: dict[str, Any] = {"format": NUMBERS_FORMAT, "key": self.key, "baseline": self.baseline}
        values["left_out"] = self.everything.left_out
        tables |= {name: earlier["tables"][name] for name in kept}
        values |= {"studies": {name: asdict(study) for name, study in self.known_studies.items()}, "shown": [*kept, *self.studies]}
        values["studies"] = {name: earlier["studies"][name] for name in kept} | values["studies"]
        values |= {"runs": _as_json(self.everything.runs), "tables": tables}
        write_text(folder / NUMBERS, json.dumps(values, ensure_ascii=False) + "\n")

    def take(self, folder: Path) -> Numbers:
        """Take what a folder's numbers.json has of these very runs, so that nothing is computed twice; returns itself."""
        if not (folder / NUMBERS).is_file():
            return self
        values = read_json(folder / NUMBERS, NUMBERS_FORMAT)
        if values["key"] == self.key:
            known = json.loads(json.dumps({name: asdict(study) for name, study in self.known_studies.items()}))
            for name, part in self._parts.items():
                of = [name, self.studies[name].beside] if name in self.studies else []
                if all(known.get(one) == values["studies"].get(one) for one in of):
                    vars(part).update({table: _of_json(value) for table, value in values["tables"].get(name, {}).items()})
        return self

    @classmethod
    def load(cls, folder: Path, results: Path = Path("results")) -> Numbers:
        """Read numbers.json: all tables, and runs without scores and records. Raises InputError."""
        path = folder / NUMBERS
        if not path.is_file():
            raise InputError(folder, f"tables with {NUMBERS} are required", "none", "Make them first: `neuspring tables`.")
        values = read_json(path, NUMBERS_FORMAT)
        studies = {name: parse(Study, study, f"{path}, study {name}") for name, study in values["studies"].items()}
        everything = Collected(stacked([]), _of_json(values["runs"]), left_out=values["left_out"])
        shown = {name: studies[name] for name in values["shown"]}
        found = cls(everything=everything, baseline=values["baseline"], studies=shown, known_studies=studies, results=results)
        for name, part in found._parts.items():
            vars(part).update({table: _of_json(value) for table, value in values["tables"][name].items()})
        return found


def shown_names(method_table: Path, extra: Iterable[Path] = ()) -> dict[str, str]:
    """Method to its name for people, title (`row`), of methods with a title; none where there is no table."""
    rows = read_rows(Method, method_table, "method", extra) if method_table.is_file() else {}
    return {name: f"{row.title} (`{name}`)" for name, row in rows.items() if row.title}


def kept_studies(folder: Path) -> list[str]:
    """The studies whose numbers a folder's numbers.json has."""
    return list(read_json(folder / NUMBERS, NUMBERS_FORMAT)["shown"]) if (folder / NUMBERS).is_file() else []


def _as_json(table: pd.DataFrame) -> dict[str, Any]:
    rows = table.astype(object).where(table.notna(), None)
    return {"columns": [str(name) for name in table], "rows": rows.to_numpy().tolist()}


def _of_json(value: Mapping[str, Any]) -> pd.DataFrame:
    table = pd.DataFrame(value["rows"], columns=value["columns"])
    # Of a column without any value the type is not known: it was one of numbers.
    return table.astype({name: float for name in table if table[name].isna().all()})
