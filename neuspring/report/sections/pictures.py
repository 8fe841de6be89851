"""Pictures and films, methods side by side: in the report, made smaller or linked where they do not fit."""

from __future__ import annotations

import io
import os
import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
from PIL import Image

from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.run_record import RunRecord
from neuspring.core.text import program
from neuspring.draw.scene import chosen_frames
from neuspring.draw.sheet import TIME_BAR, TITLE_LINE
from neuspring.report.blocks import Block, Code, Fold, Grid, PageSection, Picture, Text
from neuspring.report.data import PERCEPTION, UNREADABLE, ReportData, ReportSection, data_uri, link, several

HEAD = TITLE_LINE + TIME_BAR
"""Height of what stands above the panels of a film, px."""
WEBP_QUALITY = 75
"""Quality of WebP pictures, of 100."""
MARKUP = 400
"""Characters around an embedded picture."""
NO_ROOM = "not embedded, to keep this page small"
PLAY_ADDRESS = "http://127.0.0.1:8080/"
"""Address at which `neuspring play` listens unless it is told otherwise."""
MOST_OPEN_FILMS = 3
"""Scenarios whose films are not folded."""


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
    frames: bool = False
    """Shows the frames that `frame_links` names."""
    shared: str = ""
    """Caption of a picture that methods of a scenario share; {} stands for the name of its folder."""


KINDS = (
    Kind(artifact="images", stem="video", title="Film: observed, predicted", least=9),
    Kind(artifact="images", stem="images", title="Frames: observed, predicted, difference", width=1100, frames=True),
    Kind(artifact="images", stem="turntable", title="Film: the twin from all around", least=13),
    Kind(artifact="plots", stem="motion", title="Motion: predicted nodes and observed points", width=1200, paper=True, frames=True),
    Kind(artifact="plots", stem="stiffness", title="Stiffness of the springs", width=900, paper=True, least=27),
    Kind(artifact="plots", stem="topology", title="Regions and springs", width=900, paper=True, least=27),
    Kind(artifact="images", stem="appearance", title="Splats of frame 0", width=900, shared="Observed and drawn in frame 0"),
    Kind(artifact=PERCEPTION, stem="masks", title="Perceived: masks", width=900, shared="Masks of camera {}"),
    Kind(artifact=PERCEPTION, stem="tracks", title="Perceived: tracks", width=900, shared="Tracks of camera {}"),
    Kind(artifact=PERCEPTION, stem="lifted", title="Perceived: points in space", width=900, shared="Points in space", paper=True),
)


def embed(material: ReportData, room: int, video_room: int) -> dict[Path, Picture]:
    """Every file that the section shows, embedded, or with the reason why it is linked.

    Pictures may take `room` characters, and films what they leave, up to `video_room`. Of every kind, the first method's of all
    scenarios come before the second method's.
    """
    runs = [pair for scenario in material.choice.scenarios for pair in enumerate(material.first_runs(scenario).values())]
    wanted, shown = dict[Path, Kind](), dict[Path, Picture]()
    for kind in KINDS:
        for _, run in sorted(runs, key=lambda pair: pair[0]):
            if path := material.file(run, kind.artifact, kind.stem):
                wanted.setdefault(path.resolve(), kind)
    room -= MARKUP * len(wanted)
    widths = {path: kind.width for path, kind in wanted.items() if kind.width}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for path, made in zip(widths, pool.map(_smaller, widths, widths.values()), strict=True):
            if made.reason:
                material.lost(path, made.reason)
            fits = len(made.data) <= room
            room -= len(made.data) * fits
            shown[path] = made if fits else Picture(caption="", reason=NO_ROOM)
    room = min(room, video_room)
    for path in (path for path in wanted if path not in widths):
        fits = 4 * path.stat().st_size / 3 <= room
        data = data_uri("video/mp4", path.read_bytes()) if fits else ""
        room -= len(data)
        head = HEAD / max(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_WIDTH), 1.0) if fits else 0.0
        shown[path] = Picture(caption="", film=True, data=data, head=min(head, 1.0), reason="" if fits else NO_ROOM)
    return shown


