"""The numbers of a study of twins on other recordings of the same object, beside published numbers: DEFORM's benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from neuspring.core.records import StageRecord
from neuspring.scores.paper import CLIP_METRIC, Study
from neuspring.scores.runs import DAMAGED, collect, read_transfers

EUCLID = "track_error"
"""Markers of cables are nodes, so it is the mean Euclidean error of free markers."""
LEARNING = ("search", "fit", "train")
"""Stages whose time is that of the model."""
CLIP_COLUMNS = ["cable", "clip", "label", "method", "source", "seed", "l1_mm", "euclid_mm", "minutes"]
CLIP_FACTS = ["l1_mm", "spread_mm", "median_mm", "worst_mm", "euclid_mm", "minutes", "worst_clip", "clips", "of", "seeds"]


@dataclass(frozen=True, kw_only=True)
class ClipNumbers:
    """The predictions of a study's methods on other recordings; each table is computed once, or was read from numbers.json."""

    TABLES: ClassVar = ("clips", "records", "cells", "growth")
    name: str
    study: Study
    results: Path
    sources: Sequence[str]
    """Scenarios whose twins were rolled out on clips."""
    methods: Sequence[str]
    """The methods of the benchmark."""
    seeds: Sequence[int]

    @property
    def labels(self) -> dict[str, str]:
        """Method to label, of the methods that the benchmark has."""
        return {method: label for label, method in self.study.rows.items() if method in self.methods}

    @property
    def cables(self) -> list[str]:
        """Those that we predicted, else those with published numbers."""
        return list(dict.fromkeys(self.clips["cable"])) or list(dict.fromkeys(cable for _, cable, _ in self.study.values))

    @cached_property
    def _read(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        return read_transfers(self.results, self.sources, self.labels, self.seeds)

    @cached_property
    def clips(self) -> pd.DataFrame:
        """Every clip, row, source and seed, mm; minutes of search and fit."""
        if not len(table := self._read[0]):
            return pd.DataFrame(columns=CLIP_COLUMNS)
        keys = {"category": "cable", "scenario": "clip", "method": "method", "source": "source", "seed": "seed"}
        clips = 1e3 * table.pivot_table(index=list(keys), columns="metric", values="value", sort=False)
        clips = clips.reindex(columns=[CLIP_METRIC, EUCLID]).dropna(subset=CLIP_METRIC).reset_index()
        clips = clips.rename(columns=keys | {CLIP_METRIC: "l1_mm", EUCLID: "euclid_mm"})
        runs = collect(self.results, self.sources, self.labels, self.seeds).records.items()
        minutes = {key: sum(record.timings.get(stage, 0.0) for stage in LEARNING) / 60 for key, record in runs}
        times = [minutes.get(key, np.nan) for key in zip(clips["source"], clips["method"], clips["seed"], strict=True)]
        clips = clips.assign(label=clips["method"].map(self.labels), minutes=times)[CLIP_COLUMNS]
        return clips.sort_values("cable", kind="stable", key=lambda names: names.map(list(dict.fromkeys(names)).index))

    @cached_property
    def records(self) -> pd.DataFrame:
        """Every transfer that has a record: how it ended, clips that it was to be judged on, files that it kept, in the results."""
        rows = []
        runs: list[dict[str, Any]] = self._read[1].to_dict("records")  # type: ignore[assignment]
        for run in runs:
            path = self.results / run["scenario"] / run["method"] / str(run["seed"]) / "transfer.json"
            record = None if run["reason"].startswith(DAMAGED) else StageRecord.load(path)
            kept = [role for role in ("frames", "lines") if record and role in record.files]
            files = {role: record.file(role, path).relative_to(self.results).as_posix() for role in kept if record}
            targets = int(record.facts["targets"]) if record and record.facts else 0
            rows.append(run | {"label": self.labels[run["method"]], "targets": targets, "frames": "", "lines": ""} | files)
        columns = ["scenario", "method", "seed", "status", "reason", "label", "targets", "frames", "lines"]
        return pd.DataFrame(rows, columns=columns)

    @cached_property
    def cells(self) -> pd.DataFrame:
        """A row per cable and row of the table, published numbers first; those have a `text`.

        `l1_mm` is the mean over clips, seeds averaged within each; `spread_mm` the standard deviation over the seeds that have
        every clip. `ranked`: it is a method, and has every clip that it was to be judged on, with every seed.
        """
        asked: dict[Any, int] = self.records.groupby("scenario")["targets"].max().to_dict()
        rows: list[dict[str, Any]] = []
        for (label, cable, _), value in self.study.values.items():
            facts = {"source": value.source, "tag": value.tag, "text": value.text, "ranked": value.tag != "reference"}
            rows += [{"cable": cable, "label": label, "l1_mm": value.value, **facts}] if cable in self.cables else []
        for key, part in self.clips.groupby(["cable", "label"], sort=False):
            cable, label = map(str, key)
            of = sum(asked.get(source, 0) for source in part["source"].unique())
            means, seeds = part.groupby("clip")[["l1_mm", "euclid_mm", "minutes"]].mean(), part.groupby("seed")
            l1, spread = means["l1_mm"], seeds["l1_mm"].mean()[seeds["clip"].nunique() == of].std(ddof=1)
            numbers = [l1.mean(), spread, l1.median(), l1.max(), means["euclid_mm"].mean(), means["minutes"].mean(), l1.idxmax()]
            facts = dict(zip(CLIP_FACTS, [*numbers, int(seeds["clip"].nunique().min()), of, len(seeds)], strict=True))
            facts |= {"source": "ours", "tag": "", "text": "", "ranked": facts["clips"] == of}
            rows.append({"cable": cable, "label": label, **facts})
        return pd.DataFrame(rows, columns=["cable", "label", *CLIP_FACTS, "source", "tag", "text", "ranked"])

    @cached_property
    def growth(self) -> pd.DataFrame:
        """Mean error of free markers over clips and seeds: cable, label, seconds, euclid_mm."""
        tables = [pd.DataFrame(columns=["cable", "label", "seconds", "euclid_mm"])]
        cables = dict(zip(self.clips["clip"], self.clips["cable"], strict=True))
        for run in self.records[self.records["frames"] != ""].itertuples():
            table = pd.read_parquet(self.results / str(run.frames))
            table = table[(table["metric"] == EUCLID) & table["scenario"].isin(list(cables))].assign(label=str(run.label))
            tables.append(table.assign(cable=table["scenario"].map(cables), euclid_mm=1e3 * table["value"]))
        table = pd.concat([table for table in tables if len(table)] or tables)
        return table.groupby(["cable", "label", "seconds"], sort=False)["euclid_mm"].mean().reset_index()
