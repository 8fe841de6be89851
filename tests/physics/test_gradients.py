"""Adjoints against central finite differences, in float64: each kernel alone, a frame, and several frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from neuspring.core.artifacts import Simulation
from neuspring.core.device import start_warp
from neuspring.physics import collision, contact, position, reference, springs, velocity
from neuspring.physics.autograd import pack, simulate_frame
from neuspring.physics.solver import FrameSolver
from tests.support.scenes import packed, random_scene, scene, solver_for, tensors, with_values

# Central differences with step h of a smooth function: truncation h^2 f''' / 6 plus rounding 1e-16 f / h. With h = 1e-6 of
# values of order 1, both stay below 1e-9 of the largest derivative; third derivatives grow with 1 / length^2 = 1e3..1e4.
STEP = 1e-6
KERNEL = 1e-7
"""Relative to the largest entry of the gradient compared; measured 1e-9 to 1e-8."""
FRAMES = 1e-5
"""The same over one to three frames of 10 substeps, whose higher derivatives are larger."""
EXACT = 1e-12
"""Two ways to compute the same adjoint: rounding only."""
VEC3 = wp.types.vector(3, wp.float64)
Arrays = dict[str, np.ndarray]


def differences(function: Callable[[Arrays], float], at: Arrays, **steps: float) -> Arrays:
    """Central differences of a scalar function of named arrays, entry by entry; `steps` by name, else STEP."""
    result = {}
    for name, values in at.items():
        gradient = np.zeros(values.shape)
        for index in np.ndindex(values.shape):
            shift = np.zeros(values.shape)
            shift[index] = steps.get(name, STEP) * max(1.0, abs(values[index]))
            up, down = (function(at | {name: values + s * shift}) for s in (1, -1))
            gradient[index] = (up - down) / (2 * shift[index])
        result[name] = gradient
    return result


def assert_gradients(got: Arrays, wanted: Arrays, tolerance: float) -> None:
    assert got.keys() >= wanted.keys()
    for name, expected in wanted.items():
        scale = np.abs(expected).max(initial=0) or 1.0
        np.testing.assert_allclose(got[name] / scale, expected / scale, atol=tolerance, rtol=0, err_msg=name)


# One kernel at a time -------------------------------------------------------------------------------------------------


def vectors(values: np.ndarray) -> Any:
    """[.., 3] -> Warp array of vectors."""
    return wp.array(np.ascontiguousarray(values, np.float64), dtype=VEC3, device="cpu")


def reals(values: Any) -> Any:
    return wp.array(np.atleast_1d(np.asarray(values, np.float64)), dtype=wp.float64, device="cpu")


def launch(kernel: Any, size: int, *arguments: Any) -> None:
    start_warp()
    wp.launch(kernel, size, list(arguments), device="cpu")


@pytest.mark.parametrize("dashpot", [0.0, 3.0])
def test_spring_kernel(dashpot: float) -> None:
    """x, v, Y, l0 and gamma, of four springs that share nodes; one is compressed."""
    rng, pairs = np.random.default_rng(0), np.array([[0, 1], [1, 2], [2, 0], [3, 1]], np.int32)
    force_kernel, adjoint_kernel = springs.kernels(wp.float64)
    weight = rng.standard_normal((4, 3))
    at = {
        "x": rng.uniform(-0.5, 0.5, (4, 3)),
        "v": rng.standard_normal((4, 3)),
        "stiffness": rng.uniform(1, 3, 4),
        "rest_length": rng.uniform(0.3, 1.2, 4),
        "dashpot": np.full(4, dashpot),
    }
    index = wp.array(pairs, dtype=wp.vec2i, device="cpu")

    def columns(values: Arrays) -> np.ndarray:
        return np.stack([values["stiffness"], 1 / values["rest_length"], values["dashpot"]], axis=1)

    def total(values: Arrays) -> float:
        force = vectors(np.zeros((4, 3)))
        launch(force_kernel, 4, index, vectors(columns(values)), vectors(values["x"][None]), vectors(values["v"][None]), 0, force)
        return float((force.numpy() * weight).sum())

    adj_x, adj_v, adj_p = (vectors(np.zeros((4, 3))) for _ in range(3))
    state = index, vectors(columns(at)), vectors(at["x"][None]), vectors(at["v"][None]), 0
    launch(adjoint_kernel, 4, *state, vectors(weight), adj_x, adj_v, adj_p)
    p = adj_p.numpy()
    # The kernel leaves out the factor Y of the second column; d(1/l0) = -d(l0) / l0^2.
    rest = -p[:, 1] * at["stiffness"] / at["rest_length"] ** 2
    got = {"x": adj_x.numpy(), "v": adj_v.numpy(), "stiffness": p[:, 0], "rest_length": rest, "dashpot": p[:, 2]}
    assert_gradients(got, differences(total, at), KERNEL)


def test_spring_adjoint_accumulates() -> None:
    """Adjoints add to what is there: substeps share the buffers."""
    rng, pairs = np.random.default_rng(1), wp.array(np.array([[0, 1]], np.int32), dtype=wp.vec2i, device="cpu")
    start_warp()
    state = pairs, vectors(np.array([[2.0, 3.0, 0.5]])), vectors(rng.random((1, 2, 3))), vectors(rng.random((1, 2, 3))), 0
    weight, adjoints = vectors(rng.random((2, 3))), [vectors(np.zeros((n, 3))) for n in (2, 2, 1)]
    launch(springs.kernels(wp.float64)[1], 1, *state, weight, *adjoints)
    once = [a.numpy().copy() for a in adjoints]
    launch(springs.kernels(wp.float64)[1], 1, *state, weight, *adjoints)
    for a, b in zip(adjoints, once, strict=True):
        np.testing.assert_allclose(a.numpy(), 2 * b, rtol=EXACT)


def test_velocity_kernel() -> None:
    """v, force and the decay factor."""
    rng, dt, count = np.random.default_rng(2), 0.01, 5
    terms, weight = velocity.kernels(wp.float64), rng.standard_normal((count, 3))
    at = {"v": rng.standard_normal((count, 3)), "force": rng.standard_normal((count, 3)) * 50, "decay": np.array([0.93])}

    def after(values: Arrays) -> np.ndarray:
        result = vectors(np.zeros((1, count, 3)))
        force, gravity = vectors(values["force"]), VEC3(0.0, 0.0, -9.8)
        launch(terms.velocity, count, gravity, dt, reals(values["decay"]), vectors(values["v"][None]), 0, force, result, 0)
        assert not force.numpy().any(), "the force is cleared for the next substep"
        return result.numpy()[0]

    adj_v, adj_force, adj_decay = vectors(np.zeros((count, 3))), vectors(np.zeros((count, 3))), reals(np.zeros(count))
    state = dt, reals(at["decay"]), vectors(after(at)[None]), 0, vectors(weight)
    launch(terms.velocity_adjoint, count, *state, adj_v, adj_force, adj_decay)
    got = {"v": adj_v.numpy(), "force": adj_force.numpy(), "decay": adj_decay.numpy().sum(keepdims=True)}
    assert_gradients(got, differences(lambda values: float((after(values) * weight).sum()), at), KERNEL)


def test_position_kernel_without_ground() -> None:
    """x' = x + dt v', v' unchanged, also for nodes below z = 0."""
    rng, dt = np.random.default_rng(3), 0.01
    wx, wv, x, v = rng.standard_normal((4, 4, 3))
    after_x, after_v, response = vectors(np.stack([x, x])), vectors(np.stack([v, v])), reals([0.5, 0.3])
    forward, adjoint = position.kernels(wp.float64)
    launch(forward, 4, dt, 0.0, response, vectors(v[None]), 0, 0, 1, after_x, after_v)
    np.testing.assert_allclose(after_x.numpy()[1], x + dt * v)
    np.testing.assert_array_equal(after_v.numpy()[1], v)
    adj_x, adj_v, scalars = vectors(wx), vectors(wv), (reals(np.zeros(4)), reals(np.zeros(4)))
    launch(adjoint, 4, dt, 0.0, response, vectors(x[None]), 0, vectors(v[None]), adj_x, adj_v, *scalars)
    assert not any(scalar.numpy().any() for scalar in scalars)
    np.testing.assert_allclose(adj_x.numpy(), wx)
    np.testing.assert_allclose(adj_v.numpy(), wv + dt * wx)


