"""The integrator against closed forms, conservation laws and its order of convergence.

Symplectic Euler has exact discrete solutions for free fall and for a linear oscillator, so most comparisons are to rounding;
agreement with the continuous solution is then a matter of order: halving the substep halves the error.
"""

from __future__ import annotations

import numpy as np
import pytest

from neuspring.physics.motion import APPROACH
from tests.support.scenes import ENGINES, Engine, no_hands, scene

# Rounding of float64 accumulated over up to 10^4 substeps at meters and meters per second.
ROUNDING = 1e-10
# Error ratio when the substep halves: 2 for first order; the next order contributes about dt / T, 2 % here.
HALVING = (1.95, 2.05)
G = 9.8

pytestmark = pytest.mark.parametrize("engine", ENGINES)
SIDES = pytest.mark.parametrize("up", ["+z", "-z"])


def sign(up: str) -> float:
    return 1.0 if up == "+z" else -1.0


# Free fall ------------------------------------------------------------------------------------------------------------


@SIDES
@pytest.mark.parametrize("drag", [0.0, 3.0])
def test_free_fall_is_the_discrete_closed_form(engine, drag, up):
    """v_n = delta^n v_0 - s g dt,  x_n = x_0 + dt (s v_0 - g dt sum of partial sums),  s = delta + ... + delta^n."""
    substeps = 50
    body = scene(1, drag=drag, gravity=G, up=up, substeps=substeps, frame_time=0.1)
    x, v = engine(body, np.array([[0.1, 0.0, 3.0]]), np.array([[0.7, 0.0, 2.0]]), no_hands(4))
    dt, gravity = 0.1 / substeps, -sign(up) * G * 0.1 / substeps
    powers = np.exp(-dt * drag) ** np.arange(1, 4 * substeps + 1)
    partial = np.cumsum(powers)
    for frame in range(1, 5):
        n = frame * substeps
        speed = [0.7 * powers[n - 1], 0, 2.0 * powers[n - 1] + gravity * partial[n - 1]]
        np.testing.assert_allclose(v[frame, 0], speed, atol=ROUNDING)
        traveled = dt * np.array([0.7 * partial[n - 1], 0, 2.0 * partial[n - 1] + gravity * partial[:n].sum()])
        np.testing.assert_allclose(x[frame, 0], np.array([0.1, 0, 3.0]) + traveled, atol=ROUNDING)


# Masses ----------------------------------------------------------------------------------------------------------------


def test_masses_conserve_momentum_and_the_oscillation_has_the_reduced_mass(engine):
    """Equation of two nodes of 0.5 and 2 kg on a spring: q'' = -(Y / l0) (1/m_1 + 1/m_2) q, and m_1 v_1 + m_2 v_2 stays."""
    mass, dt, steps = np.array([0.5, 2.0]), 1e-3, 200
    body = scene(2, [(0, 1)], [0.2], stiffness=50.0, mass=mass, frame_time=dt)
    x, v = engine(body, np.array([[0.0, 0, 0], [0.22, 0, 0]]), np.array([[0.3, 0.1, 0], [0.3, 0.1, 0]]), no_hands(steps))
    momentum = np.einsum("n,fnk->fk", mass, v)
    np.testing.assert_allclose(momentum, np.broadcast_to([0.75, 0.25, 0], momentum.shape), atol=ROUNDING)
    # Along the axis: q_(k+1) = (2 - dt^2 w^2) q_k - q_(k-1) of symplectic Euler.
    q = x[:, 1, 0] - x[:, 0, 0] - 0.2
    np.testing.assert_allclose(q[2:], (2 - dt**2 * 250.0 * 2.5) * q[1:-1] - q[:-2], atol=1e-13)
    assert q.min() < -0.019


