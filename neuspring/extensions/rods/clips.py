"""A study of twins on other recordings of the same object, compared with published numbers: DEFORM's benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from neuspring.core.files import write_text
from neuspring.core.records import StageRecord
from neuspring.core.table import Cell, Table
from neuspring.draw.sheet import save
from neuspring.extensions.rods.metric import DEFORM_L1
from neuspring.report.blocks import Items
from neuspring.scores.metrics import DASH
from neuspring.scores.paper import OwnStudy, Printed, Study, Values, printed, rows_of
from neuspring.scores.table import DAMAGED, ScoreTable, collect, read_transfers

EUCLID = "track_error"
"""Mean Euclidean error of free markers: markers of cables are nodes, so this is their track error."""
LEARNING = ("search", "fit", "train")
"""Stages whose time counts as training time."""
CLIP_COLUMNS = ["cable", "clip", "label", "method", "source", "seed", "l1_mm", "euclid_mm", "minutes"]
CLIP_FACTS = ["l1_mm", "spread_mm", "median_mm", "worst_mm", "euclid_mm", "minutes", "worst_clip", "clips", "of", "seeds"]


TAGS = {
    "second-hand": "The paper prints the number. We read it on a web page that was made from the paper's TeX.",
    "log": "The number is in logs that DEFORM's authors published with their code.",
    "others": "Authors other than DEFORM's trained DEFORM and published the number.",
    "reference": "We measured it. It is not a method, but the error without learning, or a lower limit.",
}
"""Meaning of the tags in deform_published.csv."""


@dataclass(frozen=True, kw_only=True)
class PublishedError(Printed):
    """A published value with its source."""

    source: str
    tag: str
    """One of `TAGS`; empty: printed in the paper."""


def published() -> Values:
    """Published errors on DEFORM's cables, mm, by label, cable and metric."""
    return {
        (row["method"], row["cable"], DEFORM_L1.name): PublishedError(
            **vars(printed(row["l1_mm"])), source=row["source"], tag=row["tag"]
        )
        for row in rows_of("neuspring.extensions.rods", "deform_published.csv")
    }


