"""Pictures and films, methods side by side: in the report, made smaller or linked where they do not fit; and in `pictures.html`."""

from __future__ import annotations

import base64
import io
import os
import shlex
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import pandas as pd
from PIL import Image

from neuspring.core.artifacts import Observations
from neuspring.core.files import write_text
from neuspring.core.run_record import RunRecord
from neuspring.report.blocks import Block, Code, Fold, Grid, Picture, Section, Text, Video, html_page
from neuspring.report.draw.scene import chosen_frames
from neuspring.report.sections.data import UNREADABLE, ReportData, several
from neuspring.scores.metrics import METRICS
from neuspring.scores.runs import Collected

QUALITY = 75
"""Quality of WebP pictures, of 100."""
MARKUP = 400
"""Characters around an embedded picture."""
NO_ROOM = "not embedded, to keep this page small"
ADDRESS = "http://127.0.0.1:8080/"
"""Where `neuspring play` listens unless it is told otherwise."""
GALLERY = "pictures.html"
MOST_OPEN = 3
"""Scenarios whose films are not folded."""
CAPTIONED = ("track_error", "iou")
"""Metrics in captions of the gallery."""


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


KINDS = (
    Kind(artifact="images", stem="video", title="Film: observed, predicted, difference", least=56),
    Kind(artifact="images", stem="images", title="Frames: observed, predicted, difference", width=1100, frames=True),
    Kind(artifact="images", stem="turntable", title="Film: the twin from all around", least=13),
    Kind(artifact="plots", stem="motion", title="Motion: predicted nodes and observed points", width=1200, paper=True, frames=True),
    Kind(artifact="plots", stem="stiffness", title="Stiffness of the springs", width=900, paper=True, least=27),
    Kind(artifact="plots", stem="topology", title="Regions and springs", width=900, paper=True, least=27),
    Kind(artifact="images", stem="appearance", title="Splats of frame 0", width=900),
)


class Media:
    """The files that are embedded, of all that the pictures of a report may show."""

    def __init__(self, material: ReportData, room: int, video_room: int) -> None:
        """Pictures may take `room` characters, and films what they leave, up to `video_room`.

        Of every kind, the first method's of all scenarios come before the second method's.
        """
        self._folder = material.output.resolve().parent
        self._embedded: dict[Path, Picture] = {}
        self._films: dict[Path, str] = {}
        self._damaged: dict[Path, str] = {}
        runs = [pair for scenario in material.choice.scenarios for pair in enumerate(material.first_runs(scenario).values())]
        wanted: dict[Path, Kind] = {}
        for kind in KINDS:
            for _, run in sorted(runs, key=lambda pair: pair[0]):
                if path := material.file(run, kind.artifact, kind.stem):
                    wanted.setdefault(path.resolve(), kind)
        room -= MARKUP * len(wanted)
        pictures = {path: kind for path, kind in wanted.items() if kind.width}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for path, made in zip(pictures, pool.map(_smaller, pictures, (kind.width for kind in pictures.values())), strict=True):
                if isinstance(made, str):
                    self._damaged[path] = made
                    material.lost(path, made)
                elif len(made.data) <= room:
                    self._embedded[path] = made
                    room -= len(made.data)
        room = min(room, video_room)
        for path in (path for path, kind in wanted.items() if not kind.width):
            if 4 * path.stat().st_size / 3 <= room:
                self._films[path] = _uri("video/mp4", path.read_bytes())
                room -= len(self._films[path])

    def show(self, path: Path, caption: str, alt: str, kind: Kind, frames: Sequence[tuple[str, str]]) -> Block:
        """A picture or film; a link if it did not fit."""
        place, target = path.resolve(), link(path, self._folder)
        if not kind.width:
            wide = kind.least >= 40
            if place in self._films:
                return Video(caption=caption, data=self._films[place], wide=wide)
            return Video(caption=caption, link=target, reason=NO_ROOM, wide=wide)
        if found := self._embedded.get(place):
            return Picture(caption=caption, alt=alt, data=found.data, size=found.size, wide=True, paper=kind.paper, frames=frames)
        return Picture(caption=caption, alt=alt, link=target, reason=self._damaged.get(place, NO_ROOM), frames=frames)


