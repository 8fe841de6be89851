"""The adjoint of each term of a substep against central differences, in float64, of a twin alone and of four in lanes.

Four twins hold different values. Their adjoints are compared with differences of each twin alone, and their outcome must be that
of each alone, bit for bit: a lane does not see its neighbors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest
import torch

from neuspring.physics import reference
from neuspring.physics.arrays import Buffers
from neuspring.physics.motion import APPROACH
from tests.support import terms
from tests.support.differences import EXACT, Arrays, assert_gradients, differences
from tests.support.scenes import scene, solver_for
from tests.support.terms import launch, numbers, twins, vectors

KERNEL = 1e-7
"""Relative to the largest entry of the gradient compared; measured 1e-9 to 1e-8."""
WIDTHS = [1, 4]
DT = np.array([0.01, 0.008, 0.013, 0.011])
"""Substeps of the four twins, s."""


def compared(
    at: Arrays, fixed: Arrays, run: Callable[[Arrays], np.ndarray], got: Arrays, weight: np.ndarray, **steps: float
) -> Iterator[tuple[Arrays, Arrays]]:
    """(adjoint, differences) of each lane. All arrays have a leading axis [W]; the loss is sum(weight * run(at, fixed))."""
    together = run(at | fixed)
    for lane in range(len(weight)):
        own, constant, adjoint = ({name: values[lane : lane + 1] for name, values in given.items()} for given in (at, fixed, got))
        np.testing.assert_array_equal(together[lane : lane + 1], run(own | constant))

        def total(values: Arrays, lane: int = lane, constant: Arrays = constant) -> float:
            return float((run(values | constant) * weight[lane]).sum())

        yield adjoint, differences(total, own, **steps)


# Springs --------------------------------------------------------------------------------------------------------------

PAIRS = np.array([[0, 1], [1, 2], [2, 0], [3, 1], [4, 1], [3, 4]], np.int32)
"""Springs that share nodes, in both directions; point 4 is a controller."""
HAND = np.array([0.3, 0.1, -0.4])


@cache
def net(width: int) -> Buffers:
    return solver_for([scene(4, PAIRS, 1.0)] * width, 1).buffers


def fill_net(values: Arrays) -> Buffers:
    b = net(len(values["x"]))
    for name, hand in (("x", HAND), ("v", -HAND)):
        points = np.concatenate([values[name], np.broadcast_to(hand, (b.width, 1, 3))], axis=1)
        b.set_vectors(name, torch.tensor(points), slot=0)
    columns = values["stiffness"], 1 / values["rest_length"], values["dashpot"]
    b.set_parameter("springs", torch.tensor(np.stack(columns, axis=-1)))
    return b


def forces(values: Arrays, way: str) -> np.ndarray:
    b, kernels = fill_net(values), terms.kernels(len(values["x"]))
    b.tensors["force"].zero_()
    model, state, _ = b.arguments
    launch(*((kernels.rows, 1) if way == "rows" else (kernels.links, (4, 1))), model, state)
    return b.get_vectors("force", count=b.nodes).numpy()


def force_adjoints(values: Arrays, weight: np.ndarray, way: str) -> Arrays:
    b, kernels = fill_net(values), terms.kernels(len(values["x"]))
    for name, tensor in b.tensors.items():
        if name.startswith("adj_"):
            tensor.zero_()
    b.set_vectors("adj_force", torch.tensor(weight), slot=0)
    launch(*((kernels.rows_adjoint, 1) if way == "rows" else (kernels.links_adjoint, (4, 1))), *b.arguments)
    stiffness, inverse_length, dashpot = b.gradients()["springs"].numpy().transpose(2, 0, 1)
    state = {name: b.get_vectors(f"adj_{name}", count=b.nodes).numpy() for name in ("x", "v")}
    # d(1 / l0) = -d(l0) / l0^2
    return state | {"stiffness": stiffness, "rest_length": -inverse_length / values["rest_length"] ** 2, "dashpot": dashpot}


def net_values(seed: int, width: int, dashpot: float) -> tuple[Arrays, np.ndarray]:
    """(values, weight); some springs are compressed, some stretched."""
    rng, count = np.random.default_rng(seed), len(PAIRS)
    at = {
        "x": rng.uniform(-0.5, 0.5, (width, 4, 3)),
        "v": rng.standard_normal((width, 4, 3)),
        "stiffness": rng.uniform(1, 3, (width, count)),
        "rest_length": rng.uniform(0.3, 1.2, (width, count)),
        "dashpot": dashpot * rng.uniform(0.5, 1.5, (width, count)),
    }
    return at, rng.standard_normal((width, 4, 3))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("way", ["rows", "links"])
@pytest.mark.parametrize("dashpot", [0.0, 3.0])
def test_springs(dashpot: float, way: str, width: int) -> None:
    """x, v, Y, l0 and gamma, by the rows of one thread and by the links of a thread per node."""
    at, weight = net_values(0, width, dashpot)
    got = force_adjoints(at, weight, way)
    for adjoint, wanted in compared(at, {}, lambda values: forces(values, way), got, weight):
        assert_gradients(adjoint, wanted, KERNEL)


# Velocity -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", WIDTHS)
def test_velocity(width: int) -> None:
    """v, force and the drag's factor."""
    rng, count, kernels = np.random.default_rng(2), 5, terms.kernels
    weight = rng.standard_normal((width, count, 3))
    at = {
        "v": rng.standard_normal((width, count, 3)),
        "force": rng.standard_normal((width, count, 3)) * 50,
        "decay": np.array([0.93, 0.8, 0.99, 0.5])[:width],
    }
    light = rng.uniform(0.5, 2.0, (width, count))
    fixed = {
        "light": light,
        "dt": DT[:width],
        "gravity": np.array([[[0.0, 0.0, -9.8]], [[0, 0, 9.8]], [[0, 0, 0]], [[1.0, 2, 3]]])[:width],
    }

    def after(values: Arrays) -> np.ndarray:
        result = vectors(np.zeros_like(values["v"]))
        state = vectors(values["v"]), vectors(values["force"]), vectors(values["gravity"])
        scalars = (numbers(values[name]) for name in ("dt", "decay", "light"))
        launch(kernels(len(values["v"])).speed, count, *state, *scalars, result)
        return twins(result)

    values = at | fixed
    expected = values["v"] + values["dt"][:, None, None] * (values["force"] * light[..., None] + values["gravity"])
    np.testing.assert_allclose(after(values), expected * values["decay"][:, None, None], rtol=EXACT)
    adj_v, adj_force = (vectors(np.zeros_like(weight)) for _ in range(2))
    adj_decay = numbers(np.zeros((width, count)))
    state = vectors(after(values)), vectors(weight), *(numbers(values[name]) for name in ("dt", "decay", "light"))
    launch(kernels(width).speed_adjoint, count, *state, adj_v, adj_force, adj_decay)
    got = {"v": twins(adj_v), "force": twins(adj_force), "decay": twins(adj_decay).sum(axis=1)}
    for adjoint, wanted in compared(at, fixed, after, got, weight):
        assert_gradients(adjoint, wanted, KERNEL)


