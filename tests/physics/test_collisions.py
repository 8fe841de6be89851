"""Collision lists of fixed capacity report what does not fit; diverging rollouts are named results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring.core.artifacts import Topology, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.physics import reference
from neuspring.twin import rollout
from tests.support.scenes import DEVICES, no_hands, random_scene, scene, solver_for, twin_of

DISTANCE = 0.02


def clump(crowded: int, pairs: int) -> np.ndarray:
    """`crowded` nodes all within DISTANCE of each other, and `pairs` far pairs of near nodes, shuffled.

    A lonely node follows each of them: its empty list lies right behind theirs, where an overrun would show.
    """
    rng = np.random.default_rng(1)
    near = rng.uniform(-0.004, 0.004, (crowded, 3))
    far = np.repeat(np.arange(1, pairs + 1)[:, None] * [1.0, 0, 0], 2, axis=0) + rng.uniform(-0.004, 0.004, (2 * pairs, 3))
    others = rng.permutation(np.concatenate([near, far]))
    lonely = np.arange(1, len(others) + 1)[:, None] * [0, 1.0, 0]
    return np.stack([others, lonely], axis=1).reshape(-1, 3)


def lists(x: np.ndarray, capacity: int, frames: int = 1, device: str = "cpu") -> tuple[list[list[int]], int]:
    """Partner lists after `frames` frames that do not move anything, and the overflow reported."""
    body = scene(len(x), self_collision=True, contact_distance=DISTANCE, collision_capacity=capacity)
    solver = solver_for(body, 0, device)
    state, nobody = torch.tensor(x, device=device), torch.zeros(0, 3, dtype=torch.float64, device=device)
    tables = solver.buffers.indices
    tables["near"].fill_(-1)
    for _ in range(frames):
        after, _ = solver.forward(state, 0 * state, nobody, nobody)
        np.testing.assert_array_equal(after.cpu().numpy(), x)
    # One twin: one group, whose only lane every partner is listed for.
    partners, lanes, count = (tables[name][..., 0].cpu().numpy() for name in ("near", "near_lanes", "near_count"))
    assert partners.shape == (len(x), min(capacity, len(x)))
    assert (count <= capacity).all()
    # Slots behind a list stay untouched, also the first slot of the empty list behind a full one.
    beyond = np.arange(partners.shape[1]) >= count[:, None]
    assert (partners[beyond] == -1).all()
    assert (lanes[~beyond] == 1).all()
    return [row[:n].tolist() for row, n in zip(partners, count, strict=True)], solver.collision_overflow


def expected_lists(x: np.ndarray) -> list[list[int]]:
    pairs = reference.candidates(x, DISTANCE)
    return [pairs[pairs[:, 0] == i, 1].tolist() for i in range(len(x))]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("capacity", [1, 2, 5, 500])
def test_full_lists_are_reported_and_never_overrun(capacity: int, device: str) -> None:
    """Every list holds the first `capacity` partners in node order, whatever its neighbors' lists hold."""
    x = clump(7, 4)
    partners, overflow = lists(x, capacity, device=device)
    wanted = expected_lists(x)
    assert sorted(len(row) for row in wanted) == [0] * 15 + [1] * 8 + [6] * 7
    assert partners == [row[:capacity] for row in wanted]
    assert overflow == 7 * max(6 - capacity, 0)


def test_overflow_adds_up_over_frames() -> None:
    assert lists(clump(7, 4), 2, frames=3)[1] == 3 * 7 * 4


def test_a_full_list_still_collides_with_its_partners() -> None:
    """Nodes whose lists are complete move as with room to spare; the others stay finite."""
    x = clump(7, 4)
    # Towards the middle of each group: all pairs approach.
    v = 100 * (x.round() - x)
    states = []
    for capacity in (1, 500):
        body = scene(len(x), self_collision=True, contact_distance=DISTANCE, collision_capacity=capacity)
        solver = solver_for(body, 0)
        nobody = torch.zeros(0, 3, dtype=torch.float64)
        states.append(solver.forward(torch.tensor(x), torch.tensor(v), nobody, nobody)[1].numpy())
    complete = np.array([len(row) == 1 for row in expected_lists(x)])
    np.testing.assert_array_equal(states[0][complete], states[1][complete])
    assert (states[1][complete] != v[complete]).any()
    assert np.isfinite(states[0]).all()


def test_candidates_come_from_the_frame_start() -> None:
    """Pairs that come near within a frame are found in the next one (as released)."""
    body = scene(2, self_collision=True, contact_distance=DISTANCE, substeps=10, frame_time=0.01)
    x, v = np.array([[0.0, 0, 0], [0.021, 0, 0]]), np.array([[0.5, 0, 0], [-0.5, 0, 0]])
    for engine_frames in (1, 2):
        _, speed = reference.rollout(body, x, v, no_hands(engine_frames))
        assert (speed[-1, 0, 0] < 0) == (engine_frames == 2)
        solver = solver_for(body, 0)
        state, nobody = (torch.tensor(x), torch.tensor(v)), torch.zeros(0, 3, dtype=torch.float64)
        for _ in range(engine_frames):
            state = solver.forward(*state, nobody, nobody)
        np.testing.assert_allclose(state[1], speed[-1], atol=1e-14)


