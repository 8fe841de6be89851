"""The finite-element engine with our kernels: closed forms on small bodies."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from neuspring.extensions.synthetic.bodies import SoftBody, Surface
from neuspring.extensions.synthetic.fem import GRAVITY, Damping, FiniteElements, VertexBlockDescent, certify, stable_moduli
from neuspring.extensions.synthetic.meshes import block, boundary, oriented
from neuspring.extensions.synthetic.scenes import Hand, place

RATE = 60.0
NO_DAMPING = Damping(deformation=0.0, drag=0.0, edges=0.0)


def bar(height=0.5, youngs=2e4, viscosity=0.0, friction=0.5, cells=(6, 2, 2)):
    """A bar of 0.12 x 0.03 x 0.03 m along x, its lower side at `height`."""
    nodes, tetrahedra = block((-0.06, -0.015, height), (0.06, 0.015, height + 0.03), cells)
    skin = boundary(tetrahedra)
    own, one = np.arange(len(nodes))[:, None], np.ones((len(nodes), 1))
    surface = Surface(rest=nodes, faces=skin, nodes=own, weights=one, colors=nodes * 0)
    count = len(tetrahedra)
    return SoftBody(
        nodes=nodes,
        surface=surface,
        radius=0.003,
        tetrahedra=tetrahedra,
        youngs_modulus=np.full(count, youngs),
        poisson_ratio=np.full(count, 0.3),
        density=np.full(count, 200.0),
        viscosity=(viscosity, 0.05),
        friction=friction,
    )


def test_free_fall():
    engine = FiniteElements(bar(), (), 13, RATE, NO_DAMPING)
    clip = engine.run()
    time = np.arange(13) / RATE
    fallen = clip.positions[:, :, 2].mean(axis=1) - clip.positions[0, :, 2].mean()
    # Symplectic Euler falls g t dt / 2 further.
    np.testing.assert_allclose(fallen, -0.5 * GRAVITY * time * (time + engine.substep), atol=2e-6)
    np.testing.assert_allclose(clip.positions[-1], clip.positions[0] + np.array([0, 0, fallen[-1]]), atol=5e-5)
    assert clip.least_jacobian.min() > 0.999


def test_a_hanging_bar_stretches_as_its_modulus_says():
    """Held at one end and hung along z the other end sinks by rho g L^2 / (2 E), once the motion has died down."""
    body = bar(youngs=2e4, viscosity=1.0)
    upright = body.nodes[:, [2, 1, 0]] * [1, 1, -1] + [0, 0, 0.6]
    body = replace(body, nodes=upright, tetrahedra=oriented(upright, body.tetrahedra))
    top = upright[:, 2].max()
    grip = np.array([upright[:, 0].mean(), 0.0, top + 0.01])
    hand = Hand(((0.0, tuple(grip), (0, 0, 0)),), reach=0.025)
    clip = FiniteElements(body, (hand,), 90, RATE, Damping(deformation=20.0, drag=10.0)).run()
    held = np.linalg.norm(upright - grip, axis=1) < 0.025
    length = top - upright[:, 2].min()
    assert np.ptp(upright[held][:, 2]) == 0
    sunk = upright[:, 2].min() - clip.positions[-1, :, 2].min()
    assert sunk == pytest.approx(200.0 * GRAVITY * length**2 / (2 * 2e4), rel=0.08)


def test_free_vibration_keeps_its_energy():
    """Without gravity in play (falling freely) and without damping, the bar's own motion neither grows nor dies."""
    body = bar(height=3.0, youngs=2e4)
    start = body.nodes.copy()
    start[:, 0] *= 1.02
    clip = FiniteElements(body, (), 31, RATE, NO_DAMPING, start=start).run()
    centerd = clip.positions - clip.positions.mean(axis=1, keepdims=True)
    length = np.ptp(centerd[..., 0], axis=1)
    assert length[:10].max() == pytest.approx(0.1224, rel=2e-3)
    assert length[20:].max() == pytest.approx(length[:10].max(), rel=5e-3)
    assert length[20:].min() == pytest.approx(length[:10].min(), rel=5e-3)


def test_the_maxwell_branch_damps_and_leaves_rigid_motion_alone():
    def swing(viscosity):
        body = bar(height=3.0, viscosity=viscosity)
        start = body.nodes.copy()
        start[:, 0] *= 1.02
        x = FiniteElements(body, (), 31, RATE, NO_DAMPING, start=start).run().positions[20:, :, 0]
        return float(np.ptp(np.ptp(x, axis=1)))

    assert swing(1.0) < 0.5 * swing(0.0)
    falling = FiniteElements(bar(viscosity=1.0), (), 10, RATE, NO_DAMPING).run()
    elastic = FiniteElements(bar(viscosity=0.0), (), 10, RATE, NO_DAMPING).run()
    np.testing.assert_allclose(falling.positions[-1, :, 2].mean(), elastic.positions[-1, :, 2].mean(), atol=5e-4)


