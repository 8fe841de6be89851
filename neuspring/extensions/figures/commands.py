"""The commands `draw strip`, `twin`, `film` and `frames`; their code is imported when they run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import Device, Settings, arg, read_settings
from neuspring.extensions.figures.options import FilmOptions, StripOptions, TwinOptions


def draw_frames(
    capture: Annotated[Path, arg(help="capture.json")],
    appearance: Annotated[Path, arg(help="appearance.json")],
    rollout: Annotated[Path, arg(help="rollout.json")],
    camera: str,
    output: Annotated[Path, arg(help="folder for the images")],
    frames: Annotated[tuple[int, ...], arg(help="all by default")] = (),
    background: Literal["black", "white"] = "black",
    settings: Settings = "{}",
    device: Device = "auto",
) -> None:
    """Render splats with a trajectory from any camera -> RGBA images."""
    from neuspring.core.records import Before
    from neuspring.stages.render import draw_frames

    records, chosen = (Before.load(appearance), Before.load(rollout)), read_settings(settings)
    made = draw_frames(capture.parent, *records, camera, frames or None, background, chosen, device, output)
    print(f"Wrote {len(made)} images to {output}")


def draw_strip(picture: StripOptions) -> None:
    """Draw observed frames on top, each method's prediction and error below -> PDF or PNG."""
    from neuspring.extensions.figures import drawing

    drawing.strip(picture)


def draw_film(picture: FilmOptions) -> None:
    """Draw a video of observed and predicted frames, side by side -> MP4 or GIF of limited size."""
    from neuspring.extensions.figures import drawing

    drawing.film(picture)


def draw_twin(picture: TwinOptions) -> None:
    """Draw stiffness and regions of twins from any side -> PDF or PNG."""
    from neuspring.extensions.figures import drawing

    drawing.twin(picture)
