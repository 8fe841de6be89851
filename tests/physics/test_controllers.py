"""Controllers that hold in some frames or grasp later: closed forms, the reference, gradients, all kernels."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from neuspring.core.errors import InputError
from neuspring.physics.controllers import ControllerSprings, waypoints
from neuspring.physics.parameters import pack
from neuspring.physics.solver import simulate_frame
from neuspring.physics.solver import solver_for as frame_solver
from neuspring.twin.rollout import roll_out
from tests.support.scenes import WAYS, random_scene, scene, solver_for, tensors, twin_of

ROUNDING = 1e-12
"""m and m/s: float64 over a few hundred substeps."""
GRIP = 40
"""The frame, of one substep, in which the hand catches the body."""
DT = 1e-3
"""s."""
PER_LENGTH = 400.0
"""N/m, of the spring of the hand: 12 N per strain over the 3 cm that it has in frame 0."""


def run(body, x, v, rows, device="cpu", threads=False):
    """States at frame ends along the rows of `waypoints`."""
    solver = solver_for(body, rows.shape[1], device=device, threads=threads)
    states = [(torch.tensor(x, device=device), torch.tensor(v, device=device))]
    for begin, end in pairwise(rows):
        states.append(solver.forward(*states[-1], begin.to(device), end.to(device)))
    return tuple(torch.stack(values).cpu().numpy() for values in zip(*states, strict=True))


@pytest.mark.parametrize(("device", "threads"), WAYS)
def test_a_body_let_go_in_the_air_falls_freely(device, threads):
    """Two nodes and the spring between them, held above by a controller; frames of 10 ms."""
    springs = {"stiffness": [50.0, 80.0], "dashpot": [0.5, 0.3]}
    body = scene(2, [(0, 1), (0, 2)], [0.1, 0.1], **springs, gravity=9.8, frame_time=0.01, substeps=20)
    x, v = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.9]]), np.zeros((2, 3))
    hands = np.array([0.0, 0.0, 1.1]) + np.arange(9)[:, None, None] * np.array([0.002, 0.0, 0.001])
    xs, vs = run(body, x, v, waypoints(torch.tensor(hands), np.arange(9)[:, None] < 4), device, threads)
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


def test_where_all_hold_nothing_changes_bit_for_bit():
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02)
    plain, every = (waypoints(torch.tensor(hands), valid) for valid in (None, np.ones(hands.shape[:2], bool)))
    assert torch.equal(plain, every)
    flagged = torch.cat([plain, torch.ones(*plain.shape[:2], 1, dtype=plain.dtype)], dim=-1)
    for one, other in zip(run(body, x, v, plain), run(body, x, v, flagged), strict=True):
        np.testing.assert_array_equal(one, other)


def caught(frames):
    """A node of 1 kg falls from rest; in frame GRIP a hand takes hold of it from 7 cm above, and stays there."""
    body = scene(1, [(0, 1)], [0.03], stiffness=[PER_LENGTH * 0.03], gravity=9.8, frame_time=DT, substeps=1)
    n = np.arange(frames)
    fall = 2.0 - 9.8 * DT**2 * n * (n + 1) / 2
    hands = np.zeros((frames, 1, 3))
    hands[:, 0, 2] = fall[GRIP] + 0.07
    hands[0, 0, 2] = 2.03
    return body, np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 3)), hands, n[:, None] >= GRIP, fall


@pytest.mark.parametrize(("device", "threads"), WAYS)
def test_a_falling_body_is_caught_without_a_jump_of_force(device, threads):
    body, x, v, hands, valid, fall = caught(GRIP + 3)
    xs, vs = run(body, x, v, waypoints(torch.tensor(hands), valid), device, threads)
    np.testing.assert_allclose(xs[: GRIP + 1, 0, 2], fall[: GRIP + 1], atol=ROUNDING)
    gained = np.diff(vs[:, 0, 2]) / DT
    # Where the grip begins there is weight alone; one substep later also the force of the way fallen since.
    np.testing.assert_allclose(gained[: GRIP + 1], -9.8, atol=ROUNDING / DT)
    np.testing.assert_allclose(gained[GRIP + 1], -9.8 + PER_LENGTH * (fall[GRIP] - xs[GRIP + 1, 0, 2]), atol=PER_LENGTH * 1e-11)


def test_a_caught_body_falls_as_deep_as_its_energy_says():
    body, x, v, hands, valid, fall = caught(GRIP + 140)
    xs, vs = run(body, x, v, waypoints(torch.tensor(hands), valid))
    speed = vs[GRIP, 0, 2]
    # m v^2 / 2 + m g D = K D^2 / 2 at the lowest point.
    depth = (9.8 + np.sqrt(9.8**2 + PER_LENGTH * speed**2)) / PER_LENGTH
    # Symplectic Euler keeps an energy that differs by the fraction omega dt = 0.02 at most.
    assert fall[GRIP] - xs[GRIP:, 0, 2].min() == pytest.approx(depth, rel=0.02)


@pytest.mark.parametrize(("device", "threads"), WAYS)
def test_a_hand_that_only_pushes_gives_its_momentum_once(device, threads):
    """A hand runs into a free node at 0.3 m/s: as with an elastic wall the node leaves at twice that, and nothing pulls it back."""
    body = scene(1, [(0, 1)], [0.03], stiffness=[30.0], pushes=True, frame_time=2e-3, substeps=20)
    hands = np.array([-0.05, 0.0, 0.0]) + np.arange(160)[:, None, None] * np.array([6e-4, 0.0, 0.0])
    hands[120:] = hands[119] - np.arange(1, 41)[:, None, None] * np.array([6e-4, 0.0, 0.0])
    _, vs = run(body, np.zeros((1, 3)), np.zeros((1, 3)), waypoints(torch.tensor(hands)), device, threads)
    first = int(np.argmax(vs[:, 0, 0] != 0))
    assert hands[first, 0, 0] == pytest.approx(-0.03, abs=6e-4)  # where the spring has its length
    assert not vs[:first].any()
    np.testing.assert_allclose(vs[-60:, 0, 0], 0.6, rtol=2e-3)
    # A hand that holds takes it back.
    body = replace(body, pushes=~body.pushes)
    held = run(body, np.zeros((1, 3)), np.zeros((1, 3)), waypoints(torch.tensor(hands)), device, threads)
    assert held[1][-60:, 0, 0].min() < 0


def late_scene():
    """A lively body; one hand lets go in frame 2 and grips again in frame 4, the other grips in frame 3 for the first time."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, on_ground=False)
    hands = np.concatenate([hands, hands[::-1]])[:7]
    valid = np.ones(hands.shape[:2], bool)
    valid[2:4, 0] = False
    valid[:3, 1] = False
    return body, x, v, hands, valid