# Position -------------------------------------------------------------------------------------------------------------


def moved(values: Arrays, up: float) -> np.ndarray:
    """x' and v' [W, n, 2, 3]."""
    after = [vectors(np.zeros_like(values["x"])) for _ in range(2)]
    state, response = (vectors(values["x"]), vectors(values["v"])), (numbers(values["e"]), numbers(values["mu"]))
    kernel, count = terms.kernels(len(values["x"])).motion, values["x"].shape[1]
    launch(kernel, count, *state, numbers(values["dt"]), up, *response, *after)
    return np.stack([twins(array) for array in after], axis=2)


def moved_adjoints(values: Arrays, up: float, weight: np.ndarray) -> Arrays:
    width, count = values["x"].shape[:2]
    adjoints = [vectors(weight[:, :, 0]), vectors(weight[:, :, 1]), *(numbers(np.zeros((width, count))) for _ in range(2))]
    state, response = (vectors(values["x"]), vectors(values["v"])), (numbers(values["e"]), numbers(values["mu"]))
    launch(terms.kernels(width).motion_adjoint, count, *state, numbers(values["dt"]), up, *response, *adjoints)
    adj_x, adj_v, adj_e, adj_mu = map(twins, adjoints)
    return {"x": adj_x, "v": adj_v, "e": adj_e.sum(axis=1), "mu": adj_mu.sum(axis=1)}