# Rollouts -------------------------------------------------------------------------------------------------------------


def crowded_twin(capacity: int) -> Twin:
    body, x, _, hands = random_scene(41, nodes=12, self_collision=True, collision_capacity=capacity)
    return twin_of(body, x, hands[0])


def test_a_rollout_reports_overflow() -> None:
    hands = random_scene(41, nodes=12, self_collision=True)[3]
    roomy = rollout.roll_out(crowded_twin(500), hands)
    tight = rollout.roll_out(crowded_twin(1), hands)
    assert roomy.collision_overflow == 0
    first = [len(row) for row in np.split(reference.candidates(roomy.positions[0], 0.035)[:, 0], 1)]
    assert first[0] > 12
    assert tight.collision_overflow >= first[0] - 12
    assert np.isfinite(tight.positions).all()


def thrown(frames: int, when: int, speed: float) -> tuple[Twin, np.ndarray]:
    """A held node whose controller leaves the scene at frame `when`."""
    body = scene(1, [(1, 0)], [0.1], stiffness=50.0, substeps=100, frame_time=0.1)
    hands = np.tile([[[0.1, 0.0, 0.0]]], (frames, 1, 1)).astype(np.float32)
    hands[when:, 0, 0] = speed
    return twin_of(body, np.zeros((1, 3)), hands[0]), hands


def test_a_diverged_rollout_is_a_named_result() -> None:
    """It keeps the frames before, says when and why, and round-trips through its file."""
    twin, hands = thrown(8, 4, 1e7)
    result = rollout.roll_out(twin, hands)
    assert result.diverged_frame == 4
    assert result.reason == "node 0 left the scene in frame 4"
    assert result.frame_count == 8
    assert result.positions.shape == (4, 1, 3)
    assert np.isfinite(result.positions).all()


def test_a_rollout_that_ends_in_nan_is_diverged_too() -> None:
    """NaN compares false with everything; infinite forces make NaN within the frame."""
    twin, hands = thrown(5, 2, np.finfo(np.float32).max)
    result = rollout.roll_out(twin, hands)
    assert result.diverged_frame == 2
    assert np.isfinite(result.positions).all()


def test_a_saved_divergence_stays_one(tmp_path) -> None:
    result = rollout.roll_out(*thrown(8, 4, 1e7))
    result.save(tmp_path / "trajectory.npz")
    again = Trajectory.load(tmp_path / "trajectory.npz")
    assert (again.diverged_frame, again.reason, len(again.positions)) == (4, result.reason, 4)


def test_a_rollout_starts_at_rest_and_reports_progress() -> None:
    body, x, _, hands = random_scene(42)
    twin, seen = twin_of(body, x, hands[0]), []
    result = rollout.roll_out(twin, hands, progress=seen.append)
    np.testing.assert_array_equal(result.positions[0], twin.topology.nodes)
    assert seen == [1, 2, 3]
    assert result.diverged_frame is None
    expected, _ = reference.rollout(reference.Scene.of(twin), twin.topology.nodes, 0 * twin.topology.nodes, hands)
    # float32 against float64 over 60 substeps, as in test_reference.
    np.testing.assert_allclose(result.positions, expected, atol=2e-5)


def test_an_unstable_rollout_is_refused() -> None:
    body, x, _, hands = random_scene(42)
    twin = twin_of(replace(body, simulation=replace(body.simulation, frame_time=1.0, substeps=1)), x, hands[0])
    with pytest.raises(InputError, match="substep must stay below"):
        rollout.roll_out(twin, hands)


def test_a_missing_device_is_named() -> None:
    from neuspring.core.device import resolve_device

    assert resolve_device("cpu") == "cpu"
    assert resolve_device("auto") in ("cpu", "cuda:0")
    with pytest.raises(InputError, match=r"CUDA devices|build for the CPU alone"):
        resolve_device("cuda:99")


def test_a_topology_without_springs_rolls_out() -> None:
    body = scene(2, gravity=9.8, on_ground=True, substeps=10, frame_time=0.1)
    topology = Topology(
        nodes=np.array([[0, 0, 1.0], [0, 0, 2.0]]),
        controllers=np.zeros((1, 3)),
        springs=np.zeros((0, 2), np.int32),
        rest_lengths=np.zeros(0),
        labels=np.zeros(2, np.int32),
    )
    twin = Twin(topology=topology, material=twin_of(body, np.zeros((2, 3)), np.zeros((1, 3))).material, simulation=body.simulation)
    assert len(rollout.roll_out(twin, np.zeros((3, 1, 3))).positions) == 3
