"""A device against the CPU, both in float32, part by part: `python -m tests.gpu.parity PART DEVICE OUTPUT.json`.

Both devices run the same source with sums in another order, so a tolerance is what rounding may do. Where a record of the same
numbers is at hand (tests/golden) each device may be as far from it as the tests of that part allow, and two devices twice as far
from each other. For the rest, the state of every frame was moved by 1e-6 of itself on the CPU; the tolerance says what that did.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuspring import config
from neuspring.core.device import resolve_device
from neuspring.extensions.spring_gaus.model import SpringGausModel, SpringGausTraining
from neuspring.extensions.spring_gaus.model import roll_out as roll_out_anchors
from neuspring.extensions.spring_gaus.physics import AnchorGraph, AnchorSolver
from neuspring.physics.parameters import pack, twin_tensors
from neuspring.physics.solver import simulate_frame, solver_for
from neuspring.splats.rasterize import choose_backend, rasterize
from neuspring.splats.skinning import Skin
from neuspring.splats.view import View
from neuspring.twin.fit import fit
from neuspring.twin.search import search
from tests.gpu.differences import Difference, array, largest, relative
from tests.support import golden_splats, small
from tests.support.clips import NAMES, Clip, clip
from tests.support.golden_splats import random_splats, small_view

QUIET_FRAME = 6
ABSENT = "absent"
"""The key under which a part says why it could not run; that is no failure."""
POSITION = 4e-5
"""m, over a whole clip without self-collision."""
CLOTH_QUIET, CLOTH_MEDIAN, CLOTH_NODE, CLOTH_FRACTION = 6e-7, 2e-5, 1e-5, 0.7
"""Self-collision flips at thresholds: m, in the frame where nothing flips; the median node of a frame, m; and the share of nodes
that are more than CLOTH_NODE off, which may be 0.35 of them on each side of the record."""
FRAME_GRADIENT = 1e-2
"""Of its norm. Moved by 1e-6 it is 1e-3 (rope_lift)."""
PICTURE, COVER, DEPTH, SPLAT_GRADIENT = 4e-5, 4e-5, 2e-4, 2e-4
METERS, COMPONENTS = 1e-5, 4e-5
ANCHORS, ANCHOR_GRADIENT = 1e-5, 5e-3
"""m after 12 frames, and of the largest entry, in one frame. Moved by 1e-6 they are 5e-7 and 2e-3."""
COST_MEDIAN, COST_LARGEST = 1e-3, 5e-2
"""Of a candidate's cost. Moved by 1e-6 the median is 2e-5, the largest 9e-3: the rope's ends leave and meet the ground."""
LOSS, STIFFNESS_MEDIAN, STIFFNESS_MOST = 2e-2, 2e-3, 2e-2
"""Of an epoch's loss, of the stiffness of the middle spring and of the spring at 95 %. Moved by 1e-6 they are 3e-3, 3e-4 and 3e-3;
the fit itself moves the middle spring by 2.5e-2."""
GSPLAT = 1e-4
"""Mean over the picture: gsplat's clamp of coverage and ours differ, so the splats here are below both."""
GSPLAT_GRADIENT = 1e-2


def simulator(device: str) -> dict[str, Any]:
    """The released clips: whole rollouts, a frame with self-collision from every recorded state, and the gradient of a frame."""
    found = []
    for name in NAMES:
        c, free = clip(name), name != "cloth_selfcollision"
        received, wanted = (_frames(c, where, restart=not free) for where in (device, "cpu"))
        if free:
            found.append(largest(f"{name}: positions over the clip", "m", received, wanted, POSITION))
            pair = [_frame_gradient(c, where) for where in (device, "cpu")]
            error = np.linalg.norm(pair[0] - pair[1]) / np.linalg.norm(pair[1])
            found.append(Difference(f"{name}: gradient of stiffness in a frame", "of its norm", float(error), FRAME_GRADIENT))
        else:
            error = np.abs(received - wanted).max(axis=-1)
            quiet = QUIET_FRAME - c.frames.start
            found.append(Difference(f"{name}: the frame where nothing flips", "m", float(error[quiet].max()), CLOTH_QUIET))
            found.append(Difference(f"{name}: median node", "m", float(np.median(error, axis=1).max()), CLOTH_MEDIAN))
            share = (~(error <= CLOTH_NODE)).mean(axis=1).max()
            found.append(Difference(f"{name}: nodes beyond {CLOTH_NODE:g} m", "share", float(share), CLOTH_FRACTION))
    return {"differences": found}


