"""Adjoints of a frame and of several against central finite differences, in float64; those of each term are in test_terms.py."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuspring.physics import reference
from neuspring.physics import solver as solver_module
from neuspring.physics.controllers import waypoints
from neuspring.physics.parameters import PARAMETERS, pack
from neuspring.physics.solver import AdjointLimit, FrameSolver, FrameWindow, simulate_frame
from tests.support.differences import EXACT, Arrays, assert_gradients, differences
from tests.support.scenes import VARIANTS, packed, random_scene, scene, solver_for, tensors, with_values

FRAMES = 1e-5
"""Relative to the largest entry of the gradient compared, over one to three frames of 10 substeps."""
LEARNED = (
    "stiffness", "rest_lengths", "dashpot", "drag", "ground_elasticity", "ground_friction", "contact_elasticity",
    "contact_friction",
)  # fmt: skip


def lively(variant: str) -> tuple[reference.ReferenceTwin, np.ndarray, np.ndarray, np.ndarray]:
    """(scene, x0, v0, hands) of three frames; the first already touches the ground and, where on, itself (tested below).

    The seed is one for which no contact decision lies so near its threshold that a step of the differences flips it.
    """
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, **VARIANTS[variant])
    return body, x, v, hands


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradcheck_of_a_frame(variant: str) -> None:
    """torch.autograd.gradcheck over pack and simulate_frame: every physical parameter and the initial state."""
    body, x, v, hands = lively(variant)
    solver, values = solver_for(body, hands.shape[1]), tensors(body)
    begin, end, *_ = waypoints(torch.tensor(hands))

    def run(x: torch.Tensor, v: torch.Tensor, *learned: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        parameters = pack(**(values | dict(zip(LEARNED, learned, strict=True))), substep=body.simulation.substep)
        return simulate_frame(solver, parameters, x, v, begin, end)

    inputs = [torch.tensor(x), torch.tensor(v), *(values[name] for name in LEARNED)]
    inputs = [value.clone().requires_grad_() for value in inputs]
    # Each entry: |analytic - numerical| <= atol + rtol |numerical|. Entries reach 1; rounding of the differences is 1e-10.
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_lively_scenes_touch_what_they_should(variant: str) -> None:
    body, x, v, hands = lively(variant)
    gradient = loss_gradient(body, x, v, hands[:2], weights(2, 6))
    for name, on in (("ground", body.simulation.ground), ("contact", body.simulation.self_collision)):
        assert bool(gradient[f"{name}_elasticity"].any()) == on
        assert bool(gradient[f"{name}_friction"].any()) == on


def weights(frames: int, nodes: int) -> np.ndarray:
    """Fixed weights of a scalar loss over x and v at every frame end, [2, F, N, 3]."""
    return np.random.default_rng(7).standard_normal((2, frames, nodes, 3))


def loss_gradient(body: reference.ReferenceTwin, x: np.ndarray, v: np.ndarray, hands: np.ndarray, weight: np.ndarray) -> Arrays:
    """Gradient of sum(weight * (x, v) at frame ends) through all frames, by simulate_frame; frame 0 has no weight."""
    solver, motion = solver_for(body, hands.shape[1]), waypoints(torch.tensor(hands))
    values = {name: value.requires_grad_() for name, value in tensors(body).items()}
    start = torch.tensor(x).requires_grad_(), torch.tensor(v).requires_grad_()
    parameters = pack(**values, substep=body.simulation.substep)
    state, total = start, torch.zeros((), dtype=torch.float64)
    for k in range(1, len(hands)):
        state = simulate_frame(solver, parameters, *state, motion[k - 1], motion[k])
        total = total + sum((torch.tensor(w[k]) * s).sum() for w, s in zip(weight, state, strict=True))
    total.backward()
    leaves = {name: values[name] for name in LEARNED} | {"x": start[0], "v": start[1]}
    return {name: np.zeros(leaf.shape) if leaf.grad is None else leaf.grad.numpy() for name, leaf in leaves.items()}


@pytest.mark.parametrize("variant", VARIANTS)
def test_three_frames_match_differences_of_the_reference(variant: str) -> None:
    """The adjoint over three frames against central differences of the NumPy specification: no code in common."""
    body, x, v, hands = lively(variant)
    weight = weights(4, 6)
    weight[:, 0] = 0.0
    got = loss_gradient(body, x, v, hands, weight)

    def total(values: Arrays) -> float:
        state = reference.rollout(with_values(body, values), values["x"], values["v"], hands)
        return float((weight * np.stack(state)).sum())

    at = {name: tensors(body)[name].numpy() for name in LEARNED} | {"x": x, "v": v}
    assert_gradients(got, differences(total, at, x=1e-7), FRAMES)


def test_recomputed_frames_equal_the_chain_of_single_frames() -> None:
    """Backward runs when later frames have overwritten the buffers; the same chain with one solver per frame must agree."""
    body, x, v, hands = random_scene(23, self_collision=True, frames=3)
    weight = weights(4, body.nodes)
    got = loss_gradient(body, x, v, hands, weight)
    motion, solvers = torch.tensor(hands), [solver_for(body, hands.shape[1]) for _ in range(3)]
    state = torch.tensor(x), torch.tensor(v)
    for k, solver in enumerate(solvers):
        state = solver.forward(*state, motion[k], motion[k + 1])
    adj_x, adj_v, springs_ = torch.zeros(body.nodes, 3).double(), torch.zeros(body.nodes, 3).double(), 0.0
    for k in (3, 2, 1):
        adj = solvers[k - 1].backward(adj_x + torch.tensor(weight[0, k]), adj_v + torch.tensor(weight[1, k]))
        adj_x, adj_v, springs_ = adj[0], adj[1], springs_ + adj[2]["springs"]
    chain = {"x": adj_x.numpy(), "v": adj_v.numpy(), "stiffness": springs_[:, 0].numpy(), "dashpot": springs_[:, 2].numpy()}
    assert_gradients(got, chain, EXACT)


@pytest.mark.parametrize(("frames", "again"), [(1, 4), (3, 2), (9, 0)])
def test_a_window_gives_what_its_solver_gives_and_simulates_less(frames: int, again: int, monkeypatch: pytest.MonkeyPatch) -> None:
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
        return list(torch.autograd.grad(state[0].square().sum(), values))

    expected = gradient(solver_for(body, hands.shape[1]))
    simulated.clear()
    got = gradient(FrameWindow(lambda: solver_for(body, hands.shape[1]), frames))
    assert len(simulated) == 5 + again
    assert all(torch.equal(one, other) for one, other in zip(got, expected, strict=True))


def test_a_window_is_as_long_as_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    body, x, v, hands = random_scene(27, frames=4)
    size = solver_for(body, hands.shape[1]).nbytes
    monkeypatch.setattr(solver_module, "FRAME_WINDOW_BYTES", 2 * size + size // 2)
    window, motion = FrameWindow(lambda: solver_for(body, hands.shape[1]), 4, 7), torch.tensor(hands)
    for k in range(4):
        window.run(motion[k], motion[k + 1], torch.tensor(x), torch.tensor(v), packed(body))
    assert [window.holding(token) is not None for token in range(7, 13)] == [False, False, False, True, True, False]
    monkeypatch.setattr(solver_module, "FRAME_WINDOW_BYTES", 1)
    assert FrameWindow(lambda: solver_for(body, hands.shape[1]), 4).holding(0) is None


def resting_block(substeps: int) -> tuple[reference.ReferenceTwin, np.ndarray]:
    """(scene, x): a block of 6 x 2 x 2 nodes, 2 cm apart, a tenth of a millimeter above an elastic ground."""
    x = 0.02 * np.stack(np.meshgrid(np.arange(6), np.arange(2), np.arange(2), indexing="ij"), axis=-1).reshape(-1, 3)
    x[:, 2] += 1e-4
    apart = np.linalg.norm(x[:, None] - x, axis=2)
    pairs = np.argwhere(np.triu((apart > 0) & (apart < 0.036)))
    body = scene(
        len(x), pairs, apart[tuple(pairs.T)], stiffness=np.full(len(pairs), 5e4), dashpot=np.full(len(pairs), 1.0), drag=5.0,
        ground=(0.8, 0.4), frame_time=1 / 30, substeps=substeps, gravity=9.8, on_ground=True,
    )  # fmt: skip
    return body, x


def resting_gradient(substeps: int, frames: int, limit: AdjointLimit | None) -> tuple[float, float]:
    """(largest entry of dL/dx0, largest way of a node, m) with L = sum |x - 1|^2 at the end of each frame."""
    body, x = resting_block(substeps)
    start, none = torch.tensor(x).requires_grad_(), torch.zeros((0, 3), dtype=torch.float64)
    # The sum has a gradient, which is zero, even where all frames are left out.
    state, total = (start, torch.zeros_like(start)), start.sum() * 0
    window = FrameWindow(lambda: solver_for(body, 0), frames)
    for _ in range(frames):
        state = simulate_frame(window, packed(body), *state, none, none, limit)
        total = total + (state[0] - 1).square().sum()
    (gradient,) = torch.autograd.grad(total, start)
    return float(gradient.abs().max()), float((state[0] - start).detach().abs().max())


def test_adjoints_grow_without_bound_through_a_resting_body_and_the_limit_leaves_such_frames_out() -> None:
    """The exact gradient at the stability bound's margin of 0.8 is useless; smaller steps or the limit are a remedy."""
    exact, way = resting_gradient(80, 4, None)
    assert exact > 1e8
    assert way < 2e-4, "the motion itself is calm: it falls by a tenth of a millimeter and rests"
    limit = AdjointLimit(100.0, 1 / 30)
    assert resting_gradient(80, 4, limit) == (0.0, way)
    assert limit.left_out == 4
    limit = AdjointLimit(1e3, 1 / 30)
    calm, _ = resting_gradient(160, 4, limit)
    assert (calm, 0) == (resting_gradient(160, 4, None)[0], limit.left_out)
    assert calm < 1e5