def test_nodes_of_other_mass_collide_with_their_momentum(engine):
    """Head on: m_1 v_1 + m_2 v_2 stays, and the relative velocity becomes -e times what it was."""
    mass, start = np.array([0.5, 2.0]), np.array([[1.0, 0, 0], [-0.5, 0, 0]])
    body = scene(2, mass=mass, contact=(0.6, 0.3), contact_distance=0.02, self_collision=True)
    v = engine(body, np.array([[0.0, 0, 0], [0.01, 0, 0]]), start, no_hands(1))[1][1]
    np.testing.assert_allclose(mass @ v, mass @ start, atol=ROUNDING)
    np.testing.assert_allclose(v[1] - v[0], -0.6 * (start[1] - start[0]), atol=ROUNDING)


# A linear oscillator: two nodes and a spring --------------------------------------------------------------------------

LENGTH, STIFFNESS, AMPLITUDE = 0.2, 50.0, 0.02
OMEGA_SQUARED = 2 * STIFFNESS / LENGTH
"""Equation of the distance between two unit masses: q'' = -2 (Y / l0) q."""
PERIOD = 2 * np.pi / np.sqrt(OMEGA_SQUARED)


def oscillate(
    engine: Engine, substep: float, steps: int, per_frame: int = 1, dashpot: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Extension q [F] and its rate, at frame ends, along a tilted axis, starting at AMPLITUDE with rate 0."""
    body = scene(2, [(0, 1)], [LENGTH], stiffness=STIFFNESS, dashpot=dashpot, substeps=per_frame, frame_time=substep * per_frame)
    axis = np.array([2.0, -1.0, 2.0]) / 3
    x = np.stack([np.zeros(3), axis * (LENGTH + AMPLITUDE)])
    x, v = engine(body, x, np.zeros((2, 3)), no_hands(steps // per_frame))
    return (x[:, 1] - x[:, 0]) @ axis - LENGTH, (v[:, 1] - v[:, 0]) @ axis


@pytest.mark.parametrize("damping", [0.0, 0.8])
def test_oscillator_is_the_discrete_closed_form(engine, damping):
    """q_{n+1} - (2 - c dt - w^2 dt^2) q_n + (1 - c dt) q_{n-1} = 0, so q_n = r^n (A cos n theta + B sin n theta)."""
    dt, c = PERIOD / 40, 2 * damping
    q, _ = oscillate(engine, dt, 400, dashpot=damping)
    r = np.sqrt(1 - c * dt)
    theta = np.arccos((2 - c * dt - OMEGA_SQUARED * dt**2) / (2 * r))
    first = AMPLITUDE * (1 - OMEGA_SQUARED * dt**2)
    sine = (first / r - AMPLITUDE * np.cos(theta)) / np.sin(theta)
    n = np.arange(401)
    np.testing.assert_allclose(q, r**n * (AMPLITUDE * np.cos(n * theta) + sine * np.sin(n * theta)), atol=ROUNDING)


def test_oscillator_converges_at_first_order(engine):
    """Compared with A cos(w t) at 0.7 periods: the leading error is A (w dt / 2) sin(w t), and phase errors are still small."""
    steps, t = 300, 0.7 * PERIOD
    exact = AMPLITUDE * np.cos(np.sqrt(OMEGA_SQUARED) * t)
    errors = [abs(oscillate(engine, t / n, n, n)[0][-1] - exact) for n in (steps, 2 * steps)]
    assert HALVING[0] < errors[0] / errors[1] < HALVING[1]


def test_energy_is_bounded_without_damping(engine):
    """Symplectic: q'^2 + w^2 q^2 - dt w^2 q q' is conserved exactly, so the energy stays within w dt / 2 of its start."""
    dt = PERIOD / 60
    q, rate = oscillate(engine, dt, 60 * 100, per_frame=7)
    shadow = rate**2 + OMEGA_SQUARED * q**2 - dt * OMEGA_SQUARED * q * rate
    np.testing.assert_allclose(shadow, shadow[0], rtol=1e-9)
    energy = (rate**2 + OMEGA_SQUARED * q**2) / (OMEGA_SQUARED * AMPLITUDE**2)
    half = np.sqrt(OMEGA_SQUARED) * dt / 2
    assert energy.max() < 1 / (1 - half) + ROUNDING
    assert energy.min() > 1 / (1 + half) - ROUNDING
    # No drift: the second half of 100 periods reaches the same extremes as the first.
    middle = len(energy) // 2
    assert energy[middle:].max() == pytest.approx(energy[:middle].max(), rel=1e-3)


def test_energy_decays_with_a_dashpot(engine):
    """Per period: monotone, at the rate of the discrete envelope, r^2 = 1 - c dt per substep."""
    gamma, per_frame = 0.3, 60
    dt = PERIOD / per_frame
    q, rate = oscillate(engine, dt, per_frame * 12, per_frame, gamma)
    energy = rate**2 + OMEGA_SQUARED * q**2
    assert (np.diff(energy) < 0).all()
    # A frame is a period of the undamped motion; the phase slips a little, which moves the energy within the band above.
    band = np.sqrt(OMEGA_SQUARED) * dt
    assert energy[-1] / energy[0] == pytest.approx((1 - 2 * gamma * dt) ** (12 * per_frame), rel=band)


# Conservation in a net ------------------------------------------------------------------------------------------------


def net(dashpot: float, frames: int = 20) -> tuple:
    rng = np.random.default_rng(5)
    x, v = rng.uniform(-0.1, 0.1, (12, 3)), rng.uniform(-1, 1, (12, 3))
    springs = [(i, j) for i in range(12) for j in range(i + 1, 12) if rng.random() < 0.5]
    lengths = [np.linalg.norm(x[i] - x[j]) * rng.uniform(0.8, 1.2) for i, j in springs]
    body = scene(12, springs, lengths, stiffness=rng.uniform(5, 100, len(springs)), dashpot=dashpot, substeps=20, frame_time=0.02)
    return body, x, v, no_hands(frames)


@pytest.mark.parametrize("dashpot", [0.0, 2.0])
def test_momentum_and_angular_momentum(engine, dashpot):
    """Springs and dashpots act along the line between their ends. Momentum is conserved, and so is angular momentum:

    x_{n+1} x v_{n+1} = (x_n + dt v_{n+1}) x v_{n+1} = x_n x (v_n + dt f_n), and central forces have no total moment.
    """
    x, v = engine(*net(dashpot))
    np.testing.assert_allclose(v.sum(axis=1), np.tile(v[0].sum(axis=0), (len(v), 1)), atol=ROUNDING)
    spin = np.cross(x, v).sum(axis=1)
    np.testing.assert_allclose(spin, np.tile(spin[0], (len(spin), 1)), atol=ROUNDING)


@pytest.mark.parametrize(("e", "mu"), [(1.0, 0.0), (0.7, 0.3), (0.0, 2.0)])
def test_a_colliding_pair(engine, e, mu):
    """Momentum is conserved, the normal speed is reversed times e, the tangential one shrinks by a."""
    body = scene(2, self_collision=True, contact=(e, mu), contact_distance=0.02, substeps=1, frame_time=1e-3)
    x = np.array([[0.0, 0, 0], [0.015, 0, 0]])
    v = np.array([[0.4, 0.1, 0], [-0.2, -0.5, 0.3]])
    _, after = engine(body, x, v, no_hands(1))
    np.testing.assert_allclose(after[1].sum(axis=0), v.sum(axis=0), atol=1e-15)
    before, relative = v[1] - v[0], after[1, 1] - after[1, 0]
    tangent = np.linalg.norm(before[1:])
    a = max(0.0, 1 - mu * (1 + e) * abs(before[0]) / tangent)
    np.testing.assert_allclose(relative, [-e * before[0], *(a * before[1:])], atol=1e-15)
    if (e, mu) == (1.0, 0.0):
        assert (after[1] ** 2).sum() == pytest.approx((v**2).sum(), rel=1e-14)


def test_receding_or_distant_pairs_do_not_collide(engine):
    body = scene(2, self_collision=True, contact_distance=0.02)
    v = np.array([[-0.1, 0, 0], [0.1, 0, 0]])
    near, far = np.array([[0.0, 0, 0], [0.015, 0, 0]]), np.array([[0.0, 0, 0], [0.02, 0, 0]])
    for x, speed in ((near, v), (near, 0 * v), (far, -v)):
        np.testing.assert_array_equal(engine(body, x, speed, no_hands(1))[1][1], speed)


@pytest.mark.parametrize("moving", [False, True])
def test_a_dashpot_feels_the_speed_of_its_hand_only_if_hands_have_one(engine, moving):
    """One substep from rest, with a spring that hardly pulls: v' = dt gamma V."""
    body = scene(1, [(1, 0)], [0.1], stiffness=1e-12, dashpot=2.0, controller_velocity=moving)
    hands = np.array([[[0.1, 0, 0]], [[0.1005, 0, 0]]])
    v = engine(body, np.zeros((1, 3)), np.zeros((1, 3)), hands)[1][1]
    np.testing.assert_allclose(v, [[1e-3 * 2.0 * 0.5 * moving, 0, 0]], atol=ROUNDING)


# Ground ---------------------------------------------------------------------------------------------------------------


@SIDES
@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_restitution_is_exact_in_speed(engine, e, up):
    """One substep: reflected at the time of impact, then v' for the rest of the substep."""
    s, dt = sign(up), 1e-3
    body = scene(1, on_ground=True, ground=(e, 0.0), up=up)
    x, v = engine(body, np.array([[0, 0, s * 2e-4]]), np.array([[0.3, 0, -s * 0.8]]), no_hands(1))
    impact = 2e-4 / 0.8
    np.testing.assert_allclose(v[1, 0], [0.3, 0, s * e * 0.8], atol=1e-15)
    np.testing.assert_allclose(x[1, 0], [0.3 * dt, 0, s * e * 0.8 * (dt - impact)], atol=1e-15)


@SIDES
def test_bounce_height_is_e_squared(engine, up):
    """Height of the n-th bounce: e^(2n) h, up to the distance fallen in a substep at full speed."""
    s, dt, height, e = sign(up), 2e-4, 0.1, 0.6
    body = scene(1, on_ground=True, ground=(e, 0.0), gravity=G, up=up, frame_time=dt)
    z = s * engine(body, np.array([[0, 0, s * height]]), np.zeros((1, 3)), no_hands(3000))[0][:, 0, 2]
    tops = z[1:-1][(z[1:-1] > z[:-2]) & (z[1:-1] >= z[2:])]
    step = dt * np.sqrt(2 * G * height)
    assert len(tops) >= 2
    np.testing.assert_allclose(tops[:2], [e**2 * height, e**4 * height], atol=step)


@SIDES
def test_sliding_and_sticking(engine, up):
    """a = max(0, 1 - mu (1 + e) |v_n| / |v_t|): partly braked, or stopped when mu is large."""
    s, e, w = sign(up), 0.4, np.array([0.6, -0.8, -0.5 * sign(up)])
    for mu, a in ((0.0, 1.0), (0.3, 1 - 0.3 * 1.4 * 0.5), (2.0, 0.0)):
        body = scene(1, on_ground=True, ground=(e, mu), up=up)
        _, v = engine(body, np.array([[0, 0, s * 1e-4]]), w[None], no_hands(1))
        np.testing.assert_allclose(v[1, 0], [a * w[0], a * w[1], -e * w[2]], atol=1e-15)


@SIDES
@pytest.mark.parametrize("e", [0.0, 0.3, 1.0])
def test_the_ground_holds(engine, e, up):
    """From above nothing goes deeper than a node slower than APPROACH can travel in the substep in which it is let pass."""
    rng, s, dt = np.random.default_rng(2), sign(up), 1e-3
    body = scene(40, on_ground=True, ground=(e, 0.2), gravity=G, up=up, frame_time=dt)
    x, v = rng.uniform(0, 0.02, (40, 3)), rng.uniform(-1, 1, (40, 3))
    x[:, 2] *= s
    z = s * engine(body, x, v, no_hands(400))[0][:, :, 2]
    assert (z < 1e-3).any()
    assert z.min() >= -APPROACH * dt - 1e-15