GROUND_CASES = {
    "flying": ((0.1, 0.2, 0.5), (0.3, -0.2, -1.0), 0.3),
    "sliding": ((0.1, 0.2, 0.004), (1.3, -0.9, -0.8), 0.3),
    "sticking": ((0.1, 0.2, 0.004), (0.2, -0.1, -0.8), 1.5),
    "already below": ((0.1, 0.2, -0.003), (1.3, -0.9, -0.8), 0.3),
    "rising from below": ((0.1, 0.2, -0.003), (1.3, -0.9, 0.8), 0.3),
    "falling straight": ((0.1, 0.2, 0.004), (0.0, 0.0, -0.8), 0.3),
    "without friction": ((0.1, 0.2, 0.004), (1.3, -0.9, -0.8), 0.0),
}


@pytest.mark.parametrize("up", [1.0, -1.0])
@pytest.mark.parametrize("case", GROUND_CASES)
def test_ground_kernel(case: str, up: float) -> None:
    """x, v, elasticity and friction, in contact and out, sliding and sticking."""
    place, speed, friction = GROUND_CASES[case]
    rng, dt, (forward, adjoint) = np.random.default_rng(4), 0.01, position.kernels(wp.float64)
    flip = np.array([1.0, 1.0, up])
    weight_x, weight_v = rng.standard_normal((2, 1, 3))
    at = {"x": (np.array(place) * flip)[None], "v": (np.array(speed) * flip)[None], "e": np.array(0.6), "mu": np.array(friction)}

    def total(values: Arrays) -> float:
        x, v = vectors(np.stack([values["x"]] * 2)), vectors(np.zeros((2, 1, 3)))
        response = reals([values["e"], values["mu"]])
        launch(forward, 1, dt, up, response, vectors(values["v"][None]), 0, 0, 1, x, v)
        return float((x.numpy()[1] * weight_x + v.numpy()[1] * weight_v).sum())

    adj_x, adj_v, adj_e, adj_mu = vectors(weight_x), vectors(weight_v), reals(0.0), reals(0.0)
    response = reals([at["e"], at["mu"]])
    adjoints = adj_x, adj_v, adj_e, adj_mu
    launch(adjoint, 1, dt, up, response, vectors(at["x"][None]), 0, vectors(at["v"][None]), *adjoints)
    got = {"x": adj_x.numpy(), "v": adj_v.numpy(), "e": adj_e.numpy()[0], "mu": adj_mu.numpy()[0]}
    wanted = differences(total, at)
    if case == "falling straight":
        # The tangential speed is at its floor, where |v_t| has a kink; nothing moves sideways, so e and z are smooth.
        for values in (got, wanted):
            values["v"] = values["v"][:, 2]
    assert_gradients(got, wanted, KERNEL)
    touched = case not in ("flying", "rising from below")
    assert bool(got["e"]) == touched
    assert bool(got["mu"]) == (case in ("sliding", "already below", "without friction"))


