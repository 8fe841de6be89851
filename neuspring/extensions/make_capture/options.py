"""Options of `neuspring make-capture`; every `--help` imports this module, so it imports only light modules."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import arg
from neuspring.core.artifacts import Up


@dataclass(frozen=True, kw_only=True)
class Intake:
    """The options of `neuspring make-capture`."""

    output: Path = Path()
    """required: the capture folder to write"""
    category: str = ""
    """required: the kind of object, such as cloth, rope, package or plush"""
    name: str | None = None
    """name of the capture; default: the name of the folder"""
    color: tuple[Path, ...] = ()
    """per camera: a folder of images or a video; FILE#1 is its second track"""
    depth: tuple[Path, ...] = ()
    """per camera: a folder of images or a 16-bit gray video"""
    recording: tuple[Path, ...] = ()
    """instead of --color: a ROS bag, a case in PhysTwin's raw layout, or files of another format"""
    format: str | None = None
    """name of the format of --recording; default: recognized"""
    topics: tuple[str, ...] = ()
    """of a bag: COLOR DEPTH for each camera; default: the only color and depth topics"""
    list_topics: Annotated[bool, arg(name="list")] = False
    """print the topics of a bag and exit"""
    rig: Path | None = None
    """JSON file with frame rate, depth unit, lenses, poses and up; keys: neuspring/extensions/make_capture/README.md"""
    pair: Literal["names", "order"] | None = None
    """without stamps, pair images by equal frame numbers (names) or by order"""
    frames: str = ""
    """frames to keep, by number: 250-335 or 0-300/2"""
    shift: tuple[str, ...] = ()
    """number of images by which a stream is late: 0.depth=1 shifts depth of camera 0, 1=-2 shifts camera 1"""
    train_end: int | None = None
    """training frames end before this frame; default: the first 70 percent"""
    pose: Literal["lying", "standing"] | None = None
    """without depth: pose of the object in frame 0, which one image does not determine"""
    controllers: Path | None = None
    """controllers in space: .npz or .csv, m, one row per frame; or markers of a C3D file, FILE.c3d#LABEL,LABEL"""
    nodes: Path | None = None
    """nodes of the object in frame 0: .npz or .ply, m"""
    tracks: Path | None = None
    """annotated points in space: JSON, m; or markers of a C3D file"""
    teach: bool = False
    """use annotated points of training frames in the fit; always on without color"""
    rate: float | None = None
    """points in space without color: rows per second; C3D files contain it"""
    up: Up | None = None
    """points in space without color, required: the axis that points up"""
    plumb: bool = False
    """points in space without color: rotate all points so that the object hangs vertically below its hands in frame 0"""
    no_table: bool = False
    """points in space without color: there is no table below the object"""
    mass: float | None = None
    """mass of the object, kg, for exports; motion does not depend on it"""
    force: bool = False
    """replace the images of an existing capture"""

    @property
    def called(self) -> str:
        """The name of the capture."""
        return self.name or self.output.resolve().name

    @property
    def brought(self) -> dict[str, Path]:
        """The given files with points in space, by option."""
        return {name: path for name in ("controllers", "nodes", "tracks") if (path := getattr(self, name)) is not None}
