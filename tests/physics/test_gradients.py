"""Adjoints of frames against central differences (torch.autograd.gradcheck), in float64, and gradients through chains of frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring.physics import solver as solver_module
from neuspring.physics.controllers import waypoints
from neuspring.physics.parameters import PARAMETERS, pack
from neuspring.physics.solver import AdjointLimit, FrameSolver, FrameWindow, simulate_frame
from tests.support.scenes import VARIANTS, Scene, packed, random_scene, scene, solver_for, tensors

EXACT = 1e-12
"""Relative: two ways to compute the same adjoint differ by rounding alone."""
LEARNED = (
    "stiffness", "rest_lengths", "dashpot", "drag", "ground_elasticity", "ground_friction", "contact_elasticity",
    "contact_friction",
)  # fmt: skip
NOBODY = torch.zeros((0, 3), dtype=torch.float64)


def check(
    body: Scene, x: np.ndarray, v: np.ndarray, hands: torch.Tensor, *, threads: bool = False, only: slice = slice(None)
) -> dict:
    """gradcheck of a frame by x, v (the coordinates `only`) and every physical parameter; gradients of a sum of v' by name."""
    solver, values = solver_for(body, hands.shape[1], threads=threads), tensors(body)

    def run(x: torch.Tensor, own: torch.Tensor, *learned: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        speed = torch.tensor(v)
        speed[:, only] = own
        parameters = pack(**(values | dict(zip(LEARNED, learned, strict=True))), substep=body.simulation.substep)
        return simulate_frame(solver, parameters, x, speed, hands[0], hands[1])

    inputs = [torch.tensor(x), torch.tensor(v)[:, only], *(values[name] for name in LEARNED)]
    inputs = [value.clone().requires_grad_() for value in inputs]
    # Entries reach 1; rounding of the differences is 1e-10.
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)
    speed = run(*inputs)[1]
    loss = (speed * torch.arange(1.0, speed.numel() + 1).reshape(speed.shape)).sum()
    return dict(zip(("x", "v", *LEARNED), torch.autograd.grad(loss, inputs), strict=True))


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_of_a_frame(variant):
    """Six nodes in all terms at once. The seed is one for which a step of the differences flips no contact."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, **VARIANTS[variant])
    found = check(body, x, v, waypoints(torch.tensor(hands)))
    for name, on in (("ground", body.simulation.ground), ("contact", body.simulation.self_collision)):
        assert bool(found[f"{name}_elasticity"].any()) == bool(found[f"{name}_friction"].any()) == on, "it touches what it should"


@pytest.mark.parametrize("up", ["+z", "-z"])
@pytest.mark.parametrize(
    ("height", "speed", "friction", "felt"),
    [
        (0.5, (0.3, -0.2, -1.0), 0.3, (False, False)),  # flies
        (4e-4, (1.3, -0.9, -0.8), 0.3, (True, True)),  # slides
        (4e-4, (0.2, -0.1, -0.8), 1.5, (True, False)),  # sticks
        (-3e-4, (1.3, -0.9, -0.8), 0.3, (True, True)),  # is below already
        (-3e-4, (1.3, -0.9, 0.8), 0.3, (False, False)),  # rises from below
        (4e-4, (0.0, 0.0, -0.8), 0.3, (True, False)),  # falls straight
        (4e-4, (1.3, -0.9, -0.8), 0.01, (True, True)),  # slides almost without friction
    ],
)
def test_gradients_at_the_ground(height, speed, friction, felt, up):
    flip = np.array([1.0, 1.0, 1.0 if up == "+z" else -1.0])
    body = scene(1, on_ground=True, ground=(0.6, friction), drag=2.0, up=up)
    # Where it falls straight the tangential speed has a kink.
    only = slice(2, 3) if not speed[0] else slice(None)
    found = check(body, flip * [[0.1, 0.2, height]], flip * [speed], torch.stack([NOBODY] * 2), only=only)
    assert (bool(found["ground_elasticity"]), bool(found["ground_friction"])) == felt


@pytest.mark.parametrize("threads", [False, True])
@pytest.mark.parametrize("friction", [0.01, 0.1, 0.9, 1.99])
def test_gradients_in_a_crowd(friction, threads):
    """Nodes of several masses, each with several partners; with much friction some stick."""
    rng = np.random.default_rng(11)
    x = rng.uniform(-0.012, 0.012, (6, 3))
    v = -30 * x + rng.uniform(-0.3, 0.3, (6, 3))
    x[5] += 1.0
    mass = np.array([0.3, 1.7, 0.8, 2.1, 0.5, 0.6])
    body = scene(6, self_collision=True, contact=(0.4, friction), contact_distance=0.02, mass=mass, frame_time=1e-5)
    found = check(body, x, v, torch.stack([NOBODY] * 2), threads=threads)
    assert found["contact_elasticity"] and bool(found["contact_friction"]) == (friction < 1.9)


def weights(frames: int, nodes: int) -> np.ndarray:
    """Fixed weights of a scalar loss over x and v at every frame end, [2, F, N, 3]."""
    return np.random.default_rng(7).standard_normal((2, frames, nodes, 3))


def test_recomputed_frames_equal_the_chain_of_single_frames():
    """Backward runs when later frames have overwritten the buffers; the same chain with one solver per frame must agree."""
    body, x, v, hands = random_scene(23, self_collision=True, frames=3)
    weight, motion = torch.tensor(weights(4, body.nodes)), torch.tensor(hands)
    values = {name: value.requires_grad_() for name, value in tensors(body).items()}
    start = state = torch.tensor(x).requires_grad_(), torch.tensor(v).requires_grad_()
    solver, total = solver_for(body, 2), torch.zeros((), dtype=torch.float64)
    for k in (1, 2, 3):
        state = simulate_frame(solver, pack(**values, substep=body.simulation.substep), *state, motion[k - 1], motion[k])
        total = total + sum((w[k] * s).sum() for w, s in zip(weight, state, strict=True))
    total.backward()
    solvers, state = [solver_for(body, 2) for _ in range(3)], (torch.tensor(x), torch.tensor(v))
    for k, own in enumerate(solvers):
        state = own.forward(*state, motion[k], motion[k + 1])
    adj_x, adj_v, springs = torch.zeros(body.nodes, 3).double(), torch.zeros(body.nodes, 3).double(), 0.0
    for k in (3, 2, 1):
        adj_x, adj_v, found = solvers[k - 1].backward(adj_x + weight[0, k], adj_v + weight[1, k])
        springs = springs + found["springs"]
    pairs = ((start[0], adj_x), (start[1], adj_v), (values["stiffness"], springs[:, 0]), (values["dashpot"], springs[:, 2]))
    for leaf, chain in pairs:
        torch.testing.assert_close(leaf.grad, chain, rtol=0, atol=EXACT * float(chain.abs().max()))


@pytest.mark.parametrize(("frames", "again"), [(1, 4), (3, 2), (9, 0)])
def test_a_window_gives_what_its_solver_gives_and_simulates_less(frames, again, monkeypatch):
    """Five frames of which the last ones are held: the same numbers bit for bit; only what is no longer held is simulated again."""
    body, x, v, hands = random_scene(26, self_collision=True, frames=5)
    motion, simulated = torch.tensor(hands), []
    forward = FrameSolver.forward
    monkeypatch.setattr(FrameSolver, "forward", lambda self, *inputs: simulated.append(1) or forward(self, *inputs))

    def gradient(solver: FrameSolver | FrameWindow) -> list[torch.Tensor]:
        values = tensors(body)["stiffness"].requires_grad_(), torch.tensor(x).requires_grad_()
        state = values[1], torch.tensor(v)
        # Parameters differ from frame to frame: each has its own at its adjoint.
        for k in range(5):
            parameters = pack(**tensors(body) | {"stiffness": (1 + 0.1 * k) * values[0]}, substep=body.simulation.substep)
            state = simulate_frame(solver, parameters, *state, motion[k], motion[k + 1])
        # The graph is kept: a second backward pass gives the same.
        first, second = (torch.autograd.grad(state[0].square().sum(), values, retain_graph=True) for _ in range(2))
        assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))
        return list(first)

    expected = gradient(solver_for(body, 2))
    simulated.clear()
    got = gradient(FrameWindow(lambda: solver_for(body, 2), frames))
    assert len(simulated) >= 5 + again
    assert all(torch.equal(one, other) for one, other in zip(got, expected, strict=True))


def test_a_window_is_as_long_as_its_memory(monkeypatch):
    body, x, v, hands = random_scene(27, frames=4)
    size = solver_for(body, 2).nbytes
    monkeypatch.setattr(solver_module, "FRAME_WINDOW_BYTES", 2 * size + size // 2)
    window, motion = FrameWindow(lambda: solver_for(body, 2), 4), torch.tensor(hands)
    for k in range(4):
        window.run(motion[k], motion[k + 1], torch.tensor(x), torch.tensor(v), packed(body))
    assert [window.holding(token) is not None for token in range(6)] == [False, False, False, True, True, False]


@pytest.mark.parametrize("threads", [False, True])
def test_only_gradients_keep_all_substeps_and_frames_do_not_add_to_buffers(threads):
    sizes = {}
    for substeps in (10, 40):
        body, x, v, hands = random_scene(33, substeps=substeps)
        for differentiable in (True, False):
            solver = solver_for([body] * 8, 2, dtype=torch.float32, differentiable=differentiable, threads=threads)
            sizes[substeps, differentiable] = before = solver.nbytes
            state = [torch.tensor(values, dtype=torch.float32).expand(8, -1, -1) for values in (x, v, hands[0], hands[1])]
            solver.forward(*solver.forward(*state), *state[2:])
            assert solver.nbytes == before
    assert sizes[40, False] == sizes[10, False]
    # Vectors of float32: x and v of all points, and velocities of nodes.
    assert sizes[40, True] - sizes[10, True] == 8 * 30 * (2 * (body.nodes + 2) + body.nodes) * 12


def resting_gradient(substeps: int, limit: AdjointLimit | None) -> tuple[float, float]:
    """(largest entry of dL/dx0, largest way of a node, m) of a block of 6 x 2 x 2 nodes that comes to rest on an elastic ground.

    L = sum |x - 1|^2 at the end of each of four frames.
    """
    x = 0.02 * np.stack(np.meshgrid(np.arange(6), np.arange(2), np.arange(2), indexing="ij"), axis=-1).reshape(-1, 3)
    x[:, 2] += 1e-4
    apart = np.linalg.norm(x[:, None] - x, axis=2)
    pairs = np.argwhere(np.triu((apart > 0) & (apart < 0.036)))
    body = scene(
        len(x), pairs, apart[tuple(pairs.T)], stiffness=5e4, dashpot=1.0, drag=5.0, ground=(0.8, 0.4), frame_time=1 / 30,
        substeps=substeps, gravity=9.8, on_ground=True,
    )  # fmt: skip
    start = torch.tensor(x).requires_grad_()
    # The sum has a gradient, which is zero, even where all frames are left out.
    state, total = (start, torch.zeros_like(start)), start.sum() * 0
    window = FrameWindow(lambda: solver_for(body, 0), 4)
    for _ in range(4):
        state = simulate_frame(window, packed(body), *state, NOBODY, NOBODY, limit)
        total = total + (state[0] - 1).square().sum()
    (gradient,) = torch.autograd.grad(total, start)
    return float(gradient.abs().max()), float((state[0] - start).detach().abs().max())


def test_adjoints_grow_without_bound_through_a_resting_body_and_the_limit_leaves_such_frames_out():
    """The exact gradient at the stability bound's margin of 0.8 is useless; smaller steps or the limit are a remedy."""
    exact, way = resting_gradient(80, None)
    assert exact > 1e8
    assert way < 2e-4, "the motion itself is calm: it falls by a tenth of a millimeter and rests"
    limit = AdjointLimit(100.0, 1 / 30)
    assert resting_gradient(80, limit) == (0.0, way)
    assert limit.left_out == 4
    limit = AdjointLimit(1e3, 1 / 30)
    calm, _ = resting_gradient(160, limit)
    assert (calm, 0) == (resting_gradient(160, None)[0], limit.left_out)
    assert calm < 1e5


