"""The steps of appearance: splats from frame 0 of a capture, and every frame drawn as a twin predicts it, scored and filmed.

Each reads artefacts, computes, writes artefacts, pictures and a record, like the steps in `stages`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring import config, figures_images, image_metrics
from neuspring.artifacts import Observations, Trajectory, write_atomically
from neuspring.config import Config
from neuspring.config_images import Images
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Camera, Capture
from neuspring.errors import InputError, NumericalFailure
from neuspring.lpips import Lpips, find_weights
from neuspring.perception.lift import clean_masks, lifting_cameras
from neuspring.perception.results import LiftedTracks, Masks, ShapePrior
from neuspring.physics.solver import resolve_device
from neuspring.progress import Progress
from neuspring.records import StageRecord, Stopwatch, digest_file
from neuspring.splats.densify import REFERENCE_WIDTH
from neuspring.splats.losses import Shot
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterise import Backend, choose_backend
from neuspring.splats.skinning import Skin
from neuspring.splats.train import first_splats, in_sight, restricted, train
from neuspring.splats.view import View
from neuspring.video import Video

VIDEOS = ("video", "turntable")
COVERED = 128
"""Of 255: a pixel that splats cover by half counts as object."""
NEAR_SEEN = 1.5
"""Widths of a pixel: points of the shape prior this near to a seen one add nothing."""
BEHIND = 3.0
"""Widths of a pixel by which a splat may lie behind what a view shows and still count as seen."""


def learn(
    folder: Path,
    masks: Sequence[Path],
    observations_path: Path,
    lifted_record: Path | None,
    settings: Config,
    seed: int,
    device: str,
    output: Path,
) -> None:
    """Frame 0 of a capture -> splats.ply, history.parquet, appearance.png, appearance.json.

    The first splats lie on the points that perception lifted and its shape prior; without its record (processed data), on the
    lifted masks and the observations' surface points. A failure to train (no finite loss) is recorded.
    """
    clock, device, images = Stopwatch(), resolve_device(device), settings.images
    capture = Capture.load(folder)
    loaded = _masks(capture, masks)
    backend = choose_backend(images.backend, device)
    seen = _seen_points(capture, loaded, observations_path, lifted_record, settings, seed)
    _require_outside(capture, np.concatenate([seen.cloud, seen.prior]))
    shots = _shots(capture, loaded, images, device)
    points, colours = seen.first()
    common: dict[str, Any] = {
        "inputs": {"capture": digest_file(folder / CAPTURE), "observations": digest_file(observations_path)},
        "settings": {"appearance": config.plain(images.appearance), "seed": seed},
        "device": device,
    }
    try:
        trained = train(first_splats(points, colours, images.appearance, seen.width), shots, images.appearance, seed, backend)
        splats = restricted(trained.splats, images.opacity)
    except NumericalFailure as failure:
        clock.stage("appearance", "failed", reason=str(failure), **common).save(output)
        return
    paths = {name: output.with_name(file) for name, file in (("splats", "splats.ply"), ("history", "history.parquet"))}
    trained.splats.save(paths["splats"])
    history = pd.DataFrame(trained.history).melt("step", var_name="metric", value_name="value")
    write_atomically(paths["history"], lambda temporary: history.to_parquet(temporary, index=False))
    gaussians = Gaussians.of(splats, device)
    drawn = {shot.name: _picture(gaussians, shot.view, backend) for shot in shots}
    around = {angle: _turned(gaussians, shots[0].view, backend, angle) for angle in (90, 180, 270)}
    paths["picture"] = figures_images.appearance_figure(shots, drawn, around, output.with_name("appearance.png"))
    facts = {
        "splats": len(trained.splats.means),
        "kept": len(splats.means),
        "first_splats": trained.first,
        "iterations": images.appearance.iterations,
        "loss": trained.history["loss"][-1],
        "backend": backend,
        "cameras": [shot.name for shot in shots],
        **_seen_facts(gaussians, shots, drawn, backend, BEHIND * seen.width),
    }
    hands = ", ".join(f"camera {shot.name} {facts[f'behind_hands_{shot.name}']:.0%}" for shot in shots)
    hidden = f"frame 0 hides {facts['hidden_splats']:.0%} of the splats from all cameras; behind hands: {hands}"
    print(f"{len(splats.means)} splats; {hidden}", flush=True)
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

    A stage that failed before is passed on; a trajectory that diverged is drawn as far as it goes.
    """
    clock, device, images = Stopwatch(), resolve_device(device), settings.images
    before = {"appearance": StageRecord.load(appearance_record), "rollout": StageRecord.load(rollout_record)}
    paths = {"appearance": appearance_record, "rollout": rollout_record}
    common: dict[str, Any] = {
        "inputs": {name: digest_file(path) for name, path in paths.items()} | {"capture": digest_file(folder / CAPTURE)},
        "settings": {"images": {name: value for name, value in config.plain(images).items() if name != "appearance"}},
        "device": device,
    }
    rollout = before["rollout"]
    trajectory = Trajectory.load(rollout.file("trajectory", rollout_record)) if "trajectory" in rollout.files else None
    broken = next((record for record in before.values() if record.status == "failed"), None)
    if before["appearance"].status == "failed" or trajectory is None or not len(trajectory.positions):
        assert broken is not None
        clock.stage("render", "failed", reason=broken.reason, **common).save(output)
        return
    capture, scenario = Capture.load(folder), Observations.load(observations_path).scenario
    scene = _Scene.of(capture, _masks(capture, masks), images, device)
    splats = restricted(Splats.load(before["appearance"].file("splats", appearance_record)), images.opacity)
    weights = find_weights(*(Path(path) if path else None for path in (images.lpips.backbone, images.lpips.heads)))
    metric = weights if isinstance(weights, str) else Lpips.load(weights.backbone, weights.heads, device)
    rows: list[dict[str, Any]] = []
    film, first = figures_images.Film(scenario), scene.scored[0]
    files = {role: output.with_name(f"{role}.mp4") for role in (VIDEOS if images.video else ())}
    strip = figures_images.Strip(scenario, len(trajectory.positions))
    progress = Progress("render", len(trajectory.positions))
    with contextlib.ExitStack() as stack:
        videos = {role: stack.enter_context(Video(path, capture.description.frame_rate)) for role, path in files.items()}
        for frame, gaussians in enumerate(_moved(splats, trajectory.positions, images, device)):
            for name in scene.scored:
                if not capture.has(name, frame):
                    continue
                pair = scene.pair(name, frame, gaussians)
                found = _scores(pair, metric, images.released_quirks.unit_lpips)
                rows += [{"frame": frame, "camera": name, "metric": key, "value": value} for key, value in found.items()]
                if name == first:
                    strip.add(frame, pair)
                    if videos:
                        videos["video"].add(film.compared(frame, pair))
            if videos:
                angle = 360 * frame / len(trajectory.positions)
                videos["turntable"].add(film.turned(frame, _turned(gaussians, scene.views[first], scene.backend, angle)))
            progress.update(frame + 1)
    table = pd.DataFrame(rows, columns=["frame", "camera", "metric", "value"])
    files |= {"frames": output.with_name("frames.parquet"), "strip": strip.save(output.with_name("images.png"))}
    write_atomically(files["frames"], lambda temporary: table.to_parquet(temporary, index=False))
    facts = {
        "backend": scene.backend,
        "masks": scene.masks_from,
        "views": list(scene.scored),
        "splats": len(splats.means),
        "lpips": metric if isinstance(metric, str) else "computed",
        "hidden_splats": before["appearance"].facts["hidden_splats"],
        "quirks": sorted(name for name, on in config.plain(images.released_quirks).items() if on),
    }
    reason = broken.reason if broken else ""
    clock.stage("render", "failed" if broken else "ok", files, reason=reason, facts=facts, **common).save(output)


