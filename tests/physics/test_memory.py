"""Memory does not grow with the horizon, except for the states between frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from neuspring.physics.parameters import pack
from neuspring.physics.solver import FrameSolver, simulate_frame
from tests.support.scenes import random_scene, solver_for, tensors

VECTOR = 3 * 4
"""Bytes of a float32 vector."""


def saved_bytes(substeps: int, frames: int) -> int:
    """Bytes of distinct storage that autograd keeps for a chain of up to 9 frames; hands are not counted."""
    body, x, v, hands = random_scene(31, nodes=10, frames=9, substeps=substeps, self_collision=True)
    solver = solver_for(body, hands.shape[1], dtype=torch.float32)
    motion = torch.tensor(hands, dtype=torch.float32)
    values = tensors(body, dtype=torch.float32)
    values["stiffness"].requires_grad_()
    storages: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        # Holding the storage keeps its address from being given to another tensor.
        storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
        return tensor

    parameters = pack(**values, substep=body.simulation.substep)
    state = torch.tensor(x, dtype=torch.float32), torch.tensor(v, dtype=torch.float32)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        for k in range(frames):
            state = simulate_frame(solver, parameters, *state, motion[k], motion[k + 1])
    shared = motion.untyped_storage()
    return sum(s.nbytes() for s in storages.values() if s.data_ptr() != shared.data_ptr())


@pytest.mark.parametrize("substeps", [5, 50])
def test_a_further_frame_keeps_its_start_only(substeps: int) -> None:
    """x and v of 10 nodes, whatever the number of substeps."""
    assert saved_bytes(substeps, 9) - saved_bytes(substeps, 1) == 8 * 2 * 10 * VECTOR


def storages(solver: FrameSolver) -> dict[int, int]:
    """Bytes by address of everything that the solver keeps; the hash grid's cells are Warp's."""
    b = solver.buffers
    sizes = {view.ptr: view.capacity for view in b.views.values() if isinstance(view, wp.array)}
    return sizes | {t.data_ptr(): t.untyped_storage().nbytes() for t in (*b.tensors.values(), *b.indices.values())}


@pytest.mark.parametrize("differentiable", [True, False])
@pytest.mark.parametrize("threads", [False, True])
def test_buffers_do_not_grow_with_frames(threads: bool, differentiable: bool) -> None:
    body, x, v, hands = random_scene(32, frames=12, self_collision=True)
    options: dict[str, Any] = {"dtype": torch.float32, "differentiable": differentiable, "threads": threads}
    solver, motion = solver_for(body, hands.shape[1], **options), torch.tensor(hands, dtype=torch.float32)
    before, grid = storages(solver), solver.buffers.views["grid"].id
    state = torch.tensor(x, dtype=torch.float32), torch.tensor(v, dtype=torch.float32)
    for k in range(12):
        state = solver.forward(*state, motion[k], motion[k + 1])
        if differentiable:
            solver.backward(*state)
    assert storages(solver) == before
    assert solver.buffers.views["grid"].id == grid


@pytest.mark.parametrize("twins", [1, 4])
@pytest.mark.parametrize("threads", [False, True])
def test_only_gradients_keep_all_substeps(threads: bool, twins: int) -> None:
    """Differentiable: every substep of one frame, of each twin. Forward only: independent of the number of substeps."""
    sizes = {}
    for substeps in (10, 40):
        body, *_, hands = random_scene(33, substeps=substeps)
        for differentiable in (True, False):
            options: dict[str, Any] = {"dtype": torch.float32, "differentiable": differentiable, "threads": threads}
            sizes[substeps, differentiable] = sum(storages(solver_for([body] * twins, hands.shape[1], **options)).values())
    assert sizes[40, False] == sizes[10, False]
    nodes, total = body.nodes, body.nodes + hands.shape[1]
    assert sizes[40, True] - sizes[10, True] == twins * 30 * (2 * total + nodes) * VECTOR


def test_results_do_not_alias_the_buffers() -> None:
    """A state handed out stays what it was when the next frame overwrites the buffers."""
    body, x, v, hands = random_scene(34)
    solver, motion = solver_for(body, hands.shape[1]), torch.tensor(hands)
    first = solver.forward(torch.tensor(x), torch.tensor(v), motion[0], motion[1])
    copies = [value.clone() for value in first]
    solver.forward(*first, motion[1], motion[2])
    for value, copy in zip(first, copies, strict=True):
        np.testing.assert_array_equal(value, copy)
