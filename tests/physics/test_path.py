"""The controllers' way within a frame against closed forms, and that a solver refuses the other kind."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from neuspring.core.artifacts import Simulation
from neuspring.core.errors import InputError
from neuspring.physics.path import tangents, waypoints
from tests.support.scenes import WAYS, random_scene, scene, solver_for, warp

FRAMES, SUBSTEPS, FRAME_TIME = 6, 7, 0.04
# A few operations in float64 on values of order 1.
ROUNDING = 1e-13


def way(hands: np.ndarray, device: str = "cpu", threads: bool = False, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities [T - 1, n, C, 3] of controllers in every substep of every frame; none moves a node."""
    options = {"substeps": SUBSTEPS, "frame_time": FRAME_TIME, "controller_path": "cubic", "controller_velocity": True} | options
    solver = solver_for(scene(1, **options), hands.shape[1], device, threads=threads)
    points = waypoints(torch.tensor(hands, device=device), solver.simulation)
    states, node = [], torch.zeros(1, 3, dtype=torch.float64, device=device)
    for begin, end in pairwise(points):
        solver.forward(node, node, begin, end)
        every = [[solver.buffers.get_vectors(name, k)[0, 1:] for k in range(SUBSTEPS)] for name in ("x", "v")]
        states.append([torch.stack(each).cpu().numpy() for each in every])
    return np.array([x for x, _ in states]), np.array([v for _, v in states])


def times() -> np.ndarray:
    """Time, in frames, at the end of each substep [T - 1, n]."""
    return np.arange(FRAMES)[:, None] + (np.arange(SUBSTEPS) + 1) / SUBSTEPS


def curve(t: np.ndarray, degree: int) -> np.ndarray:
    """A polynomial motion of two controllers at times t [...], in frames: [..., 2, 3]."""
    factors = np.random.default_rng(degree).uniform(-0.1, 0.1, (degree + 1, 2, 3))
    return sum(np.asarray(t)[..., None, None] ** power * factors[power] for power in range(degree + 1))


def speed(t: np.ndarray, degree: int) -> np.ndarray:
    """Its derivative by time, m/s."""
    factors = np.random.default_rng(degree).uniform(-0.1, 0.1, (degree + 1, 2, 3))
    return (
        sum(power * np.asarray(t)[..., None, None] ** (power - 1) * factors[power] for power in range(1, degree + 1)) / FRAME_TIME
    )


@pytest.mark.parametrize(("device", "threads"), WAYS)
@pytest.mark.parametrize("degree", [1, 2])
def test_a_parabola_is_followed_exactly(degree: int, device: str, threads: bool) -> None:
    """In place and velocity, in the first and the last frame too; so is uniform motion."""
    x, v = way(curve(np.arange(FRAMES + 1.0), degree), device, threads)
    np.testing.assert_allclose(x, curve(times(), degree), atol=ROUNDING * 10, rtol=0)
    np.testing.assert_allclose(v, speed(times(), degree), atol=ROUNDING * 1000, rtol=0)


def test_a_cubic_is_followed_to_fourth_order_of_the_bend() -> None:
    """Inside, the error of t^3 is that of its tangents: h^3 per frame, at most 2 u (1 - u) |1 - 2 u| / 2 of its factor."""
    x, _ = way(curve(np.arange(FRAMES + 1.0), 3))
    factor = np.random.default_rng(3).uniform(-0.1, 0.1, (4, 2, 3))[3]
    u = ((np.arange(SUBSTEPS) + 1) / SUBSTEPS)[:, None, None]
    # Tangents at both ends are too large by the factor: u (1 - u)^2 - u^2 (1 - u) of it.
    np.testing.assert_allclose((x - curve(times(), 3))[1:-1], np.broadcast_to(u * (1 - u) * (1 - 2 * u) * factor, x[1:-1].shape),
                               atol=ROUNDING * 100, rtol=0)  # fmt: skip


def test_places_at_frame_ends_are_the_given_ones() -> None:
    """And tangents are the same from both sides, so that the velocity has no steps there."""
    hands = np.random.default_rng(0).uniform(-1, 1, (FRAMES + 1, 2, 3))
    x, v = way(hands)
    np.testing.assert_allclose(x[:, -1], hands[1:], atol=ROUNDING, rtol=0)
    np.testing.assert_allclose(v[:, -1] * FRAME_TIME, tangents(torch.tensor(hands))[1:].numpy(), atol=ROUNDING, rtol=0)


def test_controllers_have_no_velocity_where_that_is_off() -> None:
    assert not way(curve(np.arange(FRAMES + 1.0), 2), controller_velocity=False)[1].any()


@pytest.mark.parametrize("frames", [1, 2])
def test_too_few_frames_for_a_bend_are_a_line(frames: int) -> None:
    hands = torch.tensor(np.random.default_rng(0).uniform(-1, 1, (frames, 2, 3)))
    assert torch.equal(tangents(hands), (hands[-1] - hands[0]).expand_as(hands))


def test_the_cubic_of_uniform_motion_moves_a_body_as_the_line_does() -> None:
    body, x, v, hands = random_scene(2, controller_velocity=True)
    steady = hands[0] + np.arange(4)[:, None, None] * (hands[1] - hands[0])
    cubic = replace(body, simulation=replace(body.simulation, controller_path="cubic"))
    for line, bent in zip(warp(body, x, v, steady), warp(cubic, x, v, steady), strict=True):
        np.testing.assert_allclose(bent, line, atol=1e-9, rtol=0)
    assert np.abs(warp(body, x, v, hands)[0] - warp(cubic, x, v, hands)[0]).max() > 1e-4


@pytest.mark.parametrize("path", ["linear", "cubic"])
def test_a_solver_refuses_the_other_kind_of_path(path: str) -> None:
    body, x, v, hands = random_scene(2, controller_path=path)
    wrong = waypoints(torch.tensor(hands), replace(body.simulation, controller_path={"linear": "cubic", "cubic": "linear"}[path]))
    with pytest.raises(InputError, match=rf"{3 if path == 'linear' else 6} numbers per controller.*controller_path: {path}"):
        solver_for(body, 2).forward(torch.tensor(x), torch.tensor(v), wrong[0], wrong[1])


def test_an_unknown_path_is_refused() -> None:
    with pytest.raises(InputError, match=r"simulation\.controller_path: must be 'linear' or 'cubic'; received 'arc'"):
        Simulation(frame_time=0.1, substeps=1, controller_path="arc")  # type: ignore[arg-type]
