"""A twin, a prediction or a run as one figure or video, in a notebook cell or a file."""

from __future__ import annotations

import base64
import mimetypes
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from neuspring.core.artifacts import Observations, Scenario, Trajectory, Twin, Up
from neuspring.core.errors import InputError
from neuspring.core.run_folder import RunFolder
from neuspring.draw.film import write_film
from neuspring.draw.painter import DrawingStyle, Painter
from neuspring.draw.run import RUN_WIDTH, motion_figure, stiffness_figure
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.draw.sheet import save
from neuspring.draw.strip import strip_figure

PICTURE_KINDS, FILM_KINDS = (".png", ".jpg", ".svg", ".pdf"), (".gif", ".mp4")
PANELS = 5
"""Number of frames in a figure of nodes without observations."""
CELL_PIXELS, CELL_RATE, CELL_MEGABYTES = 480, 15.0, 4.0
"""Width of each panel of a video, px; largest frame rate, fps; largest file, MB."""
ALONE_RATE = 30.0
"""Frame rate, fps, of a trajectory without observations."""


@dataclass(frozen=True)
class InlinePicture:
    """A figure or video; a notebook displays it as the last value of a cell."""

    data: bytes = field(repr=False)
    """Content of the file."""
    mime: str
    """MIME type, for example image/png."""

    def _repr_html_(self) -> str:
        source = f"data:{self.mime};base64,{base64.b64encode(self.data).decode()}"
        if self.mime.startswith("video/"):
            return f'<video controls loop src="{source}"></video>'
        return f'<img src="{source}">'


def show(what: RunFolder | Twin | Trajectory, observations: Observations | None, output: Path | None, film: bool) -> InlinePicture:
    """Implementation of `neuspring.api.show`."""
    if isinstance(what, RunFolder):
        observations = what.observations if observations is None else observations
        subject = what.twin if what.trajectory is None else what.trajectory
    else:
        subject = what
    if subject is None:
        raise InputError("show", "needs a run with a prediction or a twin", str(getattr(what, "folder", what)), "Run its rollout.")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("film.gif" if film else "picture.png") if output is None else output
        kinds = FILM_KINDS if film else (*PICTURE_KINDS, *FILM_KINDS)
        if path.suffix.lower() not in kinds:
            raise InputError(path, f"must end in one of {', '.join(kinds)}", path.suffix or "no ending")
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() not in FILM_KINDS:
            save(_figure(subject, observations), path)
        elif isinstance(subject, Twin):
            raise InputError(path, "a video needs a trajectory", "a twin", "Roll it out, or write a figure (.png).")
        else:
            painter = _painter(subject, observations)
            panels = len(painter.takes) + (not painter.manner.together)
            write_film(painter, path, panels * CELL_PIXELS, megabytes=CELL_MEGABYTES)
        return InlinePicture(path.read_bytes(), mimetypes.guess_type(path.name)[0] or "application/octet-stream")


def _figure(subject: Twin | Trajectory, observations: Observations | None) -> Figure:
    if isinstance(subject, Twin):
        nodes, up = subject.topology.nodes[None], subject.simulation.up
        seen = _alone(nodes, up, subject.topology.controllers) if observations is None else observations
        return stiffness_figure(seen, ShownRun("twin", nodes, subject), None)
    if observations is not None:
        return motion_figure(observations, subject, "predicted")
    frames = np.unique(np.linspace(0, len(subject.positions) - 1, PANELS).astype(int)).tolist()
    return strip_figure(_painter(subject, None, frames), RUN_WIDTH)


def _painter(trajectory: Trajectory, observations: Observations | None, frames: Sequence[int] | None = None) -> Painter:
    """A painter of predicted nodes with the observations, or without them."""
    positions, alone = trajectory.positions, observations is None
    seen = _alone(positions) if observations is None else observations
    if len(positions) > len(seen.controller_points):
        raise InputError(
            "observations",
            f"must have at least the {len(positions)} frames of the trajectory",
            len(seen.controller_points),
            "Leave them out for other controllers.",
        )
    take = ShownRun("predicted", positions)
    frames = range(0, len(positions), max(round(seen.scenario.frame_rate / CELL_RATE), 1)) if frames is None else frames
    return Painter(ShownScene.from_side(seen, [take], frames), [take], frames, DrawingStyle(error="none", together=alone))


def _alone(positions: np.ndarray, up: Up = "+z", hands: np.ndarray | None = None) -> Observations:
    """Observations for figures: nodes [F, N, 3], m, as tracked points; `hands` [C, 3], m, if given, as constant controllers."""
    frames, none = max(len(positions), 2), np.zeros((0, 3))
    points = np.concatenate([positions, np.repeat(positions[-1:], frames - len(positions), axis=0)])
    held = points[:, :1] if hands is None else np.repeat(hands[None], frames, axis=0)
    sizes = {"frame_count": frames, "train_end": frames, "frame_rate": ALONE_RATE}
    return Observations(
        scenario=Scenario(name="alone", source="toy", category="any", up=up, **sizes),  # type: ignore[arg-type]
        object_points=points,
        object_visibility=np.ones(points.shape[:2], bool),
        object_motion_valid=np.ones(points.shape[:2], bool),
        controller_points=held,
        controller_valid=np.full(held.shape[:2], hands is not None),
        surface_points=none,
        interior_points=none,
        tracks=np.zeros((frames, 0, 3)),
    )