def test_a_frame_that_is_left_out_ends_the_gradient_and_earlier_frames_keep_theirs() -> None:
    """Frame 2 is left out: what remains is the gradient of frame 1's own loss."""
    body, x, v, hands = random_scene(26, frames=2)
    solver, motion = solver_for(body, hands.shape[1]), torch.tensor(hands)

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


def test_a_second_backward_gives_the_same() -> None:
    """retain_graph: the stored substeps survive a backward pass, and a recomputation."""
    body, x, v, hands = random_scene(24, self_collision=True, frames=2)
    solver, motion = solver_for(body, hands.shape[1]), torch.tensor(hands)
    start = torch.tensor(x).requires_grad_()
    first = simulate_frame(solver, packed(body), start, torch.tensor(v), motion[0], motion[1])
    second = simulate_frame(solver, packed(body), *first, motion[1], motion[2])
    grads = [torch.autograd.grad(second[0].sum(), start, retain_graph=True)[0] for _ in range(3)]
    for gradient in grads[1:]:
        torch.testing.assert_close(gradient, grads[0], rtol=EXACT, atol=0)


def test_backward_uses_the_parameters_of_its_own_frame() -> None:
    """Two frames with different parameters through one solver."""
    body, x, v, hands = random_scene(25, frames=1)
    soft, motion = tensors(body), torch.tensor(hands)
    stiffness = [soft["stiffness"].clone().requires_grad_(), (3 * soft["stiffness"]).requires_grad_()]
    shared, alone = solver_for(body, hands.shape[1]), [solver_for(body, hands.shape[1]) for _ in range(2)]

    def run(solver: FrameSolver, values: torch.Tensor) -> torch.Tensor:
        parameters = pack(**(soft | {"stiffness": values}), substep=body.simulation.substep)
        return simulate_frame(solver, parameters, torch.tensor(x), torch.tensor(v), motion[0], motion[1])[0].square().sum()

    together = torch.autograd.grad(sum(run(shared, s) for s in stiffness), stiffness)
    for got, solver, values in zip(together, alone, stiffness, strict=True):
        torch.testing.assert_close(got, torch.autograd.grad(run(solver, values), values)[0], rtol=1e-10, atol=0)