def _smaller(path: Path, width: int) -> Picture:
    """The picture, not wider than `width`, as WebP; or the reason why it cannot be read."""
    try:
        picture = Image.open(path).convert("RGB")
    except FileNotFoundError:
        return Picture(caption="", reason="no such file")
    except (OSError, SyntaxError, ValueError):
        return Picture(caption="", reason="damaged: not a picture")
    picture.thumbnail((width, 10 * width))
    stream = io.BytesIO()
    picture.save(stream, "WEBP", quality=WEBP_QUALITY)
    return Picture(caption="", data=data_uri("image/webp", stream.getvalue()), size=picture.size)


def facts_of(material: ReportData, scenario: str) -> Scenario | None:
    """Frames of a scenario; None where its observations cannot be read."""
    try:
        return Observations.load(material.results / scenario / "observations.npz").scenario
    except UNREADABLE:
        return None


def frame_links(facts: Scenario) -> tuple[tuple[str, str], ...]:
    """Text and address of each frame that pictures of motion show."""
    scenario = facts.name
    frames = sorted(chosen_frames(facts, facts.frame_count))
    return tuple((f"frame {frame}", f"{PLAY_ADDRESS}?frame={frame}&scenario={scenario}") for frame in frames)


def pictures(material: ReportData) -> PageSection:
    """A fold per scenario, with the command that shows its runs in the playground."""
    shown, folds = embed(material, material.room, int(1e6 * material.choice.video_megabytes)), list[Block]()
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        if blocks := _scenario(material, runs, shown, facts_of(material, scenario)):
            command = shlex.join([program("neuspring"), "play", *(str(material.folder(run)) for run in runs.values())])
            seeds = sorted({run.seed for run in runs.values()})
            summary = f"{scenario}: {several(len(runs), 'method')}, seed {', '.join(map(str, seeds))}"
            folds.append(Fold(summary=summary, blocks=[*blocks, Code(text=command, whole=True)], open=len(folds) < MOST_OPEN_FILMS))
    if not folds:
        return PageSection(key="pictures", title="Film", blocks=[Text(text="No run has left pictures yet.", tone="mute")])
    about = (
        "All methods in step, one seed of every scenario; under the slider training is blue and the future orange. The command "
        "opens the twins in the browser, to be turned and pulled; links to frames lead there. pictures.html has whole films."
    )
    return PageSection(key="pictures", title="Film", about=about, blocks=folds)


def _scenario(material: ReportData, runs: dict[str, RunRecord], shown: dict[Path, Picture], facts: Scenario | None) -> list[Block]:
    folder, name = material.output.resolve().parent, material.numbers.name
    grids: list[tuple[str, Grid]] = []
    frames = frame_links(facts) if facts else ()
    training = facts.train_end / facts.frame_count if facts else 0.0
    for kind in KINDS:
        # Methods share most splats, so a picture may belong to several.
        owners: dict[Path, list[str]] = {}
        for method, run in runs.items():
            if path := material.file(run, kind.artifact, kind.stem):
                owners.setdefault(path.resolve(), []).append(method)
        figures: list[Block] = []
        for path, methods in owners.items():
            run = runs[methods[0]]
            caption = ", ".join(map(name, methods))
            if kind.shared:
                caption = kind.shared.format(path.parent.name) + (f", {caption}" if len(owners) > 1 else "")
            alt = f"{kind.title}: {run.scenario}, {', '.join(methods)}, seed {run.seed}"
            own = frames if kind.frames else ()
            wide, panel = bool(kind.width), 1 if kind.stem == "video" else None
            target = "" if shown[path].data else link(path, folder)
            picture = replace(shown[path], caption=caption, alt=alt, link=target, wide=wide)
            figures.append(replace(picture, paper=kind.paper, frames=own, panel=panel))
        if figures and kind.stem == "video":
            head = max(shown[path].head for path in owners)
            figures.insert(0, Picture(caption="Observed", film=True, panel=0, head=head, same=True))
        if figures:
            film = not kind.width
            grids.append((kind.title, Grid(blocks=figures, least=kind.least, films=film, fit=film, training=training * film)))
    # The first kind that there is can be seen at once.
    folds: list[Block] = [Fold(summary=title, blocks=[grid]) for title, grid in grids[1:]]
    return [*(grid for _, grid in grids[:1]), *([Fold(summary="More pictures", blocks=folds)] if folds else [])]


section = ReportSection(order=30, make=pictures, phase=1)
