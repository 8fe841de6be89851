"""Training losses in the image of one camera without depth, differentiable in the predicted nodes.

With the projection u(x) = K R^T (x - c) / depth and the pixel size s (m per pixel at the object in frame 0):

    image_track   smooth-L1 of s (u(x_i) - q_i), mean over tracked points that are seen and over x and y; linear beyond BETA, since
                  trackers slide
    silhouette    s^2 (mean over points p of the mask of min_i |p - u(x_i)|^2  +  mean over nodes i of D(u(x_i))^2), the first over
                  surface nodes, assignment fixed; D is the distance from object and hands, bilinear between cells. A node that a
                  hand hides is not wrong.

A term is weighted by the field of `config.Losses` that has its name. All are in m^2, as the other losses are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn.functional import grid_sample

from neuspring.config import Losses
from neuspring.core.artifacts import Observations

BETA = 0.03
"""m: beyond it a track's error counts linearly."""
NEAR = 0.05
"""m: nodes nearer to the camera are projected as if they were there."""


@dataclass(frozen=True)
class ImageLoss:
    """The evidence of the frames that a loss may read, as tensors."""

    world_to_camera: torch.Tensor
    intrinsics: torch.Tensor
    pixels: torch.Tensor
    """[E, No, 2]."""
    visible: torch.Tensor
    """[E, No]."""
    inside: torch.Tensor
    """[E, P, 2], NaN where there are fewer."""
    outside: torch.Tensor
    """[E, h, w], pixels."""
    cell: int
    surface: int
    size: float
    """s, m per pixel."""
    weights: Losses

    @classmethod
    def of(cls, observations: Observations, weights: Losses, device: str, dtype: torch.dtype = torch.float32) -> ImageLoss | None:
        """None for captures with depth."""
        image = observations.image
        if image is None:
            return None
        end = len(image.inside)
        pose = torch.linalg.inv(torch.tensor(image.camera_to_world, dtype=torch.float64))

        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values).to(dtype=dtype, device=device)

        return cls(
            tensor(pose),
            tensor(image.intrinsics.copy()),
            tensor(image.pixels[:end].copy()),
            torch.tensor(image.visible[:end], device=device),
            tensor(image.inside.copy()),
            tensor(image.outside.copy()),
            image.cell,
            observations.surface_count,
            image.pixel_size,
            weights,
        )

    def to(self, device: str, dtype: torch.dtype) -> ImageLoss:
        """The same on another device, in another precision."""
        names = ("world_to_camera", "intrinsics", "pixels", "inside", "outside")
        moved = {name: getattr(self, name).to(device=device, dtype=dtype) for name in names}
        rest = {name: getattr(self, name) for name in ("cell", "surface", "size", "weights")}
        return ImageLoss(visible=self.visible.to(device), **moved, **rest)

    def project(self, x: torch.Tensor) -> torch.Tensor:
        """Pixels [..., 2] of points [..., 3], m."""
        local = x @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        flat = local @ self.intrinsics.T
        return flat[..., :2] / flat[..., 2:].clamp_min(NEAR)

    def terms(self, frame: int, nodes: torch.Tensor) -> dict[str, torch.Tensor]:
        """Weighted terms, m^2, of a frame for nodes [N, 3], by name; those without weight are left out."""
        near = None
        if self.weights.silhouette:
            with torch.no_grad():
                near = self.assigned(frame, nodes)
        parts = self.residuals(frame, nodes, near)
        return {name: torch.stack([r.square().sum() for r in values]).sum() for name, values in parts.items()}

    def assigned(self, frame: int, nodes: torch.Tensor) -> torch.Tensor:
        """Nearest surface node [P] of each point of the mask in the image; 0 where there is none."""
        u = self.project(nodes[: self.surface])
        points = torch.nan_to_num(self.inside[frame])
        found: torch.Tensor = torch.cdist(points, u).argmin(dim=1)
        return found

    def residuals(self, frame: int, nodes: torch.Tensor, near: torch.Tensor | None) -> dict[str, list[torch.Tensor]]:
        """What is squared and summed in each term, weights and means included, for the assignment `near` of the silhouette."""
        u, parts = self.project(nodes), dict[str, list[torch.Tensor]]()
        w = self.weights
        if w.image_track:
            seen = self.visible[frame]
            error = self.size * (u[: len(seen)] - self.pixels[frame])
            parts["image_track"] = [_weighted(_root(error) * seen[:, None], w.image_track, 2 * seen.sum())]
        inside = ~torch.isnan(self.inside[frame, :, 0])
        points = torch.nan_to_num(self.inside[frame])
        if w.silhouette:
            assert near is not None
            away = self.size * (u[near] - points) * inside[:, None]
            left = self.size * self.distance(frame, u)
            parts["silhouette"] = [_weighted(away, w.silhouette, inside.sum()), _weighted(left, w.silhouette, len(u))]
        return parts

    def distance(self, frame: int, u: torch.Tensor) -> torch.Tensor:
        """D [N], pixels, at pixels [N, 2]; beyond the image as at its border."""
        rows, columns = self.outside.shape[1:]
        # From -1 to 1 over whole cells, as `grid_sample` with align_corners = False.
        extent = torch.tensor([columns, rows], dtype=u.dtype, device=u.device) * self.cell
        grid = 2 * (u + 0.5) / extent - 1
        sampled = grid_sample(
            self.outside[frame][None, None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
        )
        return sampled[0, 0, 0]


def _weighted(values: torch.Tensor, weight: float, count: torch.Tensor | int) -> torch.Tensor:
    """Values whose squares are to be averaged over `count`, and weighted."""
    return values * (weight / torch.as_tensor(count, dtype=values.dtype, device=values.device).clamp_min(1)).sqrt()


def _root(a: torch.Tensor) -> torch.Tensor:
    """s(a), whose square is a^2 / 2 below BETA and BETA (|a| - BETA / 2) beyond; its slope is continuous."""
    size = a.abs()
    # The unused branch must have a finite slope too.
    linear = (BETA * (size.clamp_min(BETA) - BETA / 2)).sqrt()
    return torch.where(size < BETA, a / 2**0.5, a.sign() * linear)
