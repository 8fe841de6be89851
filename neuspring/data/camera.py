"""Calibrated cameras, their lenses, the planes that they see, and the limits of a plausible table."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field

from neuspring.core.section import STRICT, Finite, Name

NEAR, FAR = 0.1, 10.0
"""m. A median depth outside this range does not come from a table in a room."""
ROLL = 60.0
"""Degrees. The normal of a table is closer than this to the image's upward direction; those of side walls and ceilings are not."""
Row3: TypeAlias = tuple[Finite, Finite, Finite]
Row4: TypeAlias = tuple[Finite, Finite, Finite, Finite]


def depth_noise(depth: np.ndarray) -> np.ndarray:
    """Standard deviation, m, of depth z, m: 0.0012 + 0.0019 (z - 0.4)^2 (Nguyen et al. 2012, structured light)."""
    return np.asarray(0.0012 + 0.0019 * (depth - 0.4) ** 2)


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera."""

    name: str
    width: int
    height: int
    intrinsics: np.ndarray
    """K [3, 3], pixels."""
    camera_to_world: np.ndarray
    """[4, 4], m."""

    def entry(self, missing: tuple[int, ...] = ()) -> CameraEntry:
        """The entry of this camera in capture.json, with its `missing` frames."""
        intrinsics: Any = tuple(map(tuple, self.intrinsics.tolist()))
        pose: Any = tuple(map(tuple, self.camera_to_world.tolist()))
        return CameraEntry(
            name=self.name, width=self.width, height=self.height, intrinsics=intrinsics, camera_to_world=pose, missing=missing
        )

    def lift(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points [..., 3], m, of pixels (x, y) [..., 2] at depth [...], m along the optical axis: c2w (z K^-1 [x, y, 1])."""
        return np.asarray(self.rays(pixels) * np.asarray(depth)[..., None] + self.camera_to_world[:3, 3])

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Directions [..., 3] in the world of the rays of pixels (x, y) [..., 2], each 1 m long along the optical axis."""
        homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
        return np.asarray(homogeneous @ (self.camera_to_world[:3, :3] @ np.linalg.inv(self.intrinsics)).T)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (x, y) [..., 2] and depth [...], m, of world points [..., 3]; pixels are meaningless for depth <= 0."""
        local = (points - self.camera_to_world[:3, 3]) @ self.camera_to_world[:3, :3]
        depth = local[..., 2]
        flat = local @ self.intrinsics.T
        return flat[..., :2] / np.where(np.abs(depth) < 1e-9, 1e-9, depth)[..., None], depth

    def sees(self, pixels: np.ndarray) -> np.ndarray:
        """True for pixels (x, y) [..., 2] that round to a pixel of the image."""
        x, y = np.round(pixels[..., 0]), np.round(pixels[..., 1])
        return (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """A camera's intrinsics."""

    matrix: np.ndarray
    """K [3, 3], pixels."""
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Coefficients; empty: no distortion."""
    model: str = "none"
    """Model of the distortion: none, opencv or fisheye."""
    size: tuple[int, int] | None = None
    """(width, height) of its images; None: not stated."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that a camera sees."""

    normal: np.ndarray
    """Unit normal [3] in camera coordinates, towards the camera."""
    height: float
    """Distance of the camera from the plane, m."""
    rms: float
    """Root mean square distance of its points, m."""
    share: float
    """Fraction of the points with depth that are on the plane."""
    inliers: int
    """Number of points on the plane, of at most `planes.CLOUD_POINTS`."""
    points: np.ndarray
    """The points on the plane [n, 3], m, in camera coordinates."""

    @property
    def elevation(self) -> float:
        """Angle between the optical axis and the plane, degrees: 90 from straight above, 0 along it."""
        return float(np.degrees(np.arcsin(np.clip(-self.normal[2], -1.0, 1.0))))

    def above(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [...], m, of points [..., 3] in camera coordinates; the camera's side is positive."""
        return np.asarray(points @ self.normal + self.height)

    def text(self) -> str:
        """Size and position of the plane, in one line."""
        size = f"{1e3 * self.rms:.1f} mm rms over {self.share:.0%} of the pixels with depth ({self.inliers} points)"
        return f"{size}, camera {self.height:.3f} m above it, looking down at it by {self.elevation:.0f} degrees"


@dataclass(frozen=True, kw_only=True)
class CameraEntry:
    """One camera of capture.json."""

    __pydantic_config__ = STRICT
    name: Name
    """Name of its folders in color, depth and mask."""
    width: Annotated[int, Field(ge=16)]
    height: Annotated[int, Field(ge=16)]
    intrinsics: tuple[Row3, Row3, Row3]
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels; no distortion."""
    camera_to_world: tuple[Row4, Row4, Row4, Row4]
    """Rigid, m."""
    missing: tuple[Annotated[int, Field(ge=0)], ...] = ()
    """Frames without an image of this camera."""

    def camera(self) -> Camera:
        """The calibrated camera."""
        return Camera(self.name, self.width, self.height, np.array(self.intrinsics), np.array(self.camera_to_world))
