"""The steps of appearance: splats from frame 0 of a capture, and every frame drawn as a twin predicts it, scored and filmed.

Each reads artefacts, computes, writes artefacts, pictures and a record, like the steps in `stages`.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
import trimesh
from scipy.spatial import cKDTree

from neuspring import config
from neuspring.config import Config
from neuspring.config.images import Images
from neuspring.core.artifacts import Observations, SplatCentres, Trajectory
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_table
from neuspring.core.progress import Progress
from neuspring.core.records import StageRecord, Stopwatch, digest_file
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.perception.lift import clean_masks, lifting_cameras
from neuspring.perception.results import LiftedTracks, Masks, ShapePrior, masks_of_cameras
from neuspring.report.figures import images as figures_images
from neuspring.report.video import Video
from neuspring.scores import images as image_metrics
from neuspring.scores.lpips import Lpips
from neuspring.scores.lpips_weights import configured
from neuspring.scores.pictures import Scored, picture_scores
from neuspring.splats.alpha import points_within
from neuspring.splats.densify import REFERENCE_WIDTH
from neuspring.splats.draw import BLACK, COVERED, WHITE, moved, picture, placed, save_picture, turned, view_of
from neuspring.splats.losses import Shot
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterise import choose_backend
from neuspring.splats.train import NEAREST, first_splats, restricted, train

VIDEOS = ("video", "turntable")
NEAR_SEEN = 1.5
"""Widths of a pixel: points of the shape prior this near to a seen one add nothing."""
ALPHA, ALPHA_POINTS, GREY = 0.03, 10_000, 0.5
"""Of `start: alpha`: m, how many points, their shade, as in the public adaptation of Spring-Gaus."""
OWN_SETTINGS = ("backend", "appearance")
"""Keys of `images` that training uses, beside the quirk `corner_pixels`."""


def learn(
    folder: Path,
    masks: Sequence[Path],
    settings: Config,
    seed: int,
    device: str,
    output: Path,
    *,
    lifted_record: Path | None = None,
    observations_path: Path | None = None,
) -> None:
    """Frame 0 of a capture -> splats.ply, history.parquet, appearance.png, appearance.json.

    The first splats lie on the points that perception lifted and its shape prior (`lifted_record`), or, of processed data, on the
    lifted masks and the surface points of `observations_path`. A failure to train is recorded.
    """
    clock, device, images = Stopwatch(), resolve_device(device), settings.images
    capture = Capture.load(folder)
    loaded = masks_of_cameras(capture, masks)
    backend = choose_backend(images.backend, device)
    shots = _shots(capture, loaded, images, device)
    width = float(np.nanmedian([shot.pixel_width for shot in shots]))
    seen = _seen_points(capture, loaded, settings, seed, width, lifted_record, observations_path)
    _require_outside(capture, np.concatenate([seen.cloud, seen.prior]))
    chosen_start = images.appearance.start
    plain = config.plain(settings)
    read = {"capture": folder / CAPTURE, **{f"masks{k}": path for k, path in enumerate(masks)}}
    read |= {"lift": lifted_record} if lifted_record else {}
    read |= {"observations": observations_path} if observations_path else {}
    common: dict[str, Any] = {
        "inputs": {name: digest_file(path) for name, path in read.items()},
        "settings": {name: plain["images"][name] for name in OWN_SETTINGS}
        | {"corner_pixels": images.released_quirks.corner_pixels, "seed": seed}
        | ({} if lifted_record else {"lift": plain["perception"]["lift"]}),
        "device": device,
    }
    try:
        points, colours = seen.first(chosen_start, seed)
        trained = train(first_splats(points, colours, images.appearance, width), shots, images.appearance, seed, backend)
    except NumericalFailure as failure:
        clock.stage("appearance", "failed", reason=str(failure), **common).save(output)
        return
    paths = {name: output.with_name(file) for name, file in (("splats", "splats.ply"), ("history", "history.parquet"))}
    trained.splats.save(paths["splats"])
    write_table(pd.DataFrame(trained.history).melt("step", var_name="metric", value_name="value"), paths["history"])
    gaussians = Gaussians.of(trained.splats, device)
    drawn = {shot.name: picture(gaussians, shot.view, backend) for shot in shots}
    around = {angle: turned(gaussians, shots[0].view, backend, angle) for angle in (90, 180, 270)}
    paths["picture"] = figures_images.appearance_figure(shots, drawn, around, output.with_name("appearance.png"))
    behind = {shot.name: _behind_hands(shot, drawn[shot.name]) for shot in shots}
    facts: dict[str, Any] = {
        "splats": len(trained.splats.means),
        "first_splats": trained.first,
        "start": "seen: no shape prior" if chosen_start == "shape_prior" and not seen.has_prior else chosen_start,
        "iterations": images.appearance.iterations,
        "loss": trained.history["loss"][-1],
        "backend": backend,
        "cameras": [shot.name for shot in shots],
        "unseen_surface": seen.hidden,
        **{f"psnr_{shot.name}": _quality(shot, drawn[shot.name]) for shot in shots},
        **{f"behind_hands_{name}": share for name, share in behind.items()},
    }
    unseen = "a part that is unknown without a shape prior" if seen.hidden is None else f"{seen.hidden:.0%} of the surface"
    hands = ", ".join(f"camera {name} {share:.0%}" for name, share in behind.items())
    print(f"{facts['splats']} splats; frame 0 hides {unseen}; of the picture behind hands: {hands}", flush=True)
    clock.stage("appearance", "ok", paths, facts=facts, **common).save(output)


def render(
    folder: Path,
    masks: Sequence[Path],
    observations_path: Path,
    appearance_record: Path,
    rollout_record: Path,
    settings: Config,
    device: str,
    output: Path,
) -> None:
    """Splats moved as a trajectory says -> frames.parquet (metrics per frame and camera), images.png, videos, render.json.

    A stage that failed before is passed on; a trajectory that diverged is shown as far as it goes; its last frame is held and
    scored on, for averages over all runs.
    """
    clock, device, images = Stopwatch(), resolve_device(device), settings.images
    before = {"appearance": StageRecord.load(appearance_record), "rollout": StageRecord.load(rollout_record)}
    paths = {"appearance": appearance_record, "rollout": rollout_record, "capture": folder / CAPTURE}
    common: dict[str, Any] = {
        "inputs": {name: digest_file(path) for name, path in paths.items()},
        "settings": {name: value for name, value in config.plain(images).items() if name != "appearance"},
        "device": device,
    }

    def failed(reason: str) -> None:
        clock.stage("render", "failed", reason=reason, **common).save(output)

    capture, scenario = Capture.load(folder), Observations.load(observations_path).scenario
    _require_length(capture, scenario.frame_count, observations_path)
    scored = Scored.of(capture, masks_of_cameras(capture, masks), images, device)
    weights = configured(images.lpips)
    # Their checksums have just been taken.
    metric = weights if isinstance(weights, str) else Lpips.load(weights.backbone, weights.heads, device, trusted=True)
    rollout, learned = before["rollout"], before["appearance"]
    if learned.status == "failed":
        return failed(learned.reason)
    trajectory = Trajectory.load(rollout.file("trajectory", rollout_record)) if "trajectory" in rollout.files else None
    if trajectory is None or not len(trajectory.positions):
        return failed(rollout.reason)
    drawn = len(trajectory.positions)
    try:
        splats, posed = _posed(appearance_record, rollout_record, trajectory, images, device)
    except NumericalFailure as failure:
        return failed(str(failure))
    rows: list[dict[str, Any]] = []
    strip = figures_images.Strip(scenario, drawn)
    film, first = figures_images.Film(scenario), next(iter(scored.views))
    files = {role: output.with_name(f"{role}.mp4") for role in (VIDEOS if images.video else ())}
    progress = Progress("render", scenario.frame_count)
    with contextlib.ExitStack() as stack:
        videos = {role: stack.enter_context(Video(path, scenario.frame_rate)) for role, path in files.items()}
        for frame, gaussians in enumerate(_held(posed, scenario.frame_count)):
            for name in scored.views:
                if not capture.has(name, frame):
                    continue
                pair = scored.pair(name, frame, gaussians)
                found = picture_scores(pair, metric, unit_lpips=images.released_quirks.unit_lpips)
                rows += [{"frame": frame, "camera": name, "metric": key, "value": value} for key, value in found.items()]
                if name == first and frame < drawn:
                    strip.add(frame, pair)
                    if videos:
                        videos["video"].add(film.compared(frame, pair))
            if videos and frame < drawn:
                angle = 360 * frame / drawn
                videos["turntable"].add(film.turned(frame, turned(gaussians, scored.views[first], scored.backend, angle)))
            progress.update(frame + 1)
    table = pd.DataFrame(rows, columns=["frame", "camera", "metric", "value"])
    files |= {"frames": output.with_name("frames.parquet"), "strip": strip.save(output.with_name("images.png"))}
    write_table(table, files["frames"])
    facts = {
        "backend": scored.backend,
        "masks": scored.masks_from,
        "views": list(scored.views),
        "splats": len(splats.means),
        "lpips": metric if isinstance(metric, str) else "computed",
        "quirks": sorted(name for name, on in config.plain(images.released_quirks).items() if on),
        "unseen_surface": learned.facts["unseen_surface"],
        # Nothing but black on both sides: such frames have no finite PSNR.
        "empty_frames": int(np.isinf(table.loc[table["frame"] < drawn, "value"]).sum()),
    }
    clock.stage("render", rollout.status, files, reason=rollout.reason, facts=facts, **common).save(output)


def draw(
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
    _, posed = _posed(appearance_record, rollout_record, trajectory, images, device)
    view, backend = view_of(capture.cameras[camera], images, device), choose_backend(images.backend, device)
    made = []
    for frame, gaussians in enumerate(posed):
        if frame in wanted:
            made.append(output / f"{frame:05d}.png")
            save_picture(made[-1], picture(gaussians, view, backend, WHITE if background == "white" else BLACK))
    return made


def _posed(
    appearance_record: Path, rollout_record: Path, trajectory: Trajectory, images: Images, device: str
) -> tuple[Splats, Iterator[Gaussians]]:
    """Splats of frame 0, and in every frame: where the method's own model puts them, else skinned to the trajectory.

    Raises NumericalFailure where no splat is opaque enough to be moved.
    """
    splats = Splats.load(StageRecord.load(appearance_record).file("splats", appearance_record))
    rollout = StageRecord.load(rollout_record)
    if "centres" not in rollout.files:
        splats = restricted(splats, images.opacity)
        return splats, moved(splats, trajectory.positions, images, device)
    return splats, placed(splats, SplatCentres.load(rollout.file("centres", rollout_record)).positions, device)


def _held(frames: Iterator[Gaussians], count: int) -> Iterator[Gaussians]:
    """`count` frames: the last one again and again where there are fewer."""
    last = None
    for last in itertools.islice(frames, count):
        count -= 1
        yield last
    if last is not None:
        yield from itertools.repeat(last, count)


def _shots(capture: Capture, masks: Mapping[str, Masks], images: Images, device: str) -> list[Shot]:
    """Views of frame 0 to train on; a camera that does not show the object is left out, and said."""
    shots = []
    for name, camera in capture.cameras.items():
        labels = masks[name].labels[0]
        margin = images.appearance.hand_margin * camera.width / REFERENCE_WIDTH
        seen = (capture.colour(name, 0), labels == OBJECT, labels == HANDS, capture.depth(name, 0))
        shot = Shot.of(name, view_of(camera, images, device), *seen, margin)
        if shot is None:
            print(f"camera {name}: the object is not in view in frame 0; it does not train the appearance", flush=True)
        else:
            shots.append(shot)
    if not shots:
        rule = "at least one camera must have the object in view in frame 0, away from hands"
        raise InputError(f"{capture.folder}, masks of frame 0", rule, "empty masks", "Look at perception/<camera>/masks.png.")
    return shots


@dataclass(frozen=True)
class _Seen:
    """What is known of the object's surface in frame 0."""

    cloud: np.ndarray
    """[P, 3] m, seen."""
    colours: np.ndarray
    """[P, 3] RGB."""
    prior: np.ndarray
    """[Q, 3] m, on the surface that a shape prior guesses."""
    reach: float
    """m: points of the prior this near to a seen one add nothing."""
    uniform: bool
    """Whether the prior's points are uniform over its surface, so that their share is one of area."""

    def first(self, start: Literal["seen", "shape_prior", "alpha"], seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Where splats begin, [R, 3] m, and their RGB [R, 3]. Raises NumericalFailure for a flat `alpha`."""
        if start == "alpha":
            points = points_within(self.cloud, ALPHA, ALPHA_POINTS, seed)
            return points, np.full_like(points, GREY)
        distance, nearest = self._to_cloud
        if start == "shape_prior" and self.has_prior:
            return self.prior, self.colours[nearest]
        # What was seen, and where nothing was the prior, in the colours of what is nearest.
        new = distance > self.reach
        return np.concatenate([self.cloud, self.prior[new]]), np.concatenate([self.colours, self.colours[nearest[new]]])

    @property
    def has_prior(self) -> bool:
        """Whether there are points enough of a prior for splats to begin with."""
        return len(self.prior) > NEAREST

    @property
    def hidden(self) -> float | None:
        """Part of the surface that no camera saw; None where no prior says what the whole is."""
        if not (self.uniform and len(self.prior)):
            return None
        return float((self._to_cloud[0] > self.reach).mean())

    @cached_property
    def _to_cloud(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance, m, and index of the nearest seen point of each point of the prior [Q]."""
        distance, nearest = cKDTree(self.cloud).query(self.prior)
        return distance, nearest


def _seen_points(
    capture: Capture,
    masks: Mapping[str, Masks],
    settings: Config,
    seed: int,
    width: float,
    lifted_record: Path | None,
    observations_path: Path | None,
) -> _Seen:
    """From perception's record, or from masks and processed observations; `width`, m, is a pixel's at the object."""
    if lifted_record is not None:
        record = StageRecord.load(lifted_record)
        lifted = LiftedTracks.load(record.file("lifted", lifted_record))
        prior = ShapePrior.load(record.file("shape", lifted_record))
        apart = max(settings.images.appearance.spacing, 1.0) * width
        return _Seen(lifted.cloud, lifted.cloud_colours, _surface_points(prior, apart, seed), NEAR_SEEN * width, True)
    if observations_path is None:
        raise InputError("--lifted, --observations", "one of the two is required", "neither")
    observations = Observations.load(observations_path)
    _require_length(capture, observations.scenario.frame_count, observations_path)
    chosen = settings.perception.lift
    _, cloud, colours = clean_masks(capture, lifting_cameras(capture, chosen), masks, chosen, frames=1)
    if not len(cloud):
        remedy = "perception.lift has depth_range, neighbourhood and outlier_neighbours."
        raise InputError(capture.folder, "the object's masks of frame 0 must hold pixels with usable depth", "none", remedy)
    return _Seen(cloud, colours, observations.surface_points, NEAR_SEEN * width, False)


def _surface_points(prior: ShapePrior, apart: float, seed: int) -> np.ndarray:
    """Random points [Q, 3] on the prior's surface, one per square of side `apart`, m."""
    if not len(prior.faces):
        return np.zeros((0, 3))
    mesh = trimesh.Trimesh(prior.vertices, prior.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, max(int(mesh.area / apart**2), 1), seed=seed)
    return np.asarray(points)


def _behind_hands(shot: Shot, drawn: np.ndarray) -> float:
    """Part of the splats' picture that hands cover."""
    cover = drawn[..., 3] >= COVERED
    return float((cover & (shot.known.cpu().numpy() == 0)).sum() / max(cover.sum(), 1))


def _quality(shot: Shot, drawn: np.ndarray) -> float:
    """PSNR of a training view, dB."""
    splats = torch.tensor(drawn[..., :3].astype(np.float32) / 255) * shot.known.cpu()[..., None]
    return float(image_metrics.psnr(splats.permute(2, 0, 1), shot.colour.cpu().permute(2, 0, 1)))


def _require_outside(capture: Capture, points: np.ndarray) -> None:
    """A camera within the object's box sees nothing that could be right."""
    low, high = points.min(axis=0), points.max(axis=0)
    for name, camera in capture.cameras.items():
        centre = camera.camera_to_world[:3, 3]
        if ((centre > low) & (centre < high)).all():
            rule = f"cameras.{name}.camera_to_world: the camera must stand outside the object"
            remedy = "Poses are camera-to-world, metres; an inverted or unscaled one puts the camera elsewhere."
            raise InputError(capture.folder / CAPTURE, rule, np.round(centre, 3).tolist(), remedy)


def _require_length(capture: Capture, frames: int, observations_path: Path) -> None:
    if capture.frame_count != frames:
        rule = f"must have as many frames as {observations_path}: {frames}"
        remedy = "Correct the data, or set images.enabled: false to go without pictures."
        raise InputError(capture.folder / CAPTURE, rule, capture.frame_count, remedy)
