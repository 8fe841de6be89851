"""The specification of a rod against closed forms, conservation laws and differences of its energy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Rod
from neuspring.rods import reference
from neuspring.rods.reference import Frames, Parameters, Rate
from tests.support import rods as make

# Central differences over STEP: rounding of 1e-16 / STEP, and STEP^2 / 6 times third derivatives of about 3 EA / L^2 = 1e3 N/m^2.
STEP = 1e-6
SLOPE = 1e-7
# Sums of some hundred numbers in float64, amplified by the stiffness of edges.
ROUNDING = 1e-11


def curled(held: Any = (0, 1, 6, 7), **changes: Any) -> Rod:
    """Eight vertices with rest curvature; clamped by default."""
    curvature = np.random.default_rng(1).normal(0, 0.3, (8, 2))
    return make.rod(make.crooked(), held, **({"curvature": curvature, "roll": 0.5} | changes))


@pytest.fixture(autouse=True)
def without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


def settled(p: Parameters, x: torch.Tensor, frames: Frames, theta: torch.Tensor, rate: Rate | None = None) -> torch.Tensor:
    """The potential where the twist is in equilibrium."""
    moved = reference.carried(frames, x)
    return reference.potential(p, x, moved, reference.relaxed(p, x, moved, theta, rate), rate)


def stiffness(p: Parameters, x: torch.Tensor) -> torch.Tensor:
    """Derivatives of forces on free vertices by their positions, negative [3 F, 3 F]."""
    frames, theta = reference.start(p, x)
    with torch.enable_grad():
        free = x[~p.held].clone().requires_grad_()
        placed = x.index_put((torch.nonzero(~p.held)[:, 0],), free)
        angles = reference.relaxed(p, placed, reference.carried(frames, placed), theta)
        pushes = reference.forces(p, placed, frames, angles)[~p.held].ravel()
        each = torch.eye(len(pushes), dtype=torch.float64)
        return -torch.autograd.grad(pushes, free, each, is_grads_batched=True)[0].reshape(len(pushes), -1)


def softest(p: Parameters, free: torch.Tensor | None = None) -> float:
    """The smallest eigenvalue of the stiffness: negative where the vertices are no stable equilibrium.

    A motion `free` [V, 3] that needs no force, for symmetry, does not count.
    """
    matrix = stiffness(p, p.vertices)
    if free is not None:
        mode = free[~p.held].ravel()
        matrix = matrix + matrix.trace() * torch.outer(mode, mode) / (mode @ mode)
    return float(torch.linalg.eigvalsh((matrix + matrix.T) / 2)[0])


@pytest.mark.parametrize("held", [(0, 1, 6, 7), (0, 1), (0, 7), ()])
@pytest.mark.parametrize("damped", [False, True])
def test_forces_are_minus_the_slope_of_the_potential(held: tuple[int, ...], damped: bool) -> None:
    p = Parameters.of(curled(held, damping=0.02, stretching=1.0))
    frames, theta = reference.start(p, p.vertices)
    x = p.vertices + 0.003 * make.real(np.random.default_rng(2).normal(size=(8, 3)))
    rate = Rate(50.0, 50.0 * reference.curvatures(frames, theta)) if damped else None
    theta = reference.relaxed(p, x, reference.carried(frames, x), theta, rate)
    forces = reference.forces(p, x, frames, theta, rate)
    for direction in make.real(np.random.default_rng(4).normal(size=(5, 8, 3))):
        ahead, behind = (settled(p, x + side * STEP * direction, frames, theta, rate) for side in (1, -1))
        slope = (ahead - behind) / (2 * STEP)
        assert float(-(forces * direction).sum()) == pytest.approx(float(slope), abs=SLOPE * float(direction.abs().sum()))


def test_a_rigid_motion_changes_nothing() -> None:
    p = Parameters.of(curled())
    turn = make.real(Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix())
    moved = replace(p, vertices=p.vertices @ turn.T + 3.0, axis=turn @ p.axis)
    forces, energies = [], []
    for each in (p, moved):
        frames, theta = reference.start(each, each.vertices)
        forces.append(reference.forces(each, each.vertices, frames, theta))
        energies.append(reference.energy(each, each.vertices, frames, theta).item())
    assert energies[0] == pytest.approx(energies[1], rel=1e-9)
    np.testing.assert_allclose(forces[1], forces[0] @ turn.T, atol=1e-9 * float(forces[0].abs().max()), rtol=0)


@pytest.mark.parametrize("damping", [0.0, 0.02])
def test_a_free_rod_keeps_its_momentum_and_loses_energy_to_damping_alone(damping: float) -> None:
    stretching, h = 20.0, 1e-3
    p = Parameters.of(curled((), damping=damping, stretching=stretching))
    state = reference.beginning(p, make.real(np.random.default_rng(3).normal(0, 0.3, (8, 3))))
    none = torch.zeros(3, dtype=torch.float64)
    mass = p.mass[:, None]
    momenta, energies = [], []
    for _ in range(15):
        turns = torch.linalg.cross(state.x, mass * state.v).sum(0)
        momenta.append(torch.cat([(mass * state.v).sum(0), turns]))
        frames = reference.carried(state.frames, state.x)
        elastic = reference.energy(p, state.x, frames, reference.relaxed(p, state.x, frames, state.theta))
        energies.append(float(elastic + (mass * state.v.square()).sum() / 2))
        state = reference.advanced(p, state, h, state.x, state.x, none)
    np.testing.assert_allclose(torch.stack(momenta) - momenta[0], 0, atol=ROUNDING)
    if damping:
        assert energies[-1] < 0.9 * energies[0]
    else:
        # Leapfrog keeps an energy that differs by (w h)^2 / 8 of itself from the true one, to either side.
        highest = 4 * stretching / float(p.lengths.min() * p.mass.min())
        assert np.ptp(energies) < highest * h**2 / 4 * energies[0]


def test_steps_converge_with_second_order() -> None:
    p = Parameters.of(curled(damping=0.01, stretching=20.0, drag_quadratic=0.3), drag=0.3)
    hands = p.vertices + 0.002 * torch.arange(3)[:, None, None]
    v = torch.full((8, 3), 0.2, dtype=torch.float64)
    coarse, middle, fine = (
        reference.roll_out(p, make.simulation(gravity=9.8, frame_time=0.005), hands, v, steps=n)[-1] for n in (3, 6, 12)
    )
    order = np.log2(float((middle - coarse).norm() / (fine - middle).norm()))
    assert order == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_steps_that_are_needed_are_stable_and_few(damping: float) -> None:
    """A stiff rod swings on in them; in five times fewer it does not, without damping."""
    body = make.rod(make.straight(4, 0.15), (0, 1), bending=0.1, stretching=2000.0, damping=damping)
    frame_time = 0.01
    needed = reference.steps_needed(Parameters.of(body), frame_time)
    v = torch.zeros(4, 3, dtype=torch.float64)
    v[3, 2] = 0.5

    def reach(steps: int) -> float:
        h = frame_time / steps
        hands = make.real(body.vertices).expand(2, 4, 3)
        return float(reference.roll_out(body, make.simulation(frame_time=25 * h), hands, v, steps=25)[-1].abs().max())

    assert reach(needed) < 0.2
    assert damping or not reach(needed // 5) < 0.2


@pytest.mark.parametrize(
    "name",
    [
        *("lengths", "mass", "bending", "twisting", "curvature", "stretching", "damping", "drag", "drag_quadratic", "roll"),
        *("vertices", "slip", "slip_twist"),
    ],
)
def test_gradients_of_a_rollout_are_its_differences(name: str) -> None:
    curvature = np.random.default_rng(1).normal(0, 0.3, (5, 2))
    slip = np.array([[1.0, 0.05], [0.5, 0.5]])
    options = {"curvature": curvature, "slip": slip, "slip_twist": 0.3}
    body = make.rod(make.crooked(5), (0, 1, 3, 4), roll=0.5, damping=0.01, drag_quadratic=2.0, **options)
    p = Parameters.of(body, drag=0.5)
    weights = make.real(np.random.default_rng(5).normal(size=(3, 5, 3)))
    start = getattr(p, name)
    direction = make.real(np.random.default_rng(6).normal(size=start.shape)) * start.abs().max()

    def loss(value: torch.Tensor) -> torch.Tensor:
        hands = p.vertices + 0.002 * torch.arange(3)[:, None, None]
        v = torch.full((5, 3), 0.5, dtype=torch.float64)
        x = reference.roll_out(replace(p, **{name: value}), make.simulation(gravity=9.8, frame_time=0.004), hands, v, steps=2)
        return (weights * x).sum()

    with torch.enable_grad():
        value = start.clone().requires_grad_()
        gradient = torch.autograd.grad(loss(value), value)[0]
    ahead, behind = (loss(start + side * STEP * direction) for side in (1, -1))
    assert float((gradient * direction).sum()) == pytest.approx(float((ahead - behind) / (2 * STEP)), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("held", [(), (0, 1)])
def test_a_helix_is_at_rest_in_its_own_curvatures(held: tuple[int, ...]) -> None:
    """Neither mirrored nor turned: signs of curvatures, directors and axis are those that the docstring of `Rod` says."""
    p = Parameters.of(make.coil(8, held))
    frames, theta = reference.start(p, p.vertices)
    assert float(reference.energy(p, p.vertices, frames, theta)) < 1e-20
    np.testing.assert_allclose(reference.forces(p, p.vertices, frames, theta), 0, atol=ROUNDING)
    mirrored = p.vertices * make.real([1, 1, -1])
    assert float(reference.energy(p, mirrored, *reference.start(p, mirrored))) > 1e-5


def sag(vertices: int) -> float:
    """Of the end of a cantilever over that of theory: three steps of Newton."""
    p = Parameters.of(make.cantilever(vertices))
    x = p.vertices.clone()
    for _ in range(3):
        frames, theta = reference.start(p, x)
        push = (reference.forces(p, x, frames, theta) + p.mass[:, None] * make.real([0, 0, -9.8]))[2:].ravel()
        x[2:] += torch.linalg.solve(stiffness(p, x), push).reshape(-1, 3)
    return float(-x[-1, 2]) / make.SAG


def test_a_cantilever_sags_as_theory_says_with_second_order_in_segments() -> None:
    coarse, fine = (abs(sag(vertices) - 1) for vertices in (6, 11))
    assert fine < 0.006
    # Segments from the clamp to the end: 4.5 and 9.5.
    assert np.log(coarse / fine) / np.log(9.5 / 4.5) == pytest.approx(2, abs=0.1)


def test_a_pinned_column_buckles_at_the_load_of_its_segments() -> None:
    found = brentq(lambda load: softest(Parameters.of(make.column(6, load))), 5, 12, rtol=1e-6)
    # The column is shorter than at rest by its strain of 1e-6.
    assert found == pytest.approx(make.buckling_load(6), rel=4e-6)
    assert make.buckling_load(1000) == pytest.approx(np.pi**2, rel=1e-6)


def greenhill(segments: int) -> float:
    """Critical twisting moment of a straight rod over that of theory."""
    return brentq(lambda moment: softest(Parameters.of(make.twisted(segments, moment))), 6, 12, rtol=1e-4) / make.GREENHILL


def ring(segments: int) -> float:
    """Critical twist of a ring that is straight at rest over that of Michell, 2 pi sqrt(3) EI / GJ."""
    angles = 2 * np.pi / segments * np.arange(segments + 2)
    points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)

    def level(roll: float) -> float:
        body = make.rod(points, (0, 1, segments, segments + 1), bending=1.0, twisting=1.5, stretching=1e4, roll=roll)
        p = Parameters.of(body)
        # The ring can turn about the edge that is clamped.
        return softest(p, torch.linalg.cross(reference.tangents(p.vertices)[:1], p.vertices - p.vertices[:1]))

    return brentq(level, 5, 12, rtol=1e-4) / (2 * np.pi * 3**0.5 / 1.5)


@pytest.mark.parametrize(("ratio", "segments", "rest"), [(greenhill, 8, 1e-3), (ring, 16, 5e-3)])
def test_twist_makes_a_straight_rod_and_a_ring_unstable(ratio: Any, segments: int, rest: float) -> None:
    """Second order in segments: what is left of the error after Richardson's extrapolation is of fourth order."""
    coarse, fine = ratio(segments), ratio(2 * segments)
    assert 0 < fine - 1 < (coarse - 1) / 3
    assert fine - (coarse - fine) / 3 == pytest.approx(1, abs=rest)