def link(path: Path, folder: Path) -> str:
    """A relative link from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def embedded(data: bytes, caption: str, alt: str, *, wide: bool = False) -> Picture:
    """A PNG, drawn for white paper, as a picture of the page."""
    return Picture(
        caption=caption, alt=alt, data=_uri("image/png", data), size=Image.open(io.BytesIO(data)).size, wide=wide, paper=True
    )


def _smaller(path: Path, width: int) -> Picture | str:
    """The picture, not wider than `width`, as WebP; or the reason why it cannot be read."""
    try:
        picture = Image.open(path).convert("RGB")
    except FileNotFoundError:
        return "no such file"
    except (OSError, SyntaxError, ValueError):
        return "damaged: not a picture"
    picture.thumbnail((width, 10 * width))
    stream = io.BytesIO()
    picture.save(stream, "WEBP", quality=QUALITY)
    return Picture(caption="", alt="", data=_uri("image/webp", stream.getvalue()), size=picture.size)


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def frame_links(material: ReportData, scenario: str) -> tuple[tuple[str, str], ...]:
    """Text and address of each frame that pictures of motion show; none where the observations cannot be read."""
    try:
        facts = Observations.load(material.results / scenario / "observations.npz").scenario
    except UNREADABLE:
        return ()
    frames = sorted(chosen_frames(facts, facts.frame_count))
    return tuple((f"frame {frame}", f"{ADDRESS}?frame={frame}&scenario={scenario}") for frame in frames)


def pictures_section(material: ReportData, media: Media) -> Section:
    """A fold per scenario, with the command that shows its runs in the playground."""
    folds: list[Block] = []
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        if blocks := _scenario(material, runs, media, frame_links(material, scenario)):
            command = shlex.join(["neuspring", "play", *(str(material.folder(run)) for run in runs.values())])
            seeds = sorted({run.seed for run in runs.values()})
            summary = f"{scenario}: {several(len(runs), 'method')}, seed {', '.join(map(str, seeds))}"
            folds.append(Fold(summary=summary, blocks=[*blocks, Code(text=command, whole=True)], open=len(folds) < MOST_OPEN))
    if not folds:
        return Section(key="pictures", title="Film", blocks=[Text(text="No run has left pictures yet.", tone="mute")])
    about = (
        "All methods in step, one seed of every scenario. The bar above a film is blue in training frames and orange in the "
        "future. The command below opens the twins in the browser, to be turned and pulled; links to frames lead there."
    )
    return Section(key="pictures", title="Film", about=about, blocks=folds)


def _scenario(material: ReportData, runs: dict[str, RunRecord], media: Media, frames: Sequence[tuple[str, str]]) -> list[Block]:
    blocks: list[Block] = []
    for kind in KINDS:
        # Methods share most splats, so a picture may belong to several.
        owners: dict[Path, list[str]] = {}
        for method, run in runs.items():
            if path := material.file(run, kind.artifact, kind.stem):
                owners.setdefault(path.resolve(), []).append(method)
        figures: list[Block] = []
        for path, methods in owners.items():
            run = runs[methods[0]]
            caption = ", ".join(methods)
            if kind.stem == "appearance":
                caption = "Observed and drawn in frame 0" + (f", {caption}" if len(owners) > 1 else "")
            alt = f"{kind.title}: {run.scenario}, {', '.join(methods)}, seed {run.seed}"
            figures.append(media.show(path, caption, alt, kind, frames if kind.frames else ()))
        if figures:
            grid = Grid(blocks=figures, least=kind.least, films=not kind.width)
            # The first kind that there is can be seen at once.
            blocks.append(Fold(summary=kind.title, blocks=[grid]) if blocks else grid)
    return blocks


def write_gallery(
    results: Path, scenarios: Iterable[str], methods: Sequence[str], seed: int, collected: Collected, folder: Path
) -> Path:
    """Write pictures.html into `folder`: the films of every scenario side by side, for one seed, with their scores.

    Films and pictures are linked, not embedded, so that the page works wherever the results folder is. Runs that are missing are
    left out.
    """
    sections: list[Section] = []
    for scenario in scenarios:
        place = Path(results) / scenario
        figures: list[Block] = []
        for method in methods:
            if record := collected.records.get((scenario, method, seed)):
                figures += _films(record, place / method / str(seed), collected.scores, folder)
        # First the splats of all methods, then those of methods with splats of their own.
        learned = sorted(place.glob(f"appearance*/{seed}/appearance.png"))
        splats = [Picture(caption="", alt=path.stem, data=link(path, folder)) for path in learned]
        blocks: list[Block] = [Text(text="No pictures: no images, or no finished run.")]
        if figures:
            shown: list[Block] = [Grid(blocks=figures, least=28, films=True)]
            blocks = [*shown, Fold(summary="Splats of frame 0", blocks=[Grid(blocks=splats, least=28)])] if splats else shown
        sections.append(Section(key=scenario, title=scenario, blocks=blocks))
    about = (
        "Observed, predicted and their difference, first camera; beside them the twin from all around. The bar above a film is "
        f"blue in training frames and orange in the future. Seed {seed}."
    )
    write_text(folder / GALLERY, html_page("NeuSpring: pictures", about, sections, embedded=False))
    return folder / GALLERY


def _films(record: RunRecord, run: Path, scores: pd.DataFrame, folder: Path) -> list[Block]:
    """A run's films, or its film strip where it has none, with its scores; nothing if it has no pictures."""
    paths = {path.stem: path for path in (run / name for name in record.artifacts.get("images", [])) if path.is_file()}
    own = scores[(scores["scenario"] == record.scenario) & (scores["method"] == record.method) & (scores["seed"] == record.seed)]
    values, parts = own.set_index(["task", "metric"])["value"], []
    for task, name in (("reconstruction", "training"), ("future", "future")):
        metrics = [METRICS[metric] for metric in CAPTIONED if (task, metric) in values.index]
        texts = [f"{one.heading} {one.text(values[task, one.name])} {one.shown_unit}".rstrip() for one in metrics]
        parts += [f"{name} {', '.join(texts)}"] if texts else []
    caption = f"{record.method}: {'; '.join(parts)}".removesuffix(": ")
    if "video" in paths:
        return [
            Video(caption=caption, data=link(paths["video"], folder)),
            Video(caption=f"{record.method}, from all around", data=link(paths["turntable"], folder)),
        ]
    if "images" in paths:
        alt = f"Frames of {record.scenario}, {record.method}"
        return [Picture(caption=caption, alt=alt, data=link(paths["images"], folder))]
    return []