@pytest.mark.parametrize(("name", "value"), [
    ("ground_elasticity", -0.1), ("ground_elasticity", 1.1), ("ground_friction", 2.1), ("ground_friction", -0.1),
    ("contact_elasticity", 1.1), ("contact_friction", 2.1),
])  # fmt: skip
def test_no_gradient_beyond_the_clamps(name: str, value: float) -> None:
    """Contact scalars may drift out of their range (released quirk 5): used at the bound, gradient zero."""
    body, x, v, hands = lively("self-collision")
    moved = with_values(body, {name: value})
    assert loss_gradient(moved, x, v, hands, weights(4, 6))[name] == 0.0
    low, high = (0.0, 1.0) if name.endswith("elasticity") else (0.0, 2.0)
    bound = with_values(body, {name: low if value < low else high})
    for name, wanted in packed(bound).items():
        assert torch.equal(packed(moved)[name], wanted)


def test_gradients_follow_names_not_places() -> None:
    """Parameters in another order: each gets the gradient it has by its name, and only those that are trained get one."""
    body, x, v, hands = lively("self-collision")
    motion, found = torch.tensor(hands), []
    for names in (list(PARAMETERS), list(reversed(PARAMETERS))):
        inputs = {name: packed(body)[name].requires_grad_() for name in names}
        after, _ = simulate_frame(solver_for(body, 2), inputs, torch.tensor(x), torch.tensor(v), motion[0], motion[1])
        after.square().sum().backward()
        found.append({name: value.grad for name, value in inputs.items()})
    assert {name for name, gradient in found[0].items() if gradient is not None} == {n for n, p in PARAMETERS.items() if p.trained}
    for name, gradient in found[0].items():
        assert gradient is None or torch.equal(gradient, found[1][name])
        assert gradient is None or gradient.any(), name


def test_contact_distance_only_selects() -> None:
    """It has no gradient, and says so by None rather than by a zero that looks computed."""
    body, x, v, hands = lively("self-collision")
    values = {name: value.requires_grad_() for name, value in tensors(body).items()}
    motion, parameters = torch.tensor(hands), pack(**values, substep=body.simulation.substep)
    after, _ = simulate_frame(solver_for(body, 2), parameters, torch.tensor(x), torch.tensor(v), motion[0], motion[1])
    after.sum().backward()
    assert values["contact_distance"].grad is None
