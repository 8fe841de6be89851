"""A study of twins on other recordings laid out beside published numbers, with films: DEFORM's benchmark.

Per study, in one folder: <study>.md and .tex (to read), .csv (a row per cable and row of the table), _clips.csv (every clip
and seed), _growth.png (mean error of free markers over time), per cable _<cable>.mp4 and .gif: the best, the median and the worst
clip of one row. All of it is made of what the stage `transfer` keeps.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.artifacts import Observations
from neuspring.core.files import read_npz, write_text
from neuspring.core.table import LATEX_PREAMBLE, Cell, Table
from neuspring.draw.benchmark import growth_figure
from neuspring.draw.film import write_film
from neuspring.draw.painter import DrawingStyle, Painter
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Items, markdown
from neuspring.scores.clips import CLIP_FACTS, ClipNumbers
from neuspring.scores.metrics import DASH
from neuspring.scores.paper import TAGS

TAG_SIGNS = {"second-hand": "†", "log": "‡", "others": "§", "reference": "¶", "": ""}
"""Tag of a published number to the sign behind it."""
FILM_RATE, FILM_WIDTH, FILM_MEGABYTES = 20, 960, 3.0
"""Pictures per second, pixels, and size of a film."""


def clip_blocks(found: ClipNumbers) -> list[Block]:
    """L1 per cable beside published numbers; ours in detail; every clip. Then the rows and runs that are not there, and why."""
    lines = [f"{label}: not run" for label in found.study.rows if label not in set(found.clips["label"])]
    failed = found.records[found.records["status"] != "ok"].itertuples()
    lines += [f"{run.label}, {run.scenario} / seed {run.seed}: {run.reason}" for run in failed]
    last = [Items(title="Not in the tables, or not whole", items=lines)] if lines else []
    return [_overview(found), *([_details(found), _per_clip(found)] if len(found.clips) else []), *last]


def _overview(found: ClipNumbers) -> Table:
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
    note += " ".join(f"{TAG_SIGNS[tag]} {text}" for tag, text in TAGS.items() if tag in set(cells["tag"]))
    return Table(caption="L1 per cable", note=note.strip(), header=["Method", "Source", *found.cables], rows=rows, stub=2)


def _l1(cell: Any, best: pd.Series) -> Cell:
    spread = f" ± {cell.spread_mm:.2f}" if np.isfinite(cell.spread_mm) else ""
    text = f"{cell.text}{TAG_SIGNS[cell.tag]}" if cell.text else f"{cell.l1_mm:.2f}{spread}{'' if cell.ranked else ' *'}"
    return Cell(text=text, mark="best" if cell.ranked and cell.l1_mm == best[cell.cable] else "", value=cell.l1_mm)


def _details(found: ClipNumbers) -> Table:
    rows = []
    for cell in found.cells[found.cells["text"] == ""].itertuples():
        numbers = [getattr(cell, name) for name in CLIP_FACTS[:6]]
        texts = [DASH if np.isnan(value) else f"{value:.2f}" for value in numbers]
        texts += [str(cell.worst_clip), f"{cell.clips:.0f}/{cell.of:.0f}", f"{cell.seeds:.0f}"]
        rows.append([str(cell.cable), str(cell.label), *texts])
    note = "L1 in mm: mean, median and worst over clips, seeds averaged within each. Euclidean: mean distance of free markers, mm. "
    note += "Minutes: search and fit of one twin, mean over seeds; rows that share a search count it each."
    header = ["Cable", "Method", "Mean", "± seeds", "Median clip", "Worst clip", "Euclidean", "Minutes", "Worst", "Clips", "Seeds"]
    return replace(Table.of_texts(header, rows, "Ours in detail"), note=note, stub=2)


def _per_clip(found: ClipNumbers) -> Table:
    means = found.clips.groupby(["cable", "clip", "label"], sort=False)["l1_mm"].mean()
    labels, rows = [label for label in found.study.rows if label in set(found.clips["label"])], []
    for _, part in means.groupby(level=["cable", "clip"], sort=False):
        values = part.droplevel([0, 1])
        rows.append([*map(str, part.index[0][:2]), *(f"{values[label]:.2f}" if label in values else DASH for label in labels)])
    return replace(Table.of_texts(["Cable", "Clip", *labels], rows, "L1 per clip"), note="mm, seeds averaged.", stub=2)


def write_clips(found: ClipNumbers, folder: Path) -> str:
    """Write all files of a study of clips; returns the Markdown."""
    name = found.name
    for old in (path for ending in ("gif", "mp4", "png") for path in folder.glob(f"{name}_*.{ending}")):
        old.unlink()
    for suffix, rows in {"": found.cells, "_clips": found.clips}.items():
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
        painters = filmed(found, cable)
        for ending in ("gif", "mp4") if painters else ():
            path, (before, after) = folder / f"{name}_{cable}.{ending}", painters[0].frames[:2]
            write_film(painters[0], path, FILM_WIDTH, 1 / (after - before), FILM_MEGABYTES, painters[1:])
            parts.append(f"{'!' * (ending == 'gif')}[{cable}: observed blue, predicted dark, held red ({ending})]({path.name})\n")
    text = "\n".join([*parts, markdown(rest)])
    write_text(folder / f"{name}.md", text)
    return text


def filmed(found: ClipNumbers, cable: str) -> list[Painter]:
    """Who paints the best, the median and the worst clip of a cable: by the baseline, else the last row that kept any."""
    here = found.clips[found.clips["cable"] == cable].sort_values("l1_mm")
    runs = found.records[found.records["lines"] != ""].sort_values("seed")
    for label in dict.fromkeys([found.study.baseline, *reversed(found.study.rows)]):
        for run in runs[runs["label"] == label].itertuples():
            part = here[(here["source"] == run.scenario) & (here["seed"] == run.seed) & (here["label"] == label)]
            if len(part):
                lines, last = read_npz(found.results / str(run.lines))[0], len(part) - 1
                # Of fewer than three clips one stands for two.
                words = {last: "worst", last // 2: "median", 0: "best"}
                shown = [(part.iloc[place], f"{label}, {words[place]}") for place in sorted(words)]
                count = min(len(lines[clip["clip"]]) for clip, _ in shown)
                return [_painter(found.results, clip, title, lines[clip["clip"]][:count]) for clip, title in shown]
    return []


def _painter(results: Path, clip: pd.Series, title: str, line: np.ndarray) -> Painter:
    """Paints a clip: the observed center line, and a predicted one [F, V, 3], m, in one view."""
    seen = Observations.load(results / clip["clip"] / "observations.npz")
    free = seen.line < len(seen.nodes)
    positions = np.full((len(line), *seen.object_points.shape[1:]), np.nan)
    positions[:, seen.line[free]] = line[:, free]
    take = ShownRun(f"{title}: {clip['clip']}, L1 {clip['l1_mm']:.1f} mm", positions)
    frames = range(0, len(line), max(round(seen.scenario.frame_rate / FILM_RATE), 1))
    manner = DrawingStyle(error="none", together=True)
    return Painter(ShownScene.from_side(seen, [take], frames), [take], frames, manner)
