"""Projection of splats from the world to ellipses in the image: pinhole views, thresholds of the rasterizer, and colors.

Let p = R x + t be the center of a splat in camera coordinates and Sigma = Rq diag(s^2) Rq^T its covariance. In the image its mean
is (fx px/pz + cx, fy py/pz + cy) and its covariance is J R Sigma R^T J^T + blur 1. J is the Jacobian of the projection at the
slopes px/pz and py/pz, clamped to a margin around the image (Zwicker et al., EWA splatting, 2001; Kerbl et al. 2023).
The code is plain Torch, for any device and precision. Torch differentiates it, including the clamps.

Colors depend on direction by real spherical harmonics up to degree 3, in the order of splat files (l = 0.., m = -l..l):
color(d) = max(0, 1/2 + sum_k Y_k(d) c_k), d the unit direction from the camera to the splat in the world, c_k [3] RGB.
Signs follow the Condon-Shortley phase (Y_1 = -y, z, -x), as in splat files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from neuspring.core.errors import InputError

PICTURE_MARGIN = 0.3
"""Slopes in the Jacobian may leave the image by this fraction of its half width or height."""
BOX_MARGIN = 1e-3
"""Bounding boxes are wider by this fraction, so that rounding cuts off no pixel."""
C0 = 0.5 / math.sqrt(math.pi)
"""Y_0."""
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = (0.5 * math.sqrt(15 / math.pi), 0.25 * math.sqrt(5 / math.pi), 0.25 * math.sqrt(15 / math.pi))
_C3 = (
    0.25 * math.sqrt(35 / (2 * math.pi)),
    0.5 * math.sqrt(105 / math.pi),
    0.25 * math.sqrt(21 / (2 * math.pi)),
    0.25 * math.sqrt(7 / math.pi),
    0.25 * math.sqrt(105 / math.pi),
)


@dataclass(frozen=True)
class Limits:
    """Thresholds of splatting; the defaults are those of PhysTwin's released evaluation."""

    near: float = 0.01
    """Splats nearer than this are not rendered, m along the optical axis."""
    far: float = 1e10
    blur: float = 0.3
    """Variance that is added to every splat in the image, px^2."""
    alpha_min: float = 1 / 255
    """Contributions with less coverage are skipped."""
    alpha_max: float = 0.999
    """Maximum coverage of one splat."""
    transmittance_min: float = 1e-4
    """Blending of a pixel stops before the splat that would reduce transmittance to this or less."""


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera with OpenCV axes (x right, y down, z forward).

    The center of the pixel in column j and row i is at (j + 0.5, i + 0.5).
    """

    world_to_camera: torch.Tensor
    """Pose [4, 4], m."""
    intrinsics: torch.Tensor
    """K [3, 3], px."""
    width: int
    height: int

    @classmethod
    def of(
        cls, camera_to_world: np.ndarray, intrinsics: np.ndarray, width: int, height: int, device: str = "cpu", shift: float = 0.5
    ) -> View:
        """View of a calibrated camera whose pixel centers are at integer coordinates: `shift` is added to its principal point.

        shift = 0 keeps the intrinsics, as the released rendering does; its images are half a pixel off.
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
        """Raise InputError for a view that cannot be rendered."""
        if self.width < 1 or self.height < 1:
            raise InputError("view", "width and height must be at least one pixel", (self.width, self.height))
        if not (torch.isfinite(self.world_to_camera).all() and torch.isfinite(self.intrinsics).all()):
            raise InputError("view", "pose and intrinsics must be finite")


@dataclass(frozen=True)
class Projected:
    """The splats between the near and the far plane, as ellipses."""

    index: torch.Tensor
    """Indices of the splats [M], int64."""
    means: torch.Tensor
    """Centers [M, 2], px."""
    covariances: torch.Tensor
    """Covariances xx, xy, yy [M, 3], px^2."""
    conics: torch.Tensor
    """Inverse covariances [M, 3], px^-2."""
    depths: torch.Tensor
    """Depths along the optical axis [M], m."""


def rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4], w first, any length except zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def project(means: torch.Tensor, quaternions: torch.Tensor, scales: torch.Tensor, view: View, limits: Limits) -> Projected:
    """Ellipses of splats with means [N, 3] m, quaternions [N, 4], standard deviations [N, 3] m."""
    turn, shift = view.world_to_camera[:3, :3].to(means), view.world_to_camera[:3, 3].to(means)
    local = means @ turn.T + shift
    index = torch.nonzero((local[:, 2] >= limits.near) & (local[:, 2] <= limits.far)).squeeze(1)
    x, y, z = local[index].unbind(-1)
    k = view.intrinsics.to(means)
    (fx, cx), (fy, cy) = (k[0, 0], k[0, 2]), (k[1, 1], k[1, 2])
    flat = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    a, b = _limited(x / z, fx, cx, view.width), _limited(y / z, fy, cy, view.height)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * a / z, zero, fy / z, -fy * b / z], dim=-1).reshape(-1, 2, 3)
    # cov = (J R Rq S)(J R Rq S)^T: the product of a factor and its transpose stays positive in single precision.
    factor = jacobian @ turn @ rotations(quaternions[index]) * scales[index, None, :]
    u, v = factor.unbind(1)
    xx = (u * u).sum(-1) + limits.blur
    xy = (u * v).sum(-1)
    yy = (v * v).sum(-1) + limits.blur
    # (u.u + blur)(v.v + blur) - (u.v)^2 = |u x v|^2 + blur (u.u + v.v) + blur^2, without cancellation for long, thin splats.
    area = torch.linalg.cross(u, v)
    determinant = (area * area).sum(-1) + limits.blur * ((u * u).sum(-1) + (v * v).sum(-1)) + limits.blur * limits.blur
    conics = torch.stack([yy, -xy, xx], dim=-1) / determinant[:, None]
    return Projected(index, flat, torch.stack([xx, xy, yy], dim=-1), conics, z)


def _limited(slope: torch.Tensor, focal: torch.Tensor, center: torch.Tensor, size: int) -> torch.Tensor:
    margin = PICTURE_MARGIN * 0.5 * size / focal
    return slope.clamp(-center / focal - margin, (size - center) / focal + margin)


@torch.no_grad()
def boxes(projected: Projected, opacities: torch.Tensor, view: View, limits: Limits) -> tuple[torch.Tensor, torch.Tensor]:
    """Which projected splats touch the image [M] bool, and their pixels [M, 4] int: x0, y0, x1, y1, ends excluded.

    A splat touches a pixel if alpha >= alpha_min: the squared Mahalanobis distance is at most 2 ln(opacity / alpha_min).
    """
    reach = 2 * torch.log(opacities / limits.alpha_min)
    half = torch.sqrt(reach.clamp_min(0.0)[:, None] * projected.covariances[:, [0, 2]]) * (1 + BOX_MARGIN)
    size = torch.tensor([view.width, view.height], device=half.device, dtype=half.dtype)
    low = torch.ceil(projected.means - half - 0.5).clamp_min(0.0).minimum(size)
    high = (torch.floor(projected.means + half - 0.5) + 1).clamp_min(0.0).minimum(size)
    seen = (reach >= 0) & (high > low).all(dim=1)
    return seen, torch.cat([low, high], dim=1).to(torch.int32)


def radii(projected: Projected) -> torch.Tensor:
    """Three standard deviations along the long axis of each ellipse [M], px."""
    xx, xy, yy = projected.covariances.detach().unbind(-1)
    largest = 0.5 * (xx + yy) + torch.sqrt((0.25 * (xx - yy) ** 2 + xy * xy).clamp_min(0.0))
    return 3 * torch.sqrt(largest)


def basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Spherical harmonics Y_k [..., (degree + 1)^2] in unit directions [..., 3]."""
    x, y, z = directions.unbind(-1)
    rows = [torch.full_like(x, C0)]
    if degree > 0:
        rows += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        a, b, c = _C2
        rows += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _C3
        rows += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(rows, dim=-1)


TURN_SAMPLES = 24
"""Number of directions in which rotated colors are sampled, to fit the 15 coefficients above the first."""


def turned_harmonics(coefficients: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Coefficients [N, K, 3] after the rotations `turns` [N, 3, 3] of splats and their colors: color'(d) = color(R^T d).

    A rotated harmonic is a sum of harmonics of its band, so least squares over a few fixed directions is exact.
    """
    degree = math.isqrt(coefficients.shape[1]) - 1
    if not coefficients[:, 1:].any():
        return coefficients
    # The directions are uniform: the golden angle, and heights that divide the sphere into equal areas.
    step = torch.arange(TURN_SAMPLES, dtype=torch.float64)
    height, angle = 1 - (2 * step + 1) / TURN_SAMPLES, step * math.pi * (3 - math.sqrt(5))
    level = torch.sqrt(1 - height**2)
    directions = torch.stack([level * torch.cos(angle), level * torch.sin(angle), height], dim=-1)
    fit = torch.linalg.pinv(basis(directions, degree)[:, 1:]).to(coefficients)
    turned_back = basis(directions.to(coefficients) @ turns.to(coefficients), degree)[..., 1:]
    return torch.cat([coefficients[:, :1], fit @ (turned_back @ coefficients[:, 1:])], dim=1)


def harmonic_colors(coefficients: torch.Tensor, offsets: torch.Tensor, degree: int) -> torch.Tensor:
    """RGB [N, 3] of coefficients [N, K, 3] up to `degree`, seen along `offsets` [N, 3] (any length)."""
    used = (degree + 1) ** 2
    values = basis(torch.nn.functional.normalize(offsets, dim=-1), degree)
    return torch.clamp_min(torch.einsum("nk,nkc->nc", values, coefficients[:, :used]) + 0.5, 0.0)
