"""Stage `render`: move splats along a trajectory, render and score every frame, write videos."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neuspring.config import Config
from neuspring.core.artifacts import Observations, SplatCenters, Trajectory
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import CAPTURE, Capture
from neuspring.stages.stage import MayFail, Rows, Written, paths, require_length, stage

if TYPE_CHECKING:
    from neuspring.splats.model import Gaussians, Splats

RENDERED_VIDEOS = ("video", "turntable")


def _weights(rows: Rows) -> str:
    """Whether the optional weights of LPIPS are available."""
    from neuspring.scores.lpips import find_weights

    return "absent" if isinstance(find_weights(), str) else "found"


@stage(
    output="{scenario}/{method}/{seed}/render.json",
    rule="run",
    reads=("images.backend", "images.views", "images.video"),
    gpu=True,
    memory_mb=8000,
    minutes=120,
    when=lambda rows: rows.images,
    stamp=_weights,
)
def render(
    capture: Capture,
    masks: Sequence[Before],
    observations: Observations,
    appearance: Before,
    rollout: MayFail,
    settings: Config,
    run: Recorder,
    device: str = "auto",
) -> Written:
    """Splats and trajectory -> rendered images, scored: frames.parquet (metrics per frame and camera), images.png, videos.

    Figures and videos of a diverged trajectory end at its last frame. Scores repeat that frame to the end, so that averages over
    all runs include it.
    """
    import numpy as np
    import pandas as pd

    from neuspring.core.files import write_table
    from neuspring.core.text import Progress
    from neuspring.data.results import masks_of_cameras
    from neuspring.draw import images as figures
    from neuspring.draw.scene import chosen_frames
    from neuspring.draw.video import Video
    from neuspring.scores.lpips import Lpips
    from neuspring.scores.pictures import Scored, picture_scores
    from neuspring.splats.draw import orbit_view

    images, scenario = settings.images, observations.scenario
    require_length(capture, observations)
    scored = Scored.of(capture, masks_of_cameras(capture, paths(masks)), images, device)
    lpips = Lpips.cached(device)
    trajectory = Trajectory.load(rollout.file("trajectory")) if rollout.has("trajectory") else None
    if trajectory is None or not len(trajectory.positions):
        raise NumericalFailure(rollout.record.reason)
    splats, frames = posed(appearance, rollout, trajectory, device)
    predicted = len(trajectory.positions)
    rows: list[dict[str, Any]] = []
    shown, pairs = chosen_frames(scenario, predicted), {}
    first = next(iter(scored.views))
    files = run.beside(**{role: f"{role}.mp4" for role in (RENDERED_VIDEOS if images.video else ())})
    progress = Progress("render", scenario.frame_count)
    with contextlib.ExitStack() as stack:
        videos = {role: stack.enter_context(Video(path, scenario.frame_rate)) for role, path in files.items()}
        for frame, gaussians in enumerate(_frozen_at_end(frames, scenario.frame_count)):
            for name in scored.views:
                if not capture.shows(name, frame):
                    continue
                pair = scored.pair(name, frame, gaussians)
                scores = picture_scores(pair, lpips)
                rows += [{"frame": frame, "camera": name, "metric": key, "value": value} for key, value in scores.items()]
                if name == first and frame < predicted:
                    if frame in shown:
                        pairs[frame] = pair
                    if videos:
                        videos["video"].add(figures.film_frame(scenario, frame, figures.panels(pair)))
            if videos and frame < predicted:
                twin = orbit_view(gaussians, scored.views[first], scored.backend, 360 * frame / predicted)
                videos["turntable"].add(figures.film_frame(scenario, frame, {"twin": twin}))
            progress.update(frame + 1)
    table = pd.DataFrame(rows, columns=["frame", "camera", "metric", "value"])
    files |= run.beside(frames="frames.parquet", strip="images.png")
    figures.pairs_figure(shown, pairs, files["strip"])
    write_table(table, files["frames"])
    facts = {
        "backend": scored.backend,
        "masks": scored.masks_from,
        "views": list(scored.views),
        "splats": len(splats.means),
        "lpips": lpips if isinstance(lpips, str) else "computed",
        "unseen_surface": appearance.record.facts["unseen_surface"],
        # Frames in which both images are black have no finite PSNR.
        "empty_frames": int(np.isinf(table.loc[table["frame"] < predicted, "value"]).sum()),
    }
    return Written(files=files, facts=facts, failure=rollout.record.reason)


def posed(appearance: Before, rollout: Before, trajectory: Trajectory, device: str) -> tuple[Splats, Iterator[Gaussians]]:
    """Splats of frame 0 and of every frame: predicted by the method's own model, or skinned to the trajectory.

    Raises NumericalFailure if no splat is opaque enough to be skinned.
    """
    from neuspring.splats.draw import frames_from_centers, prune_by_opacity, skinned_frames
    from neuspring.splats.model import Splats

    splats = Splats.load(appearance.file("splats"))
    if not rollout.has("centers"):
        splats = prune_by_opacity(splats)
        return splats, skinned_frames(splats, trajectory.positions, device)
    return splats, frames_from_centers(splats, SplatCenters.load(rollout.file("centers")).positions, device)


def _frozen_at_end(frames: Iterator[Gaussians], count: int) -> Iterator[Gaussians]:
    """Yield `count` frames; missing frames repeat the last one."""
    last = None
    for last in itertools.islice(frames, count):
        count -= 1
        yield last
    if last is not None:
        yield from itertools.repeat(last, count)


def draw_frames(
    folder: Path,
    appearance: Before,
    rollout: Before,
    camera: str,
    frames: Sequence[int] | None,
    background: Literal["black", "white"],
    settings: Config,
    device: str,
    output: Path,
) -> list[Path]:
    """Render frames of a prediction (default: all) from one camera as RGBA images <frame>.png, five digits, in folder `output`.

    Raises InputError for an unknown camera or frame, and for an empty trajectory.
    """
    from neuspring.core.device import resolve_device
    from neuspring.data.frames import write_png
    from neuspring.splats.draw import BLACK, WHITE, picture, view_of
    from neuspring.splats.rasterize import choose_backend

    device, images, capture = resolve_device(device), settings.images, Capture.load(folder)
    if camera not in capture.cameras:
        raise InputError("--camera", f"must be a camera of {folder / CAPTURE}: {', '.join(capture.cameras)}", camera)
    trajectory = Trajectory.load(rollout.file("trajectory"))
    count = len(trajectory.positions)
    wanted = range(count) if frames is None else frames
    beyond = [frame for frame in wanted if not 0 <= frame < count]
    if beyond or not count:
        raise InputError("--frames", f"the trajectory has the frames 0 to {count - 1}", beyond)
    _, frames_of_splats = posed(appearance, rollout, trajectory, device)
    view, backend = view_of(capture.cameras[camera], device), choose_backend(images.backend, device)
    made = []
    for frame, gaussians in enumerate(frames_of_splats):
        if frame in wanted:
            made.append(output / f"{frame:05d}.png")
            write_png(made[-1], picture(gaussians, view, backend, WHITE if background == "white" else BLACK))
    return made