@dataclass(frozen=True, eq=False)
class _Scene:
    """What pictures are compared with."""

    capture: Capture
    masks: Mapping[str, np.ndarray]
    masks_from: str
    views: Mapping[str, View]
    scored: tuple[str, ...]
    backend: Backend
    covered: int
    """Least coverage, of 255, that counts as object."""

    @classmethod
    def of(cls, capture: Capture, perceived: Mapping[str, Masks], images: Images, device: str) -> _Scene:
        names = tuple(capture.cameras)[: 1 if images.views == "first" else None]
        quirks, cameras = images.released_quirks, list(capture.cameras.values())
        if quirks.second_camera_intrinsics and len(cameras) < 2:
            rule = "images.released_quirks.second_camera_intrinsics needs a second camera"
            raise InputError(capture.folder / CAPTURE, rule, f"{len(cameras)} camera")
        views = {
            name: _view(capture.cameras[name], images, device, cameras[1] if quirks.second_camera_intrinsics else None)
            for name in names
        }
        # Scores should not depend on the segmentation under test, where the capture comes with masks of its own.
        own = capture.description.masks
        labels = {name: np.zeros((0,)) if own else perceived[name].labels for name in names}
        source = "given" if own else next(iter(perceived.values())).backend
        covered = 1 if quirks.any_alpha else COVERED
        return cls(capture, labels, source, views, names, choose_backend(images.backend, device), covered)

    def labels(self, name: str, frame: int) -> np.ndarray:
        """[H, W] uint8, as `Capture.mask`."""
        return self.capture.mask(name, frame) if self.masks_from == "given" else self.masks[name][frame]

    def pair(self, name: str, frame: int, gaussians: Gaussians) -> figures_images.Pair:
        """Observed and predicted picture of one camera in one frame."""
        labels = self.labels(name, frame)
        mask, hands = (np.where(labels == label, 255, 0).astype(np.uint8) for label in (OBJECT, HANDS))
        colour = self.capture.colour(name, frame)
        rendered = _picture(gaussians, self.views[name], self.backend)
        truth, prediction = image_metrics.masked_pair(colour, mask, rendered, hands)
        silhouettes = image_metrics.silhouettes(mask, rendered, hands, self.covered)
        return figures_images.Pair(colour, rendered, truth, prediction, silhouettes, hands > 0)


