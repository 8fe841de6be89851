"""Commands on data: check-data, make-capture, cut-capture, mask, compare-masks, annotate."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from neuspring.cli.options import Device, Positional, Settings, arg, read_settings
from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable


SHOWN = 5
"""How many doubtful frames are named per camera."""
BOARD = "SQUARES_XxSQUARES_Y:SQUARE_M:MARKER_M:DICTIONARY"


def check_data(folder: Positional[Path]) -> int:
    """Report how a data folder departs from the expected layout; exit status 2 where it cannot be used."""
    from neuspring.data.check import check_layout, render

    findings = check_layout(folder)
    print(render(findings))
    return 2 if any(finding.level == "error" for finding in findings) else 0


def make_capture(
    output: Annotated[Path, arg(help="the capture folder to write")],
    category: Annotated[str, arg(help="kind of object: cloth, rope, package, or any other word")],
    name: Annotated[str | None, arg(help="name of the capture; that of the folder by default")] = None,
    color: Annotated[tuple[Path, ...], arg(help="per camera: a folder of images, or a video; FILE#1 is its second track")] = (),
    depth: Annotated[
        tuple[Path, ...],
        arg(help="per camera: a folder, or a 16-bit gray video; none: color alone, of one camera with --intrinsics and --poses"),
    ] = (),
    bag: Annotated[tuple[Path, ...], arg(help="instead of color: per camera a RealSense .bag file")] = (),
    phystwin_raw: Annotated[Path | None, arg(help="instead of color: a case in PhysTwin's raw layout")] = None,
    cameras: Annotated[tuple[str, ...], arg(help="names of the cameras; 0 1 2 ... by default")] = (),
    intrinsics: Annotated[Path | None, arg(help="JSON: fx, fy, cx, cy or K of each camera, and distortion")] = None,
    depth_unit: Annotated[float | None, arg(help="meters per count of depth; guessed by default, and said")] = None,
    rate: Annotated[float | None, arg(help="frames per second at which it was filmed; that of the video by default")] = None,
    frames: Annotated[str, arg(help="what is kept, by number: 250-335, 0-300/2, 1,5,9-20")] = "",
    train_end: Annotated[int | None, arg(help="training frames end before this frame; the first 70 percent by default")] = None,
    poses: Annotated[
        Path | None,
        arg(help="JSON: camera_to_world or world_to_camera; one camera with depth needs none: the table gives its pose"),
    ] = None,
    board: Annotated[
        str | None, arg(metavar=BOARD, help="a ChArUco board that every camera sees, like 5x7:0.04:0.03:DICT_5X5_100")
    ] = None,
    board_images: Annotated[
        tuple[Path, ...], arg(help="per camera: an image of the board, or a folder of them; the first frames by default")
    ] = (),
    pose: Annotated[
        Literal["lying", "standing"] | None, arg(help="color alone: how the object is in frame 0, which one picture cannot say")
    ] = None,
    level: Annotated[bool, arg(help="move the world of given poses so that the table is z = 0")] = False,
    top_down: Annotated[bool, arg(help="the camera looks straight down: the plane it faces is the table")] = False,
    table_at: Annotated[tuple[float, float] | None, arg(help="a pixel of the table, where another plane is larger")] = None,
    controllers: Annotated[Path | None, arg(help="hands in space: .npz or .csv, m, a row per frame of the capture")] = None,
    nodes: Annotated[Path | None, arg(help="the body of frame 0: .npz or .ply, m")] = None,
    tracks: Annotated[Path | None, arg(help="annotated points in space: JSON, m")] = None,
    teach: Annotated[bool, arg(help="annotated points of training frames teach the twin; without color they always do")] = False,
    up: Annotated[Literal["+z", "-z"], arg(help="up of points in space alone")] = "+z",
    no_table: Annotated[bool, arg(help="points in space alone: no table is below the object")] = False,
    force: Annotated[bool, arg(help="replace the images of a capture that is there")] = False,
) -> None:
    """Color and depth of a camera, or points in space -> a capture folder. What was found is printed, and the next command."""
    from neuspring.data.intake.feeds import Bag, CameraFeed, Raw, pairs
    from neuspring.data.intake.lenses import Board
    from neuspring.data.intake.make import Intake, make_capture

    given = [option for option, value in (("--color", color), ("--bag", bag), ("--phystwin-raw", phystwin_raw)) if value]
    if len(given) != 1 and (given or not controllers):
        rule = "one of --color with --depth, --bag, --phystwin-raw is required, or --controllers with --nodes and --tracks"
        raise InputError("make-capture", rule, " ".join(given) or "none")
    raw = Raw.open(phystwin_raw) if phystwin_raw else None
    views: Sequence[CameraFeed]
    if raw:
        views = raw.views
    elif bag:
        names = cameras or tuple(str(k) for k in range(len(bag)))
        if len(set(names)) != len(bag):
            raise InputError("--cameras", f"{len(bag)} different names are required", " ".join(names))
        views = [Bag(camera, path) for camera, path in zip(names, bag, strict=True)]
    else:
        views = pairs(color, depth, cameras) if color else ()
    intake = Intake(
        folder=output,
        name=name or output.resolve().name,
        category=category,
        views=views,
        rate=rate if rate is not None or raw is None else raw.rate,
        frames=frames,
        depth_unit=depth_unit,
        intrinsics=intrinsics,
        poses=poses,
        board=Board.of(board) if board else None,
        board_images=board_images,
        level=level,
        top_down=top_down,
        table_at=table_at,
        train_end=train_end,
        pose=pose,
        controllers=controllers,
        nodes=nodes,
        tracks=tracks,
        teach=teach,
        up=up,
        no_table=no_table,
        raw=raw,
        force=force,
    )
    capture, report = make_capture(intake)
    print("\n".join(report))
    print(f"written: {capture.folder}\nnext:")
    print(f"  neuspring check-data {capture.folder}")
    if capture.cameras and not capture.description.masks:
        print(f"  neuspring annotate {capture.folder}")
    if not capture.cameras:
        run = "snakemake --profile workflow/profiles/default --cores 2 --configfile config/data/points.yaml"
        where = capture.folder.resolve()
        print(f"  {run} --config data_root={where.parent} 'scenarios=[{where.name}]'")


def cut_capture(
    capture: Annotated[Positional[Path], arg(help="capture folder")],
    frames: Annotated[str, arg(help="first and last frame that are kept, like 12-97")],
    output: Annotated[Path, arg(help="the capture folder to write")],
) -> None:
    """Some frames of a capture, with their masks and tracks -> another capture; marks stay behind."""
    from neuspring.data.capture import Capture
    from neuspring.data.intake.cut import cut

    first, _, last = frames.partition("-")
    if not (first.isdigit() and last.isdigit()):
        raise InputError("--frames", "a first and a last frame are required, as in 12-97", frames)
    made = cut(Capture.load(capture), int(first), int(last), output)
    print(f"written: {made.folder}, {made.frame_count} frames\nnext:\n  neuspring check-data {made.folder}")


def mask(
    capture: Annotated[Positional[Path], arg(help="capture folder")],
    marks: Annotated[Path | None, arg(help="marks of object and hands; marks.json of the capture by default")] = None,
    backend: Annotated[Literal["marks", "sam2"], arg(help="sam2 needs its weights")] = "marks",
    cameras: Annotated[tuple[str, ...], arg(help="all that have marks by default")] = (),
    again: Annotated[bool, arg(help="also where marks, images and settings are unchanged")] = False,
    masks: Annotated[
        tuple[Path, ...], arg(help="instead of marks: per camera a folder of another tool's masks, 0 nothing, 1 object, 2 hands")
    ] = (),
    hands: Annotated[tuple[Path, ...], arg(help="per camera a folder of masks of the hands; all but 0 counts in both")] = (),
    settings: Settings = "{}",
    device: Device = "auto",
) -> None:
    """Marks on a few frames, or masks of other tools -> masks of object and hands in every frame of a capture."""
    from neuspring.data.capture import Capture
    from neuspring.data.checks.masks import mask_facts
    from neuspring.perception import segment_sam2
    from neuspring.perception.findings import look_at_masks
    from neuspring.perception.marks import store
    from neuspring.perception.marks.carry import carry_camera
    from neuspring.perception.marks.marks import MARKS, Marks

    read, path = Capture.load(capture), marks or capture / MARKS
    if masks or hands:
        named = cameras or tuple(read.cameras)
        if len(masks) != len(named) or len(hands) not in (0, len(named)):
            rule = f"a folder is required for each of the cameras {' '.join(named)}; --cameras chooses some"
            raise InputError("--masks, --hands", rule, f"{len(masks)} and {len(hands)}")
        for name, folder, held in zip(named, masks, hands or [None] * len(named), strict=True):
            read.require_camera(name)
            print(f"camera {name}: masks are in {store.import_masks(read, name, folder, held)}")
        print(f"next:\n  neuspring check-data {capture}")
        return
    marked = Marks.load(path)
    marked.require(read, path)
    segmentation = read_settings(settings).perception.segment
    own = segmentation.marks if backend == "marks" else segmentation.grounded_sam2
    wanted = cameras or tuple(name for name in read.cameras if marked.of(name))
    for name in wanted:
        read.require_camera(name)
        if not marked.of(name):
            raise InputError(f"{path}, cameras", f"camera {name} needs marks", sorted(marked.cameras))
    if not wanted:
        raise InputError(f"{path}, cameras", "a camera of the capture needs marks", sorted(marked.cameras))
    made = store.MasksFile.of(read)
    for name in wanted:
        source = store.source_digest(read, name, marked.of(name), backend, own)
        if made.holds(read, name, source) and not again:
            doubts = made.cameras[name].doubt
            told = "marks, images and settings are unchanged; its masks are kept"
        else:
            if backend == "sam2":
                from neuspring.core.device import resolve_device

                carried = segment_sam2.carry(read, name, marked.of(name), segmentation.grounded_sam2, resolve_device(device))
            else:
                bar = _bar(f"camera {name}")
                carried = carry_camera(read, name, marked.of(name), segmentation.marks, progress=bar)
            doubts = store.save_carried(read, name, carried, source, backend).doubt
            for finding in look_at_masks(read, name, carried.labels, mask_facts(read, name, carried.labels)):
                print(finding)
            told = f"masks are in {capture / 'mask' / name}"
        print(f"camera {name}: {told}; look at {store.sheet_of(read, name)}")
        worst = sorted(range(len(doubts)), key=lambda frame: -doubts[frame])[:SHOWN]
        print(f"camera {name}: most doubtful frames: " + ", ".join(f"{frame} ({doubts[frame]:.2f})" for frame in worst))
    without = [name for name in read.cameras if not store.has_masks(read, [name])]
    if without:
        print(f"cameras without masks: {', '.join(without)}; {read.folder / 'capture.json'} says masks: true when all have some")


def _bar(name: str) -> Callable[[int, int], None]:
    """A line that shows how far the work is: on a terminal it is drawn over and over, elsewhere it is written ten times."""
    began, live, told = time.perf_counter(), sys.stderr.isatty(), [-1]

    def show(done: int, total: int) -> None:
        tenth = 10 * done // max(total, 1)
        if live or tenth != told[0]:
            told[0] = tenth
            left = (time.perf_counter() - began) / max(done, 1) * (total - done)
            line = f"{name}: {'#' * (2 * tenth):<20} {100 * done // max(total, 1):3d} %, {left:.0f} s left"
            print(f"\r{line:<70}" if live else line, end="" if live and done < total else "\n", file=sys.stderr, flush=True)

    return show


def compare_masks(
    masks: Annotated[Positional[Path], arg(help="folder of masks, <frame>.png")],
    truth: Annotated[Positional[Path], arg(help="folder of masks to compare with; its frames count")],
) -> None:
    """Two folders of masks -> their overlap per frame."""
    from neuspring.perception.marks.store import compare, table

    print(table(compare(masks, truth)), end="")