GROUND_CASES = {
    "flying": ((0.1, 0.2, 0.5), (0.3, -0.2, -1.0), 0.3),
    "sliding": ((0.1, 0.2, 0.004), (1.3, -0.9, -0.8), 0.3),
    "sticking": ((0.1, 0.2, 0.004), (0.2, -0.1, -0.8), 1.5),
    "already below": ((0.1, 0.2, -0.003), (1.3, -0.9, -0.8), 0.3),
    "rising from below": ((0.1, 0.2, -0.003), (1.3, -0.9, 0.8), 0.3),
    "falling straight": ((0.1, 0.2, 0.004), (0.0, 0.0, -0.8), 0.3),
    "without friction": ((0.1, 0.2, 0.004), (1.3, -0.9, -0.8), 0.0),
}


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("up", [1.0, -1.0])
@pytest.mark.parametrize("case", GROUND_CASES)
def test_ground(case: str, up: float, width: int) -> None:
    """x, v, elasticity and friction, in contact and out, sliding and sticking; other lanes are in other cases."""
    names = list(GROUND_CASES)
    cases = [names[(names.index(case) + lane) % len(names)] for lane in range(width)]
    place, speed, friction = (np.array([GROUND_CASES[name][k] for name in cases]) for k in range(3))
    flip, weight = np.array([1.0, 1.0, up]), np.random.default_rng(4).standard_normal((width, 1, 2, 3))
    elasticity = np.array([0.6, 0.2, 0.9, 0.4])[:width]
    at = {"x": (place * flip)[:, None], "v": (speed * flip)[:, None], "e": elasticity, "mu": friction}
    fixed = {"dt": DT[:width]}
    results = compared(at, fixed, lambda values: moved(values, up), moved_adjoints(at | fixed, up, weight), weight)
    for name, (got, wanted) in zip(cases, results, strict=True):
        if name == "falling straight":
            # The tangential speed is at its floor, where |v_t| has a kink; nothing moves sideways, so e and z are smooth.
            for values in (got, wanted):
                values["v"] = values["v"][..., 2]
        assert_gradients(got, wanted, KERNEL)
        assert bool(got["e"]) == (name not in ("flying", "rising from below"))
        assert bool(got["mu"]) == (name in ("sliding", "already below", "without friction"))


# Collision ------------------------------------------------------------------------------------------------------------

DISTANCE = 0.02
FRICTIONS = [0.0, 0.1, 0.9, 2.0]


@cache
def crowd_buffers(width: int) -> Buffers:
    return solver_for([scene(6, self_collision=True, contact_distance=DISTANCE)] * width, 0).buffers


def fill_crowd(values: Arrays) -> Buffers:
    """Lists of all lanes' partners, and rows of pairs; a lane's bit says who is listed for it."""
    b, listed = crowd_buffers(len(values["x"])), values["listed"]
    b.set_vectors("x", torch.tensor(values["x"]), slot=0)
    b.set_vectors("after", torch.tensor(values["v"]), slot=0)
    for name in ("e", "mu"):
        b.set_numbers(f"contact_{name}", torch.tensor(values[name]))
    bits = (listed << np.arange(b.width)[:, None, None]).sum(axis=0)
    for name, shape in {"near": (6, 6, 1), "near_lanes": (6, 6, 1), "near_count": (6, 1)}.items():
        b.set_table(name, shape)
    pairs = []
    for i, row in enumerate(bits):
        partners = np.flatnonzero(row)
        b.indices["near"][i, : len(partners), 0] = torch.tensor(partners, dtype=torch.int32)
        b.indices["near_lanes"][i, : len(partners), 0] = torch.tensor(row[partners], dtype=torch.int32)
        b.indices["near_count"][i, 0] = len(partners)
        pairs += [(j, row[j]) for j in partners if j > i]
        b.indices["pair_rows"][0, i + 1] = len(pairs)
    for k, name in enumerate(("pair_other", "pair_lanes")):
        b.indices[name][0, : len(pairs)] = torch.tensor([pair[k] for pair in pairs], dtype=torch.int32)
    return b


