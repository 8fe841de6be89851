"""The command that makes a capture: make-capture."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neuspring.data.intake.images import CameraFeed
    from neuspring.data.intake.recordings import Raw


def make_capture_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring make-capture`."""
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="the capture folder to write")
    parser.add_argument("--name", help="name of the capture (default: that of the folder)")
    parser.add_argument("--category", required=True, help="kind of object: cloth, rope, package, or any other word")
    source = parser.add_argument_group("what the cameras gave (one of the three)")
    source.add_argument(
        "--color", type=Path, nargs="+", default=[], metavar="PATH", help="per camera: a folder of images, or a video; see --depth"
    )
    depth_help = "per camera: a folder, or a 16-bit gray video; none: color alone, of one camera with --intrinsics and --poses"
    source.add_argument("--depth", type=Path, nargs="+", default=[], metavar="PATH", help=depth_help)
    source.add_argument("--bag", type=Path, nargs="+", default=[], metavar="FILE", help="per camera: a RealSense .bag file")
    source.add_argument("--phystwin-raw", type=Path, metavar="FOLDER", help="a case in PhysTwin's raw layout")
    parser.add_argument("--cameras", nargs="+", default=[], metavar="NAME", help="names of the cameras (default: 0 1 2 ...)")
    parser.add_argument("--intrinsics", type=Path, metavar="JSON", help="fx, fy, cx, cy or K of each camera, and distortion")
    parser.add_argument("--depth-unit", type=float, metavar="M", help="meters per count of depth (default: guessed, and said)")
    parser.add_argument("--rate", type=float, metavar="HZ", help="frames per second at which it was filmed (default: of the video)")
    parser.add_argument("--frames", default="", metavar="RANGES", help="what is kept, by number: 250-335, 0-300/2, 1,5,9-20")
    parser.add_argument("--train-end", type=int, metavar="FRAME", help="training frames end before it (default: the first 70 %%)")
    world = parser.add_argument_group("where the cameras are (one camera with depth needs none of these: the table gives its pose)")
    world.add_argument("--poses", type=Path, metavar="JSON", help="camera_to_world or world_to_camera matrices")
    form = "SQUARES_XxSQUARES_Y:SQUARE_M:MARKER_M:DICTIONARY"
    world.add_argument("--board", metavar=form, help="a ChArUco board that every camera sees, like 5x7:0.04:0.03:DICT_5X5_100")
    board_help = "per camera: an image of the board, or a folder of them (default: the first frames)"
    world.add_argument("--board-images", type=Path, nargs="+", default=[], metavar="PATH", help=board_help)
    world.add_argument("--level", action="store_true", help="move the world of given poses so that the table is z = 0")
    world.add_argument("--top-down", action="store_true", help="the camera looks straight down: the plane it faces is the table")
    world.add_argument(
        "--table-at", type=float, nargs=2, metavar=("X", "Y"), help="a pixel of the table, where another plane is larger"
    )
    parser.add_argument("--force", action="store_true", help="replace the images of a capture that is there")


def make_capture(a: Namespace) -> int:
    """`neuspring make-capture`: print what was found, and the next command."""
    from neuspring.data.intake.lenses import Board
    from neuspring.data.intake.make import Intake, make_capture

    views, raw = _views(a)
    intake = Intake(
        folder=a.output,
        name=a.name or a.output.resolve().name,
        category=a.category,
        views=views,
        rate=a.rate if a.rate is not None or raw is None else raw.rate,
        frames=a.frames,
        depth_unit=a.depth_unit,
        intrinsics=a.intrinsics,
        poses=a.poses,
        board=Board.of(a.board) if a.board else None,
        board_images=a.board_images,
        level=a.level,
        top_down=a.top_down,
        table_at=tuple(a.table_at) if a.table_at else None,
        train_end=a.train_end,
        raw=raw,
        force=a.force,
    )
    capture, report = make_capture(intake)
    print("\n".join(report))
    print(f"written: {capture.folder}\nnext:")
    print(f"  neuspring check-data {capture.folder}")
    if not capture.description.masks:
        print(f"  neuspring annotate {capture.folder}")
    return 0


def _views(a: Namespace) -> tuple[list[CameraFeed], Raw | None]:
    """The cameras of the one source that is given. Raises InputError."""
    from neuspring.core.errors import InputError
    from neuspring.data.intake.images import pairs
    from neuspring.data.intake.recordings import Bag, Raw

    given = [name for name, value in (("--color", a.color), ("--bag", a.bag), ("--phystwin-raw", a.phystwin_raw)) if value]
    if len(given) != 1:
        raise InputError(
            "make-capture", "one of --color with --depth, --bag, --phystwin-raw is required", " ".join(given) or "none"
        )
    if a.phystwin_raw:
        raw = Raw.open(a.phystwin_raw)
        return raw.views, raw
    if a.bag:
        names = a.cameras or [str(k) for k in range(len(a.bag))]
        if len(set(names)) != len(a.bag):
            raise InputError("--cameras", f"{len(a.bag)} different names are required", " ".join(names))
        return [Bag(name, path) for name, path in zip(names, a.bag, strict=True)], None
    return pairs(a.color, a.depth, a.cameras), None
