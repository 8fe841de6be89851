"""pictures.html: the films of every scenario side by side, for one seed, with their scores."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from neuspring.core.files import write_text
from neuspring.core.run_record import RunRecord
from neuspring.report.blocks import Block, Fold, Grid, PageSection, Picture, Text, html_page
from neuspring.report.data import link
from neuspring.scores.metrics import METRICS
from neuspring.scores.numbers import Numbers

GALLERY = "pictures.html"
CAPTIONED = ("track_error", "iou")
"""Metrics in captions."""


def write_gallery(
    results: Path, scenarios: Iterable[str], methods: Sequence[str], seed: int, numbers: Numbers, folder: Path
) -> Path:
    """Write pictures.html into `folder`: the films of every scenario side by side, for one seed, with their scores.

    Films and pictures are linked, not embedded, so that the page works wherever the results folder is. Runs that are missing are
    left out.
    """
    sections: list[PageSection] = []
    for scenario in scenarios:
        place = Path(results) / scenario
        records = [record for method in methods if (record := numbers.everything.records.get((scenario, method, seed)))]
        figures = [one for record in records for one in _films(record, Path(results) / record.name, numbers, folder)]
        # First the splats of all methods, then those of methods with splats of their own.
        learned = sorted(place.glob(f"appearance*/{seed}/appearance.png"))
        splats = [Picture(caption="", alt=path.stem, data=link(path, folder)) for path in learned]
        blocks: list[Block] = [Text(text="No pictures: no images, or no finished run.")]
        if figures:
            shown: list[Block] = [Grid(blocks=figures, least=28, films=True)]
            blocks = [*shown, Fold(summary="Splats of frame 0", blocks=[Grid(blocks=splats, least=28)])] if splats else shown
        sections.append(PageSection(key=scenario, title=scenario, blocks=blocks))
    about = (
        "Observed, predicted and their difference, first camera; beside them the twin from all around. The bar above a film is "
        f"blue in training frames and orange in the future. Seed {seed}."
    )
    write_text(folder / GALLERY, html_page("NeuSpring: pictures", about, sections, embedded=False))
    return folder / GALLERY


def _films(record: RunRecord, run: Path, numbers: Numbers, folder: Path) -> list[Block]:
    """A run's films, or its film strip where it has none, with its scores; nothing if it has no pictures."""
    paths = {path.stem: path for path in (run / name for name in record.artifacts.get("images", [])) if path.is_file()}
    scores, name = numbers.everything.scores, numbers.name(record.method)
    own = scores[(scores["scenario"] == record.scenario) & (scores["method"] == record.method) & (scores["seed"] == record.seed)]
    values, parts = own.set_index(["task", "metric"])["value"], []
    for task, frames in (("reconstruction", "training"), ("future", "future")):
        metrics = [METRICS[metric] for metric in CAPTIONED if (task, metric) in values.index]
        parts += [f"{frames} {', '.join(one.told(values[task, one.name]) for one in metrics)}"] if metrics else []
    caption = f"{name}: {'; '.join(parts)}".removesuffix(": ")
    if "video" in paths:
        return [
            Picture(film=True, caption=caption, data=link(paths["video"], folder)),
            Picture(film=True, caption=f"{name}, from all around", data=link(paths["turntable"], folder)),
        ]
    if "images" in paths:
        alt = f"Frames of {record.scenario}, {record.method}"
        return [Picture(caption=caption, alt=alt, data=link(paths["images"], folder))]
    return []
