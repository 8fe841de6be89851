"""LPIPS, the perceptual distance of two images (Zhang et al. 2018): AlexNet features with the linear heads v0.1.

    d(a, b) = sum over the five ReLUs l of the mean over pixels of w_l . (f_l(a) - f_l(b))^2,    f_l of unit length over channels

AlexNet is torchvision's (Krizhevsky 2014, "One weird trick"), written out here to avoid the dependency. Its weights and the heads
are files in torch hub's cache; the heads are also found inside an installed `lpips` or `torchmetrics`. Their SHA-256 is checked.
Nothing is downloaded; `find_weights` reports missing files.

torch is imported inside functions, because the workflow looks for the weights before it plans any job.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.errors import InputError
from neuspring.core.weights import find_file, hub_folder, read_tensors

if TYPE_CHECKING:
    import torch
    from torch.nn import Sequential

BACKBONE = "alexnet-owt-7be5be79.pth"
BACKBONE_DIGEST = "7be5be79"
"""First digits of the SHA-256, part of the file name by torch hub's convention."""
BACKBONE_ADDRESS = f"https://download.pytorch.org/models/{BACKBONE}"
HEADS = "lpips_alex_v0.1.pth"
HEADS_DIGEST = "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
PACKAGED_HEADS = {"lpips": "weights/v0.1/alex.pth", "torchmetrics": "functional/image/lpips_models/alex.pth"}
"""Path of the heads inside each package that contains them."""


def find_weights(backbone: Path | None = None, heads: Path | None = None, *, trusted: bool = False) -> tuple[Path, Path] | str:
    """Find the files of backbone and heads; return one line about missing files instead.

    None: search the usual caches. SHA-256 is checked unless `trusted`. Raises InputError only if a given path is missing or has
    another content.
    """
    hub = hub_folder()
    places = [hub / HEADS]
    for package, inside in PACKAGED_HEADS.items():  # found without importing the package
        spec = importlib.util.find_spec(package)
        places += [Path(folder) / inside for folder in (spec.submodule_search_locations or [] if spec else [])]
    first = find_file("AlexNet weights", backbone, [hub / BACKBONE], BACKBONE_DIGEST, trusted)
    second = find_file("LPIPS heads", heads, places, HEADS_DIGEST, trusted)
    if isinstance(first, Path) and isinstance(second, Path):
        return first, second
    return "; ".join(reason for reason in (first, second) if isinstance(reason, str))


HEAD_CHANNELS = (64, 192, 384, 256, 256)
"""Channels after each convolution."""
RGB_SHIFT = (-0.030, -0.088, -0.188)
RGB_SCALE = (0.458, 0.448, 0.450)
"""Means and standard deviations of ImageNet's R, G, B, for images in [-1, 1]."""
LEAST_NORM = 1e-10
"""Added to the length of a feature before the division by it."""


def alexnet() -> Sequential:
    """AlexNet's convolutions, in torchvision's order."""
    from torch.nn import Conv2d, MaxPool2d, ReLU, Sequential

    return Sequential(
        *(Conv2d(3, 64, 11, stride=4, padding=2), ReLU(), MaxPool2d(3, 2)),
        *(Conv2d(64, 192, 5, padding=2), ReLU(), MaxPool2d(3, 2)),
        *(Conv2d(192, 384, 3, padding=1), ReLU(), Conv2d(384, 256, 3, padding=1), ReLU()),
        *(Conv2d(256, 256, 3, padding=1), ReLU()),
    )


def read_layers(path: Path, make: Callable[[], Sequential], device: str) -> Sequential:
    """Load torchvision weights from `path` into layers, float32 without gradients. Raises InputError for a damaged file."""
    import torch

    # On the meta device, layers use no memory; the tensors of the file become their parameters.
    with torch.device("meta"):
        layers = make().requires_grad_(False)
    shapes = {f"features.{name}": tuple(parameter.shape) for name, parameter in layers.named_parameters()}
    tensors = read_tensors(path, shapes, device)
    layers.load_state_dict(dict(zip(layers.state_dict(), tensors, strict=True)), assign=True)
    return layers


@dataclass(frozen=True, eq=False)
class Lpips:
    """The LPIPS network, float32 on one device."""

    layers: Sequential
    """AlexNet's convolutions and ReLUs (`alexnet`)."""
    heads: list[torch.Tensor]
    """Weights w_l [1, channels, 1, 1] of the five layers."""

    @classmethod
    def load(cls, backbone: Path | None = None, heads: Path | None = None, device: str = "cpu", *, trusted: bool = False) -> Lpips:
        """Read the weights that `find_weights` returns. Raises InputError if they are missing or damaged."""
        weights = find_weights(backbone, heads, trusted=trusted)
        if isinstance(weights, str):
            remedy = f"Download the backbone from {BACKBONE_ADDRESS}; install the heads with `pip install --no-deps lpips`."
            raise InputError("LPIPS", "the weights must be in torch hub's cache", weights, remedy)
        linear = {f"lin{k}.model.1.weight": (1, channels, 1, 1) for k, channels in enumerate(HEAD_CHANNELS)}
        return cls(read_layers(weights[0], alexnet, device), read_tensors(weights[1], linear, device))

    @classmethod
    def cached(cls, device: str) -> Lpips | str:
        """As `load`, from the usual caches; if files are missing, one line that names them."""
        weights = find_weights()
        # `find_weights` has just checked the SHA-256.
        return weights if isinstance(weights, str) else cls.load(*weights, device, trusted=True)

    def features(self, pictures: torch.Tensor) -> list[torch.Tensor]:
        """The output of each ReLU [B, channels, h, w] for normalized images [B, 3, H, W]."""
        from torch.nn import ReLU

        outputs = []
        for layer in self.layers:
            pictures = layer(pictures)
            if isinstance(layer, ReLU):
                outputs.append(pictures)
        return outputs

    def __call__(self, a: torch.Tensor, b: torch.Tensor, *, released_range: bool = False) -> torch.Tensor:
        """Distances [...] of images [..., 3, H, W] in [0, 1], at least 31 px wide and high; 0 for equal images. Differentiable.

        Images are mapped to [-1, 1], as LPIPS expects; `released_range` leaves them in [0, 1], as PhysTwin's evaluation does.
        """
        import torch

        pictures = torch.cat([p.reshape(-1, *p.shape[-3:]).to(self.heads[0]) for p in (a, b)])
        if not released_range:
            pictures = 2 * pictures - 1
        shift, scale = (pictures.new_tensor(values)[:, None, None] for values in (RGB_SHIFT, RGB_SCALE))
        distance = pictures.new_zeros(len(pictures) // 2)
        # No TF32, so that GPU and CPU agree.
        with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
            for head, layer in zip(self.heads, self.features((pictures - shift) / scale), strict=True):
                unit = layer / (torch.linalg.vector_norm(layer, dim=1, keepdim=True) + LEAST_NORM)
                first, second = unit.chunk(2)
                distance = distance + ((first - second).square() * head).sum(dim=1).mean(dim=(1, 2))
        return distance.reshape(a.shape[:-3])
