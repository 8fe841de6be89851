"""SSIM of images, and the loss that the training of splats minimizes on one view of frame 0.

    L = 0.8 |C - C*| + dssim (1 - SSIM(C, C*)) + mask |A - M| + depth |D - D*|

C, A and D are the rendered color, coverage and expected depth. C* is the image, black outside the object's mask M; D* is the
depth measured on the object. Means are over all pixels. Pixels behind hands are zero on both sides, so they are not compared.

SSIM of a and b (Wang et al. 2004) per channel, with means, variances and covariance under a Gaussian window (11x11, sigma 1.5):
(2 mu_a mu_b + C1)(2 sigma_ab + C2) / ((mu_a^2 + mu_b^2 + C1)(sigma_a^2 + sigma_b^2 + C2)), C1 = 0.01^2, C2 = 0.03^2, range 1.
With s = a + b and d = a - b: 4 mu_a mu_b = mu_s^2 - mu_d^2, 2 (mu_a^2 + mu_b^2) = mu_s^2 + mu_d^2; the same holds for variances.
Images are padded with zeros, as in the released code of Gaussian splatting and PhysTwin.
Images are [..., C, H, W], float32 or float64 in [0, 1]. Wrong shapes and types raise InputError.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn.functional import conv2d

from neuspring.config.images import Appearance
from neuspring.core.errors import InputError
from neuspring.splats.rasterize import Rendered
from neuspring.splats.view import View

WINDOW_RADIUS = 5
"""The window is 2 WINDOW_RADIUS + 1 px wide."""
SIGMA = 1.5
"""Standard deviation of the window, px."""
C1 = 0.01**2
C2 = 0.03**2
COLOR_WEIGHT = 0.8
"""Weight of the mean absolute color difference, as in PhysTwin's release."""
HAND_MARGIN, REFERENCE_WIDTH = 8.0, 848
"""Side of the square that dilates masks of hands, px, and the image width that it refers to; pixels within are not compared."""
SSIM_MARGIN = 12
"""Margin around the object's mask in which SSIM counts, px; its window is 11 px wide. Farther out only color and mask count."""


def check_pair(where: str, a: torch.Tensor, b: torch.Tensor) -> None:
    """Raise InputError, naming `where`, for images that cannot be compared."""
    if a.ndim < 3 or a.shape != b.shape:
        raise InputError(where, "two images [..., C, H, W] of the same shape are required", f"{tuple(a.shape)}, {tuple(b.shape)}")
    if a.dtype != b.dtype or a.dtype not in (torch.float32, torch.float64):
        raise InputError(where, "both images must be float32, or both float64", f"{a.dtype}, {b.dtype}")


def _blur(pictures: torch.Tensor) -> torch.Tensor:
    """Mean of every [H, W] plane under the Gaussian window with zero padding: rows, then columns."""
    offsets = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, device=pictures.device, dtype=torch.float64)
    window = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    window = (window / window.sum()).to(pictures.dtype)
    # On CPU one call with a group per plane is much faster than a batch of one-channel images.
    planes = pictures.reshape(1, -1, *pictures.shape[-2:])
    groups = planes.shape[1]
    planes = conv2d(planes, window.expand(groups, 1, 1, -1), padding=(0, WINDOW_RADIUS), groups=groups)
    planes = conv2d(planes, window[:, None].expand(groups, 1, -1, 1), padding=(WINDOW_RADIUS, 0), groups=groups)
    return planes.reshape(pictures.shape)


def ssim_map(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """SSIM at every pixel and channel [..., C, H, W]; differentiable."""
    check_pair("ssim", a, b)
    # With sum and difference the formula needs four means instead of five. It is also accurate in single precision: the rounding
    # error of the large variance (of the sum) cancels between numerator and denominator.
    total, difference = a + b, a - b
    mean_total, mean_difference, total_squared, difference_squared = _blur(
        torch.stack((total, difference, total * total, difference * difference))
    )
    p, q = mean_total * mean_total, mean_difference * mean_difference
    u, v = total_squared - p, difference_squared - q
    ratio: torch.Tensor = ((p - q + 2 * C1) * (u - v + 2 * C2)) / ((p + q + 2 * C1) * (u + v + 2 * C2))
    return ratio


def ssim(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Mean SSIM of two images; differentiable. It is 1 for equal images and less otherwise."""
    return ssim_map(a, b).mean()


@dataclass(frozen=True, eq=False)
class Shot:
    """The masked image of one camera in frame 0, on a device."""

    name: str
    view: View
    color: torch.Tensor
    """Color [H, W, 3] in 0..1, black outside the object's mask."""
    mask: torch.Tensor
    """1 where the object is visible, else 0 [H, W]."""
    known: torch.Tensor
    """0 behind hands, else 1 [H, W]."""
    depth: torch.Tensor
    """Depth [H, W], m; 0 outside the object and where it was not measured."""
    box: tuple[int, int, int, int]
    """Rows and columns around the mask: top, bottom, left, right, ends excluded."""

    @classmethod
    def of(
        cls, name: str, view: View, color: np.ndarray, mask: np.ndarray, hands: np.ndarray, depth: np.ndarray, margin: float
    ) -> Shot | None:
        """Shot of an image [H, W, 3] uint8, bool masks [H, W] and depth [H, W], m; None if the object is not visible.

        Hands are dilated by a square of `margin` pixels. Raises InputError for sizes that differ from the view's.
        """
        size = (view.height, view.width)
        for what, array in {"image": color, "mask": mask, "mask of hands": hands, "depth": depth}.items():
            if array.shape[:2] != size:
                raise InputError(f"camera {name}, {what} of frame 0", f"must have the camera's size {size}", array.shape[:2])
        square = np.ones((max(round(margin), 1),) * 2, np.uint8)
        known = cv2.dilate(hands.astype(np.uint8), square) == 0
        seen = mask & known
        if not seen.any():
            return None
        (top, bottom), (left, right) = (np.flatnonzero(seen.any(axis=axis))[[0, -1]].tolist() for axis in (1, 0))
        box = (
            max(top - SSIM_MARGIN, 0),
            min(bottom + SSIM_MARGIN + 1, view.height),
            max(left - SSIM_MARGIN, 0),
            min(right + SSIM_MARGIN + 1, view.width),
        )

        def on_device(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values.astype(np.float32), device=view.intrinsics.device)

        on_black = np.where(seen[..., None], color, 0).astype(np.float32) / 255
        measured = np.where(seen, depth, 0.0)
        return cls(name, view, on_device(on_black), on_device(seen), on_device(known), on_device(measured), box)

    @property
    def pixel_width(self) -> float:
        """Width of a pixel at the object, m; NaN if no depth was measured on the object."""
        measured = self.depth[self.depth > 0]
        return float(measured.median() / self.view.intrinsics[0, 0]) if len(measured) else float("nan")


def loss(rendered: Rendered, shot: Shot, settings: Appearance) -> torch.Tensor:
    """The training loss of one rendered image."""
    color = rendered.rgb * shot.known[..., None]
    total = COLOR_WEIGHT * (color - shot.color).abs().mean()
    if settings.dssim:
        top, bottom, left, right = shot.box
        pair = [image[top:bottom, left:right].permute(2, 0, 1) for image in (color, shot.color)]
        total = total + settings.dssim * (1 - ssim_map(*pair)).sum() / color.numel()
    if settings.mask:
        total = total + settings.mask * (rendered.alpha * shot.known - shot.mask).abs().mean()
    if settings.depth:
        measured = shot.depth > 0
        total = total + settings.depth * ((rendered.depth - shot.depth) * measured).abs().mean()
    return total
