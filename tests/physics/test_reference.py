"""The Warp solver against its specification, `neuspring.physics.reference`, on random scenes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from neuspring.physics import reference
from tests.support.scenes import WAYS, no_hands, random_scene, scene, warp

# Two float64 programs of the same equations differ by rounding (1e-16 of 0.1 m and 1 m/s), amplified along 60 substeps of
# stiff springs and bounces by less than 1e5; a decision that flips would show as 1e-6 or more.
SAME = 1e-9
# Float32 rounds positions of 0.1 m to 1e-8 m, and dt * force to 1e-8 m/s, in each of the 20 substeps of a frame.
SINGLE = 2e-5
VARIANTS: dict[str, dict[str, Any]] = {
    "free": {"on_ground": False},
    "ground": {},
    "upside down": {"up": "-z"},
    "self-collision": {"self_collision": True},
    "moving hands": {"controller_velocity": True},
    "all": {"up": "-z", "self_collision": True, "controller_velocity": True},
    "masses": {"mass": np.linspace(0.2, 1.8, 10), "self_collision": True},
    "odd substeps": {"substeps": 21},
    "one substep": {"substeps": 1, "frame_time": 1e-3},
}


@pytest.mark.parametrize(("device", "threads"), WAYS)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("variant", VARIANTS)
def test_solver_equals_reference(variant: str, seed: int, device: str, threads: bool) -> None:
    body = random_scene(seed, **VARIANTS[variant])
    expected = reference.rollout(*body)
    for differentiable in (False, True):
        for got, wanted in zip(warp(*body, device, differentiable=differentiable, threads=threads), expected, strict=True):
            np.testing.assert_allclose(got, wanted, atol=SAME, rtol=0)


def test_the_random_scenes_do_touch_the_ground_and_themselves() -> None:
    """Otherwise the comparison above would prove less than it says."""
    for seed in range(3):
        body = random_scene(seed, self_collision=True)
        apart = random_scene(seed, self_collision=False)
        flying = random_scene(seed, self_collision=True, on_ground=False)
        x = reference.rollout(*body)[0]
        assert np.abs(x - reference.rollout(*apart)[0]).max() > 1e-4
        assert np.abs(x - reference.rollout(*flying)[0]).max() > 1e-4


@pytest.mark.parametrize("variant", ["ground", "all", "masses"])
def test_node_order_does_not_matter(variant: str) -> None:
    """Renaming nodes renames the result: nothing depends on the order of storage."""
    body, x, v, hands = random_scene(3, **VARIANTS[variant])
    order = np.random.default_rng(0).permutation(body.nodes)
    renamed = np.concatenate([np.argsort(order), body.nodes + np.arange(hands.shape[1])])
    mass = np.broadcast_to(body.mass, body.nodes)[order]
    shuffled = replace(body, springs=renamed[body.springs], mass=mass)
    plain, moved = warp(body, x, v, hands)[0], warp(shuffled, x[order], v[order], hands)[0]
    np.testing.assert_allclose(moved, plain[:, order], atol=SAME, rtol=0)


def test_upside_down_is_a_mirror_image() -> None:
    """z -> -z with `up` reversed gives the mirrored motion, exactly: negation does not round."""
    body, x, v, hands = random_scene(4, self_collision=True)
    below = replace(body, simulation=replace(body.simulation, up="-z"))
    flip = np.array([1.0, 1.0, -1.0])
    for engine in (reference.rollout, warp):
        for up, down in zip(engine(body, x, v, hands), engine(below, x * flip, v * flip, hands * flip), strict=True):
            np.testing.assert_array_equal(up * flip, down)


def test_a_scene_without_springs_or_hands() -> None:
    falling = scene(3, gravity=9.8, on_ground=True, substeps=10, frame_time=0.1)
    x = np.array([[0.0, 0, 0.01], [0, 0, 0.2], [0, 0, 5.0]])
    for got, wanted in zip(warp(falling, x, 0 * x, no_hands(3)), reference.rollout(falling, x, 0 * x, no_hands(3)), strict=True):
        np.testing.assert_allclose(got, wanted, atol=SAME, rtol=0)
