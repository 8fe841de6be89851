"""Golden pictures of splats, and random splats before a small camera: inputs as tensors that ask for gradients, and the view."""

from pathlib import Path

import numpy as np
import torch

from neuspring.splats.view import Limits, View

FOLDER = Path(__file__).parents[1] / "golden"
CASES = sorted(path.stem for path in FOLDER.glob("r*.npz"))
INPUTS = ("means", "quats", "scales", "opacities", "colors")


class Golden:
    def __init__(self, name, dtype, device="cpu"):
        with np.load(FOLDER / f"{name}.npz") as stored:
            self.values = {key: stored[key] for key in stored.files}
        v = self.values
        self.degree = int(v["sh_degree"]) if int(v["sh_degree"]) >= 0 else None
        self.color_key = "colors" if self.degree is None else "sh_coeffs"
        keys = ("means", "quats", "scales", "opacities", self.color_key)
        self.inputs = {
            name: torch.tensor(v[key], dtype=dtype, device=device).requires_grad_() for name, key in zip(INPUTS, keys, strict=True)
        }
        matrices = (torch.tensor(v[key], dtype=dtype, device=device) for key in ("viewmat", "K"))
        self.view = View(*matrices, int(v["width"]), int(v["height"]))
        self.background = tuple(map(float, v["background"]))
        self.limits = Limits(
            near=float(v["near"]),
            far=float(v["far"]),
            blur=float(v["eps2d"]),
            alpha_min=float(v["alpha_min"]),
            alpha_max=float(v["alpha_max"]),
            transmittance_min=float(v["t_stop"]),
        )

    @property
    def options(self):
        return {"degree": self.degree, "background": self.background, "limits": self.limits}

    def expected_gradient(self, which, name):
        return self.values[f"grad{which}_{self.color_key if name == 'colors' else name}"]

    def loss(self, which, rgb, alpha, depth):
        weights = {key: torch.tensor(self.values[f"w_{key}"]).to(rgb) for key in ("rgb", "alpha", "depth")}
        total = (weights["rgb"] * rgb).sum() + (weights["alpha"] * alpha).sum()
        return total if which == "A" else total + (weights["depth"] * depth).sum()


def random_splats(seed, count, dtype):
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


def small_view(width=37, height=29):
    intrinsics = torch.tensor([[30.0, 0, width / 2 + 1.3], [0, 28.0, height / 2 - 0.7], [0, 0, 1]], dtype=torch.float64)
    return View(torch.eye(4, dtype=torch.float64), intrinsics, width, height)
