"""Videos and images of all methods side by side. Images are scaled down; files that do not fit into the page are linked."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
from PIL import Image

from neuspring.core.run_record import RunRecord
from neuspring.core.text import program
from neuspring.draw.sheet import TIME_BAR, TITLE_LINE
from neuspring.report.blocks import Block, Code, Fold, Grid, Picture
from neuspring.report.data import NO_ROOM, PERCEPTION, ReportData, ReportSection, data_uri, link, webp
from neuspring.report.tables import several

MOST_OPEN = 3
"""Number of scenarios that are unfolded."""


@dataclass(frozen=True)
class Kind:
    """A kind of image or video of a run."""

    artifact: str
    stem: str
    title: str
    width: int = 0
    """Maximum width of an image, pixels; 0: a video."""
    paper: bool = False
    """The image requires a white background."""
    least: int = 40
    """Minimum width in the page, rem."""


KINDS = (
    Kind("images", "video", "Videos: observed and predicted", least=9),
    Kind("images", "images", "Frames: observed, predicted, difference", width=1100),
    Kind("images", "turntable", "Videos: the twin from all sides", least=13),
    Kind("plots", "motion", "Motion of predicted nodes and observed points", width=1200, paper=True),
    Kind("plots", "stiffness", "Stiffness of the springs", width=900, paper=True, least=27),
    Kind("plots", "topology", "Regions and springs", width=900, paper=True, least=27),
    Kind("images", "appearance", "Splats in frame 0", width=900),
    Kind(PERCEPTION, "masks", "Perception: masks", width=900),
    Kind(PERCEPTION, "tracks", "Perception: tracks", width=900),
    Kind(PERCEPTION, "lifted", "Perception: points in 3D", width=900, paper=True),
)
"""In the order in which they are embedded."""


def embedded(material: ReportData, path: Path, kind: Kind) -> Picture:
    """An image or video: embedded if it fits, else with the reason why it is linked."""
    if kind.width:
        data = material.read(path, lambda path: webp(Image.open(path), kind.width))
        if data is None:
            return Picture(caption="", reason="the file is damaged")
        return Picture(caption="", data=data) if material.take(len(data)) else Picture(caption="", reason=NO_ROOM)
    if not material.take(4 * path.stat().st_size // 3, film=True):
        return Picture(caption="", film=True, reason=NO_ROOM)
    width = cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_WIDTH)
    head = min((TITLE_LINE + TIME_BAR) / max(width, 1.0), 1.0)
    return Picture(caption="", film=True, data=data_uri("video/mp4", path.read_bytes()), head=head)


def pictures(material: ReportData) -> list[Block]:
    """One fold per scenario with its videos and images; empty if no run has any."""
    folds = list[Block]()
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        if grids := list(_grids(material, scenario, runs)):
            command = shlex.join([program("neuspring"), "play", *(str(material.folder(run)) for run in runs.values())])
            seeds = ", ".join(map(str, sorted({run.seed for run in runs.values()})))
            more: list[Block] = [Fold(summary=title, blocks=[grid]) for title, grid in grids[1:]]
            images = [Fold(summary="More images", blocks=more)] if more else []
            summary = f"{scenario}: {several(len(runs), 'method')}, seed {seeds}"
            blocks: list[Block] = [grids[0][1], *images, Code(text=command)]
            folds.append(Fold(summary=summary, blocks=blocks, open=len(folds) < MOST_OPEN))
    return folds


def _grids(material: ReportData, scenario: str, runs: dict[str, RunRecord]) -> Iterator[tuple[str, Grid]]:
    """Title and grid of every kind of image or video that the runs of a scenario have."""
    folder, seen = material.output.resolve().parent, material.observations(scenario)
    training = seen.scenario.train_end / seen.scenario.frame_count if seen else 0.0
    for kind in KINDS:
        # Methods may share splats, so an image may belong to several methods.
        owners: dict[Path, list[str]] = {}
        for method, run in runs.items():
            if path := material.file(run, kind.artifact, kind.stem):
                owners.setdefault(path.resolve(), []).append(material.numbers.name(method))
        figures: list[Block] = []
        for path, methods in owners.items():
            figure, caption = embedded(material, path, kind), "" if len(owners) == 1 and len(runs) > 1 else ", ".join(methods)
            if kind.stem == "video" and not figures:
                figures.append(Picture(caption="Observed", film=True, panel=0, head=figure.head, same=True))
            target = link(path, folder) if figure.film or not figure.data else ""
            alt, panel = f"{kind.title}: {scenario}, {', '.join(methods)}", 1 if kind.stem == "video" else None
            figures.append(
                replace(figure, caption=caption, link=target, alt=alt, panel=panel, paper=kind.paper, wide=not figure.film)
            )
        film = not kind.width
        if figures:
            yield kind.title, Grid(blocks=figures, least=kind.least, films=film, training=training * film)


section = ReportSection(
    order=30,
    title="Videos",
    make=pictures,
    about="One seed per scenario. The slider is blue during training frames and orange during future frames. The command below "
    "the videos opens the twins in the browser, where you can rotate and pull them.",
    phase=1,
)
