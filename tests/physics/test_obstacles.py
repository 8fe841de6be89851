"""Static obstacles: a box is a ground elsewhere, closed forms of friction and restitution, the reference, gradients, momentum."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Simulation, Twin
from neuspring.core.errors import InputError
from neuspring.core.geometry import Obstacle
from neuspring.physics import reference
from neuspring.physics.parameters import pack
from neuspring.physics.solver import simulate_frame
from neuspring.twin.rollout import roll_out
from neuspring.twin.trials import motions
from tests.support.differences import assert_gradients, compared
from tests.support.scenes import WAYS, random_scene, scene, solver_for, twin_of, warp

ROUNDING = 1e-12
"""m and m/s: float64 over a few hundred substeps."""
FRAMES = 1e-5
"""Relative to the largest entry, of gradients against central differences, as in test_gradients."""


def box(center, half_sizes, rotation=None) -> Obstacle:
    turn = np.eye(3) if rotation is None else rotation.as_matrix()
    return Obstacle(shape="box", center=center, half_sizes=half_sizes, rotation=tuple(map(tuple, turn.tolist())))


def ball(center, radius) -> Obstacle:
    return Obstacle(shape="sphere", center=center, radius=radius)


def thrown(obstacles, x, v, *, frames=1, ground=False, response=(0.5, 0.3), device="cpu", threads=False, **options):
    """States of free nodes among obstacles."""
    settings = {"frame_time": 0.4, "substeps": 400, "gravity": 9.8, "obstacles": obstacles} | options
    body = scene(len(x), ground=response, on_ground=ground, **settings)
    return warp(body, np.array(x), np.array(v), np.zeros((frames + 1, 0, 3)), device, threads=threads)


@pytest.mark.parametrize(("device", "threads"), WAYS)
def test_a_box_is_a_ground_at_its_height(device, threads):
    """Dropped beside each other with sliding: on the ground, and half a meter higher on a box."""
    x, v = np.array([[0.0, 0.0, 0.1], [0.3, 0.1, 0.2]]), np.array([[1.0, 0.3, 0.0], [0.0, -2.0, -1.0]])
    options = {"frames": 3, "device": device, "threads": threads}
    low, speed = thrown((), x, v, ground=True, **options)
    lift = np.array([0.0, 0.0, 0.5])
    high, same = thrown((box((0.0, 0.0, 0.25), (3.0, 3.0, 0.25)),), x + lift, v, **options)
    np.testing.assert_allclose(high - lift, low, atol=1e-10)
    np.testing.assert_allclose(same, speed, atol=1e-8)
    assert (low[-1, :, 2] < 0.02).all()


@pytest.mark.parametrize("friction", [0.3, 0.9])
def test_a_node_on_a_tilted_box_slides_by_the_law_of_friction(friction):
    """Without restitution: v changes by -mu |v_n| along the way, so a = g (sin - mu cos), or it comes to rest."""
    angle = np.radians(30)
    turn = Rotation.from_euler("y", angle)
    down, normal = turn.apply([1.0, 0.0, 0.0]), turn.apply([0.0, 0.0, 1.0])
    start = 0.5 * normal
    obstacle = box((0.0, 0.0, 0.0), (4.0, 1.0, 0.5), turn)
    xs, vs = thrown((obstacle,), [start], [np.zeros(3)], response=(0.0, friction))
    expected = max(9.8 * (np.sin(angle) - friction * np.cos(angle)), 0.0) * 0.4
    # Every other substep may be in the air, so by a few substeps of 1 ms.
    assert vs[-1, 0] @ down == pytest.approx(expected, abs=0.03)
    assert abs(xs[-1, 0] @ normal - 0.5) < 1e-4
    assert (xs[-1, 0] - start) @ down == pytest.approx(expected * 0.4 / 2, abs=0.01)


def test_an_elastic_smooth_obstacle_keeps_energy_and_turns_momentum_along_the_normal():
    rng = np.random.default_rng(0)
    obstacle = box((0.0, 0.0, 0.0), (0.3, 0.2, 0.1), Rotation.from_euler("xyz", [0.3, -0.5, 1.0]))
    directions = rng.normal(size=(40, 3))
    x = 0.6 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    xs, vs = thrown((obstacle,), x, -1.0 * x, response=(1.0, 0.0), gravity=0.0, frame_time=2.0, frames=1)
    np.testing.assert_allclose((vs[-1] ** 2).sum(axis=1), (x**2).sum(axis=1), atol=ROUNDING)
    assert (obstacle.depth(xs[-1]) < 1e-9).all()
    gained = (vs[-1] + x) @ np.array(obstacle.rotation)
    # Each was hit by one face: the momentum that it gained is along one of the box's axes.
    assert (np.sort(np.abs(gained), axis=1)[:, :2] < 1e-9).all()
    assert (np.abs(gained).max(axis=1) > 0.1).all()


def test_nothing_passes_beside_and_what_is_fast_does_not_pass_through():
    wall = box((0.0, 0.0, 0.0), (0.001, 0.5, 0.5))
    x, v = [[-0.1, 0.0, 0.0], [-0.1, 0.6, 0.0]], [[50.0, 0.0, 0.0], [50.0, 0.0, 0.0]]
    xs, _ = thrown((wall,), x, v, gravity=0.0, frame_time=0.01, substeps=2)
    assert xs[-1, 0, 0] < 0 < xs[-1, 1, 0]


def among_obstacles(**options):
    """A lively body that falls into a corner of the ground, a turned box and a ball."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, **options)
    low = float(x[:, 2].min())
    center = x.mean(axis=0)
    turned = box(tuple(center - [0.0, 0.0, 0.07]), (0.08, 0.05, 0.05), Rotation.from_euler("xy", [0.2, 0.3]))
    stands = ball((center[0] + 0.03, center[1], low - 0.03), 0.035)
    return replace(body, simulation=replace(body.simulation, obstacles=(turned, stands))), x, v - [0.0, 0.0, 1.0], hands


