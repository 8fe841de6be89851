"""How close a rendered picture is to the observed one: SSIM, PSNR and IoU, and the masked pair of pictures that they compare.

SSIM (Wang et al. 2004) of a and b, with means, variances and covariance under a Gaussian window (11x11, sigma 1.5), per channel:
(2 mu_a mu_b + C1)(2 sigma_ab + C2) / ((mu_a^2 + mu_b^2 + C1)(sigma_a^2 + sigma_b^2 + C2)), C1 = 0.01^2, C2 = 0.03^2, data range 1.
With s = a + b and d = a - b: 4 mu_a mu_b = mu_s^2 - mu_d^2, 2 (mu_a^2 + mu_b^2) = mu_s^2 + mu_d^2, and so for the variances.
Outside the picture everything is zero, as in the released code of Gaussian splatting and PhysTwin.
Pictures are [..., C, H, W], float32 or float64 in [0, 1]. Bad shapes and types raise InputError.
"""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import conv2d

from neuspring.core.errors import InputError

RADIUS = 5
"""px: the window is 2 RADIUS + 1 wide."""
SIGMA = 1.5
"""px."""
C1 = 0.01**2
C2 = 0.03**2


def _check_pair(where: str, a: torch.Tensor, b: torch.Tensor) -> None:
    if a.ndim < 3 or a.shape != b.shape:
        raise InputError(where, "two pictures [..., C, H, W] of the same shape are needed", f"{tuple(a.shape)}, {tuple(b.shape)}")
    if a.dtype != b.dtype or a.dtype not in (torch.float32, torch.float64):
        raise InputError(where, "both pictures must be float32 or both float64", f"{a.dtype}, {b.dtype}")


def _blur(pictures: torch.Tensor) -> torch.Tensor:
    """Mean of every [H, W] plane under the Gaussian window, zeros outside: rows, then columns."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, device=pictures.device, dtype=torch.float64)
    window = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    window = (window / window.sum()).to(pictures.dtype)
    # One call with a group per plane: much faster on CPU than a batch of one-channel pictures.
    planes = pictures.reshape(1, -1, *pictures.shape[-2:])
    groups = planes.shape[1]
    planes = conv2d(planes, window.expand(groups, 1, 1, -1), padding=(0, RADIUS), groups=groups)
    planes = conv2d(planes, window[:, None].expand(groups, 1, -1, 1), padding=(RADIUS, 0), groups=groups)
    return planes.reshape(pictures.shape)


def ssim_map(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """SSIM at every pixel and channel [..., C, H, W]; differentiable."""
    _check_pair("ssim", a, b)
    # In sum and difference the formula needs four means instead of five, and keeps its digits in single precision: the rounding
    # of the large variance, that of the sum, cancels between numerator and denominator.
    total, difference = a + b, a - b
    mean_total, mean_difference, total_squared, difference_squared = _blur(
        torch.stack((total, difference, total * total, difference * difference))
    )
    p, q = mean_total * mean_total, mean_difference * mean_difference
    u, v = total_squared - p, difference_squared - q
    ratio: torch.Tensor = ((p - q + 2 * C1) * (u - v + 2 * C2)) / ((p + q + 2 * C1) * (u + v + 2 * C2))
    return ratio


def ssim(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """SSIM: the mean of its map; differentiable. 1 for equal pictures, less for all others."""
    return ssim_map(a, b).mean()


def psnr(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Peak signal-to-noise ratio [...], dB: 20 log10(1 / sqrt(MSE)), MSE over the channels and pixels of one picture.

    One value per leading index. Equal pictures: inf, without a usable gradient.
    """
    _check_pair("psnr", a, b)
    squared: torch.Tensor = (a - b).square().mean(dim=(-3, -2, -1))
    return -10.0 * torch.log10(squared)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two bool masks of the same shape; 1 where both are empty."""
    if a.dtype != bool or b.dtype != bool or a.shape != b.shape:
        received = f"{a.dtype.name} {a.shape}, {b.dtype.name} {b.shape}"
        raise InputError("iou", "two bool masks of the same shape are needed", received)
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def _check_bytes(shape: tuple[int, ...], **pictures: np.ndarray) -> None:
    for name, picture in pictures.items():
        wanted = {"observed": (*shape, 3), "rendered": (*shape, 4)}.get(name, shape)
        if picture.dtype != np.uint8 or picture.shape != wanted:
            raise InputError(name, f"a picture {list(wanted)} uint8 is needed", f"{picture.dtype.name} {picture.shape}")


def masked_pair(
    observed: np.ndarray, object_mask: np.ndarray, rendered: np.ndarray, hand_mask: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """(observed, rendered) as PhysTwin compares them, each [3, H, W] float32 in [0, 1].

    Takes bytes: observed [H, W, 3], object mask [H, W], rendered over black [H, W, 4], hand mask [H, W]. The observed picture is
    cut to the object, the rendered one is not. Both lose what the hand hides. Masks weigh by their value / 255.
    """
    _check_bytes(observed.shape[:2], observed=observed, object_mask=object_mask, rendered=rendered, hand_mask=hand_mask)
    shown = 1.0 - hand_mask / 255.0
    truth = observed * (object_mask / 255.0 * shown / 255.0)[..., None]
    prediction = rendered[..., :3] * (shown / 255.0)[..., None]
    first, second = (torch.from_numpy(p.transpose(2, 0, 1).astype(np.float32)) for p in (truth, prediction))
    return first, second


def silhouettes(
    object_mask: np.ndarray, rendered: np.ndarray, hand_mask: np.ndarray, covered: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """(observed, rendered) silhouettes whose IoU is reported, each [H, W] bool; inputs as in `masked_pair`.

    An alpha of at least `covered` counts as object; PhysTwin counts any but 0. Only the rendered silhouette loses what the hand
    hides, so a part of the observed mask under the hand lowers the IoU.
    """
    _check_bytes(object_mask.shape, object_mask=object_mask, rendered=rendered, hand_mask=hand_mask)
    return object_mask > 0, (rendered[..., 3] >= covered) & (hand_mask < 255)
