"""Controllers that hold for a part of the frames: against the reference, closed forms of a body that was let go, gradients."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from neuspring.physics import reference
from neuspring.physics.controllers import waypoints
from neuspring.physics.parameters import pack
from neuspring.physics.solver import simulate_frame
from neuspring.twin.rollout import roll_out
from neuspring.twin.trials import motions
from tests.support.differences import assert_gradients, differences
from tests.support.scenes import WAYS, random_scene, scene, solver_for, tensors, twin_of, with_values

ROUNDING = 1e-12
"""m and m/s: float64 over a few hundred substeps."""
FRAMES = 1e-5
"""Relative to the largest entry, of gradients against central differences, as in test_gradients."""


def run(body, x, v, rows, device="cpu", threads=False):
    """States at frame ends along the rows of `waypoints`."""
    solver = solver_for(body, rows.shape[1], device=device, threads=threads)
    parameters = pack(**tensors(body, device), substep=body.simulation.substep)
    solver.set_parameters(parameters)
    states = [(torch.tensor(x, device=device), torch.tensor(v, device=device))]
    for begin, end in pairwise(rows):
        states.append(solver.forward(*states[-1], begin.to(device), end.to(device)))
    return tuple(torch.stack(values).cpu().numpy() for values in zip(*states, strict=True))


def held_body():
    """Two nodes and the spring between them, held above by a controller; frames of 10 ms."""
    body = scene(
        2,
        [(0, 1), (0, 2)],
        [0.1, 0.1],
        stiffness=[50.0, 80.0],
        dashpot=[0.5, 0.3],
        gravity=9.8,
        frame_time=0.01,
        substeps=20,
    )
    x = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.9]])
    hands = np.array([0.0, 0.0, 1.1]) + np.arange(9)[:, None, None] * np.array([0.002, 0.0, 0.001])
    return body, x, np.zeros((2, 3)), hands


@pytest.mark.parametrize(("device", "threads"), WAYS)
def test_a_body_let_go_in_the_air_falls_freely(device, threads):
    body, x, v, hands = held_body()
    valid = np.arange(9)[:, None] < 4
    xs, vs = run(body, x, v, waypoints(torch.tensor(hands), valid), device, threads)
    momentum, dt = vs.sum(axis=1), body.simulation.substep
    # Held up to frame 3, so that the fall begins there: each substep adds 2 g dt to the momentum of two kilograms.
    for frame in range(3, 8):
        gained = np.array([0.0, 0.0, -2 * 9.8 * 0.01])
        np.testing.assert_allclose(momentum[frame + 1] - momentum[frame], gained, atol=ROUNDING)
    assert np.abs(momentum[3] - momentum[2] - [0.0, 0.0, -2 * 9.8 * 0.01]).max() > 1e-3
    # Symplectic Euler of a center that falls from v0: after n substeps n v0 dt - g dt^2 n (n + 1) / 2.
    n = 20 * 5
    fallen = n * momentum[3] / 2 * dt - np.array([0, 0, 9.8]) * dt**2 * n * (n + 1) / 2
    np.testing.assert_allclose(xs[8].mean(axis=0) - xs[3].mean(axis=0), fallen, atol=ROUNDING)


def test_without_damping_the_energy_after_letting_go_is_kept():
    body, x, v, hands = held_body()
    body = replace(body, dashpot=np.zeros(2), simulation=replace(body.simulation, gravity=0.0, substeps=200))
    valid = np.arange(9)[:, None] < 4
    xs, vs = run(body, x, v, waypoints(torch.tensor(hands), valid))
    length = np.linalg.norm(xs[:, 1] - xs[:, 0], axis=1)
    energy = 0.5 * (vs**2).sum(axis=(1, 2)) + 50.0 * (length - 0.1) ** 2 / (2 * 0.1)
    # The error of symplectic Euler oscillates with omega dt = 1.6e-3.
    assert np.ptp(energy[3:]) < 5e-3 * energy[3]
    assert energy[3] > 1e-6


@pytest.mark.parametrize(("device", "threads"), WAYS)
def test_the_solver_agrees_with_the_reference(device, threads):
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02)
    hands = np.concatenate([hands, hands[::-1], hands])
    valid = np.ones(hands.shape[:2], bool)
    valid[2:, 0] = False
    valid[4:7] = False
    xs, vs = run(body, x, v, waypoints(torch.tensor(hands), valid), device, threads)
    expected, speeds = reference.rollout(body, x, v, hands, valid)
    np.testing.assert_allclose(xs, expected, atol=ROUNDING)
    np.testing.assert_allclose(vs, speeds, atol=1e-9)
    # And it matters.
    assert np.abs(reference.rollout(body, x, v, hands)[0] - expected).max() > 1e-3


def test_where_all_hold_nothing_changes_bit_for_bit():
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02)
    plain, every = (waypoints(torch.tensor(hands), valid) for valid in (None, np.ones(hands.shape[:2], bool)))
    assert torch.equal(plain, every)
    flagged = torch.cat([plain, torch.ones(*plain.shape[:2], 1, dtype=plain.dtype)], dim=-1)
    for one, other in zip(run(body, x, v, plain), run(body, x, v, flagged), strict=True):
        np.testing.assert_array_equal(one, other)


def test_twins_in_company_let_go_as_alone():
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02)
    valid = np.ones(hands.shape[:2], bool)
    valid[2:, 1] = False
    rows = waypoints(torch.tensor(hands), valid)
    stiffer = replace(body, stiffness=2.0 * body.stiffness)
    together = solver_for([body, stiffer], hands.shape[1])
    state = tuple(torch.tensor(np.stack([values] * 2)) for values in (x, v))
    for begin, end in pairwise(rows[:, None].expand(-1, 2, -1, -1)):
        state = together.forward(*state, begin, end)
    for lane, alone in enumerate((body, stiffer)):
        np.testing.assert_array_equal(state[0][lane].numpy(), run(alone, x, v, rows)[0][-1])
        np.testing.assert_allclose(state[0][lane].numpy(), reference.rollout(alone, x, v, hands, valid)[0][-1], atol=ROUNDING)


@pytest.mark.parametrize("name", ["stiffness", "dashpot", "rest_lengths"])
def test_gradients_through_a_release(name):
    """Frames 1 and 2 held, then let go; the first frames are simulated again for their adjoints."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, on_ground=False)
    hands = np.concatenate([hands, hands[::-1]])[:5]
    valid = np.ones(hands.shape[:2], bool)
    valid[3:] = False
    weights = np.random.default_rng(0).normal(size=x.shape)
    values = tensors(body)
    learned = values[name].clone().requires_grad_()
    solver, rows = solver_for(body, hands.shape[1]), waypoints(torch.tensor(hands), valid)
    parameters = pack(**(values | {name: learned}), substep=body.simulation.substep)
    state = torch.tensor(x), torch.tensor(v)
    for begin, end in pairwise(rows):
        state = simulate_frame(solver, parameters, *state, begin, end)
    (state[0] * torch.tensor(weights)).sum().backward()
    assert learned.grad is not None

    def loss(changed: np.ndarray) -> float:
        return float((reference.rollout(with_values(body, {name: changed}), x, v, hands, valid)[0][-1] * weights).sum())

    wanted = differences(lambda at: loss(at[name]), {name: values[name].numpy()})
    assert_gradients({name: learned.grad.numpy()}, wanted, FRAMES)


def test_a_twin_s_rollout_and_its_judge_in_a_search_let_go_alike():
    """`roll_out` and `trials.motions`, from what observations say."""
    twin, seen = twin_of(*held_twin()), np.arange(6)[:, None] < 3
    hands = held_body()[3][:6]
    alone = roll_out(twin, hands, valid=seen).positions
    kept = roll_out(twin, hands).positions
    rows = waypoints(torch.tensor(hands, dtype=torch.float32), seen)
    judged, _ = motions([twin, twin], rows, torch.zeros(2, 3), "cpu")
    np.testing.assert_array_equal(judged[:, 0].numpy(), alone[1:])
    assert np.abs(alone - kept).max() > 1e-3


def held_twin():
    body, x, _, hands = held_body()
    return body, x, hands[0]
