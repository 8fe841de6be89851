"""Move splats along a trajectory, draw every frame, score it, write videos."""

from __future__ import annotations

import contextlib
import itertools
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring import config
from neuspring.config import Config
from neuspring.config.images import Images
from neuspring.core.artifacts import Observations, SplatCenters, Trajectory
from neuspring.core.device import resolve_device
from neuspring.core.errors import NumericalFailure
from neuspring.core.files import write_table
from neuspring.core.records import Recorder, StageRecord
from neuspring.core.text import Progress
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception.results import masks_of_cameras
from neuspring.report.figures import images as figures
from neuspring.report.video import Video
from neuspring.scores.lpips import Lpips
from neuspring.scores.lpips_weights import configured
from neuspring.scores.pictures import Scored, picture_scores
from neuspring.splats.draw import frames_from_centers, orbit_view, prune_by_opacity, skinned_frames
from neuspring.splats.model import Gaussians, Splats
from neuspring.stages import options as shared
from neuspring.stages.lengths import require_length

VIDEOS = ("video", "turntable")


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring render`."""
    shared.add_capture(parser)
    shared.add_masks(parser)
    shared.add_observations(parser)
    shared.add_record(parser, "appearance", "appearance.json")
    shared.add_record(parser, "rollout", "rollout.json")
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring render`."""
    settings = shared.read_settings(a.settings)
    run(a.capture.parent, a.masks, a.observations, a.appearance, a.rollout, settings, a.device, a.output)


def run(
    folder: Path,
    masks_records: Sequence[Path],
    observations_path: Path,
    appearance_record: Path,
    rollout_record: Path,
    settings: Config,
    device: str,
    output: Path,
) -> None:
    """Write frames.parquet (metrics per frame and camera), images.png, videos, and the record `output`.

    A failure of an earlier stage is passed on. A trajectory that diverged is shown as far as it goes; its last frame is frozen and
    scored on, for averages over all runs.
    """
    device, images = resolve_device(device), settings.images
    inputs = {"appearance": appearance_record, "rollout": rollout_record}
    record = Recorder(
        "render",
        output,
        inputs=inputs | {"capture": folder / CAPTURE},
        settings={name: value for name, value in config.plain(images).items() if name != "appearance"},
        device=device,
    )
    appearance, rollout = StageRecord.load(appearance_record), StageRecord.load(rollout_record)
    capture, scenario = Capture.load(folder), Observations.load(observations_path).scenario
    require_length(capture, scenario.frame_count, observations_path)
    scored = Scored.of(capture, masks_of_cameras(capture, masks_records), images, device)
    weights = configured(images.lpips)
    # Their checksums have just been taken.
    lpips = weights if isinstance(weights, str) else Lpips.load(weights.backbone, weights.heads, device, trusted=True)
    if appearance.status == "failed":
        record.save(failure=appearance.reason)
        return
    trajectory = Trajectory.load(rollout.file("trajectory", rollout_record)) if "trajectory" in rollout.files else None
    if trajectory is None or not len(trajectory.positions):
        record.save(failure=rollout.reason)
        return
    try:
        splats, frames = posed(appearance_record, rollout_record, trajectory, images, device)
    except NumericalFailure as failure:
        record.save(failure=str(failure))
        return
    predicted = len(trajectory.positions)
    rows: list[dict[str, Any]] = []
    strip, film = figures.Strip(scenario, predicted), figures.Film(scenario)
    first = next(iter(scored.views))
    files = record.beside(**{role: f"{role}.mp4" for role in (VIDEOS if images.video else ())})
    progress = Progress("render", scenario.frame_count)
    with contextlib.ExitStack() as stack:
        videos = {role: stack.enter_context(Video(path, scenario.frame_rate)) for role, path in files.items()}
        for frame, gaussians in enumerate(_frozen_at_end(frames, scenario.frame_count)):
            for name in scored.views:
                if not capture.has(name, frame):
                    continue
                pair = scored.pair(name, frame, gaussians)
                scores = picture_scores(pair, lpips, unit_lpips=images.released_quirks.unit_lpips)
                rows += [{"frame": frame, "camera": name, "metric": key, "value": value} for key, value in scores.items()]
                if name == first and frame < predicted:
                    strip.add(frame, pair)
                    if videos:
                        videos["video"].add(film.compared(frame, pair))
            if videos and frame < predicted:
                angle = 360 * frame / predicted
                videos["turntable"].add(film.turned(frame, orbit_view(gaussians, scored.views[first], scored.backend, angle)))
            progress.update(frame + 1)
    table = pd.DataFrame(rows, columns=["frame", "camera", "metric", "value"])
    files |= record.beside(frames="frames.parquet", strip="images.png")
    strip.save(files["strip"])
    write_table(table, files["frames"])
    facts = {
        "backend": scored.backend,
        "masks": scored.masks_from,
        "views": list(scored.views),
        "splats": len(splats.means),
        "lpips": lpips if isinstance(lpips, str) else "computed",
        "quirks": sorted(name for name, on in config.plain(images.released_quirks).items() if on),
        "unseen_surface": appearance.facts["unseen_surface"],
        # Nothing but black on both sides: such frames have no finite PSNR.
        "empty_frames": int(np.isinf(table.loc[table["frame"] < predicted, "value"]).sum()),
    }
    record.save(files, facts, failure=rollout.reason)


def posed(
    appearance_record: Path, rollout_record: Path, trajectory: Trajectory, images: Images, device: str
) -> tuple[Splats, Iterator[Gaussians]]:
    """Splats of frame 0, and in every frame: where the method's own model puts them, else skinned to the trajectory.

    Raises NumericalFailure where no splat is opaque enough to be moved.
    """
    splats = Splats.load(StageRecord.load(appearance_record).file("splats", appearance_record))
    rollout = StageRecord.load(rollout_record)
    if "centers" not in rollout.files:
        splats = prune_by_opacity(splats, images.opacity)
        return splats, skinned_frames(splats, trajectory.positions, images, device)
    return splats, frames_from_centers(splats, SplatCenters.load(rollout.file("centers", rollout_record)).positions, device)


def _frozen_at_end(frames: Iterator[Gaussians], count: int) -> Iterator[Gaussians]:
    """`count` frames: the last one again and again where there are fewer."""
    last = None
    for last in itertools.islice(frames, count):
        count -= 1
        yield last
    if last is not None:
        yield from itertools.repeat(last, count)
