"""Rough or smooth: closed forms of white noise, of a slope, and of two halves."""

import numpy as np
import pytest

from neuspring.twin.roughness import roughness, variogram

GRID = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * 0.01
EDGES = np.array([0.005, 0.015, 0.035, 0.055])


def test_white_noise_is_as_rough_near_as_far():
    noise = np.random.default_rng(0).standard_normal(len(GRID))
    assert roughness(GRID, noise) == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(variogram(GRID, noise, EDGES), 1, atol=0.05)


def test_a_slope_is_smooth_and_its_variogram_a_parabola():
    """(z_e - z_n)^2 = g^2 dx^2, and the variance of 0, 1, ..., 11 steps is 143 / 12."""
    slope = 3.0 + 40 * GRID[:, 0]
    # Neighbors along one axis in three: of the six nearest two are a step off, of the two further ones some are.
    assert 0.01 < roughness(GRID, slope) < 0.05
    steps = variogram(GRID[:12] @ np.eye(3)[[2, 1, 0]], 40 * GRID[:12, 2], np.array([0.005, 0.015, 0.025]))
    np.testing.assert_allclose(steps, np.array([1, 4]) / 2 / (143 / 12), rtol=1e-6)


def test_scale_and_shift_change_nothing():
    noise = np.random.default_rng(1).standard_normal(len(GRID))
    assert roughness(GRID, 5 + 3 * noise) == pytest.approx(roughness(GRID, noise))
    np.testing.assert_allclose(variogram(GRID, 5 + 3 * noise, EDGES), variogram(GRID, noise, EDGES))


def test_midpoints_that_coincide_are_compared_with_each_other():
    """Ten springs through each place, alike there: nothing differs between nearest springs."""
    places = np.repeat(GRID[:50], 10, axis=0)
    assert roughness(places, np.repeat(np.random.default_rng(2).standard_normal(50), 10)) == 0


def test_what_has_no_variance_or_one_spring_has_no_roughness():
    assert np.isnan(roughness(GRID, np.ones(len(GRID))))
    assert np.isnan(roughness(GRID[:1], np.ones(1)))


def test_many_springs_are_sampled_and_the_sample_says_the_same():
    points = np.random.default_rng(3).random((1500, 3)) * 0.1
    values = np.sin(40 * points[:, 0])
    edges = np.linspace(0.01, 0.06, 6)
    first, second = np.triu_indices(len(points), 1)
    place = np.digitize(np.linalg.norm(points[first] - points[second], axis=1), edges) - 1
    square = (values[first] - values[second]) ** 2 / 2 / values.var()
    whole = [square[place == b].mean() for b in range(5)]
    np.testing.assert_allclose(variogram(points, values, edges), whole, rtol=0.1)
