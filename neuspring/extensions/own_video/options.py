"""Options of `neuspring twin`; nothing heavy is imported, because every `--help` reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.config.effort import Effort


@dataclass(frozen=True, kw_only=True)
class Wish:
    """The film, and what is wanted of it: the options of `neuspring twin`."""

    film: Positional[Path]
    """a folder with color/, depth/ and rig.json; a bag; a video; or a capture"""
    output: Path | None = None
    """folder for everything, whose name is the twin's; twins/<name of the film> by default"""
    category: str = "object"
    """kind of object: cloth, rope, package, or any other word"""
    mass: float | None = None
    """mass of the object, kg, for exports"""
    frames: str = ""
    """frames of the film that are kept, like 250-335"""
    intake: str = ""
    """more options of make-capture, as one text: --intake="--pair order --shift 0.depth=1" """
    masks: tuple[Path, ...] = ()
    """per camera a folder of another tool's masks: 0 nothing, 1 object, 2 hands"""
    hands: tuple[Path, ...] = ()
    """per camera a folder of masks of the hands alone, beside --masks"""
    marks: Path | None = None
    """a marks.json, which is carried through the film; without masks and marks, annotate opens"""
    no_browser: bool = False
    """annotate prints its address, and opens no browser"""
    window: str = ""
    """frames of the capture that the twin is learned from, like 12-97, or all; by default the longest constant grip"""
    yes: bool = False
    """ask nothing"""
    effort: Effort = "quick"
    """sizes of search, fit and pictures"""
    method: str | None = None
    """row of config/methods.yaml; the last one of config/data/own.yaml by default"""
    cores: int | None = None
    """all by default"""
    dry_run: bool = False
    """print the commands, and run none"""
    play: Annotated[bool, arg(help="open the twin in the browser at the end")] = False
