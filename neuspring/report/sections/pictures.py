"""Pictures and films, methods side by side; they are made smaller, or linked where they do not fit."""

from __future__ import annotations

import io
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
from PIL import Image

from neuspring.core.artifacts import Observations
from neuspring.core.run_record import RunRecord
from neuspring.core.text import program
from neuspring.draw.sheet import TIME_BAR, TITLE_LINE
from neuspring.report.blocks import Block, Code, Fold, Grid, PageSection, Picture
from neuspring.report.data import PERCEPTION, ReportData, ReportSection, data_uri, link
from neuspring.report.tables import several

MARKUP = 400
"""Characters around an embedded picture."""
NO_ROOM = "not embedded, to keep this page small"
MOST_OPEN = 3
"""Scenarios that are not folded."""


@dataclass(frozen=True, kw_only=True)
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
    Kind(artifact="images", stem="video", title="Film: observed, predicted", least=9),
    Kind(artifact="images", stem="images", title="Frames: observed, predicted, difference", width=1100),
    Kind(artifact="images", stem="turntable", title="Film: the twin from all around", least=13),
    Kind(artifact="plots", stem="motion", title="Motion: predicted nodes and observed points", width=1200, paper=True),
    Kind(artifact="plots", stem="stiffness", title="Stiffness of the springs", width=900, paper=True, least=27),
    Kind(artifact="plots", stem="topology", title="Regions and springs", width=900, paper=True, least=27),
    Kind(artifact="images", stem="appearance", title="Splats of frame 0", width=900),
    Kind(artifact=PERCEPTION, stem="masks", title="Perceived: masks", width=900),
    Kind(artifact=PERCEPTION, stem="tracks", title="Perceived: tracks", width=900),
    Kind(artifact=PERCEPTION, stem="lifted", title="Perceived: points in space", width=900, paper=True),
)


def webp(picture: Image.Image, width: int) -> str:
    """Data URI of a picture, not wider than `width`."""
    picture, stream = picture.convert("RGB"), io.BytesIO()
    picture.thumbnail((width, 10 * width))
    picture.save(stream, "WEBP", quality=75)
    return data_uri("image/webp", stream.getvalue())


def embed(material: ReportData, video_room: int) -> dict[Path, Picture]:
    """Every file that the section shows, embedded, or with the reason why it is linked.

    Films may take what pictures leave of the room, up to `video_room` characters. Of every kind, the files of the first method
    in all scenarios come first.
    """
    runs = [pair for scenario in material.choice.scenarios for pair in enumerate(material.first_runs(scenario).values())]
    wanted, shown = dict[Path, Kind](), dict[Path, Picture]()
    for kind in KINDS:
        for _, run in sorted(runs, key=lambda pair: pair[0]):
            if path := material.file(run, kind.artifact, kind.stem):
                wanted.setdefault(path.resolve(), kind)
    room = material.room - MARKUP * len(wanted)
    for path, kind in sorted(wanted.items(), key=lambda pair: not pair[1].width):
        if kind.width:
            data, head = material.read(path, lambda path, width=kind.width: webp(Image.open(path), width)), 0.0  # type: ignore[misc]
        else:
            room = min(room, video_room)
            fits = 4 * path.stat().st_size / 3 <= room
            data = data_uri("video/mp4", path.read_bytes()) if fits else " " * (room + 1)
            head = (TITLE_LINE + TIME_BAR) / max(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_WIDTH), 1.0)
        if data is None:
            shown[path] = Picture(caption="", reason="damaged: not a picture")
        elif len(data) > room:
            shown[path] = Picture(caption="", reason=NO_ROOM)
        else:
            room -= len(data)
            video_room -= len(data) * (not kind.width)
            shown[path] = Picture(caption="", film=not kind.width, data=data, head=min(head, 1.0))
    return shown


def pictures(material: ReportData) -> PageSection | None:
    """A fold per scenario, with the command that shows its runs in the playground; None where no run has pictures."""
    shown, folds = embed(material, int(1e6 * material.choice.video_megabytes)), list[Block]()
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        if grids := list(_grids(material, runs, shown)):
            command = shlex.join([program("neuspring"), "play", *(str(material.folder(run)) for run in runs.values())])
            seeds = ", ".join(map(str, sorted({run.seed for run in runs.values()})))
            more: list[Block] = [Fold(summary=title, blocks=[grid]) for title, grid in grids[1:]]
            blocks: list[Block] = [
                grids[0][1],
                *([Fold(summary="More pictures", blocks=more)] if more else []),
                Code(text=command, whole=True),
            ]
            summary = f"{scenario}: {several(len(runs), 'method')}, seed {seeds}"
            folds.append(Fold(summary=summary, blocks=blocks, open=len(folds) < MOST_OPEN))
    about = (
        "All methods in step, one seed of every scenario; under the slider training is blue and the future orange. The command "
        "opens the twins in the browser, to be turned and pulled."
    )
    return PageSection(key="pictures", title="Film", about=about, blocks=folds) if folds else None


def _grids(material: ReportData, runs: dict[str, RunRecord], shown: dict[Path, Picture]) -> Iterator[tuple[str, Grid]]:
    """Title and pictures of every kind that the runs of a scenario have."""
    folder = material.output.resolve().parent
    for kind in KINDS:
        # Methods share most splats, so a picture may belong to several.
        owners: dict[Path, list[str]] = {}
        for method, run in runs.items():
            if path := material.file(run, kind.artifact, kind.stem):
                owners.setdefault(path.resolve(), []).append(material.numbers.name(method))
        if not owners:
            continue
        film, scenario = not kind.width, next(iter(runs.values())).scenario
        figures: list[Block] = []
        for path, methods in owners.items():
            caption = "" if len(owners) == 1 and len(runs) > 1 else ", ".join(methods)
            alt, panel = f"{kind.title}: {scenario}, {', '.join(methods)}", 1 if kind.stem == "video" else None
            target = link(path, folder) if film or not shown[path].data else ""
            own = replace(shown[path], caption=caption, alt=alt, link=target, wide=not film, paper=kind.paper, panel=panel)
            figures.append(own)
        if kind.stem == "video":
            head = max(shown[path].head for path in owners)
            figures.insert(0, Picture(caption="Observed", film=True, panel=0, head=head, same=True))
        yield kind.title, Grid(blocks=figures, least=kind.least, films=film, training=_training(material, scenario) * film)


def _training(material: ReportData, scenario: str) -> float:
    """Share of the frames that is training; 0 where the observations cannot be read."""
    seen = material.read(material.results / scenario / "observations.npz", Observations.load)
    return seen.scenario.train_end / seen.scenario.frame_count if seen else 0.0


section = ReportSection(order=30, make=pictures, phase=1)
