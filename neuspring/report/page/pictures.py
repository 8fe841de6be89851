"""Pictures and films of every scenario, methods side by side: inside the page, made smaller, or linked where they do not fit."""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np

from neuspring.core.artifacts import Observations
from neuspring.report.blocks import Block, Code, Fold, Grid, Picture, Section, Text, Video
from neuspring.report.draw.scene import chosen_frames
from neuspring.report.page.material import UNREADABLE, FinishedRun, ReportData, several

QUALITY = 75
"""Quality of WebP pictures, of 100."""
CHUNK = 32
"""How many pictures are made smaller at once."""
NO_ROOM = "not embedded, to keep this page small"


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A picture or video that a section would show. Those of the lowest rank are embedded first."""

    path: Path
    rank: tuple[int, ...]
    width: int = 0
    """Largest width of a picture in pixels; 0: a video."""


@dataclass(frozen=True, kw_only=True)
class Embedded:
    """A file as a data URI, and its size in pixels."""

    uri: str
    size: tuple[int, int] = (0, 0)


class Media:
    """The files that are embedded, of all that are wanted."""

    def __init__(self, output: Path, wanted: Iterable[Wanted], room: int, video_room: int) -> None:
        """Pictures may take `room` characters, and videos what they leave, up to `video_room`."""
        self._folder = output.resolve().parent
        self._embedded: dict[Path, Embedded] = {}
        self.damaged: dict[Path, str] = {}
        ordered = sorted(wanted, key=lambda one: (one.rank, one.path))
        room = self._pictures([one for one in ordered if one.width], room)
        self._videos([one for one in ordered if not one.width], min(room, video_room))

    @property
    def count(self) -> int:
        """Files that were embedded."""
        return len(self._embedded)

    def picture(
        self,
        path: Path,
        caption: str,
        alt: str,
        *,
        wide: bool = False,
        paper: bool = False,
        frames: Sequence[tuple[str, str]] = (),
    ) -> Picture:
        """A picture, or a link if it did not fit."""
        file = self._embedded.get(path)
        if file:
            return Picture(caption=caption, alt=alt, data=file.uri, size=file.size, wide=wide, paper=paper, frames=frames)
        return Picture(caption=caption, alt=alt, link=self.link(path), reason=self.damaged.get(path, NO_ROOM), frames=frames)

    def video(self, path: Path, caption: str, *, wide: bool = False) -> Video:
        """A video, or a link if it did not fit."""
        file = self._embedded.get(path)
        if file:
            return Video(caption=caption, data=file.uri, wide=wide)
        return Video(caption=caption, link=self.link(path), reason=self.damaged.get(path, NO_ROOM))

    def link(self, path: Path) -> str:
        """A link from the page to a file."""
        return link(path, self._folder)

    def _pictures(self, wanted: Sequence[Wanted], room: int) -> int:
        """Embed in order until there is no room; returns what is left."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for start in range(0, len(wanted), CHUNK):
                part = wanted[start : start + CHUNK]
                for one, smaller in zip(part, pool.map(_smaller, part), strict=True):
                    if isinstance(smaller, str):
                        self.damaged[one.path] = smaller
                    elif len(smaller.uri) <= room:
                        self._embedded[one.path] = smaller
                        room -= len(smaller.uri)
                if room < 20_000:
                    break
        return room

    def _videos(self, wanted: Sequence[Wanted], room: int) -> None:
        for one in wanted:
            try:
                if 4 * one.path.stat().st_size / 3 > room:
                    continue
                uri = _uri("video/mp4", one.path.read_bytes())
            except OSError as error:
                self.damaged[one.path] = str(error.strerror)
                continue
            self._embedded[one.path] = Embedded(uri=uri)
            room -= len(uri)


def link(path: Path, folder: Path) -> str:
    """A relative link from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def embedded_png(path: Path) -> Embedded | None:
    """A PNG file as it is; None if it is not there."""
    if not path.is_file():
        return None
    data = path.read_bytes()
    shape = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return None if shape is None else Embedded(uri=_uri("image/png", data), size=(shape.shape[1], shape.shape[0]))


def _smaller(one: Wanted) -> Embedded | str:
    """The picture, not wider than wanted, as WebP; or the reason why it cannot be read."""
    try:
        data = np.frombuffer(one.path.read_bytes(), np.uint8)
    except OSError as error:
        return str(error.strerror)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        return "damaged: not a picture"
    if picture.shape[1] > one.width:
        height = max(1, round(picture.shape[0] * one.width / picture.shape[1]))
        picture = cv2.resize(picture, (one.width, height), interpolation=cv2.INTER_AREA)
    ok, webp = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    assert ok, "a picture can be encoded"
    return Embedded(uri=_uri("image/webp", webp.tobytes()), size=(picture.shape[1], picture.shape[0]))


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


ADDRESS = "http://127.0.0.1:8080/"
"""Where `neuspring play` listens unless it is told otherwise."""


def play_command(material: ReportData, runs: Iterable[FinishedRun]) -> str:
    """What shows these runs of one scenario side by side."""
    return shlex.join(["neuspring", "play", *(str(material.results / material.relative(run.folder)) for run in runs)])


def frame_links(material: ReportData, scenario: str) -> tuple[tuple[str, str], ...]:
    """Text and address of each frame that pictures of motion show; none where the observations cannot be read."""
    path = material.results / scenario / "observations.npz"
    try:
        facts = Observations.load(path).scenario
    except UNREADABLE:
        return ()
    return tuple(
        (f"frame {frame}", f"{ADDRESS}?frame={frame}&scenario={scenario}")
        for frame in sorted(chosen_frames(facts, facts.frame_count))
    )


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A picture that runs have."""

    artifact: str
    stem: str
    title: str
    width: int
    paper: bool
    """Drawn for a white page."""
    least: int = 40
    """Least width in the page, rem."""
    frames: bool = False
    """Shows the frames that `playing.links` names."""


