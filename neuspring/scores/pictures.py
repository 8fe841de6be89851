"""Image metrics: masked pairs of observed and predicted images, their scores, and the cameras that are compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from neuspring.config.images import Images
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.results import Masks
from neuspring.scores.lpips import Lpips
from neuspring.scores.metrics import metrics_of
from neuspring.splats.draw import OBJECT_COVERAGE, picture, view_of
from neuspring.splats.losses import WINDOW_RADIUS, check_pair, ssim_map
from neuspring.splats.model import Gaussians
from neuspring.splats.rasterize import Backend, choose_backend
from neuspring.splats.view import View


def psnr(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Peak signal-to-noise ratio [...], dB, of images [..., C, H, W] in [0, 1]: 20 log10(1 / sqrt(MSE)).

    MSE is over the channels and pixels of one image. Equal images give inf without a usable gradient.
    """
    check_pair("psnr", a, b)
    squared = (a - b).square().mean(dim=(-3, -2, -1))
    return -10.0 * torch.log10(squared)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two bool masks of the same shape; 1 if both are empty.

    Perception uses `data.frames.overlap` instead.
    """
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def masked_pair(
    observed: np.ndarray, object_mask: np.ndarray, rendered: np.ndarray, hand_mask: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (observed, rendered) as PhysTwin compares them, each [3, H, W] float32 in [0, 1].

    Inputs are uint8: observed [H, W, 3], object mask [H, W], rendered over black [H, W, 4], hand mask [H, W]. The observed image is
    cut to the object, the rendered image is not. Pixels of hands are black in both. Masks weight pixels by their value / 255.
    """
    shown = 1.0 - hand_mask / 255.0
    truth = observed * (object_mask / 255.0 * shown / 255.0)[..., None]
    prediction = rendered[..., :3] * (shown / 255.0)[..., None]
    first, second = (torch.from_numpy(p.transpose(2, 0, 1).astype(np.float32)) for p in (truth, prediction))
    return first, second


def silhouettes(
    object_mask: np.ndarray, rendered: np.ndarray, hand_mask: np.ndarray, covered: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (observed, rendered) silhouettes for the IoU, each [H, W] bool; inputs as in `masked_pair`.

    An alpha of at least `covered` counts as object; PhysTwin counts every nonzero alpha. As published, hands are removed only from
    the rendered silhouette, so object pixels under a hand lower the IoU.
    """
    return object_mask > 0, (rendered[..., 3] >= covered) & (hand_mask < 255)


@dataclass(frozen=True, eq=False)
class Pair:
    """The observed and the predicted image of one frame of one camera."""

    observed: np.ndarray
    """[H, W, 3] uint8."""
    rendered: np.ndarray
    """[H, W, 4] uint8, over black."""
    truth: torch.Tensor
    """Observed image [3, H, W], masked as in `masked_pair`."""
    prediction: torch.Tensor
    """Rendered image [3, H, W], masked as in `masked_pair`."""
    silhouettes: tuple[np.ndarray, np.ndarray]
    """Observed and predicted silhouettes [H, W] bool."""
    hands: np.ndarray
    """Pixels of hands [H, W] bool."""

    @classmethod
    def of(cls, observed: np.ndarray, rendered: np.ndarray, labels: np.ndarray) -> Pair:
        """Build a pair from images as in `masked_pair` and labels [H, W]."""
        mask, hands = (np.where(pixels, 255, 0).astype(np.uint8) for pixels in (labels == OBJECT, labels >= HANDS))
        truth, prediction = masked_pair(observed, mask, rendered, hands)
        return cls(observed, rendered, truth, prediction, silhouettes(mask, rendered, hands, OBJECT_COVERAGE), hands > 0)


Perceptual = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""LPIPS of two images [3, H, W]."""


def picture_scores(pair: Pair, lpips: Lpips | str) -> dict[str, float]:
    """Every image metric (`metrics.METRICS`) of a pair.

    `lpips` is the network, or a text with the reason why it is missing; LPIPS is then left out.
    """
    perceptual = None if isinstance(lpips, str) else lpips
    values = {metric.name: metric.measure(pair, perceptual) for metric in metrics_of("pictures")}
    return {name: value for name, value in values.items() if value is not None}


def psnr_of(pair: Pair, _: Perceptual | None) -> float:
    """PSNR, dB."""
    return float(psnr(pair.prediction, pair.truth))


def ssim_of(pair: Pair, _: Perceptual | None) -> float:
    """SSIM of the whole image, which is mostly black."""
    return _ssim_on_black(pair.prediction, pair.truth)


def iou_of(pair: Pair, _: Perceptual | None) -> float:
    """IoU of the silhouettes."""
    return iou(*pair.silhouettes)


def lpips_of(pair: Pair, perceptual: Perceptual | None) -> float | None:
    """LPIPS; None without the network's weights."""
    return None if perceptual is None else float(perceptual(pair.prediction, pair.truth))


def _ssim_on_black(a: torch.Tensor, b: torch.Tensor) -> float:
    """SSIM of images [C, H, W] that are black around the object; only the box around it is computed, because SSIM is 1 on black."""
    shown = ((a != 0) | (b != 0)).any(dim=0)
    rows, columns = (torch.nonzero(shown.any(dim=axis)).ravel() for axis in (1, 0))
    if not len(rows):
        return 1.0
    # Windows centered up to this far outside of the object still contain some of it.
    box = [slice(max(int(where[0]) - WINDOW_RADIUS, 0), int(where[-1]) + WINDOW_RADIUS + 1) for where in (rows, columns)]
    compared = ssim_map(a[:, box[0], box[1]], b[:, box[0], box[1]])
    return 1.0 + float((compared - 1.0).sum(dtype=torch.float64)) / a.numel()


@dataclass(frozen=True, eq=False)
class Scored:
    """Everything that image metrics compare with: capture, masks, views and the rasterizer."""

    capture: Capture
    masks: Mapping[str, np.ndarray]
    """Perceived labels [T, H, W] by camera; empty if the capture provides masks."""
    masks_from: str
    views: Mapping[str, View]
    backend: Backend

    @classmethod
    def of(cls, capture: Capture, perceived: Mapping[str, Masks], images: Images, device: str) -> Scored:
        """Build the reference for the cameras that `images.views` selects."""
        scored = list(capture.cameras.values())[: 1 if images.views == "first" else None]
        views = {camera.name: view_of(camera, device) for camera in scored}
        # Masks of the capture are preferred, so that scores do not depend on the segmentation under test.
        provided = capture.description.masks
        labels = {} if provided else {name: perceived[name].labels for name in views}
        source = "given" if provided else next(iter(perceived.values())).backend
        return cls(capture, labels, source, views, choose_backend(images.backend, device))

    def pair(self, name: str, frame: int, gaussians: Gaussians) -> Pair:
        """Observed and predicted image of one camera in one frame."""
        labels = self.masks[name][frame] if self.masks else self.capture.mask(name, frame)
        rendered = picture(gaussians, self.views[name], self.backend)
        return Pair.of(self.capture.color(name, frame), rendered, labels)
