"""A page that shows what methods predict: the videos of every scenario side by side, with their scores. It needs no network.

Videos and pictures are linked, not embedded, so that the page works wherever the results folder is.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from neuspring.core.files import write_text
from neuspring.report.blocks import Block, Fold, Grid, Picture, Section, Text, Video, html_page
from neuspring.scores.metrics import METRICS
from neuspring.scores.runs import Collected

NAME = "pictures.html"
SHOWN = ("psnr", "iou")
"""Metrics in captions."""
ABOUT = (
    "Observed, predicted and their difference, first camera; below, the twin from all around. The bar above each video shows the "
    "time: blue stands for training frames, orange for the future."
)


def write(results: Path, scenarios: Iterable[str], methods: Iterable[str], seed: int, collected: Collected, folder: Path) -> Path:
    """Write pictures.html into `folder`: every method of every scenario, for one seed. Runs that are missing are left out."""
    methods, sections = list(methods), []
    for scenario in scenarios:
        place = Path(results) / scenario
        figures = [figure for method in methods for figure in _figures(place / method / str(seed), collected, folder)]
        # First the splats of all methods, then those of methods with splats of their own.
        learned = sorted(place.glob(f"appearance*/{seed}/appearance.png"))
        splats = [Picture(caption="", alt=path.stem, data=_link(path, folder)) for path in learned]
        blocks: list[Block] = [Text(text="No pictures: no images, or no finished run.")]
        if figures:
            blocks = [Fold(summary="Splats of frame 0", blocks=splats), Grid(blocks=figures, least=28)]
        sections.append(Section(key=scenario, title=scenario, blocks=blocks))
    path = folder / NAME
    write_text(path, html_page("NeuSpring: pictures", f"{ABOUT} Seed {seed}.", sections, embedded=False))
    return path


def _figures(run: Path, collected: Collected, folder: Path) -> list[Block]:
    """A run's videos, or its film strip where it has no videos, with its scores; nothing if it has no pictures."""
    scenario, method, seed = run.parts[-3], run.parts[-2], int(run.name)
    record = collected.records.get((scenario, method, seed))
    named = record.artifacts.get("images", []) if record else []
    paths = {path.stem: path for path in (run / name for name in named) if path.is_file()}
    scores = collected.scores
    own = scores[(scores["scenario"] == scenario) & (scores["method"] == method) & (scores["seed"] == seed)]
    caption = f"{method}: {_scores_text(own)}".removesuffix(": ")
    if "video" in paths:
        return [
            Video(caption=caption, data=_link(paths["video"], folder)),
            Video(caption=f"{method}, from all around", data=_link(paths["turntable"], folder)),
        ]
    if "images" in paths:
        return [Picture(caption=caption, alt=f"Frames of {scenario}, {method}", data=_link(paths["images"], folder))]
    return []


def _scores_text(scores: pd.DataFrame) -> str:
    values = scores.set_index(["task", "metric"])["value"]
    parts = []
    for task, name in (("reconstruction", "training"), ("future", "future")):
        metrics = [METRICS[metric] for metric in SHOWN if (task, metric) in values.index]
        texts = [f"{metric.label} {metric.text(values[task, metric.name])}" for metric in metrics]
        parts += [f"{name} {', '.join(texts)}"] if texts else []
    return "; ".join(parts)


def _link(path: Path, folder: Path) -> str:
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())