KINDS = (
    Kind(artifact="images", stem="images", title="Observed, predicted, difference", width=1100, paper=False, frames=True),
    Kind(
        artifact="plots",
        stem="motion",
        title="Motion: predicted nodes and observed points",
        width=1200,
        paper=True,
        frames=True,
    ),
    Kind(artifact="plots", stem="stiffness", title="Stiffness of the springs", width=900, paper=True, least=27),
    Kind(artifact="plots", stem="topology", title="Regions and springs", width=900, paper=True, least=27),
)
FILMS = {"video": ("Films: observed, predicted, difference", 40), "turntable": ("Films: the twin from all around", 13)}
"""Headings, and least widths in the page, rem."""
APPEARANCE = "appearance"


def wanted_pictures(material: ReportData) -> list[Wanted]:
    """All pictures that the section would show, the most telling first."""
    files: list[Wanted] = []
    for place, scenario in enumerate(material.choice.scenarios):
        runs = material.first_runs(scenario)
        for order, run in enumerate(runs.values()):
            paths = [(rank, run.file(kind.artifact, kind.stem), kind.width) for rank, kind in enumerate(KINDS)]
            paths += [(rank, run.file("images", film), 0) for rank, film in enumerate(FILMS)]
            files += [Wanted(path=path, rank=(rank, order, place), width=width) for rank, path, width in paths if path is not None]
        for order, path in enumerate(_splats(runs)):
            files.append(Wanted(path=path, rank=(len(KINDS), order, place), width=1000))
    return files


def pictures_section(material: ReportData, media: Media) -> Section:
    """A fold per scenario."""
    folds: list[Block] = []
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        blocks = _scenario(runs, media, frame_links(material, scenario))
        if blocks:
            blocks.append(Code(text=play_command(material, runs.values()), whole=True))
            seeds = sorted({run.seed for run in runs.values()})
            summary = f"{scenario}: {several(len(runs), 'method')}, seed {', '.join(map(str, seeds))}"
            folds.append(Fold(summary=summary, blocks=blocks, open=not folds))
    if not folds:
        return Section(key="pictures", title="Pictures", blocks=[Text(text="No run has left pictures yet.", tone="mute")])
    about = (
        "One seed of every scenario, methods side by side. Blue bars stand for training frames, orange ones for the future. The "
        "command below a scenario's pictures opens its twins in the browser, to be turned and pulled; links to frames lead there."
    )
    return Section(key="pictures", title="Pictures", about=about, blocks=folds)


def _scenario(runs: dict[str, FinishedRun], media: Media, frames: Sequence[tuple[str, str]]) -> list[Block]:
    blocks: list[Block] = []
    for kind in KINDS:
        figures: list[Block] = []
        for method, run in runs.items():
            path = run.file(kind.artifact, kind.stem)
            if path is not None:
                alt = f"{kind.title}: {run.scenario}, {method}, seed {run.seed}"
                shown = frames if kind.frames else ()
                figures.append(media.picture(path, method, alt, wide=True, paper=kind.paper, frames=shown))
        if figures:
            # The first kind that there is can be seen at once.
            blocks.append(Fold(summary=kind.title, blocks=[Grid(blocks=figures, least=kind.least)], open=not blocks))
        if kind.stem == "images":
            blocks += _filmed(runs, media)
    splats = _splats(runs)
    figures = []
    for path, methods in splats.items():
        of = f", {', '.join(methods)}" if len(splats) > 1 else ""
        alt = f"Splats of {runs[methods[0]].scenario} in frame 0{of}"
        figures.append(media.picture(path, f"Observed and drawn in frame 0{of}", alt, wide=True))
    return [*blocks, Fold(summary="Splats of frame 0", blocks=figures)] if figures else blocks


def _splats(runs: dict[str, FinishedRun]) -> dict[Path, list[str]]:
    """Picture of splats to the methods that use them: most methods share splats, some have their own."""
    methods: dict[Path, list[str]] = {}
    for method, run in runs.items():
        path = run.file("images", APPEARANCE)
        if path is not None:
            methods.setdefault(path.resolve(), []).append(method)
    return methods


def _filmed(runs: dict[str, FinishedRun], media: Media) -> list[Block]:
    blocks: list[Block] = []
    for film, (title, least) in FILMS.items():
        paths = {method: run.file("images", film) for method, run in runs.items()}
        videos: list[Block] = [
            media.video(path, method, wide=film == "video") for method, path in paths.items() if path is not None
        ]
        if videos:
            blocks.append(Fold(summary=title, blocks=[Grid(blocks=videos, least=least)], open=film == "video"))
    return blocks