@dataclass(frozen=True, kw_only=True)
class ClipNumbers(OwnStudy):
    """Errors of a study's methods on other recordings. Each table is computed once."""

    published: ClassVar = {"deform_published": published}
    name: str
    study: Study
    results: Path
    sources: Sequence[str]
    """Scenarios whose twins predict clips."""
    methods: Sequence[str]
    """The methods of the benchmark."""
    seeds: Sequence[int]

    @classmethod
    def of(cls, name: str, study: Study, table: ScoreTable, results: Path) -> ClipNumbers:
        sources, methods, seeds = (list(dict.fromkeys(table.runs[column])) for column in ("scenario", "method", "seed"))
        return cls(name=name, study=study, results=results, sources=sources, methods=methods, seeds=seeds)

    def blocks(self) -> list[Any]:
        """L1 per cable with published numbers, details of our methods, and the missing rows and runs with their reasons."""
        lines = [f"{label}: not run" for label in self.study.rows if label not in set(self.clips["label"])]
        failed = self.records[self.records["status"] != "ok"].itertuples()
        lines += [f"{run.label}, {run.scenario} / seed {run.seed}: {run.reason}" for run in failed]
        last = [Items(title="Missing or incomplete", items=lines)] if lines else []
        return [_overview(self), *([_details(self)] if len(self.clips) else []), *last]

    def files(self, folder: Path) -> list[str]:
        """Write the CSV files and the figure; returns Markdown lines that show the figure."""
        for suffix, rows in {"": self.cells, "_clips": self.clips}.items():
            write_text(folder / f"{self.name}{suffix}.csv", rows.to_csv(index=False))
        path = folder / f"{self.name}_growth.png"
        path.unlink(missing_ok=True)
        if not len(self.growth):
            return []
        save(growth_figure(self.growth, list(self.study.rows)), path)
        return [f"![Mean error of free markers over time, per cable]({path.name})"]

    @property
    def labels(self) -> dict[str, str]:
        """Method -> label, for the methods of the benchmark."""
        return {method: label for label, method in self.study.rows.items() if method in self.methods}

    @property
    def cables(self) -> list[str]:
        """Predicted cables; without any, cables with published numbers."""
        return list(dict.fromkeys(self.clips["cable"])) or list(dict.fromkeys(cable for _, cable, _ in self.study.values))

    @cached_property
    def _read(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        return read_transfers(self.results, self.sources, self.labels, self.seeds)

    @cached_property
    def clips(self) -> pd.DataFrame:
        """Errors of every clip, method, source and seed, mm, with minutes of search and fit."""
        if not len(table := self._read[0]):
            return pd.DataFrame(columns=CLIP_COLUMNS)
        keys = {"category": "cable", "scenario": "clip", "method": "method", "source": "source", "seed": "seed"}
        clips = 1e3 * table.pivot_table(index=list(keys), columns="metric", values="value", sort=False)
        clips = clips.reindex(columns=[DEFORM_L1.name, EUCLID]).dropna(subset=DEFORM_L1.name).reset_index()
        clips = clips.rename(columns=keys | {DEFORM_L1.name: "l1_mm", EUCLID: "euclid_mm"})
        runs = collect(self.results, self.sources, self.labels, self.seeds).records.items()
        minutes = {key: sum(record.timings.get(stage, 0.0) for stage in LEARNING) / 60 for key, record in runs}
        times = [minutes.get(key, np.nan) for key in zip(clips["source"], clips["method"], clips["seed"], strict=True)]
        clips = clips.assign(label=clips["method"].map(self.labels), minutes=times)[CLIP_COLUMNS]
        return clips.sort_values("cable", kind="stable", key=lambda names: names.map(list(dict.fromkeys(names)).index))

    @cached_property
    def records(self) -> pd.DataFrame:
        """Every transfer with a record: its status, its number of clips, and its file of frame errors in the results folder."""
        rows = []
        for run in self._read[1].to_dict("records"):
            path = self.results / run["scenario"] / run["method"] / str(run["seed"]) / "transfer.json"
            record = None if run["reason"].startswith(DAMAGED) else StageRecord.load(path)
            frames = record.file("frames", path).relative_to(self.results).as_posix() if record and "frames" in record.files else ""
            targets = int(record.facts["targets"]) if record and record.facts else 0
            rows.append(run | {"label": self.labels[run["method"]], "targets": targets, "frames": frames})
        return pd.DataFrame(rows, columns=["scenario", "method", "seed", "status", "reason", "label", "targets", "frames"])

    @cached_property
    def cells(self) -> pd.DataFrame:
        """One row per cable and row of the table; published numbers come first and have a `text`.

        `l1_mm` is the mean over clips, after averaging seeds per clip. `spread_mm` is the standard deviation over seeds that have
        every clip. `ranked`: the row is a method and has every clip with every seed.
        """
        asked = self.records.groupby("scenario")["targets"].max().to_dict()
        rows = []
        for (label, cable, _), value in self.study.values.items():
            assert isinstance(value, PublishedError)
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


TAG_SIGNS = {"second-hand": "†", "log": "‡", "others": "§", "reference": "¶", "": ""}
"""Tag of a published number -> the sign after it."""


def _overview(numbers: ClipNumbers) -> Table:
    cells, counts = numbers.cells, numbers.clips.groupby("cable", sort=False)["clip"].nunique()
    best, rows = cells[cells["ranked"].astype(bool)].groupby("cable")["l1_mm"].min(), []
    for (label, source), part in cells.groupby(["label", "source"], sort=False):
        of = {cell.cable: cell for cell in part.itertuples()}
        values = [_l1(of[cable], best) if cable in of else Cell(text=DASH) for cable in numbers.cables]
        rows.append([Cell(text=str(label)), Cell(text=str(source)), *values])
    note = "Mean absolute error, mm, over clips, all markers (held markers count with 0), three coordinates and frames. "
    clips = ", ".join(f"{cable} {count}" for cable, count in counts.items()) or "not run"
    note += f"Ours: evaluation clips ({clips}), predicted open-loop; ± standard deviation over seeds; * clips are missing. "
    note += f"{numbers.study.training}. "
    note += " ".join(f"{TAG_SIGNS[tag]} {text}" for tag, text in TAGS.items() if tag in set(cells["tag"]))
    return Table(caption="L1 per cable", note=note.strip(), header=["Method", "Source", *numbers.cables], rows=rows, stub=2)


def _l1(cell: Any, best: pd.Series) -> Cell:
    spread = f" ± {cell.spread_mm:.2f}" if np.isfinite(cell.spread_mm) else ""
    text = f"{cell.text}{TAG_SIGNS[cell.tag]}" if cell.text else f"{cell.l1_mm:.2f}{spread}{'' if cell.ranked else ' *'}"
    return Cell(text=text, mark="best" if cell.ranked and cell.l1_mm == best[cell.cable] else "", value=cell.l1_mm)


def _details(numbers: ClipNumbers) -> Table:
    rows = []
    for cell in numbers.cells[numbers.cells["text"] == ""].itertuples():
        values = [getattr(cell, name) for name in CLIP_FACTS[:6]]
        texts = [DASH if np.isnan(value) else f"{value:.2f}" for value in values]
        texts += [str(cell.worst_clip), f"{cell.clips:.0f}/{cell.of:.0f}", f"{cell.seeds:.0f}"]
        rows.append([str(cell.cable), str(cell.label), *texts])
    note = "L1, mm: mean, median and worst over clips, after averaging seeds per clip. Euclidean: mean error of free markers, mm. "
    note += "Minutes: search and fit of one twin, mean over seeds; each row includes a shared search."
    header = ["Cable", "Method", "Mean", "± seeds", "Median clip", "Worst clip", "Euclidean", "Minutes", "Worst", "Clips", "Seeds"]
    return replace(Table.of_texts(header, rows, "Ours in detail"), note=note, stub=2)


def growth_figure(growth: pd.DataFrame, labels: Sequence[str]) -> Figure:
    """Draw the mean error of free markers over time, one panel per cable, from rows cable, label, seconds, euclid_mm.

    The index of a label in `labels` sets its color, independent of missing labels.
    """
    cables, shown = list(dict.fromkeys(growth["cable"])), [label for label in labels if label in set(growth["label"])]
    # A column of the legend is as wide as a panel.
    size = (2.6 * len(cables) + 0.6, 2.8 + 0.2 * -(-len(shown) // len(cables)))
    figure, axes = plt.subplots(1, len(cables), figsize=size, layout="constrained", squeeze=False, sharex=True, sharey=True)
    colors = plt.get_cmap("tab10" if len(labels) <= 10 else "tab20")
    handles = [Line2D([], [], color=colors(labels.index(label)), label=label) for label in shown]
    for axis, cable in zip(axes[0], cables, strict=True):
        for label in shown:
            part = growth[(growth["cable"] == cable) & (growth["label"] == label)].sort_values("seconds")
            axis.plot(part["seconds"], part["euclid_mm"], color=colors(labels.index(label)), lw=1.2)
        axis.set(title=cable, xlim=(0, growth["seconds"].max()), ylim=(0, None))
        axis.grid(color="0.92")
    figure.supxlabel("time [s]", fontsize=9)
    figure.supylabel("error of free markers [mm]", fontsize=9)
    figure.legend(handles=handles, loc="outside upper center", ncols=min(len(shown), len(cables)), frameon=False, fontsize=8)
    return figure
