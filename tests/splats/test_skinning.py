"""Skinning against golden rollouts (`tests/golden/l*.npz`), rigid motions and degenerate neighborhoods.

Tolerances of the golden data in single precision: 5e-6 m and 2e-5 per component of a quaternion; neighbors equal as sets.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.splats.draw import skinned_frames
from neuspring.splats.model import Splats
from neuspring.splats.skinning import Skin
from neuspring.splats.view import harmonic_colors, turned_harmonics
from tests.support.devices import DEVICES

FOLDER = Path(__file__).parents[1] / "golden"
CASES = sorted(path.stem for path in FOLDER.glob("l*.npz"))
METERS, COMPONENTS = 5e-6, 2e-5


def as_tensor(values, device="cpu"):
    return torch.tensor(np.asarray(values, np.float32), device=device)


def unturned(count):
    return as_tensor(np.tile([1.0, 0, 0, 0], (count, 1)))


def same_sign(result, expected):
    return result * np.sign((result * expected).sum(-1, keepdims=True))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("frozen", [False, True], ids=["rebound", "frozen"])
@pytest.mark.parametrize("case", CASES)
def test_rollouts_are_the_golden_ones(case, frozen, device):
    with np.load(FOLDER / f"{case}.npz") as golden:
        skin = Skin(golden["points"][0], device=device, frozen=frozen)
        ending = "_frozen" if frozen else ""
        expected = zip(golden[f"exp_means{ending}"], golden[f"exp_quats{ending}"], strict=True)
        start = (as_tensor(golden[name], device) for name in ("means0", "quats0"))
        for (means, quaternions), (places, turns) in zip(skin.carry(golden["points"], *start), expected, strict=True):
            assert np.abs(means.cpu().numpy() - places).max() <= METERS
            assert np.abs(same_sign(quaternions.cpu().numpy(), turns) - turns).max() <= COMPONENTS


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 60))
def test_nearest_nodes_are_those_of_a_tree(seed, count):
    rng = np.random.default_rng(seed)
    # Clumps and strays: the search radius must grow for some and not for others.
    points = rng.normal(size=(count, 3)) * rng.choice([0.01, 1.0], (count, 1))
    queries = rng.normal(size=(40, 3)) * rng.choice([0.01, 5.0], (40, 1))
    wanted = min(16, count)
    skin = Skin(points)
    result = skin._nearest(skin._vectors(points), skin._vectors(queries), own=False, wanted=wanted).numpy()
    points, queries = points.astype(np.float32), queries.astype(np.float32)
    distances = np.linalg.norm(points[result] - queries[:, None], axis=2)
    assert np.allclose(distances, cKDTree(points).query(queries, k=list(range(1, wanted + 1)))[0], atol=1e-5)
    assert all(len(set(row)) == wanted for row in result.tolist())


def rope(count=40):
    """Nodes on one line: every neighborhood is degenerate."""
    return np.stack([np.linspace(0, 0.4, count), np.zeros(count), np.zeros(count)], axis=1)


def test_nodes_on_a_line_turn_by_the_least_angle():
    nodes, quarter = rope(), Rotation.from_euler("z", 90, degrees=True)
    beside = nodes[10:30] + np.array([0, 0.004, 0])
    moved, turned = Skin(nodes).step(nodes, quarter.apply(nodes), as_tensor(beside), unturned(20))
    assert np.abs(moved.numpy() - quarter.apply(beside)).max() < METERS
    assert np.abs(turned.numpy() - quarter.as_quat(scalar_first=True)).max() < COMPONENTS


def test_a_line_turned_round_stays_finite_and_rigid():
    nodes = rope()
    moved, _ = Skin(nodes).step(nodes, -nodes, as_tensor(nodes + np.array([0, 0.004, 0])), unturned(40))
    # Off the line the half turn may go any way round, but to the same distance.
    assert np.abs(np.linalg.norm(moved.numpy() + nodes, axis=1) - 0.004).max() < METERS


def test_a_degenerate_neighborhood_stays_local():
    """A solid body turns; far from it 17 nodes on a line turn otherwise."""
    body, strand = np.random.default_rng(0).uniform(-0.05, 0.05, (100, 3)), rope(17) * 0.2 + [2.0, 0, 0]
    turn = Rotation.from_euler("x", 40, degrees=True)
    nodes = np.concatenate([body, strand])
    after = np.concatenate([turn.apply(body), Rotation.from_euler("z", 30, degrees=True).apply(strand)])
    _, turned = Skin(nodes).step(nodes, after, as_tensor(body), unturned(100))
    assert np.abs(turned.numpy() - turn.as_quat(scalar_first=True)).max() < COMPONENTS


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_handful_of_nodes_carries_splats_too(count):
    nodes = np.random.default_rng(0).uniform(-0.1, 0.1, (count, 3))
    moved, turned = Skin(nodes).step(nodes, nodes + np.array([0.1, 0, 0]), as_tensor(nodes), unturned(count))
    assert np.abs(moved.numpy() - nodes - [0.1, 0, 0]).max() < METERS
    assert np.abs(turned.numpy() - [1, 0, 0, 0]).max() < COMPONENTS
    with pytest.raises(InputError, match=r"nodes.*finite"):
        Skin(np.full((count, 3), np.nan))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), degree=st.integers(0, 3))
def test_turned_splats_show_the_colors_of_directions_turned_back(seed, degree):
    rng, count = np.random.default_rng(seed), 30
    turns, directions = Rotation.random(count, random_state=seed), as_tensor(rng.normal(size=(count, 3)))
    coefficients = as_tensor(rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.05)
    turned = turned_harmonics(coefficients, as_tensor(turns.as_matrix()))
    expected = harmonic_colors(coefficients, as_tensor(turns.inv().apply(directions)), degree)
    assert expected.min() > 0 and np.abs(harmonic_colors(turned, directions, degree) - expected).max() < 2e-6
    assert torch.equal(turned[:, 0], coefficients[:, 0])


def test_colors_turn_with_the_body():
    """Red from +x; a quarter turn about z takes that side to +y. Half red is what the base color has from all sides."""
    nodes, angles = np.random.default_rng(0).uniform(0, 0.1, (60, 3)).astype(np.float32), np.linspace(0, 90, 7)
    film = np.array([Rotation.from_euler("z", angle, degrees=True).apply(nodes) for angle in angles], np.float32)
    red = np.zeros((4, 16, 3), np.float32)
    red[:, 3, 0] = -1.0
    turns = Rotation.random(4, random_state=1).as_quat(scalar_first=True)
    logits = {"log_scales": np.full((4, 1), -4), "opacity_logits": np.full(4, 3)}
    splats = Splats(means=nodes[:4], quaternions=3 * turns, harmonics=red, **logits)

    def seen(frame, direction):
        gaussians = list(skinned_frames(splats, film, "cpu"))[frame]
        return harmonic_colors(gaussians.harmonics, as_tensor([direction] * 4), 3)[:, 0].numpy()

    side = 0.5 + np.sqrt(3 / (4 * np.pi))
    for frame, along_x, along_y in ((0, side, 0.5), (6, 0.5, side)):
        assert np.allclose(seen(frame, [1, 0, 0]), along_x, atol=1e-5)
        assert np.allclose(seen(frame, [0, 1, 0]), along_y, atol=1e-5)