def _scores(pair: figures_images.Pair, lpips: Lpips | str, unit_lpips: bool) -> dict[str, float]:
    """PSNR, SSIM, IoU and, where its weights are there, LPIPS."""
    truth, prediction = pair.truth, pair.prediction
    found = {
        "psnr": float(image_metrics.psnr(prediction, truth)),
        "ssim": float(image_metrics.ssim(prediction, truth)),
        "iou": image_metrics.iou(*pair.silhouettes),
    }
    return found if isinstance(lpips, str) else found | {"lpips": float(lpips(prediction, truth, released_range=unit_lpips))}


def _moved(splats: Splats, positions: np.ndarray, images: Images, device: str) -> Iterator[Gaussians]:
    """The splats in every frame of a trajectory [F, N, 3], m."""
    start = Gaussians.of(splats, device)
    quirk = images.released_quirks.degenerate_skinning
    skin = Skin(positions[0], device=device, frozen=images.frozen_skinning, released_degeneracy=quirk)
    for means, quaternions in skin.carry(positions, start.means, start.quaternions):
        yield Gaussians(means, quaternions, start.log_scales, start.opacity_logits, start.harmonics)


@torch.no_grad()
def _picture(
    gaussians: Gaussians, view: View, backend: Backend, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """RGBA [H, W, 4] uint8, colour over the background."""
    drawn = gaussians.draw(view, background=background, backend=backend)
    picture = torch.cat([drawn.rgb, drawn.alpha[..., None]], dim=-1).clamp(0, 1)
    return np.asarray((255 * picture + 0.5).floor().to(torch.uint8).cpu().numpy())


def _turned(gaussians: Gaussians, like: View, backend: Backend, angle: float) -> np.ndarray:
    """RGB picture over white from a camera like `like` that went round the object by `angle` degrees and still faces it."""
    centre = gaussians.means.median(0).values.double().cpu().numpy()
    turn = Rotation.from_euler("z", angle, degrees=True)
    pose = np.linalg.inv(like.world_to_camera.double().cpu().numpy())
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    pose[:3, 3] = centre + turn.apply(pose[:3, 3] - centre)
    view = View.of(pose, like.intrinsics.cpu().numpy(), like.width, like.height, str(like.intrinsics.device), shift=0.0)
    return _picture(gaussians, view, backend, (1.0, 1.0, 1.0))[..., :3]


def _view(camera: Camera, images: Images, device: str, borrowed: Camera | None = None) -> View:
    intrinsics = (borrowed or camera).intrinsics
    shift = 0.0 if images.released_quirks.corner_pixels else 0.5
    return View.of(camera.camera_to_world, intrinsics, camera.width, camera.height, device, shift)


def _shots(capture: Capture, masks: Mapping[str, Masks], images: Images, device: str) -> list[Shot]:
    """Views of frame 0 to train on; a camera that does not have the object in view is left out, and said."""
    shots = []
    for name, camera in capture.cameras.items():
        labels = masks[name].labels[0]
        if not (labels == OBJECT).any():
            print(f"camera {name}: the object is not in view in frame 0; it does not train the appearance", flush=True)
            continue
        margin = images.appearance.hand_margin * camera.width / REFERENCE_WIDTH
        seen = (capture.colour(name, 0), labels == OBJECT, labels == HANDS, capture.depth(name, 0))
        shots.append(Shot.of(name, _view(camera, images, device), *seen, margin))
    if not shots:
        raise InputError(capture.folder, "at least one camera must have the object in view in frame 0", "empty masks")
    return shots


@dataclass(frozen=True)
class _Seen:
    """What is known of the object's surface in frame 0."""

    cloud: np.ndarray
    """[P, 3] m, seen."""
    colours: np.ndarray
    """[P, 3] RGB."""
    prior: np.ndarray
    """[Q, 3] m, guessed by a shape prior."""
    width: float
    """Of a pixel at the object, m."""

    def first(self) -> tuple[np.ndarray, np.ndarray]:
        """Points [R, 3] m and RGB [R, 3]: what was seen, and where nothing was the prior, in the colours of what is nearest."""
        if not len(self.prior):
            return self.cloud, self.colours
        distance, nearest = cKDTree(self.cloud).query(self.prior)
        new = distance > NEAR_SEEN * self.width
        return np.concatenate([self.cloud, self.prior[new]]), np.concatenate([self.colours, self.colours[nearest[new]]])


def _seen_points(
    capture: Capture, masks: Mapping[str, Masks], observations_path: Path, lifted_record: Path | None, settings: Config, seed: int
) -> _Seen:
    camera = next(iter(capture.cameras.values()))
    if lifted_record is None:
        chosen = settings.perception.lift
        _, cloud, colours = clean_masks(capture, lifting_cameras(capture, chosen), masks, chosen, frames=1)
        if not len(cloud):
            raise InputError(capture.folder, "the object's mask of frame 0 must hold pixels with depth in range", "none")
        width = _pixel_width(camera, cloud)
        return _Seen(cloud, colours, Observations.load(observations_path).surface_points, width)
    record = StageRecord.load(lifted_record)
    lifted = LiftedTracks.load(record.file("lifted", lifted_record))
    prior = ShapePrior.load(record.file("shape", lifted_record))
    width = _pixel_width(camera, lifted.cloud)
    apart = max(settings.images.appearance.spacing, 1.0) * width
    return _Seen(lifted.cloud, lifted.cloud_colours, _surface_points(prior, apart, seed), width)


def _pixel_width(camera: Camera, cloud: np.ndarray) -> float:
    return float(np.median(camera.project(cloud)[1]) / camera.intrinsics[0, 0])


def _surface_points(prior: ShapePrior, apart: float, seed: int) -> np.ndarray:
    """Random points [Q, 3] on the prior's surface, one per square of side `apart`, m."""
    if not len(prior.faces):
        return np.zeros((0, 3))
    mesh = trimesh.Trimesh(prior.vertices, prior.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, max(int(mesh.area / apart**2), 1), seed=seed)
    return np.asarray(points)


def _seen_facts(
    gaussians: Gaussians, shots: Sequence[Shot], drawn: Mapping[str, np.ndarray], backend: Backend, margin: float
) -> dict[str, float]:
    """How well training views are met, and how much of the object frame 0 hides."""
    seen = torch.stack([in_sight(gaussians, shot, backend, margin) for shot in shots]).any(0)
    facts = {"hidden_splats": float(1 - seen.float().mean())}
    for shot in shots:
        cover = drawn[shot.name][..., 3] >= COVERED
        behind = cover & (shot.known.cpu().numpy() == 0)
        facts[f"behind_hands_{shot.name}"] = float(behind.sum() / max(cover.sum(), 1))
        picture = torch.tensor(drawn[shot.name][..., :3].astype(np.float32) / 255) * shot.known.cpu()[..., None]
        facts[f"psnr_{shot.name}"] = float(image_metrics.psnr(picture.permute(2, 0, 1), shot.colour.cpu().permute(2, 0, 1)))
    return facts


def _require_outside(capture: Capture, points: np.ndarray) -> None:
    """A camera within the object's box sees nothing that could be right."""
    low, high = points.min(axis=0), points.max(axis=0)
    for name, camera in capture.cameras.items():
        centre = camera.camera_to_world[:3, 3]
        if ((centre > low) & (centre < high)).all():
            rule = f"cameras.{name}.camera_to_world: the camera must stand outside the object"
            remedy = "Poses are camera-to-world, metres; an inverted or unscaled one puts the camera elsewhere."
            raise InputError(capture.folder / CAPTURE, rule, np.round(centre, 3).tolist(), remedy)


def _masks(capture: Capture, records: Sequence[Path]) -> dict[str, Masks]:
    """Masks by camera, from records in the capture's order."""
    if len(records) != len(capture.cameras):
        raise InputError("--masks", f"one record per camera is required: {list(capture.cameras)}", len(records))
    loaded = {}
    for (name, camera), path in zip(capture.cameras.items(), records, strict=True):
        masks = Masks.load(StageRecord.load(path).file("masks", path))
        wanted = (capture.frame_count, camera.height, camera.width)
        if masks.labels.shape != wanted:
            remedy = f"Delete {path} and run again."
            raise InputError(path, f"masks must have the frames and size of camera {name}: {wanted}", masks.labels.shape, remedy)
        loaded[name] = masks
    return loaded
