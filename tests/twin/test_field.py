"""The neural spring field: zero at the start, as large as the paper says, and the same function as its dense definition."""

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample

from neuspring import config
from neuspring.twin.field import PLANE_AXES, SpringField, TriPlane, bilinear, fourier, in_cube

EXACT = 1e-12
"""Absolute, for values of order 1 in float64: the same sums in another order."""
STEPS = 1e-8
"""Absolute, for weights of order 1 after optimizer steps in float64: Adam divides by gradients, which magnifies rounding."""


def points(count: int = 30, seed: int = 0) -> np.ndarray:
    """Midpoints of a body of 0.3 x 0.1 x 0.2 m, away from the origin."""
    return np.random.default_rng(seed).uniform(0, 1, (count, 3)) * [0.3, 0.1, 0.2] + [5, -3, 1]


def field_of(at: np.ndarray | None = None, outputs: int = 2, seed: int = 0, **settings) -> SpringField:
    """A small field in float64."""
    return SpringField(points() if at is None else at, config.SpringFieldSettings(**settings), outputs, seed).double()


def train(field: SpringField, target: torch.Tensor, steps: int = 5):
    """A few steps towards `target` [S, outputs]."""
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-2)
    for _ in range(steps):
        optimizer.zero_grad()
        (field() - target).square().mean().backward()
        optimizer.step()


# The start ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, {"triplane": False}, {"resolution": 256}])
def test_the_field_is_zero_at_the_start_and_can_leave_it(settings):
    field = field_of(**settings)
    assert not field().any()
    train(field, torch.ones(30, 2))
    assert field().abs().min() > 0


def test_weights_follow_the_seed_alone():
    torch.manual_seed(1)
    first = field_of(seed=3).state_dict()
    torch.manual_seed(2)
    again, other = field_of(seed=3).state_dict(), field_of(seed=4).state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["planes.texels"], other["planes.texels"])
    assert not torch.equal(first["layers.0.weight"], other["layers.0.weight"])


# Size -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("springs", "resolution"), [(1, 2), (9, 3), (50, 6), (1062, 28), (4000, 54), (20000, 120)])
def test_the_adaptive_resolution_follows_the_number_of_springs(springs, resolution):
    """N = round(0.85 sqrt(|E|)), and two texels at least."""
    assert field_of(points(springs)).resolution == max(2, math.floor(0.85 * math.sqrt(springs) + 0.5)) == resolution


def test_the_fourier_transform_by_hand():
    u = torch.tensor([[0.25, -0.5]])
    pi = math.pi
    angles = [0.25 * pi, 0.5 * pi, 1.0 * pi, -0.5 * pi, -1.0 * pi, -2.0 * pi]
    expected = torch.tensor([[*map(math.sin, angles), *map(math.cos, angles)]])
    torch.testing.assert_close(fourier(u, 3), expected)


# Where springs are ----------------------------------------------------------------------------------------------------


def test_the_bounding_cube_has_the_longest_side_and_one_scale_for_all_axes():
    corners = np.array([[0.0, 0, 0], [4, 1, 2], [1, 0.5, 0]])
    np.testing.assert_allclose(in_cube(corners), [[-1, -0.25, -0.5], [1, 0.25, 0.5], [-0.5, 0, -0.5]], atol=EXACT)
    assert not in_cube(np.ones((3, 3))).any(), "a single place is the center"


@pytest.mark.parametrize("factor", [1000.0, 39.37])
def test_units_and_place_do_not_matter(factor):
    """Midpoints in meters, millimeters or inches, here or elsewhere: the same coordinates, texels and features."""
    meters, other = field_of(), field_of(points() * factor + 7)
    torch.testing.assert_close(other.coordinates, meters.coordinates)
    assert torch.equal(other.planes.indices, meters.planes.indices)
    # Coordinates pass through float32 when the field is made.
    torch.testing.assert_close(other.encoded(), meters.encoded(), rtol=0, atol=1e-5)


def test_permuting_springs_permutes_the_field_and_changes_nothing_else():
    order = np.random.default_rng(1).permutation(30)
    target = torch.from_numpy(np.random.default_rng(2).normal(size=(30, 2)))
    first, second = field_of(), field_of(points()[order])
    train(first, target)
    train(second, target[order])
    assert first().std() > 1e-3
    torch.testing.assert_close(second(), first()[order], rtol=0, atol=STEPS)
    for (name, a), b in zip(first.named_parameters(), second.parameters(), strict=True):
        torch.testing.assert_close(b, a, rtol=0, atol=STEPS, msg=name)


def test_a_shuffled_field_is_the_field_of_midpoints_that_are_dealt_out_anew():
    shuffled, other, plain = (
        field_of(seed=seed, shuffled=shuffled).coordinates.numpy() for seed, shuffled in ((2, True), (3, True), (2, False))
    )
    assert not np.array_equal(shuffled, plain)
    assert not np.array_equal(shuffled, other)
    rows = {tuple(row) for row in plain}
    assert {tuple(row) for row in shuffled} == rows == {tuple(row) for row in other}


# Planes ---------------------------------------------------------------------------------------------------------------


def dense(at: np.ndarray, resolution: int, channels: int, scale: float) -> tuple[TriPlane, torch.Tensor]:
    """Planes that keep only the texels in use, and the full planes [3, C, N, N] of which they are a part, in float64."""
    planes = TriPlane(at, resolution, channels, scale, torch.Generator().manual_seed(5)).double()
    full = scale * torch.randn(3 * resolution**2, channels, generator=torch.Generator().manual_seed(5))
    return planes, full.double().reshape(3, resolution, resolution, channels).permute(0, 3, 1, 2).contiguous()


def sample(full: torch.Tensor, at: np.ndarray) -> torch.Tensor:
    """Summed features [S, C] of full planes [3, C, N, N], by torch's own bilinear interpolation."""
    grid = torch.stack([torch.from_numpy(at[:, list(axes)]) for axes in PLANE_AXES])[:, None]
    return grid_sample(full, grid, mode="bilinear", align_corners=True)[:, :, 0].sum(dim=0).T


def scattered(count: int = 40) -> np.ndarray:
    """Points of the cube [-1, 1]^3, some of them on its sides and corners."""
    at = np.random.default_rng(3).uniform(-1, 1, (count, 3))
    at[:3], at[3, 0], at[4, 1:], at[5] = [[-1, -1, -1], [1, 1, 1], [1, -1, 1]], 1.0, -1.0, 0.0
    return at


@pytest.mark.parametrize("resolution", [2, 3, 16])
def test_the_lookup_equals_grid_sample_on_the_full_planes(resolution):
    at = scattered()
    planes, full = dense(at, resolution, 4, 1.0)
    # The interpolation weights are kept in float32.
    weights = torch.from_numpy(bilinear(at, resolution)[1])
    torch.testing.assert_close(planes.weights, weights.float().double(), rtol=0, atol=0)
    planes.weights = weights
    torch.testing.assert_close(planes(), sample(full, at), rtol=0, atol=EXACT)
