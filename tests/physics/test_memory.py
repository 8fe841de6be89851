"""Memory does not grow with the horizon, except for the states between frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuspring.physics.autograd import pack, simulate_frame
from neuspring.physics.solver import FrameSolver
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


def buffer_bytes(solver: FrameSolver) -> int:
    sizes = {view.ptr: view.capacity for view in solver.buffers.views.values()}
    return sum((sizes | {t.data_ptr(): t.untyped_storage().nbytes() for t in solver.buffers.tensors.values()}).values())


def test_buffers_do_not_grow_with_frames() -> None:
    body, x, v, hands = random_scene(32, frames=12, self_collision=True)
    for differentiable in (True, False):
        solver = solver_for(body, hands.shape[1], differentiable=differentiable)
        before, addresses = buffer_bytes(solver), {name: b.data_ptr() for name, b in solver.buffers.tensors.items()}
        state = torch.tensor(x), torch.tensor(v)
        for k in range(12):
            state = solver.forward(*state, torch.tensor(hands[k]), torch.tensor(hands[k + 1]))
            if differentiable:
                solver.backward(*state)
        assert buffer_bytes(solver) == before
        assert {name: b.data_ptr() for name, b in solver.buffers.tensors.items()} == addresses


def test_forward_only_keeps_two_substeps() -> None:
    """Differentiable: every substep of one frame. Forward only: independent of the number of substeps."""
    sizes = {}
    for substeps in (10, 40):
        body, *_, hands = random_scene(33, substeps=substeps)
        for differentiable in (True, False):
            sizes[substeps, differentiable] = buffer_bytes(
                solver_for(body, hands.shape[1], dtype=torch.float32, differentiable=differentiable)
            )
    assert sizes[40, False] == sizes[10, False]
    nodes, total = body.nodes, body.nodes + hands.shape[1]
    assert sizes[40, True] - sizes[10, True] == 30 * (2 * total + nodes) * VECTOR


def test_results_do_not_alias_the_buffers() -> None:
    """A state handed out stays what it was when the next frame overwrites the buffers."""
    body, x, v, hands = random_scene(34)
    solver, motion = solver_for(body, hands.shape[1]), torch.tensor(hands)
    first = solver.forward(torch.tensor(x), torch.tensor(v), motion[0], motion[1])
    copies = [value.clone() for value in first]
    solver.forward(*first, motion[1], motion[2])
    for value, copy in zip(first, copies, strict=True):
        np.testing.assert_array_equal(value, copy)
