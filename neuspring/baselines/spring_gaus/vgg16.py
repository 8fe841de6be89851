"""Features of VGG16 (Simonyan and Zisserman 2015) up to its second ReLU of 128 channels: layers 0 to 8 of torchvision's `features`.

The layers are written out here, so torchvision is not needed. The weights are a file, see `vgg16_weights`; nothing is downloaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch.nn import Conv2d, MaxPool2d, ReLU, Sequential

from neuspring.core.weights import read_tensors

MEANS, DEVIATIONS = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, of R, G, B in 0..1."""


@dataclass(frozen=True, eq=False)
class Vgg16:
    """The features with their weights, float32 on one device."""

    layers: Sequential

    @classmethod
    def load(cls, path: Path, device: str) -> Vgg16:
        """Read the weights. Raises InputError for a damaged file."""
        # Layers without memory: the tensors of the file become their parameters.
        with torch.device("meta"):
            layers = Sequential(
                *(Conv2d(3, 64, 3, padding=1), ReLU(), Conv2d(64, 64, 3, padding=1), ReLU(), MaxPool2d(2)),
                *(Conv2d(64, 128, 3, padding=1), ReLU(), Conv2d(128, 128, 3, padding=1), ReLU()),
            ).requires_grad_(False)
        shapes = {f"features.{name}": tuple(parameter.shape) for name, parameter in layers.named_parameters()}
        tensors = read_tensors(path, shapes, device)
        layers.load_state_dict(dict(zip(layers.state_dict(), tensors, strict=True)), assign=True)
        return cls(layers)

    def __call__(self, pictures: torch.Tensor) -> torch.Tensor:
        """Features [B, 128, H / 2, W / 2] of pictures [B, 3, H, W] in 0..1, differentiably."""
        mean, deviation = (pictures.new_tensor(values)[:, None, None] for values in (MEANS, DEVIATIONS))
        features: torch.Tensor = self.layers((pictures - mean) / deviation)
        return features