def collided(values: Arrays) -> np.ndarray:
    """Velocities after the impulses, which a thread per node and one thread for all pairs give alike, bit for bit."""
    b = fill_crowd(values)
    launch(terms.kernels(b.width).collide, (6, 1), *b.arguments[:2])
    gathered = b.get_vectors("moving", slot=0).numpy()
    launch(terms.kernels(b.width).collide_pairs, 1, *b.arguments[:2])
    np.testing.assert_array_equal(b.get_vectors("moving", slot=0).numpy(), gathered)
    return gathered


def collided_adjoints(values: Arrays, weight: np.ndarray) -> Arrays:
    """Those of a thread per node and of one for all pairs, which are the same."""
    by_node, by_pair = (adjoints_by(name, values, weight) for name in ("collide_adjoint", "collide_pairs_adjoint"))
    for name, gathered in by_node.items():
        np.testing.assert_array_equal(by_pair[name], gathered)
    return by_node


def adjoints_by(kernel: str, values: Arrays, weight: np.ndarray) -> Arrays:
    b = fill_crowd(values)
    # The adjoint reads how many partners were met.
    launch(terms.kernels(b.width).collide, (6, 1), *b.arguments[:2])
    for name, tensor in b.tensors.items():
        if name.startswith("adj_"):
            tensor.zero_()
    b.set_vectors("adj_moving", torch.tensor(weight))
    launch(getattr(terms.kernels(b.width), kernel), (6, 1) if kernel == "collide_adjoint" else 1, *b.arguments)
    e, mu = (b.get_numbers(f"adj_contact_{name}").sum(dim=1).numpy() for name in ("e", "mu"))
    return {"x": b.get_vectors("adj_x", count=b.nodes).numpy(), "v": b.get_vectors("adj_after").numpy(), "e": e, "mu": mu}


def crowd(friction: float, seed: int = 11) -> Arrays:
    """Six nodes of which several pairs are near and approach, some slide and, with much friction, stick."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-0.012, 0.012, (6, 3))
    v = -30 * x + rng.uniform(-0.3, 0.3, (6, 3))
    x[5] += 1.0
    return {"x": x, "v": v, "e": np.array(0.4), "mu": np.array(friction)}


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("friction", FRICTIONS)
def test_collision(friction: float, width: int) -> None:
    """x, v, elasticity and friction for Jacobi impulses of nodes with several partners each.

    All nodes are listed in the first lane; in every other, some pair is none.
    """
    crowds = [crowd((friction + lane) % 2.0 if lane else friction, 11 + lane) for lane in range(width)]
    at = {name: np.stack([one[name] for one in crowds]) for name in crowds[0]}
    listed = np.broadcast_to(~np.eye(6, dtype=bool), (width, 6, 6)).astype(np.int64)
    for lane in range(1, width):
        listed[lane, lane - 1, lane % 5] = listed[lane, lane % 5, lane - 1] = 0
    weight = np.random.default_rng(12).standard_normal((width, 6, 3))
    got = collided_adjoints(at | {"listed": listed}, weight)
    # Lengths here are 0.01 m, so third derivatives in x are 1e4 times those of the other kernels: a smaller step.
    for adjoint, wanted in compared(at, {"listed": listed}, collided, got, weight, x=1e-7):
        assert_gradients(adjoint, wanted, KERNEL)
        assert wanted["e"].any()
    assert not got["x"][:, 5].any()
    np.testing.assert_allclose(got["v"][:, 5], weight[:, 5])
    assert_lively({name: values[0] for name, values in at.items()}, friction)


def assert_lively(at: Arrays, friction: float) -> None:
    """The scene has what it claims: pairs that collide, and pairs that slide or stick as the friction asks."""
    i, j = np.triu_indices(6, 1)
    dx, u = at["x"][j] - at["x"][i], at["v"][j] - at["v"][i]
    length = np.linalg.norm(dx, axis=1)
    hit = (length < DISTANCE) & ((dx * u).sum(axis=1) < -APPROACH)
    normal = (dx * u).sum(axis=1) / length
    tangent = np.linalg.norm(u - dx * (normal / length)[:, None], axis=1)
    left = reference.response(normal, tangent, 0.4, friction)[hit]
    assert hit.sum() >= 4
    assert (left > 0).any() == (friction < 2.0)
    assert (left == 0).any() == (friction > 0.5)
