"""What a machine can do at most, by measurement: python -m tests.benchmarks.limits [DEVICE]

One CPU thread, or a whole GPU. Bandwidth: a = b + s c over three float32 arrays, 12 bytes an element. Arithmetic: chains of fused
multiply-adds of 16 lanes, which need no memory; and chains of one square root and one division per lane.
"""

import functools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from neuspring.core.device import load, resolve_device, start_warp

LANES = 16
CHAINS = 6
"""Independent ones per thread: of 16 lanes, more than the latency of an instruction needs."""
STEPS = 16
"""Of a chain, in a loop as long as Warp unrolls."""
SIZES = {"cpu": (2**20, 2**26, 3 * 2**29), "cuda": (3 * 2**23, 3 * 2**29)}
"""Bytes of the three arrays: of a core's own cache, of the shared cache, of memory; of a GPU's cache and memory."""
THREADS = {"cpu": 2**13, "cuda": 2**22}
TIMES = {"cpu": 1, "cuda": 4}
"""A GPU needs more steps than a CPU to hide that it writes the sum."""


@dataclass(frozen=True)
class Limits:
    """The most that a device does."""

    bandwidth: dict[int, float]
    """Bytes per second, by bytes that are used again and again."""
    fused: float
    """Fused multiply-adds of one number per second."""
    roots: float
    """Pairs of a square root and a division of one number per second."""

    def bandwidth_of(self, working_set: float) -> float:
        """Of the smallest size measured that holds so many bytes, or of the largest."""
        return self.bandwidth[min((size for size in self.bandwidth if size >= working_set), default=max(self.bandwidth))]

    def lines(self) -> list[str]:
        """Text."""
        sizes = [f"{rate / 1e9:.0f} GB/s in {size / 2**20:.0f} MiB" for size, rate in sorted(self.bandwidth.items())]
        arithmetic = (
            f"{self.fused / 1e9:.1f} billion fused multiply-adds and {self.roots / 1e9:.2f} billion roots with divisions a second"
        )
        return [f"bandwidth: {', '.join(sizes)}", f"arithmetic: {arithmetic}"]


def measure(device: str = "cpu") -> Limits:
    """The limits of a device, the best of several runs. Some two seconds."""
    start_warp()
    kind = device.partition(":")[0]
    threads = THREADS[kind]
    work = threads * LANES * CHAINS * STEPS * TIMES[kind]
    fused, roots = (work / chain_seconds(kernel, threads, device) for kernel in kernels(TIMES[kind]))
    return Limits({size: triad(size, device) for size in SIZES[kind]}, fused, roots)


def triad(size: int, device: str) -> float:
    """Bytes per second of a = b + s c, whose three arrays have `size` bytes together."""
    count = size // 12
    a, b, c = (torch.full((count,), value, dtype=torch.float32, device=device) for value in (0.0, 1.0, 2.0))
    calls = max(1, 2**26 // size)

    def run() -> None:
        for _ in range(calls):
            torch.add(b, c, alpha=0.5, out=a)

    return 12 * count * calls / shortest(run, device)


def chain_seconds(kernel: Any, threads: int, device: str) -> float:
    """Seconds of all chains of a kernel."""
    load(kernel, device)
    out = wp.zeros(threads, dtype=wp.types.vector(LANES, wp.float32), device=device)
    return shortest(lambda: wp.launch(kernel, threads, [out], device=device), device)


def shortest(run: Callable[[], object], device: str, repeats: int = 5) -> float:
    """Seconds of the fastest of several runs after one that is not timed."""
    best = float("inf")
    for turn in range(repeats + 1):
        start = time.perf_counter()
        run()
        if device != "cpu":
            wp.synchronize_device(device)
        if turn:
            best = min(best, time.perf_counter() - start)
    return best


@functools.cache
def kernels(times: int) -> tuple[Any, Any]:
    """(fused multiply-adds, square roots with divisions): CHAINS chains a thread of `times` x STEPS steps; their sum is written.

    The loops are unrolled. A loop of Warp over a number that it does not know keeps vectors in memory, at an eighth of the rate.
    """
    lanes = wp.types.vector(LANES, wp.float32)
    vectors: Any = wp.array(dtype=lanes)
    times, steps = wp.constant(times), wp.constant(STEPS)

    def fused(out: vectors):
        i = wp.tid()
        # Values that the compiler does not know, and that stay finite: x <- x s + t has the fixed point t / (1 - s).
        s = out[i] + lanes(0.999)
        t = out[i] + lanes(0.001)
        a = out[i]
        b = out[i] + lanes(0.1)
        c = out[i] + lanes(0.2)
        d = out[i] + lanes(0.3)
        e = out[i] + lanes(0.4)
        f = out[i] + lanes(0.5)
        for _ in range(times):
            for _ in range(steps):
                a = wp.cw_mul(a, s) + t
                b = wp.cw_mul(b, s) + t
                c = wp.cw_mul(c, s) + t
                d = wp.cw_mul(d, s) + t
                e = wp.cw_mul(e, s) + t
                f = wp.cw_mul(f, s) + t
        out[i] = (a + b + c + d + e + f) * 0.0

    def root(x: lanes, t: lanes):
        y = lanes()
        for k in range(LANES):
            y[k] = t[k] / wp.sqrt(x[k])
        return y

    rooted = wp.func(root)

    def roots(out: vectors):
        i = wp.tid()
        # x <- t / sqrt(x) has the fixed point t^(2/3).
        t = out[i] + lanes(1.5)
        a = out[i] + lanes(0.1)
        b = out[i] + lanes(0.2)
        c = out[i] + lanes(0.3)
        d = out[i] + lanes(0.4)
        e = out[i] + lanes(0.5)
        f = out[i] + lanes(0.6)
        for _ in range(times):
            for _ in range(steps):
                a = rooted(a, t)
                b = rooted(b, t)
                c = rooted(c, t)
                d = rooted(d, t)
                e = rooted(e, t)
                f = rooted(f, t)
        out[i] = (a + b + c + d + e + f) * 0.0

    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(fused), unique(roots)


def main() -> None:
    """Print them."""
    torch.set_num_threads(1)
    device = resolve_device(sys.argv[1] if len(sys.argv) > 1 else "cpu")
    print(device, *measure(device).lines(), sep="\n")


if __name__ == "__main__":
    main()
