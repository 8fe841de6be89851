"""Colors that depend on direction: real spherical harmonics up to degree 3, in the order of Gaussian splats (l = 0.., m = -l..l).

color(d) = max(0, 1/2 + sum_k Y_k(d) c_k), d the unit direction from the camera to the splat in the world, c_k [3] RGB.
The signs are those of the Condon-Shortley phase (Y_1 = -y, z, -x), as splat files have them.
"""

from __future__ import annotations

import math

import torch

C0 = 0.5 / math.sqrt(math.pi)
"""Y_0."""
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = (0.5 * math.sqrt(15 / math.pi), 0.25 * math.sqrt(5 / math.pi), 0.25 * math.sqrt(15 / math.pi))
_C3 = (
    0.25 * math.sqrt(35 / (2 * math.pi)),
    0.5 * math.sqrt(105 / math.pi),
    0.25 * math.sqrt(21 / (2 * math.pi)),
    0.25 * math.sqrt(7 / math.pi),
    0.25 * math.sqrt(105 / math.pi),
)


def basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Y_k [N, (degree + 1)^2] in unit directions [N, 3]."""
    x, y, z = directions.unbind(-1)
    rows = [torch.full_like(x, C0)]
    if degree > 0:
        rows += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        a, b, c = _C2
        rows += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _C3
        rows += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(rows, dim=-1)


def colors(coefficients: torch.Tensor, offsets: torch.Tensor, degree: int) -> torch.Tensor:
    """RGB [N, 3] of coefficients [N, K, 3] seen along `offsets` [N, 3] (any length); bands above `degree` are not used."""
    used = (degree + 1) ** 2
    values = basis(torch.nn.functional.normalize(offsets, dim=-1), degree)
    return torch.clamp_min(torch.einsum("nk,nkc->nc", values, coefficients[:, :used]) + 0.5, 0.0)
