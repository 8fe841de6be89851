"""How a picture is taken: a pinhole view, and the thresholds of the rasterizer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from neuspring.core.errors import InputError


@dataclass(frozen=True)
class Limits:
    """Thresholds of splatting; the defaults are those that the released evaluation was rendered with."""

    near: float = 0.01
    """m along the optical axis; nearer splats are not drawn."""
    far: float = 1e10
    blur: float = 0.3
    """Added to the variance of every splat in the image, px^2."""
    alpha_min: float = 1 / 255
    """Coverage below this is skipped."""
    alpha_max: float = 0.999
    """No splat covers more than this."""
    transmittance_min: float = 1e-4
    """A pixel is done before the splat that would leave no more than this transmittance."""


LIMITS = Limits()


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera: OpenCV axes (x right, y down, z forward), the center of pixel (column j, row i) at (j + 0.5, i + 0.5)."""

    world_to_camera: torch.Tensor
    """[4, 4], m."""
    intrinsics: torch.Tensor
    """K [3, 3], pixels."""
    width: int
    height: int

    @classmethod
    def of(
        cls, camera_to_world: np.ndarray, intrinsics: np.ndarray, width: int, height: int, device: str = "cpu", shift: float = 0.5
    ) -> View:
        """From a calibrated camera whose pixel centers lie at whole coordinates, `shift` pixels away from those here.

        shift = 0 takes the intrinsics as they are, as the released rendering does: a picture half a pixel off.
        """
        k = np.array(intrinsics, dtype=np.float64)
        k[:2, 2] += shift
        pose, matrix = (torch.tensor(m, dtype=torch.float32, device=device) for m in (np.linalg.inv(camera_to_world), k))
        return cls(pose, matrix, width, height)

    @property
    def position(self) -> torch.Tensor:
        """The camera's center in the world [3], m."""
        pose: torch.Tensor = torch.linalg.inv(self.world_to_camera)
        return pose[:3, 3]

    def require_valid(self) -> None:
        """Raise InputError for a view that cannot be drawn."""
        if self.width < 1 or self.height < 1:
            raise InputError("view", "width and height must be at least one pixel", (self.width, self.height))
        if not (torch.isfinite(self.world_to_camera).all() and torch.isfinite(self.intrinsics).all()):
            raise InputError("view", "pose and intrinsics must be finite")
