"""Rough or smooth: closed forms of white noise, of a slope, and of two halves."""

import numpy as np
import pytest

from neuspring.twin.roughness import roughness

GRID = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * 0.01


def test_white_noise_is_rough():
    noise = np.random.default_rng(0).standard_normal(len(GRID))
    assert roughness(GRID, noise) == pytest.approx(1, abs=0.05)


def test_a_slope_is_smooth():
    # Neighbors along one axis in three: of the six nearest two are a step off, of the two further ones some are.
    assert 0.01 < roughness(GRID, 3.0 + 40 * GRID[:, 0]) < 0.05


def test_scale_and_shift_change_nothing():
    noise = np.random.default_rng(1).standard_normal(len(GRID))
    assert roughness(GRID, 5 + 3 * noise) == pytest.approx(roughness(GRID, noise))


def test_midpoints_that_coincide_are_compared_with_each_other():
    """Ten springs through each place, alike there: nothing differs between nearest springs."""
    places = np.repeat(GRID[:50], 10, axis=0)
    assert roughness(places, np.repeat(np.random.default_rng(2).standard_normal(50), 10)) == 0


def test_what_has_no_variance_or_one_spring_has_no_roughness():
    assert np.isnan(roughness(GRID, np.ones(len(GRID))))
    assert np.isnan(roughness(GRID[:1], np.ones(1)))
