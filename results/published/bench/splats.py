"""Time and memory of the rasterizer: `python -m results.published.bench.splats [--device cuda:0] [--repeats 9]`.

The scene is a ball of isotropic splats with harmonics of degree 3 that covers 7 % of the image; all tensors have gradients.
Columns are medians over repeats of the forward pass and of both passes, and the rise of peak memory. On a GPU it also draws
100,000 splats at 848 x 480, by gsplat too if it works. Then it measures skinning, with splats and nodes growing together.
"""

from __future__ import annotations

import argparse
import ctypes
import time
from functools import partial

import numpy as np
import torch

from neuspring.core.errors import InputError
from neuspring.splats.rasterize import Backend, choose_backend, rasterize
from neuspring.splats.skinning import Skin
from neuspring.splats.view import View
from results.published.bench.memory import growth
from results.published.bench.simulators import take_turns

SIZES = ((212, 120), (424, 240), (848, 480))
COUNTS = (2_000, 10_000, 50_000)
DEGREE = 3


def ball(count: int, device: str) -> list[torch.Tensor]:
    """Splats on an ellipsoid 0.6 m in front of the camera, as large as their spacing."""
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(count, 3))
    means = 0.1 * towards / np.linalg.norm(towards, axis=1, keepdims=True) * [1.5, 1, 1] + [0, 0, 0.6]
    scale = 0.05 * np.sqrt(4 * np.pi * 1.2 / count)
    arrays = (
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), scale),
        rng.uniform(0.3, 1, count),
        rng.uniform(-0.5, 0.5, (count, (DEGREE + 1) ** 2, 3)),
    )
    return [torch.tensor(a, dtype=torch.float32, device=device).requires_grad_() for a in arrays]


def front(width: int, height: int, device: str) -> View:
    """A camera with the released field of view."""
    focal = 430 * width / 848
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]], device=device)
    return View(torch.eye(4, device=device), intrinsics, width, height)


def bench(size: tuple[int, int], count: int, device: str, repeats: int, backend: Backend) -> float:
    """Print one row; returns the median of both passes, s."""
    splats, view = ball(count, device), front(*size, device)

    def forward() -> None:
        rasterize(*splats, view, degree=DEGREE, backend=backend)

    def both() -> None:
        drawn = rasterize(*splats, view, degree=DEGREE, backend=backend)
        (drawn.rgb.sum() + drawn.alpha.sum() + drawn.depth.sum()).backward()
        for tensor in splats:
            tensor.grad = None

    both()
    if device == "cpu":
        # Freed memory would hide the growth (glibc).
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    grown = growth(both, device)
    times = take_turns({"forward": forward, "both": both}, device, rounds=repeats, least=repeats)
    first, second = times["forward"].median, times["both"].median
    row = f"{backend:>8}{size[0]:>6} x {size[1]:<4}{count:>8}{1e3 * first:>12.1f}{1e3 * second:>16.1f}{grown:>14.0f}"
    print(row, flush=True)
    return second


def skinning(device: str) -> None:
    """Print the time per frame for growing numbers of splats and nodes."""
    print(f"\nskinning\n{'splats':>8}{'nodes':>8}{'ms/frame':>12}{'ns/splat':>12}")
    for count in (2_000, 10_000, 50_000):
        nodes = np.random.default_rng(1).uniform(-0.1, 0.1, (count // 10, 3))
        means = torch.tensor(np.random.default_rng(2).uniform(-0.1, 0.1, (count, 3)), dtype=torch.float32, device=device)
        turns = torch.zeros(count, 4, device=device)
        turns[:, 0] = 1
        step = partial(Skin(nodes, device=device).step, nodes, nodes + 0.001, means, turns)
        median = take_turns({"step": step}, device, rounds=5, least=5)["step"].median
        print(f"{count:>8}{len(nodes):>8}{1e3 * median:>12.2f}{1e9 * median / count:>12.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"device {options.device}, torch {torch.__version__}, float32, degree {DEGREE}")
    print(f"{'':>8}{'pixels':>13}{'splats':>8}{'forward ms':>12}{'gradient too ms':>16}{'peak MiB':>14}")
    start = time.perf_counter()
    for size in SIZES:
        for count in COUNTS:
            bench(size, count, options.device, options.repeats, "warp")
    if options.device != "cpu":
        our_seconds = bench((848, 480), 100_000, options.device, options.repeats, "warp")
        try:
            choose_backend("gsplat", options.device)
            gsplat_seconds = bench((848, 480), 100_000, options.device, options.repeats, "gsplat")
            print(f"gsplat takes {gsplat_seconds / our_seconds:.2f} of our time")
        except InputError as error:
            print(f"gsplat: {error}")
    skinning(options.device)
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
