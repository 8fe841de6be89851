"""Neural spring field (the paper's NSF): a physical quantity of each spring as a function of its midpoint at rest.

    S(e) = S0 + F(x_mid(e)),   x_mid = (x_i + x_j) / 2

F interpolates three N x N planes of C channels (xy, yz, xz) bilinearly and sums the three features. The planes span the bounding
cube of all midpoints. A Fourier feature transform and an MLP of three layers follow. The last layer starts at zero, so F = 0 at
the start. `parameters` defines S and its scale.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import nn
from torch.nn.functional import embedding_bag

from neuspring.config import SpringFieldSettings as Settings

TEXEL_SCALE = 0.1
"""Standard deviation of the initial texels, which are white noise."""
FIELD_CHANNELS, FIELD_HIDDEN, FIELD_LAYERS, FIELD_BANDS = 32, 128, 3, 4
"""Channels per texel; units per hidden layer; layers of the MLP, the last linear layer included; frequencies (powers of two,
times pi) of the Fourier features."""
ADAPTIVE_FACTOR = 0.85
"""Texels per side of a plane, divided by the square root of the number of springs, for an adaptive `resolution`."""
PLANE_AXES = ((0, 1), (1, 2), (0, 2))
"""Coordinates that span the planes xy, yz, xz."""


def midpoints(canonical: np.ndarray, springs: np.ndarray) -> np.ndarray:
    """Midpoints [S, 3], m, of springs [S, 2], which index the points at rest `canonical` [N + C, 3]: nodes, then controllers."""
    return np.asarray(canonical.astype(np.float64)[springs].mean(axis=1))


def in_cube(points: np.ndarray) -> np.ndarray:
    """Map points [S, 3] to [-1, 1]^3 by their bounding cube, which has the center and the longest side of the bounding box."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(float((high - low).max()) / 2, 1e-12)
    return np.asarray((points - (low + high) / 2) / half)


def fourier(values: torch.Tensor, bands: int) -> torch.Tensor:
    """Fourier features sin(2^k pi u), cos(2^k pi u) for k < bands: [..., D] -> [..., 2 D bands]."""
    angle = (values[..., None] * (torch.pi * 2.0 ** torch.arange(bands, device=values.device))).flatten(-2)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


class TriPlane(nn.Module):
    """Three feature planes, interpolated at fixed points.

    Only texels next to the points can receive a gradient. `texels` [A, C] contains these, out of the 3 N^2 texels of the full
    planes. So memory and time depend on the number of springs, not on N^2.
    """

    indices: torch.Tensor
    weights: torch.Tensor

    def __init__(self, points: np.ndarray, resolution: int, channels: int, scale: float, generator: torch.Generator) -> None:
        """Create planes for `points` [S, 3] in [-1, 1]^3. Texels of the full planes are drawn from N(0, scale^2)."""
        super().__init__()
        cells, weights = bilinear(points, resolution)
        active, inverse = np.unique(cells, return_inverse=True)
        full = scale * torch.randn(3 * resolution**2, channels, generator=generator)
        self.texels = nn.Parameter(full[torch.from_numpy(active)])
        self.register_buffer("indices", torch.from_numpy(inverse.reshape(cells.shape)), persistent=False)
        self.register_buffer("weights", torch.from_numpy(weights.astype(np.float32)), persistent=False)

    def forward(self) -> torch.Tensor:
        """Summed features [S, C] of the points."""
        return embedding_bag(self.indices, self.texels, per_sample_weights=self.weights, mode="sum")


def bilinear(points: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels (index: plane N^2 + row N + column) and bilinear weights [S, 12] of points [S, 3] in [-1, 1]^3.

    Texel centers form a regular grid; the outermost centers are on the sides of the cube. Columns follow the first axis of a
    plane.
    """
    grid = (np.clip(points, -1, 1) + 1) / 2 * (resolution - 1)
    low = np.minimum(np.floor(grid).astype(np.int64), resolution - 2)
    fraction = grid - low
    cells, weights = [], []
    for plane, (a, b) in enumerate(PLANE_AXES):
        for row in (0, 1):
            for column in (0, 1):
                cells.append(plane * resolution**2 + (low[:, b] + row) * resolution + low[:, a] + column)
                along, up = (fraction[:, a], fraction[:, b])
                weights.append((along if column else 1 - along) * (up if row else 1 - up))
    return np.stack(cells, axis=1), np.stack(weights, axis=1)


class SpringField(nn.Module):
    """F at the midpoints of a fixed set of springs. `forward` returns [S, outputs], zero at the start."""

    coordinates: torch.Tensor

    def __init__(self, points: np.ndarray, settings: Settings, outputs: int, seed: int) -> None:
        """Create the field for the midpoints `points` [S, 3], m. Initial weights depend only on `seed`, the settings and S."""
        super().__init__()
        mapped = in_cube(points)
        if settings.shuffled:
            mapped = mapped[np.random.default_rng(seed).permutation(len(mapped))]
        self.register_buffer("coordinates", torch.from_numpy(mapped.astype(np.float32)), persistent=False)
        # Bilinear interpolation requires at least 2.
        adaptive = max(round(ADAPTIVE_FACTOR * math.sqrt(len(points))), 2)
        self.resolution = adaptive if settings.resolution == "adaptive" else settings.resolution
        generator = torch.Generator().manual_seed(seed)
        self.planes = None
        if settings.triplane:
            self.planes = TriPlane(mapped, self.resolution, FIELD_CHANNELS, TEXEL_SCALE, generator)
        widths = [self.encoded().shape[1], *[FIELD_HIDDEN] * (FIELD_LAYERS - 1), outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(widths))
        with torch.no_grad():
            for layer in self.layers:
                assert isinstance(layer, nn.Linear)
                bound = layer.in_features**-0.5
                for tensor in (layer.weight, layer.bias):
                    tensor.uniform_(-bound, bound, generator=generator)
            for tensor in self.layers[-1].parameters():
                tensor.zero_()

    def encoded(self) -> torch.Tensor:
        """Inputs of the MLP [S, width]: Fourier features of the plane features and of the coordinates."""
        parts = [self.coordinates] if self.planes is None else [self.planes(), self.coordinates]
        return torch.cat([fourier(part, FIELD_BANDS) for part in parts], dim=1)

    def forward(self) -> torch.Tensor:
        """F [S, outputs] of the springs."""
        x = self.encoded()
        for layer in self.layers[:-1]:
            x = torch.relu(layer(x))
        result: torch.Tensor = self.layers[-1](x)
        return result
