"""How close a rendered picture is to the observed one: PSNR and IoU (SSIM: `neuspring.splats.losses`), and the masked pair of
pictures that they compare.

Pictures are [..., C, H, W], float32 or float64 in [0, 1]. Bad shapes and types raise InputError.
"""

from __future__ import annotations

import numpy as np
import torch

from neuspring.core.errors import InputError
from neuspring.splats.losses import check_pair, ssim

__all__ = ["iou", "masked_pair", "psnr", "silhouettes", "ssim"]


def psnr(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Peak signal-to-noise ratio [...], dB: 20 log10(1 / sqrt(MSE)), MSE over the channels and pixels of one picture.

    One value per leading index. Equal pictures: inf, without a usable gradient.
    """
    check_pair("psnr", a, b)
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
