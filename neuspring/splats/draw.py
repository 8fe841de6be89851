"""Images of a twin: its splats in every frame of a trajectory, from any camera, as RGBA over any background."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError, NumericalFailure
from neuspring.data.camera import Camera
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterize import Backend
from neuspring.splats.skinning import Skin
from neuspring.splats.view import View, rotations, turned_harmonics

OBJECT_COVERAGE = 128
"""A pixel is part of the object from this coverage (of 255): one half."""
LEAST_OPACITY = 0.1
"""Splats of a moving twin are rendered above this opacity. The value is that of PhysTwin's release."""
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


def view_of(camera: Camera, device: str) -> View:
    """The view of a calibrated camera."""
    return View.of(camera.camera_to_world, camera.intrinsics, camera.width, camera.height, device)


def prune_by_opacity(splats: Splats) -> Splats:
    """Keep the splats whose opacity exceeds `LEAST_OPACITY`. Raises NumericalFailure if none does."""
    dense = 1 / (1 + np.exp(-splats.opacity_logits)) > LEAST_OPACITY
    if not dense.any():
        raise NumericalFailure(f"appearance: no splat has an opacity above {LEAST_OPACITY}")
    return Splats(**{field.name: getattr(splats, field.name)[dense] for field in fields(Splats)})


def skinned_frames(splats: Splats, positions: np.ndarray, device: str) -> Iterator[Gaussians]:
    """Yield the splats in every frame of a trajectory [F, N, 3], m. Colors that depend on direction rotate with the splats."""
    start = Gaussians.of(splats, device)
    unturned = rotations(start.quaternions).mT
    skin = Skin(positions[0], device=device)
    for frame, (means, quaternions) in enumerate(skin.carry(positions, start.means, start.quaternions)):
        harmonics = start.harmonics
        if frame:
            harmonics = turned_harmonics(harmonics, rotations(quaternions) @ unturned)
        yield Gaussians(means, quaternions, start.log_scales, start.opacity_logits, harmonics)


def frames_from_centers(splats: Splats, centers: np.ndarray, device: str) -> Iterator[Gaussians]:
    """Yield the splats with the centers [F, G, 3], m, of every frame; their orientations do not change."""
    start = Gaussians.of(splats, device)
    if centers.shape[1] != len(splats.means):
        rule = f"one center for each of {len(splats.means)} splats is required"
        raise InputError("splat centers", rule, centers.shape[1], "Give splats and rollout of the same method and seed.")
    for means in torch.tensor(centers, device=device):
        yield replace(start, means=means)


@torch.no_grad()
def picture(gaussians: Gaussians, view: View, backend: Backend, background: tuple[float, float, float] = BLACK) -> np.ndarray:
    """Render RGBA [H, W, 4] uint8: color over the background, and coverage."""
    drawn = gaussians.draw(view, background=background, backend=backend)
    rgba = torch.cat([drawn.rgb, drawn.alpha[..., None]], dim=-1).clamp(0, 1)
    return (255 * rgba + 0.5).floor().to(torch.uint8).cpu().numpy()


def orbit_view(gaussians: Gaussians, like: View, backend: Backend, angle: float) -> np.ndarray:
    """Render RGB [H, W, 3] uint8 over white: the view `like`, rotated about the object by `angle` degrees."""
    center = gaussians.means.median(0).values.double().cpu().numpy()
    turn = Rotation.from_euler("z", angle, degrees=True)
    pose = np.linalg.inv(like.world_to_camera.double().cpu().numpy())
    pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    pose[:3, 3] = center + turn.apply(pose[:3, 3] - center)
    view = View.of(pose, like.intrinsics.cpu().numpy(), like.width, like.height, str(like.intrinsics.device), shift=0.0)
    return picture(gaussians, view, backend, WHITE)[..., :3]