def crowd(friction: float) -> tuple[Arrays, np.ndarray, np.ndarray]:
    """Six nodes of which several pairs are near and approach, some slide and, with much friction, stick."""
    rng = np.random.default_rng(11)
    x = rng.uniform(-0.012, 0.012, (6, 3))
    v = -30 * x + rng.uniform(-0.3, 0.3, (6, 3))
    x[5] += 1.0
    partners = np.array([[j for j in range(6) if j != i] for i in range(6)], np.int32)
    return {"x": x, "v": v, "e": np.array(0.4), "mu": np.array(friction)}, partners, np.full(6, 5, np.int32)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.9, 2.0])
def test_collision_kernel(friction: float) -> None:
    """x, v, elasticity and friction for Jacobi impulses of nodes with several partners each."""
    at, partners, count = crowd(friction)
    distance, hits = 0.02, collision.kernels(wp.float64)
    weight = np.random.default_rng(12).standard_normal((6, 3))
    start_warp()
    lists = wp.array(partners, dtype=int, device="cpu"), wp.array(count, dtype=int, device="cpu")

    def total(values: Arrays) -> float:
        after = vectors(np.zeros((1, 6, 3)))
        state = vectors(values["x"][None]), 0, vectors(values["v"][None]), 0
        launch(hits.collide, 6, reals(distance), reals([values["e"], values["mu"]]), *lists, *state, after)
        return float((after.numpy()[0] * weight).sum())

    adj_v, adj_x, adj_e, adj_mu = vectors(np.zeros((6, 3))), vectors(np.zeros((6, 3))), reals(np.zeros(6)), reals(np.zeros(6))
    model, state = (reals(distance), reals([at["e"], at["mu"]]), *lists), (vectors(at["x"][None]), 0, vectors(at["v"][None]))
    launch(hits.collide_adjoint, 6, *model, *state, vectors(weight), adj_v, adj_x, adj_e, adj_mu)
    got = {"x": adj_x.numpy(), "v": adj_v.numpy(), "e": adj_e.numpy().sum(), "mu": adj_mu.numpy().sum()}
    # Lengths here are 0.01 m, so third derivatives in x are 1e4 times those of the other kernels: a smaller step.
    assert_gradients(got, differences(total, at, x=1e-7), KERNEL)
    assert not got["x"][5].any()
    np.testing.assert_allclose(got["v"][5], weight[5])
    # The scene has what it claims: pairs that collide, and pairs that slide or stick as the friction asks.
    i, j = np.triu_indices(6, 1)
    dx, u = at["x"][j] - at["x"][i], at["v"][j] - at["v"][i]
    length = np.linalg.norm(dx, axis=1)
    hit = (length < distance) & ((dx * u).sum(axis=1) < -contact.APPROACH)
    normal = (dx * u).sum(axis=1) / length
    tangent = np.linalg.norm(u - dx * (normal / length)[:, None], axis=1)
    left = reference.response(normal, tangent, 0.4, friction)[hit]
    assert hit.sum() >= 4
    assert (left > 0).any() == (friction < 2.0)
    assert (left == 0).any() == (friction > 0.5)


