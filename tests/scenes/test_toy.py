"""Toy scenes: truth is kept apart, observations have the requested noise, everything is deterministic."""

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.scenes import toy
from tests.support import small

SCENES = [f"{shape}/{motion}/{field}" for shape in toy.SHAPES for motion in toy.MOTIONS for field in toy.FIELDS]


@pytest.mark.parametrize("path", SCENES)
def test_every_scene_is_a_valid_capture_with_its_truth(path):
    scene = small.scene(path, frames=5)
    nodes = scene.observations.nodes
    assert nodes.shape == scene.truth.topology.nodes.shape
    # Without noise the observed rest state is the true one.
    np.testing.assert_array_equal(nodes, scene.truth.topology.nodes)
    assert np.ptp(np.log2(scene.truth.material.stiffness)) == pytest.approx(2.0, abs=0.02)
    # Every node hangs on a spring, and the hands hold the body.
    assert set(range(len(nodes))) <= set(scene.truth.topology.springs.ravel().tolist())
    assert scene.truth.topology.object_spring_count < len(scene.truth.topology.springs)


def test_the_same_seed_gives_the_same_capture_and_another_seed_does_not():
    settings = toy.ToyObservation(frames=5, seed=3)
    first, second = (toy.make(small.row(), settings).observations for _ in range(2))
    other = toy.make(small.row(), toy.ToyObservation(frames=5, seed=4)).observations
    np.testing.assert_array_equal(first.object_points, second.object_points)
    assert not np.array_equal(first.object_points, other.object_points)


def test_noise_and_occlusion_are_as_configured():
    scene = small.scene(noise=0.002, occlusion=0.3, frames=20)
    visible = scene.observations.object_visibility
    assert visible[0].all()
    assert 0.3 <= 1 - visible.mean() < 0.6  # runs of 3 to 7 frames overshoot the fraction, never undershoot
    assert (scene.observations.object_points[~visible] == 0).all()
    error = (scene.observations.object_points - scene.motion[:, : visible.shape[1]])[visible]
    assert error.std() == pytest.approx(0.002, rel=0.1)
    valid = scene.observations.object_motion_valid
    np.testing.assert_array_equal(valid[:-1], visible[:-1] & visible[1:])
    assert not valid[-1].any()


def test_an_unknown_scene_is_an_error_that_lists_the_choices():
    with pytest.raises(InputError, match=r"path: must be shape/motion/field with .*'rope'"):
        toy.make(small.row("rope/fly/smooth"), toy.ToyObservation())
