"""Time and memory of one simulated frame: `python -m tests.benchmarks.bench_frame [--device cuda:0] [--repeats 15]`.

One CPU thread, float32, points drawn in a box with springs from `uniform_topology`. Columns: min and median over repeats, and
the median per spring and substep. `captured` is what FrameSolver runs (a recorded graph on CUDA, a launch on a CPU);
`launched` issues every kernel again from Python. Finishes within two minutes.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
import warp as wp

from neuspring.physics import reference
from neuspring.physics.autograd import pack, simulate_frame, solver_for, twin_tensors
from tests.benchmarks.memory import peak_mib, reset_peak
from tests.benchmarks.scenes import CASES, box


def timed(action: Callable[[], object], repeats: int, device: str) -> tuple[float, float]:
    """(min, median) seconds, after one untimed call."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        action()
        if device != "cpu":
            wp.synchronize_device(device)
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:]), statistics.median(seconds[1:])


def bench(name: str, device: str, repeats: int) -> dict[str, float]:
    """Print the rows of a case; return medians by row."""
    twin, motion = box(*CASES[name])
    springs, substeps = len(twin.topology.springs), twin.simulation.substeps
    print(f"\n({name}) {len(twin.topology.nodes)} nodes, {springs} springs, {substeps} substeps per frame")
    x = torch.tensor(twin.topology.nodes, device=device)
    v, (begin, end) = torch.zeros_like(x), torch.tensor(motion, dtype=torch.float32, device=device)
    free, kept = solver_for(twin, device, differentiable=False), solver_for(twin, device, differentiable=True)
    packed = pack(**twin_tensors(twin, device), substep=twin.simulation.substep)
    packed.springs.requires_grad_()

    def learn() -> None:
        after, _ = simulate_frame(kept, packed, x, v, begin, end)
        after.square().sum().backward()

    def relaunched() -> None:
        kept.launch_forward()
        kept.clear_adjoints()
        kept.buffers.tensors["adj_x"][: len(x)].copy_(x)
        kept.launch_backward()

    start = time.perf_counter()
    free.forward(x, v, begin, end)
    print(f"    first forward (compile, record, run): {time.perf_counter() - start:.2f} s")
    start = time.perf_counter()
    learn()
    print(f"    first forward + backward:             {time.perf_counter() - start:.2f} s")
    rows = {
        "forward only, captured": lambda: free.forward(x, v, begin, end),
        "forward only, launched": free.launch_forward,
        "forward + backward, captured": learn,
        "forward + backward, launched": relaunched,
    }
    if name == "a" and device == "cpu":
        scene, state = reference.Scene.of(twin), (twin.topology.nodes.astype(np.float64), np.zeros((len(x), 3)))
        rows["float64 NumPy reference"] = lambda: reference.frame(scene, *state, *motion)
    print(f"    {'':30}{'min ms':>10}{'median ms':>11}{'ns/spring/substep':>19}")
    medians = {}
    for row, action in rows.items():
        shortest, medians[row] = timed(action, repeats, device)
        each = medians[row] / springs / substeps * 1e9
        print(f"    {row:30}{shortest * 1e3:10.2f}{medians[row] * 1e3:11.2f}{each:19.1f}")
    captured, direct = medians["forward only, captured"], medians["forward only, launched"]
    print(f"    captured graph: forward {direct / captured:.2f} x", end="")
    print(f", forward + backward {medians['forward + backward, launched'] / medians['forward + backward, captured']:.2f} x as fast")
    if "float64 NumPy reference" in medians:
        print(f"    forward is {medians['float64 NumPy reference'] / captured:.1f} x as fast as the NumPy reference")
    return medians


def memory(device: str) -> None:
    """Growth of the peak resident memory by the horizon of the gradient, on case (a)."""
    twin, motion = box(*CASES["a"])
    solver = solver_for(twin, device, differentiable=True)
    hands = torch.tensor(motion, dtype=torch.float32, device=device)
    packed = pack(**twin_tensors(twin, device), substep=twin.simulation.substep)
    packed.springs.requires_grad_()
    start = torch.tensor(twin.topology.nodes, device=device)
    state_kib = 2 * start.numel() * start.element_size() / 1024
    print(f"\nPeak resident memory by horizon, case (a); states kept per further frame: {state_kib:.1f} KiB")
    before = None
    for horizon in (1, 10, 50):
        reset_peak()
        x, v, total = start, torch.zeros_like(start), start.new_zeros(())
        for k in range(horizon):
            x, v = simulate_frame(solver, packed, x, v, hands[k % 2], hands[(k + 1) % 2])
            total = total + x.square().sum()
        total.backward()
        packed.springs.grad = None
        peak = peak_mib()
        before = peak if before is None else before
        print(f"    {horizon:3d} frames: {peak:8.1f} MiB, {peak - before:+.2f} MiB since 1 frame")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"device {options.device}, torch {torch.__version__}, warp {wp.__version__}, float32, one CPU thread")
    bench("a", options.device, options.repeats)
    memory(options.device)
    bench("b", options.device, max(3, options.repeats // 3))


if __name__ == "__main__":
    main()
