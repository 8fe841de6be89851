"""Features of VGG16 (Simonyan and Zisserman 2015) up to its second ReLU of 128 channels: layers 0 to 8 of torchvision's `features`.

The layers are written out here, so torchvision is not needed. The weights are a file; nothing is downloaded. Imports nothing heavy
before features are loaded, because the workflow asks for the weights before it starts jobs.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.weights import find_file, hub_folder, read_tensors

if TYPE_CHECKING:
    import torch

FILE = "vgg16-397923af.pth"
DIGEST = "397923af"
"""First digits of the SHA-256; by torch hub's convention they are in the file's name."""
MEANS, DEVIATIONS = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, of R, G, B in 0..1."""


def find_weights(path: str | None) -> Path | str:
    """The weight file that the configuration names or that is in torch hub's cache, else one line that says why there is none.

    Raises InputError only for a named file that is missing or has another content.
    """
    return find_file("VGG16 weights", Path(path) if path else None, [hub_folder() / FILE], DIGEST, False)


def load_features(path: Path, device: str) -> Callable[[torch.Tensor], torch.Tensor]:
    """Pictures [B, 3, H, W] in 0..1 -> features [B, 128, H / 2, W / 2], differentiably. Raises InputError for a damaged file."""
    import torch
    from torch.nn import Conv2d, MaxPool2d, ReLU, Sequential

    # Layers without memory: the tensors of the file become their parameters.
    with torch.device("meta"):
        layers = Sequential(
            *(Conv2d(3, 64, 3, padding=1), ReLU(), Conv2d(64, 64, 3, padding=1), ReLU(), MaxPool2d(2)),
            *(Conv2d(64, 128, 3, padding=1), ReLU(), Conv2d(128, 128, 3, padding=1), ReLU()),
        ).requires_grad_(False)
    shapes = {f"features.{name}": tuple(parameter.shape) for name, parameter in layers.named_parameters()}
    tensors = read_tensors(path, shapes, device)
    layers.load_state_dict(dict(zip(layers.state_dict(), tensors, strict=True)), assign=True)

    def features(pictures: torch.Tensor) -> torch.Tensor:
        mean, deviation = (pictures.new_tensor(values)[:, None, None] for values in (MEANS, DEVIATIONS))
        found: torch.Tensor = layers((pictures - mean) / deviation)
        return found

    return features
