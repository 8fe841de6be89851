"""What training of splats minimizes, on one view of frame 0.

    L = l1 |C - C*| + dssim (1 - SSIM(C, C*)) + mask |A - M| + depth |D - D*|

C color, A coverage, D expected depth of the picture; C* the image on black outside the object's mask M; D* depth measured on the
object. Means are over all pixels. What hands hide is not compared: there everything is zero on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from neuspring.config.images import Appearance
from neuspring.core.errors import InputError
from neuspring.splats.rasterize import Rendered
from neuspring.splats.ssim import ssim_map
from neuspring.splats.view import View

WINDOW = 12
"""Pixels around the object's mask in which SSIM is taken; its window is 11 wide. Splats farther out cost l1 and mask alone."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One camera's picture of frame 0, masked, on a device."""

    name: str
    view: View
    color: torch.Tensor
    """[H, W, 3] in 0..1, black outside the object's mask."""
    mask: torch.Tensor
    """[H, W] 1 where the object is seen."""
    known: torch.Tensor
    """[H, W] 0 behind hands, else 1."""
    depth: torch.Tensor
    """[H, W] m, 0 where the object's depth was not measured."""
    box: tuple[int, int, int, int]
    """Rows and columns around the mask: top, bottom, left, right, ends excluded."""

    @classmethod
    def of(
        cls, name: str, view: View, color: np.ndarray, mask: np.ndarray, hands: np.ndarray, depth: np.ndarray, margin: float
    ) -> Shot | None:
        """From an image [H, W, 3] uint8, bool masks [H, W] and depth [H, W] m; hands are dilated by a square of `margin` pixels.

        None where nothing of the object is seen. Raises InputError for sizes that differ from the view's.
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
            max(top - WINDOW, 0),
            min(bottom + WINDOW + 1, view.height),
            max(left - WINDOW, 0),
            min(right + WINDOW + 1, view.width),
        )

        def on_device(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values.astype(np.float32), device=view.intrinsics.device)

        on_black = np.where(seen[..., None], color, 0).astype(np.float32) / 255
        measured = np.where(seen, depth, 0.0)
        return cls(name, view, on_device(on_black), on_device(seen), on_device(known), on_device(measured), box)

    @property
    def pixel_width(self) -> float:
        """Width of a pixel at the object, m; NaN where no depth was measured on it."""
        measured = self.depth[self.depth > 0]
        return float(measured.median() / self.view.intrinsics[0, 0]) if len(measured) else float("nan")


def loss(rendered: Rendered, shot: Shot, settings: Appearance) -> torch.Tensor:
    """The training loss of one picture."""
    color = rendered.rgb * shot.known[..., None]
    total = settings.l1 * (color - shot.color).abs().mean()
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
