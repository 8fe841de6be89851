"""Splats and trajectory -> RGBA pictures of any camera: a tool, no rule of the workflow."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from neuspring.config import Config
from neuspring.core.artifacts import Trajectory
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.data.capture import CAPTURE, Capture
from neuspring.splats.draw import BLACK, WHITE, picture, save_picture, view_of
from neuspring.splats.rasterize import choose_backend
from neuspring.stages import options as shared
from neuspring.stages.render import posed


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring draw`."""
    shared.add_capture(parser)
    shared.add_record(parser, "appearance", "appearance.json")
    shared.add_record(parser, "rollout", "rollout.json")
    parser.add_argument("--camera", required=True)
    parser.add_argument("--frames", type=int, nargs="+", help="all by default")
    parser.add_argument("--background", choices=("black", "white"), default="black")
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser, "folder to write to")


def command(a: Namespace) -> None:
    """`neuspring draw`."""
    settings = shared.read_settings(a.settings)
    pictures = run(a.capture.parent, a.appearance, a.rollout, a.camera, a.frames, a.background, settings, a.device, a.output)
    print(f"{len(pictures)} pictures: {a.output}")


def run(
    folder: Path,
    appearance_record: Path,
    rollout_record: Path,
    camera: str,
    frames: Sequence[int] | None,
    background: Literal["black", "white"],
    settings: Config,
    device: str,
    output: Path,
) -> list[Path]:
    """RGBA pictures <frame>.png (five digits) of a prediction, seen by one camera, in the folder `output`; all frames by default.

    Raises InputError for a camera or frame that is not there, and where there is nothing to draw.
    """
    device, images, capture = resolve_device(device), settings.images, Capture.load(folder)
    if camera not in capture.cameras:
        raise InputError("--camera", f"must be a camera of {folder / CAPTURE}: {', '.join(capture.cameras)}", camera)
    rollout = StageRecord.load(rollout_record)
    trajectory = Trajectory.load(rollout.file("trajectory", rollout_record))
    count = len(trajectory.positions)
    wanted = range(count) if frames is None else frames
    beyond = [frame for frame in wanted if not 0 <= frame < count]
    if beyond or not count:
        raise InputError("--frames", f"the trajectory has the frames 0 to {count - 1}", beyond)
    _, frames_of_splats = posed(appearance_record, rollout_record, trajectory, images, device)
    view, backend = view_of(capture.cameras[camera], images, device), choose_backend(images.backend, device)
    made = []
    for frame, gaussians in enumerate(frames_of_splats):
        if frame in wanted:
            made.append(output / f"{frame:05d}.png")
            save_picture(made[-1], picture(gaussians, view, backend, WHITE if background == "white" else BLACK))
    return made
