"""Pictures and films of every scenario, methods side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neuspring.report.blocks import Block, Code, Fold, Grid, Section, Text
from neuspring.report.page import playing
from neuspring.report.page.media import Media, Wanted
from neuspring.report.page.sources import Material, Run
from neuspring.report.page.words import several


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


def wanted(material: Material) -> list[Wanted]:
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


def section(material: Material, media: Media) -> Section:
    """A fold per scenario."""
    folds: list[Block] = []
    for scenario in material.choice.scenarios:
        runs = material.first_runs(scenario)
        blocks = _scenario(runs, media, playing.links(material, scenario))
        if blocks:
            blocks.append(Code(text=playing.command(material, runs.values()), whole=True))
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


def _scenario(runs: dict[str, Run], media: Media, frames: Sequence[tuple[str, str]]) -> list[Block]:
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


def _splats(runs: dict[str, Run]) -> dict[Path, list[str]]:
    """Picture of splats to the methods that use them: most methods share splats, some have their own."""
    methods: dict[Path, list[str]] = {}
    for method, run in runs.items():
        path = run.file("images", APPEARANCE)
        if path is not None:
            methods.setdefault(path.resolve(), []).append(method)
    return methods


def _filmed(runs: dict[str, Run], media: Media) -> list[Block]:
    blocks: list[Block] = []
    for film, (title, least) in FILMS.items():
        paths = {method: run.file("images", film) for method, run in runs.items()}
        videos: list[Block] = [
            media.video(path, method, wide=film == "video") for method, path in paths.items() if path is not None
        ]
        if videos:
            blocks.append(Fold(summary=title, blocks=[Grid(blocks=videos, least=least)], open=film == "video"))
    return blocks