def test_a_frame_that_is_left_out_ends_the_gradient_and_earlier_frames_keep_theirs():
    """Frame 2 is left out: what remains is the gradient of frame 1's own loss."""
    body, x, v, hands = random_scene(26, frames=2)
    solver, motion = solver_for(body, 2), torch.tensor(hands)

    def gradient(factor: float, *weights: float) -> tuple[torch.Tensor, int]:
        start, limit = torch.tensor(x).requires_grad_(), AdjointLimit(factor, body.simulation.frame_time)
        first = simulate_frame(solver, packed(body), start, torch.tensor(v), motion[0], motion[1], AdjointLimit(1e30, 1.0))
        second = simulate_frame(solver, packed(body), *first, motion[1], motion[2], limit)
        loss = sum(weight * state[0].square().sum() for weight, state in zip(weights, (first, second), strict=True))
        return torch.autograd.grad(loss, start)[0], limit.left_out

    (cut, count), (alone, _), (whole, none) = gradient(1e-9, 1.0, 1.0), gradient(1e30, 1.0, 0.0), gradient(1e30, 1.0, 1.0)
    assert (count, none) == (1, 0)
    torch.testing.assert_close(cut, alone, rtol=EXACT, atol=0)
    assert not torch.allclose(whole, alone)


@pytest.mark.parametrize(
    ("kind", "place", "value", "bound"),
    [("ground", 0, -0.1, 0.0), ("ground", 1, 2.1, 2.0), ("contact", 0, 1.1, 1.0), ("contact", 1, -0.1, 0.0)],
)
def test_no_gradient_beyond_the_clamps(kind, place, value, bound):
    """Contact scalars may drift out of their range (released quirk 5): used at the bound, gradient zero."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, self_collision=True)
    moved, at_bound = (
        replace(body, **{kind: tuple(number if k == place else old for k, old in enumerate(getattr(body, kind)))})
        for number in (value, bound)
    )
    name = f"{kind}_{('elasticity', 'friction')[place]}"
    values, motion = tensors(moved), torch.tensor(hands)
    values[name].requires_grad_()
    after, _ = simulate_frame(
        solver_for(moved, 2), pack(**values, substep=1e-3), torch.tensor(x), torch.tensor(v), motion[0], motion[1]
    )
    after.square().sum().backward()
    assert values[name].grad == 0
    assert all(torch.equal(packed(moved)[name], wanted) for name, wanted in packed(at_bound).items())


def test_gradients_follow_names_not_places():
    """Parameters in another order: each gets the gradient it has by its name, and only those that are trained get one."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, self_collision=True)
    motion, found = torch.tensor(hands), []
    for names in (list(PARAMETERS), list(reversed(PARAMETERS))):
        inputs = {name: packed(body)[name].requires_grad_() for name in names}
        after, _ = simulate_frame(solver_for(body, 2), inputs, torch.tensor(x), torch.tensor(v), motion[0], motion[1])
        after.square().sum().backward()
        found.append({name: value.grad for name, value in inputs.items()})
    assert {name for name, gradient in found[0].items() if gradient is not None} == {n for n, p in PARAMETERS.items() if p.trained}
    for name, gradient in found[0].items():
        assert gradient is None or (torch.equal(gradient, found[1][name]) and gradient.any()), name