@pytest.mark.parametrize(("friction", "sticks"), [(0.8, True), (0.1, False)])
def test_a_body_sticks_to_the_table_or_slides(friction, sticks):
    """Pushed sideways by a slow hand's worth of speed: Coulomb friction stops it after v^2 / (2 mu g)."""
    body = bar(height=0.0031, friction=friction, youngs=1e5)
    engine = FiniteElements(body, (), 20, RATE, Damping(deformation=5.0, drag=0.0))
    speed = 0.4
    engine.now.particle_qd.assign(np.tile([speed, 0, 0], (len(body.nodes), 1)).astype(np.float32))
    clip = engine.run()
    slid = clip.positions[-1, :, 0].mean() - body.nodes[:, 0].mean()
    expected = speed**2 / (2 * friction * GRAVITY)
    if sticks:
        assert slid == pytest.approx(expected, abs=0.004)
    else:
        assert slid > 0.05


def test_held_nodes_follow_the_hand_exactly():
    body = bar(height=0.2)
    start = body.nodes[0]
    hand = Hand(((0.0, tuple(start), (0, 0, 0)), (0.2, tuple(start + np.array([0.05, 0, 0.1])), (0, 0, 0.5))), reach=0.02)
    engine = FiniteElements(body, (hand,), 13, RATE, Damping())
    clip = engine.run()
    held = engine.holder == 0
    assert 1 <= held.sum() < len(body.nodes)
    poses = hand.poses(np.arange(13) / RATE)
    np.testing.assert_allclose(clip.positions[:, held], place(body.nodes[held] - start, poses), atol=2e-5)


def test_twice_the_substeps_change_little_and_runs_repeat_exactly():
    body = bar(height=0.05)
    hand = Hand(((0.0, tuple(body.nodes[0]), (0, 0, 0)), (0.2, tuple(body.nodes[0] + [0, 0, 0.05]), (0, 0, 0))), reach=0.02)
    engines = [FiniteElements(body, (hand,), 12, RATE, Damping()) for _ in range(2)]
    clips = [engine.run() for engine in engines]
    np.testing.assert_array_equal(clips[0].positions, clips[1].positions)
    refined, nudged = certify(engines[0], clips[0], 12)
    assert 0 < refined < 3e-4
    assert 0 < nudged < 1e-5


@pytest.mark.slow
def test_what_hangs_at_rest_in_one_engine_stays_at_rest_in_the_other():
    """Different integrators, the same statics: the sag of a bar that a hand holds at one end."""
    body = bar(height=0.3)
    hand = Hand(((0.0, tuple(body.nodes[body.nodes[:, 0].argmax()]), (0, 0, 0)),), reach=0.03)
    first = FiniteElements(body, (hand,), 120, RATE, Damping(deformation=20.0, drag=5.0))
    rest = first.run().positions[-1]
    sag = np.linalg.norm(rest - body.nodes, axis=1).max()
    assert sag > 0.01
    second = VertexBlockDescent(body, (hand,), 20, RATE, Damping(), start=rest, holder=first.holder)
    assert np.linalg.norm(second.run().positions - rest, axis=2).max() < 0.03 * sag


def test_moduli_of_the_engine_s_energy():
    """Uniaxial stretch of the stable neo-Hookean energy has the wanted Young's modulus at small strain."""
    mu, lame = stable_moduli(np.array(1e4), np.array(0.3))

    def energy(axial, lateral):
        f = np.diag([axial, lateral, lateral])
        square, volume, alpha = (f**2).sum(), np.linalg.det(f), 1 + 0.75 * mu / lame
        return float(0.5 * mu * (square - 3) - 0.5 * mu * np.log(square + 1) + 0.5 * lame * (volume - alpha) ** 2)

    def relaxed(axial):
        return float(
            minimize_scalar(
                lambda lateral: energy(axial, lateral), bounds=(0.9, 1.1), method="bounded", options={"xatol": 1e-12}
            ).fun
        )

    h = 1e-3
    assert (relaxed(1 + h) - 2 * relaxed(1.0) + relaxed(1 - h)) / h**2 == pytest.approx(1e4, rel=1e-2)