def _frames(c: Clip, device: str, *, restart: bool) -> np.ndarray:
    """Positions [F, N, 3] at frame ends; `restart` starts every frame from the record."""
    solver = solver_for(c.twin, device, differentiable=False)
    x, v, hands = (torch.tensor(values, dtype=torch.float32, device=device) for values in (c.x, c.v, c.controllers))
    state, ends = (x[0], v[0]), []
    for k in c.frames:
        state = solver.forward(*((x[k - 1], v[k - 1]) if restart else state), hands[k - 1], hands[k])
        ends.append(array(state[0]))
    return np.stack(ends)


def _frame_gradient(c: Clip, device: str) -> np.ndarray:
    """Gradient with respect to log stiffness [S] of the loss of the clip's middle frame, from the record."""
    k = c.frames[len(c.frames) // 2]
    values = twin_tensors(c.twin, device)
    x, v, hands = (torch.tensor(values, dtype=torch.float32, device=device) for values in (c.x, c.v, c.controllers))
    log_stiffness = values["stiffness"].log().requires_grad_()
    values["stiffness"] = log_stiffness.exp()
    packed = pack(**values, substep=c.twin.simulation.substep)
    after, _ = simulate_frame(solver_for(c.twin, device, differentiable=True), packed, x[k - 1], v[k - 1], hands[k - 1], hands[k])
    loss = c.frame_loss(device, torch.float32)
    return array(torch.autograd.grad(loss(k, after), log_stiffness)[0])


def rasterizer(device: str) -> dict[str, Any]:
    """The golden pictures and their gradients; pictures on the pixels that no threshold decides."""
    found = []
    for case in ("r03_overlap6", "r06_sh3", "r09_dense400"):
        received, wanted = (_picture(case, where) for where in (device, "cpu"))
        for name, unit, allowed in (("rgb", "", PICTURE), ("alpha", "", COVER), ("depth", "m", DEPTH)):
            found.append(largest(f"{case}: {name}", unit, received[name], wanted[name], allowed))
        for name in golden_splats.INPUTS:
            found.append(relative(f"{case}: gradient of {name}", received[name], wanted[name], SPLAT_GRADIENT))
    return {"differences": found}


def _picture(case: str, device: str) -> dict[str, np.ndarray]:
    golden = golden_splats.Golden(case, torch.float32, device)
    picture = rasterize(*golden.inputs.values(), golden.view, **golden.options)
    loss = golden.loss("B", picture.rgb, picture.alpha, picture.depth)
    gradients = torch.autograd.grad(loss, list(golden.inputs.values()))
    stable = golden.values["stable"]
    images = {name: array(getattr(picture, name))[stable] for name in ("rgb", "alpha", "depth")}
    return images | {name: array(gradient) for name, gradient in zip(golden.inputs, gradients, strict=True)}


def skinning(device: str) -> dict[str, Any]:
    """The golden rollouts of splats bound to nodes."""
    found = []
    for path in sorted(golden_splats.FOLDER.glob("l*.npz")):
        with np.load(path, allow_pickle=False) as golden:
            points, means, quaternions = (golden[name] for name in ("points", "means0", "quats0"))
        (places, turns), (wanted_places, wanted_turns) = (_carried(points, means, quaternions, where) for where in (device, "cpu"))
        found.append(largest(f"{path.stem}: centers", "m", places, wanted_places, METERS))
        signs = np.sign((turns * wanted_turns).sum(axis=-1, keepdims=True))
        found.append(largest(f"{path.stem}: quaternions", "", turns * signs, wanted_turns, COMPONENTS))
    return {"differences": found}


def _carried(points: np.ndarray, means: np.ndarray, quaternions: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    start = (torch.tensor(values, dtype=torch.float32, device=device) for values in (means, quaternions))
    places, turns = zip(*Skin(points[0], device=device).carry(points, *start), strict=True)
    return np.stack([array(place) for place in places]), np.stack([array(turn) for turn in turns])


def spring_gaus(device: str) -> dict[str, Any]:
    """A bar of 72 anchors that is lifted: positions over 12 frames, and the gradient of one."""
    lattice = np.stack(np.meshgrid(np.arange(8), np.arange(3), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 3)
    anchors = lattice * 0.02 + np.random.default_rng(0).uniform(-0.002, 0.002, lattice.shape) + [0, 0, 0.05]
    hands = (anchors[:3] + 0.004)[None] + 0.01 * np.arange(12)[:, None, None] * np.array([0.3, 0.2, 1.0])
    settings = SpringGausTraining(anchors=72, neighbors=12, full_neighbors=8, substeps=150, damping=1.0)
    graph = AnchorGraph.between(anchors, hands[0], settings.neighbors)
    model = SpringGausModel.start(graph, settings, frame_time=1 / 30, up_sign=1.0, gravity=9.8, ground=True)
    model = replace(model, link_stiffness=3e3)
    (received, reason), (wanted, _) = (roll_out_anchors(model, hands, where) for where in (device, "cpu"))
    assert not reason, reason
    found = [largest("positions over 12 frames", "m", received, wanted, ANCHORS)]
    gradients = [_anchor_gradients(model, hands[:2], where) for where in (device, "cpu")]
    for name in gradients[1]:
        found.append(relative(f"gradient of {name}", gradients[0][name], gradients[1][name], ANCHOR_GRADIENT))
    return {"differences": found}


def _anchor_gradients(model: SpringGausModel, hands: np.ndarray, device: str) -> dict[str, torch.Tensor]:
    values = {name: tensor.requires_grad_() for name, tensor in model.tensors(device).items()}
    begin, end = torch.tensor(hands, dtype=torch.float32, device=device)
    # Away from rest: springs as good as unstretched exert no force, and rounding would choose which.
    noise = np.random.default_rng(1).normal(size=(2, *model.anchors.shape))
    x = torch.tensor(model.anchors + 0.002 * noise[0], dtype=torch.float32, device=device).requires_grad_()
    v = torch.tensor(0.1 * noise[1], dtype=torch.float32, device=device)
    solver = AnchorSolver(model, model, model.substeps, device)
    after, speed = solver.frame(model.parameters(values), x, v, begin, end)
    (100 * after.square().sum() + (speed * torch.arange(3, device=device)).sum()).backward()
    trained = {"anchors": x} | values
    return {name: tensor.grad for name, tensor in trained.items() if tensor.grad is not None and bool(tensor.grad.any())}


def tiny_search(device: str) -> dict[str, Any]:
    """Two generations on a toy rope. The first has the same candidates on every machine, since no cost has been seen; the second
    has the same ones where the costs put the first in the same order, and is compared where it has."""
    found, tables = [], []
    for where in (device, "cpu"):
        problem = small.search_problem(device=where)
        with contextlib.redirect_stdout(io.StringIO()):
            tables.append(search(problem, seed=0).trace)
    names = list(problem.variables)
    same = np.all(tables[0][names].to_numpy() == tables[1][names].to_numpy(), axis=1)
    first = tables[1]["generation"].to_numpy() == 0
    found.append(Difference("candidates of the first generation that differ", "", float((~same[first]).sum()), 0))
    differing = tables[0].loc[same, "reason"].to_numpy() != tables[1].loc[same, "reason"].to_numpy()
    found.append(Difference("candidates that fail on one device alone", "", float(differing.sum()), 0))
    costs = [table.loc[same, "cost"].to_numpy() for table in tables]
    errors = np.abs(costs[0] / costs[1] - 1)
    found.append(Difference("cost of a candidate, median", "of the cost", float(np.median(errors)), COST_MEDIAN))
    found.append(Difference("cost of a candidate, largest", "of the cost", float(errors.max()), COST_LARGEST))
    best = [int(table["cost"].to_numpy().argmin()) for table in tables]
    facts = {"candidates": len(same), "compared": int(same.sum()), "best candidate": best[0], "best candidate on the CPU": best[1]}
    return {"differences": found, "facts": facts}


def tiny_fit(device: str) -> dict[str, Any]:
    """Three epochs on a toy rope. Adam gives a spring with next to no gradient a step of either sign, so that single springs may
    part: the middle one and the one at 95 % are compared, and the losses."""
    results = []
    for where in (device, "cpu"):
        settings = config.Fit(epochs=3, learning_rate=5e-3)
        with contextlib.redirect_stdout(io.StringIO()):
            results.append(fit(small.fit_problem(fit=settings, device=where)))
    losses = [result.history["loss"].to_numpy(np.float64) for result in results]
    errors = np.abs(losses[0] / losses[1] - 1)
    found = [Difference(f"loss of epoch {epoch}", "of the loss", float(error), LOSS) for epoch, error in enumerate(errors)]
    stiffness = [result.twin.material.stiffness.astype(np.float64) for result in results]
    middle, most = np.quantile(np.abs(stiffness[0] / stiffness[1] - 1), [0.5, 0.95])
    found.append(Difference("stiffness, the middle spring", "of it", float(middle), STIFFNESS_MEDIAN))
    found.append(Difference("stiffness, the spring at 95 %", "of it", float(most), STIFFNESS_MOST))
    return {"differences": found, "facts": {"best epoch": results[0].best_epoch, "best epoch on the CPU": results[1].best_epoch}}


def gsplat(device: str) -> dict[str, Any]:
    """gsplat against our rasterizer, on the same device: pictures, gradients, and times of both passes."""
    if not device.startswith("cuda"):
        return {ABSENT: f"gsplat needs CUDA, the device is {device}"}
    if importlib.util.find_spec("gsplat") is None:
        return {ABSENT: "gsplat is not installed (the extra `gpu`)"}
    choose_backend("gsplat", device)
    view = small_view()
    view = View(view.world_to_camera.float().to(device), view.intrinsics.float().to(device), view.width, view.height)
    splats = [tensor.detach().to(device) for tensor in random_splats(4, 200, torch.float32)]
    splats[3] = splats[3].clamp(max=0.95)
    splats = [tensor.requires_grad_() for tensor in splats]
    pictures = [rasterize(*splats, view, backend=backend) for backend in ("gsplat", "warp")]
    gradients = [torch.autograd.grad(p.rgb.sum() + p.alpha.sum(), splats) for p in pictures]
    found = []
    for name in ("rgb", "alpha"):
        error = float((getattr(pictures[0], name) - getattr(pictures[1], name)).abs().mean())
        found.append(Difference(f"{name}, mean", "", error, GSPLAT))
    for name, received, wanted in zip(golden_splats.INPUTS, *gradients, strict=True):
        error = float((received - wanted).norm() / wanted.norm())
        found.append(Difference(f"gradient of {name}", "of its norm", error, GSPLAT_GRADIENT))

    def both_passes(backend: str) -> float:
        torch.cuda.synchronize()
        start = time.perf_counter()
        rasterize(*splats, view, backend=backend).rgb.sum().backward()
        torch.cuda.synchronize()
        return 1e3 * (time.perf_counter() - start)

    facts = {f"{name}, ms, median of 9": float(np.median([both_passes(name) for _ in range(9)])) for name in ("gsplat", "warp")}
    return {"differences": found, "facts": facts}


PARTS: dict[str, Callable[[str], dict[str, Any]]] = {
    "simulator": simulator,
    "rasterizer": rasterizer,
    "skinning": skinning,
    "spring_gaus": spring_gaus,
    "search": tiny_search,
    "fit": tiny_fit,
    "gsplat": gsplat,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("device")
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    result = PARTS[options.part](resolve_device(options.device))
    if "differences" in result:
        result["differences"] = [difference.as_dict() for difference in result["differences"]]
    options.output.write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main()
