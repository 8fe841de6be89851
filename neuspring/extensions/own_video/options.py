"""Options of `neuspring twin`; imports nothing heavy, because every `--help` reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.config.effort import Effort


@dataclass(frozen=True, kw_only=True)
class Wish:
    """The options of `neuspring twin`."""

    film: Positional[Path]
    """folder with color/, depth/ and rig.json, bag, video file, or capture"""
    output: Path | None = None
    """folder for all results, which names the twin; twins/<name of the video> by default"""
    category: str = "object"
    """kind of object: cloth, package, rope, or any other word"""
    mass: float | None = None
    """mass of the object, kg; scales exports"""
    frames: str = ""
    """frames of the video to keep, such as 250-335"""
    intake: str = ""
    """further options of make-capture in one string: --intake="--pair order --shift 0.depth=1" """
    masks: tuple[Path, ...] = ()
    """one folder of another tool's masks per camera: 0 nothing, 1 object, 2 hands"""
    hands: tuple[Path, ...] = ()
    """one folder of masks of the hands per camera, in addition to --masks"""
    marks: Path | None = None
    """a marks.json to carry through the video; without --masks and --marks, the annotation page opens"""
    no_browser: bool = False
    """print the address of the annotation page without opening a browser"""
    window: str = ""
    """frames of the capture to learn from, such as 12-97, or all; by default those of the longest constant grasp"""
    yes: bool = False
    """do not ask questions"""
    effort: Effort = "quick"
    """sizes of search, fit and renders"""
    method: str | None = None
    """a method of config/methods.yaml; by default the last one of config/data/own.yaml"""
    cores: int | None = None
    """number of CPU cores; all by default"""
    dry_run: bool = False
    """print the commands without running them"""
    play: Annotated[bool, arg(help="open the twin in the browser at the end")] = False
