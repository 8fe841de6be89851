"""Features of VGG16 (Simonyan and Zisserman 2015) up to its second ReLU of 128 channels: layers 0 to 8 of torchvision's `features`.

Written out here, so torchvision is not needed. The weights are a file, see `vgg16_weights`; nothing is downloaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch.nn.functional import conv2d, max_pool2d, relu

from neuspring.core.weights import read_tensors

LAYERS = (0, 2, 5, 7)
"""Places of the convolutions, each followed by a ReLU; a max-pooling comes before the third."""
CHANNELS = (3, 64, 64, 128, 128)
POOLED = 2
MEANS, DEVIATIONS = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, of R, G, B in 0..1."""


@dataclass(frozen=True, eq=False)
class Vgg16:
    """The features with their weights, float32 on one device."""

    tensors: list[torch.Tensor]
    """Kernels and biases in turn."""

    @classmethod
    def load(cls, path: Path, device: str) -> Vgg16:
        """Read the weights. Raises InputError for a damaged file."""
        shapes: dict[str, tuple[int, ...]] = {}
        for layer, before, after in zip(LAYERS, CHANNELS[:-1], CHANNELS[1:], strict=True):
            shapes |= {f"features.{layer}.weight": (after, before, 3, 3), f"features.{layer}.bias": (after,)}
        return cls(read_tensors(path, shapes, device))

    def __call__(self, pictures: torch.Tensor) -> torch.Tensor:
        """Features [B, 128, H / 2, W / 2] of pictures [B, 3, H, W] in 0..1, differentiably."""
        shift, scale = (pictures.new_tensor(values)[:, None, None] for values in (MEANS, DEVIATIONS))
        found = (pictures - shift) / scale
        for k, (kernel, bias) in enumerate(zip(self.tensors[::2], self.tensors[1::2], strict=True)):
            if k == POOLED:
                found = max_pool2d(found, 2)
            found = relu(conv2d(found, kernel, bias, padding=1))
        return found
