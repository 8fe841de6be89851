"""A study of twins on other recordings of the same object, beside published numbers: DEFORM's benchmark.

Per study, in one folder: <study>.md and .tex (to read), .csv (a row per cable and row of the table), _clips.csv (every clip
and seed), _growth.csv and .png (mean error of free markers over time), per cable _<cable>.mp4 and .gif: the best, the median and
the worst clip of one row. All of it is made of what the stage `transfer` keeps.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.config.images import Images
from neuspring.core.artifacts import Observations
from neuspring.core.files import read_npz, write_text
from neuspring.core.records import StageRecord
from neuspring.core.table import LATEX_PREAMBLE, Cell, Table
from neuspring.report.blocks import Block, Items, markdown
from neuspring.report.draw.benchmark import growth_figure
from neuspring.report.draw.film import write_film
from neuspring.report.draw.painter import DrawingStyle, Painter
from neuspring.report.draw.scene import Prediction, Scene
from neuspring.report.draw.sheet import save
from neuspring.scores.metrics import DASH
from neuspring.scores.paper import CLIP_METRIC, TAGS, Study
from neuspring.scores.runs import DAMAGED, collect, read_transfers

MM = 1e3
EUCLID = "track_error"
"""Markers of cables are nodes, so it is the mean Euclidean error of free markers."""
LEARNING = ("search", "fit", "train")
"""Stages whose time is that of the model."""
SIGNS = {"second-hand": "†", "log": "‡", "others": "§", "reference": "¶", "": ""}
"""Tag of a published number to the sign behind it."""
FILM_RATE, FILM_WIDTH, FILM_MEGABYTES = 20, 960, 3.0
"""Pictures per second, pixels, and size of a film."""
COLUMNS = ["cable", "clip", "label", "method", "source", "seed", "l1_mm", "euclid_mm", "minutes"]
FACTS = ["l1_mm", "spread_mm", "median_mm", "worst_mm", "euclid_mm", "minutes", "worst_clip", "clips", "of", "seeds"]


@dataclass(frozen=True, kw_only=True)
class Clips:
    """A study of clips with what its methods predicted; what tables show is computed once."""

    study: Study
    results: Path
    clips: pd.DataFrame
    """Every clip, row, source and seed (`COLUMNS`), mm; minutes of search and fit."""
    records: pd.DataFrame
    """Every transfer that has a record."""

    @property
    def cables(self) -> list[str]:
        """Those that we predicted, else those with published numbers."""
        return list(dict.fromkeys(self.clips["cable"])) or list(dict.fromkeys(cable for _, cable, _ in self.study.values))

    @cached_property
    def asked(self) -> dict[str, int]:
        """Scenario of a twin -> clips that it was to be rolled out on."""
        found = {str(run.scenario): self._record(run) for run in self.records.itertuples()}
        return {name: int(record.facts["targets"]) for name, record in found.items() if record and record.facts}

    @cached_property
    def cells(self) -> pd.DataFrame:
        """A row per cable and row of the table, published numbers first; those have a `text`.

        `l1_mm` is the mean over clips, seeds averaged within each; `spread_mm` the standard deviation over the seeds that have
        every clip. `ranked`: it is a method, and has every clip that it was to be judged on, with every seed.
        """
        rows: list[dict[str, Any]] = []
        for (label, cable, _), value in self.study.values.items():
            facts = {"source": value.source, "tag": value.tag, "text": value.text, "ranked": value.tag != "reference"}
            rows += [{"cable": cable, "label": label, "l1_mm": value.value, **facts}] if cable in self.cables else []
        for key, part in self.clips.groupby(["cable", "label"], sort=False):
            cable, label = map(str, key)
            of = sum(self.asked.get(source, 0) for source in part["source"].unique())
            means, seeds = part.groupby("clip")[["l1_mm", "euclid_mm", "minutes"]].mean(), part.groupby("seed")
            l1, spread = means["l1_mm"], seeds["l1_mm"].mean()[seeds["clip"].nunique() == of].std(ddof=1)
            numbers = [l1.mean(), spread, l1.median(), l1.max(), means["euclid_mm"].mean(), means["minutes"].mean()]
            facts = dict(zip(FACTS, numbers, strict=False))
            facts |= {"worst_clip": l1.idxmax(), "clips": int(seeds["clip"].nunique().min()), "of": of, "seeds": len(seeds)}
            facts["ranked"] = facts["clips"] == of
            rows.append({"cable": cable, "label": label, **facts, "source": "ours", "tag": "", "text": ""})
        return pd.DataFrame(rows, columns=["cable", "label", *FACTS, "source", "tag", "text", "ranked"])

    @cached_property
    def growth(self) -> pd.DataFrame:
        """Mean error of free markers over clips and seeds: cable, label, seconds, euclid_mm."""
        tables = [pd.DataFrame(columns=["cable", "label", "seconds", "euclid_mm"])]
        cables = dict(zip(self.clips["clip"], self.clips["cable"], strict=True))
        for run in self.records.itertuples():
            if path := self._file(run, "frames"):
                table = pd.read_parquet(path)
                table = table[(table["metric"] == EUCLID) & table["scenario"].isin(list(cables))].assign(label=str(run.label))
                tables.append(table.assign(cable=table["scenario"].map(cables), euclid_mm=MM * table["value"]))
        table = pd.concat([table for table in tables if len(table)] or tables)
        return table.groupby(["cable", "label", "seconds"], sort=False)["euclid_mm"].mean().reset_index()

    def _file(self, run: Any, role: str) -> Path | None:
        """A file that a transfer kept; None: it has none."""
        record = self._record(run)
        return record.file(role, self._path(run)) if record and role in record.files else None

    def _path(self, run: Any) -> Path:
        return Path(self.results, str(run.scenario), str(run.method), str(run.seed), "transfer.json")

    def _record(self, run: Any) -> StageRecord | None:
        return None if run.reason.startswith(DAMAGED) else StageRecord.load(self._path(run))

    def filmed(self, cable: str) -> list[Painter]:
        """Who paints the best, the median and the worst clip of a cable: by the baseline, else the last row that kept any."""
        here = self.clips[self.clips["cable"] == cable].sort_values("l1_mm")
        for label in dict.fromkeys([self.study.baseline, *reversed(self.study.rows)]):
            for run in self.records[self.records["label"] == label].sort_values("seed").itertuples():
                part = here[(here["source"] == run.scenario) & (here["seed"] == run.seed) & (here["label"] == label)]
                if len(part) and (path := self._file(run, "lines")):
                    lines, last = read_npz(path)[0], len(part) - 1
                    # Of fewer than three clips one stands for two.
                    words = {last: "worst", last // 2: "median", 0: "best"}
                    shown = [(part.iloc[place], f"{label}, {words[place]}") for place in sorted(words)]
                    count = min(len(lines[clip["clip"]]) for clip, _ in shown)
                    return [_painter(self.results, clip, title, lines[clip["clip"]][:count]) for clip, title in shown]
        return []


def _painter(results: Path, clip: pd.Series, title: str, line: np.ndarray) -> Painter:
    """Paints a clip: the observed center line, and a predicted one [F, V, 3], m, in one view."""
    seen = Observations.load(results / clip["clip"] / "observations.npz")
    free = seen.line < len(seen.nodes)
    positions = np.full((len(line), *seen.object_points.shape[1:]), np.nan)
    positions[:, seen.line[free]] = line[:, free]
    take = Prediction(f"{title}: {clip['clip']}, L1 {clip['l1_mm']:.1f} mm", positions)
    frames = range(0, len(line), max(round(seen.scenario.frame_rate / FILM_RATE), 1))
    manner = DrawingStyle(style="nodes", error="none", ground="white", together=True)
    return Painter(Scene.from_side(seen, [take], frames), [take], frames, manner, Images(), "cpu")


def read_clips(study: Study, results: Path, sources: Sequence[str], seeds: Sequence[int], known_methods: Collection[str]) -> Clips:
    """What the methods of a study predicted on other recordings, by the records in a results folder."""
    labels = {method: label for label, method in study.rows.items() if method in known_methods}
    table, records = read_transfers(results, sources, labels, seeds)
    clips = pd.DataFrame(columns=COLUMNS)
    if len(table):
        keys = {"category": "cable", "scenario": "clip", "method": "method", "source": "source", "seed": "seed"}
        clips = MM * table.pivot_table(index=list(keys), columns="metric", values="value", sort=False)
        clips = clips.reindex(columns=[CLIP_METRIC, EUCLID]).dropna(subset=CLIP_METRIC).reset_index()
        clips = clips.rename(columns=keys | {CLIP_METRIC: "l1_mm", EUCLID: "euclid_mm"})
        runs = collect(results, sources, labels, seeds).records.items()
        minutes = {key: sum(record.timings.get(stage, 0.0) for stage in LEARNING) / 60 for key, record in runs}
        times = [minutes.get(key, np.nan) for key in zip(clips["source"], clips["method"], clips["seed"], strict=True)]
        clips = clips.assign(label=clips["method"].map(labels), minutes=times)[COLUMNS]
        clips = clips.sort_values("cable", kind="stable", key=lambda names: names.map(list(dict.fromkeys(names)).index))
    return Clips(study=study, results=Path(results), clips=clips, records=records.assign(label=records["method"].map(labels)))


def clip_blocks(found: Clips) -> list[Block]:
    """L1 per cable beside published numbers; ours in detail; every clip. Then the rows and runs that are not there, and why."""
    lines = [f"{label}: not run" for label in found.study.rows if label not in set(found.clips["label"])]
    failed = found.records[found.records["status"] != "ok"].itertuples()
    lines += [f"{run.label}, {run.scenario} / seed {run.seed}: {run.reason}" for run in failed]
    last = [Items(title="Not in the tables, or not whole", items=lines)] if lines else []
    return [_overview(found), *([_details(found), _per_clip(found)] if len(found.clips) else []), *last]


def _overview(found: Clips) -> Table:
    cells, counts = found.cells, found.clips.groupby("cable", sort=False)["clip"].nunique()
    best, rows = cells[cells["ranked"].astype(bool)].groupby("cable")["l1_mm"].min(), []
    for (label, source), part in cells.groupby(["label", "source"], sort=False):
        of = {cell.cable: cell for cell in part.itertuples()}
        values = [_l1(of[cable], best) if cable in of else Cell(text=DASH) for cable in found.cables]
        rows.append([Cell(text=str(label)), Cell(text=str(source)), *values])
    note = "mm: mean absolute error over clips, all markers (held ones count with 0), three coordinates and frames. "
    clips = ", ".join(f"{cable} {count}" for cable, count in counts.items()) or "not run"
    note += f"Ours: evaluation clips ({clips}), predicted open loop; ± standard deviation over seeds; * clips are missing. "
    note += f"{found.study.training}. "
    note += " ".join(f"{SIGNS[tag]} {text}" for tag, text in TAGS.items() if tag in set(cells["tag"]))
    return Table(caption="L1 per cable", note=note.strip(), header=["Method", "Source", *found.cables], rows=rows, stub=2)


def _l1(cell: Any, best: pd.Series) -> Cell:
    spread = f" ± {cell.spread_mm:.2f}" if np.isfinite(cell.spread_mm) else ""
    text = f"{cell.text}{SIGNS[cell.tag]}" if cell.text else f"{cell.l1_mm:.2f}{spread}{'' if cell.ranked else ' *'}"
    return Cell(text=text, mark="best" if cell.ranked and cell.l1_mm == best[cell.cable] else "", value=cell.l1_mm)


def _details(found: Clips) -> Table:
    rows = []
    for cell in found.cells[found.cells["text"] == ""].itertuples():
        numbers = [getattr(cell, name) for name in FACTS[:6]]
        texts = [DASH if np.isnan(value) else f"{value:.2f}" for value in numbers]
        texts += [str(cell.worst_clip), f"{cell.clips:.0f}/{cell.of:.0f}", f"{cell.seeds:.0f}"]
        rows.append([str(cell.cable), str(cell.label), *texts])
    note = "L1 in mm: mean, median and worst over clips, seeds averaged within each. Euclidean: mean distance of free markers, mm. "
    note += "Minutes: search and fit of one twin, mean over seeds; rows that share a search count it each."
    header = ["Cable", "Method", "Mean", "± seeds", "Median clip", "Worst clip", "Euclidean", "Minutes", "Worst", "Clips", "Seeds"]
    return replace(Table.of_texts(header, rows, "Ours in detail"), note=note, stub=2)


def _per_clip(found: Clips) -> Table:
    means = found.clips.groupby(["cable", "clip", "label"], sort=False)["l1_mm"].mean()
    labels, rows = [label for label in found.study.rows if label in set(found.clips["label"])], []
    for _, part in means.groupby(level=["cable", "clip"], sort=False):
        values = part.droplevel([0, 1])
        rows.append([*map(str, part.index[0][:2]), *(f"{values[label]:.2f}" if label in values else DASH for label in labels)])
    return replace(Table.of_texts(["Cable", "Clip", *labels], rows, "L1 per clip"), note="mm, seeds averaged.", stub=2)


def write_clips(name: str, found: Clips, folder: Path) -> str:
    """Write all files of a study of clips; returns the Markdown."""
    for old in (path for ending in ("gif", "mp4", "png") for path in folder.glob(f"{name}_*.{ending}")):
        old.unlink()
    for suffix, rows in {"": found.cells, "_clips": found.clips, "_growth": found.growth}.items():
        write_text(folder / f"{name}{suffix}.csv", rows.to_csv(index=False))
    title, (first, *rest) = found.study.title, clip_blocks(found)
    tables = [block for block in (first, *rest) if isinstance(block, Table)]
    floats = [table.latex(f"{name}-{k}", f"{title}: {table.caption}") for k, table in enumerate(tables, 1)]
    write_text(folder / f"{name}.tex", "\n".join([LATEX_PREAMBLE, *floats]))
    parts = [f"# {title}\n", markdown([first])]
    if len(found.growth):
        path = save(growth_figure(found.growth, list(found.study.rows)), folder / f"{name}_growth.png")
        parts.append(f"![Mean error of free markers over time, per cable]({path.name})\n")
    for cable in dict.fromkeys(found.clips["cable"]):
        painters = found.filmed(cable)
        for ending in ("gif", "mp4") if painters else ():
            path, (before, after) = folder / f"{name}_{cable}.{ending}", painters[0].frames[:2]
            write_film(painters[0], path, FILM_WIDTH, 1 / (after - before), FILM_MEGABYTES, painters[1:])
            parts.append(f"{'!' * (ending == 'gif')}[{cable}: observed blue, predicted dark, held red ({ending})]({path.name})\n")
    text = "\n".join([*parts, markdown(rest)])
    write_text(folder / f"{name}.md", text)
    return text