def simulated(body, rows, x, v, values):
    """The last positions, differentiable in values, x and v: as a fit simulates."""
    solver, grips = solver_for(body, rows.shape[1]), ControllerSprings(body.springs, body.nodes, "cpu")
    parameters, lengths = pack(**values, substep=body.simulation.substep), None
    for begin, end in pairwise(rows):
        lengths = grips.taken(lengths, x, begin)
        held = parameters | {"springs": grips.applied(parameters["springs"], lengths)}
        x, v = simulate_frame(solver, held, x, v, begin, end)
    return x


@pytest.mark.parametrize("name", ["stiffness", "dashpot", "rest_lengths", "x", "v"])
def test_gradients_through_grips_are_exact(name):
    """Rest lengths of grips depend on the state in which they begin, and so on everything before: no part is left out."""
    body, x, v, hands, valid = late_scene()
    rows, every = waypoints(torch.tensor(hands), valid), tensors(body) | {"x": torch.tensor(x), "v": torch.tensor(v)}

    def last(value):
        values = every | {name: value}
        return simulated(body, rows, values.pop("x"), values.pop("v"), values)

    assert torch.autograd.gradcheck(last, (every[name].clone().requires_grad_(),), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_rows_of_another_width_and_gradients_of_grips_that_a_solver_took_itself_are_refused():
    body, x, v, hands, valid = late_scene()
    rows, state = waypoints(torch.tensor(hands), valid), (torch.tensor(x), torch.tensor(v))
    solver = solver_for(body, hands.shape[1])
    for begin, end in pairwise(rows):
        state = solver.forward(*state, begin, end)
    with pytest.raises(AssertionError, match="simulate_frame"):
        solver.backward(*state)
    with pytest.raises(InputError, match="3 numbers per controller are required, or 4"):
        solver.forward(*state, rows[0], rows[0, :, :3])


def test_all_ways_to_roll_out_take_the_same_grips():
    """`roll_out`, a solver of several twins, and a fit's frames."""
    body, x, v, hands, valid = late_scene()
    twin = twin_of(body, x, hands[0])
    alone = roll_out(twin, hands, velocity=v, valid=valid).positions
    rows = waypoints(torch.tensor(hands, dtype=torch.float32), valid)
    stiffer = replace(twin, material=replace(twin.material, stiffness=2.0 * twin.material.stiffness))
    solver = frame_solver([twin, stiffer], differentiable=False)
    state = tuple(torch.tensor(values, dtype=torch.float32).expand(2, -1, -1) for values in (x, v))
    for begin, end in pairwise(rows):
        state = solver.forward(*state, begin.expand(2, -1, -1), end.expand(2, -1, -1))
    np.testing.assert_array_equal(state[0][0].numpy(), alone[-1])
    np.testing.assert_array_equal(state[0][1].numpy(), roll_out(stiffer, hands, velocity=v, valid=valid).positions[-1])
    double = torch.tensor(hands), torch.tensor(x), torch.tensor(v)
    fitted = simulated(body, waypoints(double[0], valid), *double[1:], tensors(body))
    assert np.abs(fitted.numpy() - alone[-1]).max() < 1e-5


def test_stiffness_per_length_stays_however_near_the_hand():
    """So the substep that was checked for the lengths of frame 0 stays safe."""
    body, x, _, _, _ = late_scene()
    grips, springs = ControllerSprings(body.springs, body.nodes, "cpu"), pack(**tensors(body), substep=1e-3)["springs"]
    controllers = int(body.springs.max()) + 1 - body.nodes
    row = torch.zeros(controllers, 4, dtype=torch.float64)
    row[:, :3] = torch.tensor(x[int(grips.nodes[0])])
    row[:, 3] = 2.0
    after = grips.applied(springs, grips.taken(None, torch.tensor(x), row))
    torch.testing.assert_close(after[:, 0] * after[:, 1], springs[:, 0] * springs[:, 1])
    assert bool(torch.isfinite(after).all())
    assert float(after[:, 1].max()) > 2 * float(springs[:, 1].max())
