"""Pictures and films, methods side by side; they are made smaller, or linked where they do not fit."""

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
"""Scenarios that are not folded."""


@dataclass(frozen=True)
class Kind:
    """A picture or film that runs have, in the order in which they are embedded."""

    artifact: str
    stem: str
    title: str
    width: int = 0
    """Largest width of a picture in pixels; 0: a film."""
    paper: bool = False
    """Drawn for a white page."""
    least: int = 40
    """Least width in the page, rem."""


KINDS = (
    Kind("images", "video", "Film: observed, predicted", least=9),
    Kind("images", "images", "Frames: observed, predicted, difference", width=1100),
    Kind("images", "turntable", "Film: the twin from all around", least=13),
    Kind("plots", "motion", "Motion: predicted nodes and observed points", width=1200, paper=True),
    Kind("plots", "stiffness", "Stiffness of the springs", width=900, paper=True, least=27),
    Kind("plots", "topology", "Regions and springs", width=900, paper=True, least=27),
    Kind("images", "appearance", "Splats of frame 0", width=900),
    Kind(PERCEPTION, "masks", "Perceived: masks", width=900),
    Kind(PERCEPTION, "tracks", "Perceived: tracks", width=900),
    Kind(PERCEPTION, "lifted", "Perceived: points in space", width=900, paper=True),
)


def embedded(material: ReportData, path: Path, kind: Kind) -> Picture:
    """A picture or film, embedded while there is room, else with the reason why it is linked."""
    if kind.width:
        data = material.read(path, lambda path: webp(Image.open(path), kind.width))
        if data is None:
            return Picture(caption="", reason="damaged: not a picture")
        return Picture(caption="", data=data) if material.take(len(data)) else Picture(caption="", reason=NO_ROOM)
    if not material.take(4 * path.stat().st_size // 3, film=True):
        return Picture(caption="", film=True, reason=NO_ROOM)
    width = cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_WIDTH)
    head = min((TITLE_LINE + TIME_BAR) / max(width, 1.0), 1.0)
    return Picture(caption="", film=True, data=data_uri("video/mp4", path.read_bytes()), head=head)


def pictures(material: ReportData) -> list[Block]:
    """A fold per scenario: its films in step, and its pictures; none without any."""
    folds = list[Block]()
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        if grids := list(_grids(material, scenario, runs)):
            command = shlex.join([program("neuspring"), "play", *(str(material.folder(run)) for run in runs.values())])
            seeds = ", ".join(map(str, sorted({run.seed for run in runs.values()})))
            more: list[Block] = [Fold(summary=title, blocks=[grid]) for title, grid in grids[1:]]
            others = [Fold(summary="More pictures", blocks=more)] if more else []
            summary = f"{scenario}: {several(len(runs), 'method')}, seed {seeds}"
            blocks: list[Block] = [grids[0][1], *others, Code(text=command)]
            folds.append(Fold(summary=summary, blocks=blocks, open=len(folds) < MOST_OPEN))
    return folds


def _grids(material: ReportData, scenario: str, runs: dict[str, RunRecord]) -> Iterator[tuple[str, Grid]]:
    """Title and pictures of every kind that the runs of a scenario have."""
    folder, seen = material.output.resolve().parent, material.observations(scenario)
    training = seen.scenario.train_end / seen.scenario.frame_count if seen else 0.0
    for kind in KINDS:
        # Methods share most splats, so a picture may belong to several.
        owners: dict[Path, list[str]] = {}
        for method, run in runs.items():
            if path := material.file(run, kind.artifact, kind.stem):
                owners.setdefault(path.resolve(), []).append(material.numbers.name(method))
        figures: list[Block] = []
        for path, methods in owners.items():
            own, caption = embedded(material, path, kind), "" if len(owners) == 1 and len(runs) > 1 else ", ".join(methods)
            if kind.stem == "video" and not figures:
                figures.append(Picture(caption="Observed", film=True, panel=0, head=own.head, same=True))
            target = link(path, folder) if own.film or not own.data else ""
            alt, panel = f"{kind.title}: {scenario}, {', '.join(methods)}", 1 if kind.stem == "video" else None
            figures.append(replace(own, caption=caption, link=target, alt=alt, panel=panel, paper=kind.paper, wide=not own.film))
        film = not kind.width
        if figures:
            yield kind.title, Grid(blocks=figures, least=kind.least, films=film, training=training * film)


section = ReportSection(
    order=30,
    title="Film",
    make=pictures,
    about="All methods in step, one seed of every scenario; under the slider training is blue and the future orange. The command "
    "opens the twins in the browser, to be turned and pulled.",
    phase=1,
)
