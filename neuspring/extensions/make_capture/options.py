"""Options of `neuspring make-capture`; nothing heavy is imported, because every `--help` reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import arg
from neuspring.core.artifacts import Up


@dataclass(frozen=True, kw_only=True)
class Intake:
    """The parts of a capture: the options of `neuspring make-capture`."""

    output: Path = Path()
    """required: the capture folder to write"""
    category: str = ""
    """required, the kind of object: cloth, rope, package, or any other word"""
    name: str | None = None
    """name of the capture; that of the folder by default"""
    color: tuple[Path, ...] = ()
    """per camera: a folder of images, or a video; FILE#1 is its second track"""
    depth: tuple[Path, ...] = ()
    """per camera: a folder, or a 16-bit gray video"""
    recording: tuple[Path, ...] = ()
    """instead of color: a ROS bag, a case in PhysTwin's raw layout, or files of another format"""
    format: str | None = None
    """the format of --recording, by name; recognized by default"""
    topics: tuple[str, ...] = ()
    """of a bag: COLOR DEPTH of each camera; the only ones by default"""
    list_topics: Annotated[bool, arg(name="list")] = False
    """print the topics of a bag, and end"""
    rig: Path | None = None
    """JSON that states frame rate, unit of depth, lenses, poses and up; neuspring/extensions/make_capture/README.md has its keys"""
    pair: Literal["names", "order"] | None = None
    """images of one moment have equal frame numbers, or the same order, where these differ and there are no stamps"""
    frames: str = ""
    """what is kept, by number: 250-335 or 0-300/2"""
    shift: tuple[str, ...] = ()
    """images that a stream is late, by name: 0.depth=1 moves depth of camera 0, 1=-2 moves camera 1"""
    train_end: int | None = None
    """training frames end before this frame; the first 70 percent by default"""
    pose: Literal["lying", "standing"] | None = None
    """a camera without depth: how the object is in frame 0, which one image cannot show"""
    controllers: Path | None = None
    """hands in space: .npz or .csv, m, a row per frame of the capture; or markers of a C3D file, FILE.c3d#LABEL,LABEL"""
    nodes: Path | None = None
    """the object of frame 0: .npz or .ply, m"""
    tracks: Path | None = None
    """annotated points in space: JSON, m; or markers of a C3D file"""
    teach: bool = False
    """annotated points of training frames teach the twin; without color they always do"""
    rate: float | None = None
    """points in space without color: rows per second; a C3D file states it"""
    up: Up | None = None
    """points in space without color, required: the axis that points up"""
    plumb: bool = False
    """points in space without color: turn all so that the object hangs straight below its hands in frame 0"""
    no_table: bool = False
    """points in space without color: no table is below the object"""
    mass: float | None = None
    """mass of the object, kg, for exports; motion does not depend on it"""
    force: bool = False
    """replace the images of a capture that is there"""

    @property
    def called(self) -> str:
        """The name of the capture."""
        return self.name or self.output.resolve().name

    @property
    def brought(self) -> dict[str, Path]:
        """The files of points in space, by option."""
        return {name: path for name in ("controllers", "nodes", "tracks") if (path := getattr(self, name)) is not None}
