"""Random splats before a small camera, as tensors that ask for gradients."""

import numpy as np
import torch

from neuspring.splats.view import View


def random_splats(seed: int, count: int, dtype: torch.dtype) -> list[torch.Tensor]:
    """Means, quaternions, scales, opacities and colors, as `rasterize` takes them, before `small_view`."""
    rng = np.random.default_rng(seed)
    arrays = [
        rng.uniform([-0.6, -0.5, 0.4], [0.6, 0.5, 2.0], (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-5, -1.5, (count, 3))),
        rng.uniform(0.0, 1.0, count),
        rng.uniform(0, 1, (count, 3)),
    ]
    return [torch.tensor(a, dtype=dtype).requires_grad_() for a in arrays]


def small_view(width: int = 37, height: int = 29) -> View:
    intrinsics = torch.tensor([[30.0, 0, width / 2 + 1.3], [0, 28.0, height / 2 - 0.7], [0, 0, 1]], dtype=torch.float64)
    return View(torch.eye(4, dtype=torch.float64), intrinsics, width, height)
