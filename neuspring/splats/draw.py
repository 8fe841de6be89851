"""Pictures of a twin: its splats in every frame of a trajectory, seen by any camera, RGBA over any background."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuspring.config.images import Images
from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Camera, Capture
from neuspring.perception.results import Masks
from neuspring.report.figures.images import Pair
from neuspring.scores import images as image_metrics
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterise import Backend, choose_backend
from neuspring.splats.skinning import Skin
from neuspring.splats.view import View

COVERED = 128
"""Coverage, of 255, from which a pixel counts as object: a half."""
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


def view_of(camera: Camera, images: Images, device: str, borrowed: Camera | None = None) -> View:
    """The view of a calibrated camera, or with the intrinsics of another one."""
    intrinsics = (borrowed or camera).intrinsics
    shift = 0.0 if images.released_quirks.corner_pixels else 0.5
    return View.of(camera.camera_to_world, intrinsics, camera.width, camera.height, device, shift)


def moved(splats: Splats, positions: np.ndarray, images: Images, device: str) -> Iterator[Gaussians]:
    """The splats in every frame of a trajectory [F, N, 3], m."""
    start = Gaussians.of(splats, device)
    quirk = images.released_quirks.degenerate_skinning
    skin = Skin(positions[0], device=device, frozen=images.frozen_skinning, released_degeneracy=quirk)
    for means, quaternions in skin.carry(positions, start.means, start.quaternions):
        yield Gaussians(means, quaternions, start.log_scales, start.opacity_logits, start.harmonics)


def placed(splats: Splats, centres: np.ndarray, device: str) -> Iterator[Gaussians]:
    """The splats with the centers [F, G, 3], m, in every frame; their orientations stay."""
    start = Gaussians.of(splats, device)
    if centres.shape[1] != len(splats.means):
        rule = f"one centre for each of {len(splats.means)} splats is required"
        raise InputError("splat centres", rule, centres.shape[1], "Splats and rollout must be of the same method and seed.")
    for means in torch.tensor(centres, device=device):
        yield replace(start, means=means)


@torch.no_grad()
def picture(gaussians: Gaussians, view: View, backend: Backend, background: tuple[float, float, float] = BLACK) -> np.ndarray:
    """RGBA [H, W, 4] uint8: color over the background, and coverage."""
    drawn = gaussians.draw(view, background=background, backend=backend)
    rgba = torch.cat([drawn.rgb, drawn.alpha[..., None]], dim=-1).clamp(0, 1)
    return np.asarray((255 * rgba + 0.5).floor().to(torch.uint8).cpu().numpy())


def turned(gaussians: Gaussians, like: View, backend: Backend, angle: float) -> np.ndarray:
    """RGB [H, W, 3] uint8 over white: the view `like`, turned about the object by `angle` degrees."""
    centre = gaussians.means.median(0).values.double().cpu().numpy()
    turn = Rotation.from_euler("z", angle, degrees=True)
    pose = np.linalg.inv(like.world_to_camera.double().cpu().numpy())
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    pose[:3, 3] = centre + turn.apply(pose[:3, 3] - centre)
    view = View.of(pose, like.intrinsics.cpu().numpy(), like.width, like.height, str(like.intrinsics.device), shift=0.0)
    return picture(gaussians, view, backend, WHITE)[..., :3]


def save_picture(path: Path, rgba: np.ndarray) -> None:
    """Write RGBA [H, W, 4] uint8 as PNG, atomically."""
    ok, data = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    assert ok, "a picture can be encoded"
    write_atomically(path, lambda temporary: temporary.write_bytes(data.tobytes()))


@dataclass(frozen=True, eq=False)
class Scored:
    """What predictions are compared with: cameras, their masks, and how."""

    capture: Capture
    masks: Mapping[str, np.ndarray]
    """Perceived labels [T, H, W] by camera; empty where the capture has masks of its own."""
    masks_from: str
    views: Mapping[str, View]
    backend: Backend
    covered: int
    """Least coverage, of 255, that counts as object."""

    @classmethod
    def of(cls, capture: Capture, perceived: Mapping[str, Masks], images: Images, device: str) -> Scored:
        """The cameras that `images.views` asks for. Raises InputError if a second camera is asked for and there is none."""
        quirks, cameras = images.released_quirks, list(capture.cameras.values())
        if quirks.second_camera_intrinsics and len(cameras) < 2:
            rule = "images.released_quirks.second_camera_intrinsics needs a second camera"
            raise InputError(capture.folder / CAPTURE, rule, f"{len(cameras)} camera")
        borrowed = cameras[1] if quirks.second_camera_intrinsics else None
        chosen = cameras[: 1 if images.views == "first" else None]
        views = {camera.name: view_of(camera, images, device, borrowed) for camera in chosen}
        # Scores should not depend on the segmentation under test, where the capture comes with masks of its own.
        own = capture.description.masks
        labels = {} if own else {name: perceived[name].labels for name in views}
        source = "given" if own else next(iter(perceived.values())).backend
        covered = 1 if quirks.any_alpha else COVERED
        return cls(capture, labels, source, views, choose_backend(images.backend, device), covered)

    def pair(self, name: str, frame: int, gaussians: Gaussians) -> Pair:
        """Observed and predicted picture of one camera in one frame."""
        labels = self.masks[name][frame] if self.masks else self.capture.mask(name, frame)
        mask, hands = (np.where(labels == label, 255, 0).astype(np.uint8) for label in (OBJECT, HANDS))
        colour = self.capture.colour(name, frame)
        rendered = picture(gaussians, self.views[name], self.backend)
        truth, prediction = image_metrics.masked_pair(colour, mask, rendered, hands)
        silhouettes = image_metrics.silhouettes(mask, rendered, hands, self.covered)
        return Pair(colour, rendered, truth, prediction, silhouettes, hands > 0)