# A frame --------------------------------------------------------------------------------------------------------------

VARIANTS: dict[str, dict[str, Any]] = {
    "free": {"on_ground": False},
    "ground": {},
    "self-collision": {"self_collision": True},
    "all": {"self_collision": True, "up": "-z", "controller_velocity": True},
}
LEARNED = (
    "stiffness", "rest_lengths", "dashpot", "drag", "ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction"
)  # fmt: skip


def lively(variant: str) -> tuple[reference.Scene, np.ndarray, np.ndarray, np.ndarray]:
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
    begin, end = torch.tensor(hands[0]), torch.tensor(hands[1])

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


def loss_gradient(body: reference.Scene, x: np.ndarray, v: np.ndarray, hands: np.ndarray, weight: np.ndarray) -> Arrays:
    """Gradient of sum(weight * (x, v) at frame ends) through all frames, by simulate_frame; frame 0 has no weight."""
    solver, motion = solver_for(body, hands.shape[1]), torch.tensor(hands)
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
        adj_x, adj_v, springs_ = adj[0], adj[1], springs_ + adj[2]
    chain = {"x": adj_x.numpy(), "v": adj_v.numpy(), "stiffness": springs_[:, 0].numpy(), "dashpot": springs_[:, 2].numpy()}
    assert_gradients(got, chain, EXACT)


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
    for got, wanted in zip(packed(moved), packed(bound), strict=True):
        assert torch.equal(got, wanted)


def test_contact_distance_only_selects() -> None:
    """It has no gradient, and says so by None rather than by a zero that looks computed."""
    body, x, v, hands = lively("self-collision")
    values = {name: value.requires_grad_() for name, value in tensors(body).items()}
    motion, parameters = torch.tensor(hands), pack(**values, substep=body.simulation.substep)
    after, _ = simulate_frame(solver_for(body, 2), parameters, torch.tensor(x), torch.tensor(v), motion[0], motion[1])
    after.sum().backward()
    assert values["contact_distance"].grad is None


def test_one_spring_by_hand() -> None:
    """One substep of one spring between a controller and a node: v' = dt Y (l / l0 - 1), so dv'/dY = dt (l / l0 - 1)."""
    body = scene(1, [(1, 0)], [0.5], stiffness=7.0, substeps=1, frame_time=0.01)
    assert isinstance(body.simulation, Simulation)
    stiffness = torch.tensor([7.0], dtype=torch.float64, requires_grad=True)
    values = tensors(replace(body)) | {"stiffness": stiffness}
    hand = torch.tensor([[0.6, 0.0, 0.0]], dtype=torch.float64)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    _, v = simulate_frame(solver_for(body, 1), pack(**values, substep=0.01), zero, zero, hand, hand)
    v[0, 0].backward()
    assert float(v[0, 0].detach()) == pytest.approx(0.01 * 7.0 * 0.2)
    assert stiffness.grad is not None
    assert float(stiffness.grad) == pytest.approx(0.01 * 0.2)