@pytest.mark.parametrize(("device", "threads"), WAYS)
@pytest.mark.parametrize("options", [{}, {"on_ground": False}, {"self_collision": True}, {"up": "-z"}])
def test_the_solver_agrees_with_the_reference(device, threads, options):
    body, x, v, hands = among_obstacles(**options)
    xs, vs = warp(body, x, v, hands, device, threads=threads)
    expected, speeds = reference.rollout(body, x, v, hands)
    np.testing.assert_allclose(xs, expected, atol=ROUNDING)
    np.testing.assert_allclose(vs, speeds, atol=1e-9)
    empty = replace(body, simulation=replace(body.simulation, obstacles=()))
    assert np.abs(reference.rollout(empty, x, v, hands)[0] - expected).max() > 1e-3


@pytest.mark.parametrize("name", ["ground_elasticity", "ground_friction", "stiffness", "x", "v"])
def test_gradients_among_obstacles(name):
    body, x, v, hands = among_obstacles()
    solver, rows = solver_for(body, hands.shape[1]), torch.tensor(hands)

    def last(values, x, v):
        parameters = pack(**values, substep=body.simulation.substep)
        for begin, end in pairwise(rows[:3]):
            x, v = simulate_frame(solver, parameters, x, v, begin, end)
        return x

    got, wanted = compared(name, body, {"x": x, "v": v}, hands[:3], last, **{name: 1e-8})
    assert np.abs(wanted[name]).max() > 0
    assert_gradients(got, wanted, FRAMES)


def test_rollouts_lanes_and_files_carry_obstacles(tmp_path):
    body, x, v, hands = among_obstacles()
    twin = twin_of(body, x, hands[0])
    twin.save(tmp_path / "twin.npz")
    loaded = Twin.load(tmp_path / "twin.npz")
    assert loaded.simulation == twin.simulation
    alone = roll_out(loaded, hands, velocity=v).positions
    judged, _ = motions([twin, loaded], torch.tensor(hands, dtype=torch.float32), torch.tensor(v, dtype=torch.float32), "cpu")
    for lane in range(2):
        np.testing.assert_array_equal(judged[:, lane].numpy(), alone[1:])
    replace(twin, simulation=replace(twin.simulation, obstacles=())).save(tmp_path / "bare.npz")
    with np.load(tmp_path / "bare.npz") as file:
        assert "obstacles" not in str(file["meta"])
    assert Twin.load(tmp_path / "bare.npz").simulation.obstacles == ()


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (box((0, 0, 0), (0.1, 0.0, 0.1)), "half_sizes: three positive"),
        (replace(box((0, 0, 0), (1, 1, 1)), rotation=((1, 0, 0), (0, 2, 0), (0, 0, 1))), "rotation: must be a rotation"),
        (replace(box((0, 0, 0), (1, 1, 1)), rotation=((1, 0, 0), (0, 1, 0), (0, 0, -1))), "rotation: must be a rotation"),
        (ball((0, 0, 0), -1.0), "radius: a positive radius"),
        (ball((0, np.nan, 0), 1.0), "center: three finite"),
        (replace(ball((0, 0, 0), 1.0), shape="cone"), "shape: must be"),
    ],
)
def test_a_bad_obstacle_is_named(obstacle, message):
    with pytest.raises(InputError, match=rf"simulation.obstacles\[0\].{message}"):
        Simulation(frame_time=0.1, substeps=1, obstacles=(obstacle,))
