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
    """per camera: a folder, or a 16-bit gray video; none: color alone, of one camera with --intrinsics and --poses"""
    bag: tuple[Path, ...] = ()
    """instead of color: recordings of ROS 1, ROS 2 or a RealSense camera; one may hold all cameras"""
    topics: tuple[str, ...] = ()
    """of --bag: COLOR DEPTH of each camera; the only ones by default"""
    list_topics: Annotated[bool, arg(name="list")] = False
    """print the topics of --bag and what can be read of them, and end"""
    phystwin_raw: Path | None = None
    """instead of color: a case in PhysTwin's raw layout"""
    recording: tuple[Path, ...] = ()
    """instead of color: files or folders of another format"""
    format: str | None = None
    """the format of --recording, by name; recognized by default"""
    cameras: tuple[str, ...] = ()
    """names of the cameras; 0 1 2 ... by default"""
    intrinsics: Path | None = None
    """JSON: fx, fy, cx, cy or K of each camera, and distortion"""
    depth_unit: float | None = None
    """meters per count of depth; depth_scale of --intrinsics, or guessed, by default; said"""
    rate: float | None = None
    """frames per second at which it was filmed; that of the video by default"""
    frames: str = ""
    """what is kept, by number: 250-335, 0-300/2, 1,5,9-20"""
    shift: tuple[str, ...] = ()
    """pictures that a stream is late, by name: 0.depth=1 moves depth of camera 0, 1=-2 moves camera 1"""
    train_end: int | None = None
    """training frames end before this frame; the first 70 percent by default"""
    take: tuple[str, ...] = ()
    """another meaning of lens, depth or poses, as a message names it: distance, lens_resized, inverse+opengl:0, order=2,1,0"""
    poses: Path | None = None
    """JSON: camera_to_world or world_to_camera; one camera with depth needs none: the table gives its pose"""
    board: str | None = None
    """a ChArUco board that every camera sees, SQUARES_XxSQUARES_Y:SQUARE_M:MARKER_M:DICTIONARY, like 5x7:0.04:0.03:DICT_5X5_100"""
    board_images: tuple[Path, ...] = ()
    """per camera: an image of the board, or a folder of them; the first frames by default"""
    pose: Literal["lying", "standing"] | None = None
    """color alone: how the object is in frame 0, which one picture cannot say"""
    level: bool = False
    """move the world of given poses so that the table is z = 0"""
    top_down: bool = False
    """the camera looks straight down: the plane it faces is the table"""
    table_at: tuple[float, float] | None = None
    """a pixel of the table, where another plane is larger"""
    controllers: Path | None = None
    """hands in space: .npz or .csv, m, a row per frame of the capture; or markers of a C3D file, FILE.c3d#LABEL,LABEL"""
    nodes: Path | None = None
    """the body of frame 0: .npz or .ply, m"""
    tracks: Path | None = None
    """annotated points in space: JSON, m; or markers of a C3D file"""
    teach: bool = False
    """annotated points of training frames teach the twin; without color they always do"""
    up: Up = "+z"
    """up of points in space alone"""
    no_table: bool = False
    """points in space alone: no table is below the object"""
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
        return {name: path for name in SPACE_OPTIONS if (path := getattr(self, name)) is not None}


FILM_OPTIONS = ("color", "recording", "bag", "phystwin_raw")
"""Options of which one says where the film is."""
SPACE_OPTIONS = ("controllers", "nodes", "tracks")
"""Options of files of points in space."""
