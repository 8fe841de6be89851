"""Collision lists of fixed capacity report what does not fit; diverging rollouts are named results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from neuspring.core.artifacts import Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.physics import reference
from neuspring.physics.solver import FrameSolver
from neuspring.twin import rollout
from tests.support.scenes import WAYS, no_hands, random_scene, scene, solver_for, twin_of, warp

SINGLE, DOUBLE = torch.float32, torch.float64
DISTANCE = 0.02


def clump(crowded: int, pairs: int) -> np.ndarray:
    """`crowded` nodes all within DISTANCE of each other, and `pairs` far pairs of near nodes, shuffled.

    A single node follows each of them: its empty list is next in memory, where an overrun would appear.
    """
    rng = np.random.default_rng(1)
    near = rng.uniform(-0.004, 0.004, (crowded, 3))
    far = np.repeat(np.arange(1, pairs + 1)[:, None] * [1.0, 0, 0], 2, axis=0) + rng.uniform(-0.004, 0.004, (2 * pairs, 3))
    others = rng.permutation(np.concatenate([near, far]))
    lonely = np.arange(1, len(others) + 1)[:, None] * [0, 1.0, 0]
    return np.stack([others, lonely], axis=1).reshape(-1, 3)


def lists(x: np.ndarray, capacity: int, frames: int, device: str, threads: bool) -> tuple[list[list[int]], int]:
    """Partner lists after `frames` frames that do not move anything, and the overflow reported."""
    body = scene(len(x), self_collision=True, contact_distance=DISTANCE, collision_capacity=capacity)
    solver = solver_for(body, 0, device, threads=threads)
    state, nobody = torch.tensor(x, device=device), torch.zeros(0, 3, dtype=torch.float64, device=device)
    if solver.buffers.threads:
        solver.buffers.indices["near"].fill_(-1)
    for _ in range(frames):
        after, _ = solver.forward(state, 0 * state, nobody, nobody)
        np.testing.assert_array_equal(after.cpu().numpy(), x)
    if solver.buffers.threads:
        near, count = (solver.buffers.indices[name][..., 0].cpu().numpy() for name in ("near", "near_count"))
        assert near.shape == (len(x), min(capacity, len(x)))
        assert (count <= capacity).all()
        # Slots behind a list stay untouched, also the first slot of the empty list behind a full one.
        assert (near[np.arange(near.shape[1]) >= count[:, None]] == -1).all()
    return listed(solver, 0), solver.collision_overflow


def listed(solver: FrameSolver, twin: int) -> list[list[int]]:
    """The partners of each node of a twin: of rows that have each pair once, or of lists at both of its nodes."""
    b = solver.buffers
    group, lane = divmod(twin, b.width)
    tables = {name: tensor.cpu().numpy() for name, tensor in b.indices.items()}
    if b.threads:
        rows = zip(tables["near"][..., group], tables["near_lanes"][..., group], tables["near_count"][:, group], strict=True)
        return [row[:count][bits[:count] == 1].tolist() for row, bits, count in rows]
    found: list[list[int]] = [[] for _ in range(b.nodes)]
    ends = tables["pair_rows"][group]
    for i in range(b.nodes):
        row = slice(ends[i], ends[i + 1])
        others = tables["pair_other"][group, row]
        assert (np.diff(others, prepend=i) > 0).all()
        for j in others[tables["pair_lanes"][group, row] >> lane & 1 == 1].tolist():
            found[i].append(j)
            found[j].append(i)
    return [sorted(row) for row in found]


@pytest.mark.parametrize(("device", "threads"), WAYS)
@pytest.mark.parametrize("capacity", [1, 5, 500])
def test_full_lists_are_reported_and_never_overrun(capacity, device, threads):
    """Every list holds those of the first `capacity` partners in node order who list the node as well."""
    x = clump(7, 4)
    partners, overflow = lists(x, capacity, frames=3, device=device, threads=threads)
    wanted = expected(x, DOUBLE, DISTANCE)
    assert sorted(len(row) for row in wanted) == [0] * 15 + [1] * 8 + [6] * 7
    assert partners == mutual([row[:capacity] for row in wanted])
    assert overflow == 3 * 7 * max(6 - capacity, 0)


def test_candidates_come_from_the_frame_start():
    """Pairs that come near within a frame are found in the next one (as released)."""
    body = scene(2, self_collision=True, contact_distance=DISTANCE, substeps=10, frame_time=0.01)
    x, v = np.array([[0.0, 0, 0], [0.021, 0, 0]]), np.array([[0.5, 0, 0], [-0.5, 0, 0]])
    for engine_frames in (1, 2):
        _, speed = warp(body, x, v, no_hands(engine_frames))
        assert (speed[-1, 0, 0] < 0) == (engine_frames == 2)


# Lists of collision partners ------------------------------------------------------------------------------------------


def partners(clouds: Sequence[np.ndarray], dtype: torch.dtype, capacity: int, distance: float) -> tuple[list[Any], list[int]]:
    """Lists of partners at the start of a frame, of each twin and node, and what did not fit, of each twin."""
    options: dict[str, Any] = {"self_collision": True, "contact_distance": distance, "collision_capacity": capacity}
    solver = solver_for([scene(len(cloud), **options) for cloud in clouds], 0, dtype=dtype)
    x, nobody = torch.tensor(np.stack(clouds), dtype=dtype), torch.zeros(len(clouds), 0, 3, dtype=dtype)
    solver.forward(x, 0 * x, nobody, nobody)
    return [listed(solver, twin) for twin in range(len(clouds))], solver.overflows


def expected(cloud: np.ndarray, dtype: torch.dtype, distance: float) -> list[list[int]]:
    """The same from the specification, in the engine's precision."""
    kind = np.float32 if dtype == SINGLE else np.float64
    pairs = reference.candidates(cloud.astype(kind), kind(distance))
    return [pairs[pairs[:, 0] == i, 1].tolist() for i in range(len(cloud))]


def mutual(rows: list[list[int]]) -> list[list[int]]:
    """The partners of each node that list it as well."""
    return [[j for j in row if i in rows[j]] for i, row in enumerate(rows)]


def cloud(kind: str) -> np.ndarray:
    """[N, 3] around the origin, far from it, on the borders of the grid's cells, or wider than the grid."""
    rng, steps = np.random.default_rng(3), np.arange(-3, 4) * DISTANCE / 2
    lattice = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return {
        "around the origin": rng.uniform(-0.04, 0.04, (150, 3)),
        "far away": rng.uniform(-0.04, 0.04, (150, 3)) + np.array([900.0, -700.0, 500.0]),
        "cell borders": lattice,
        "far cell borders": lattice + np.array([5000, -3000, 7000]) * DISTANCE,
        "just off cell borders": lattice + rng.choice([-1e-7, 0.0, 1e-7], lattice.shape),
        # Points 64 cells apart share a cell.
        "wider than the grid": rng.uniform(-0.03, 0.03, (150, 3)) + rng.integers(0, 2, (150, 3)) * 64 * DISTANCE,
        "in one place": np.repeat(rng.uniform(-0.04, 0.04, (5, 3)), 6, axis=0),
    }[kind]


CLOUDS = ("around the origin", "far away", "cell borders", "far cell borders", "just off cell borders", "wider than the grid",
          "in one place")  # fmt: skip


@pytest.mark.parametrize("dtype", [SINGLE, DOUBLE])
@pytest.mark.parametrize("kind", CLOUDS)
def test_the_grid_finds_all_pairs(kind, dtype):
    x = cloud(kind)
    wanted = expected(x, dtype, DISTANCE)
    assert sum(map(len, wanted)) > len(x)
    lists, overflow = partners([x], dtype, 500, DISTANCE)
    assert lists == [wanted]
    assert overflow == [0]


def crowds(count: int, nodes: int = 24) -> list[np.ndarray]:
    """Twins in which different nodes, 3 to 8 of them, are all near each other; the others are lonely."""
    clouds = []
    for twin in range(count):
        rng = np.random.default_rng(twin)
        x, crowd = np.arange(1, nodes + 1)[:, None] * [0.0, 1.0, 0.0], rng.permutation(nodes)[: 3 + twin % 6]
        x[crowd] = rng.uniform(-0.004, 0.004, (len(crowd), 3))
        clouds.append(x)
    return clouds


@pytest.mark.parametrize("capacity", [1, 5, 50])
@pytest.mark.parametrize("dtype", [SINGLE, DOUBLE])
def test_a_crowded_twin_takes_no_room_from_others(dtype, capacity):
    """Twins whose crowds are other nodes fill one list far beyond what one of them may keep."""
    clouds = crowds(17)
    clouds[2][:20] = np.random.default_rng(2).uniform(-0.004, 0.004, (20, 3))
    lists, overflow = partners(clouds, dtype, capacity, DISTANCE)
    wanted = [expected(x, dtype, DISTANCE) for x in clouds]
    assert lists == [mutual([row[:capacity] for row in rows]) for rows in wanted]
    assert overflow == [sum(max(len(row) - capacity, 0) for row in rows) for rows in wanted]
    assert (overflow[2] > 100) == (capacity < 50)


def test_contact_distances_are_those_of_each_twin():
    """The grid's cells are as wide as the largest; a twin with a smaller one lists no more than its own."""
    x = cloud("around the origin")
    distances = (0.005, 0.02, 0.011, 0.013, 0.017)
    scenes = [scene(len(x), self_collision=True, contact_distance=distance) for distance in distances]
    solver, nobody = solver_for(scenes, 0), torch.zeros(5, 0, 3, dtype=DOUBLE)
    stacked = torch.tensor(np.stack([x] * 5))
    solver.forward(stacked, 0 * stacked, nobody, nobody)
    counts = [sum(map(len, listed(solver, lane))) for lane in range(5)]
    assert counts == [len(reference.candidates(x, distance)) for distance in distances]


@pytest.mark.parametrize("apart", [0.0, 0.2, 0.49, 0.51, 3.0])
@pytest.mark.parametrize("dtype", [SINGLE, DOUBLE])
def test_twins_that_are_alike_share_a_search(dtype, apart):
    """Nodes up to `apart` contact distances from those of the first twin, and whole bodies anywhere: all pairs are found."""
    rng = np.random.default_rng(5)
    x = cloud("around the origin")
    ways = rng.normal(size=(9, *x.shape))
    ways -= ways.mean(axis=1, keepdims=True)
    clouds = [x + rng.uniform(-5, 5, 3) + apart * DISTANCE * way / np.linalg.norm(way, axis=1).max() for way in ways]
    lists, overflow = partners(clouds, dtype, 500, DISTANCE)
    assert lists == [expected(x, dtype, DISTANCE) for x in clouds]
    assert overflow == [0] * 9


# Rollouts -------------------------------------------------------------------------------------------------------------


def crowded_twin(capacity: int) -> Twin:
    body, x, _, hands = random_scene(41, nodes=12, self_collision=True, collision_capacity=capacity)
    return twin_of(body, x, hands[0])


def test_a_rollout_reports_overflow():
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


def test_a_diverged_rollout_is_a_named_result(tmp_path):
    """It keeps the frames before, says when and why, and round-trips through its file."""
    twin, hands = thrown(8, 4, 1e7)
    result = rollout.roll_out(twin, hands)
    assert result.diverged_frame == 4
    assert result.reason == "node 0 left the scene in frame 4"
    assert result.frame_count == 8
    assert result.positions.shape == (4, 1, 3)
    result.save(tmp_path / "trajectory.npz")
    again = Trajectory.load(tmp_path / "trajectory.npz")
    assert (again.diverged_frame, again.reason, len(again.positions)) == (4, result.reason, 4)


def test_a_rollout_that_ends_in_nan_is_diverged_too():
    """NaN compares false with everything; infinite forces make NaN within the frame."""
    assert rollout.roll_out(*thrown(5, 2, np.finfo(np.float32).max)).diverged_frame == 2


def test_a_rollout_starts_at_rest_and_reports_progress():
    body, x, _, hands = random_scene(42)
    twin, seen = twin_of(body, x, hands[0]), []
    result = rollout.roll_out(twin, hands, progress=seen.append)
    assert seen == [1, 2, 3]
    assert result.diverged_frame is None
    expected, _ = warp(body, x.astype(np.float32), 0 * x, hands)
    # float32 against float64 over 60 substeps.
    np.testing.assert_allclose(result.positions, expected, atol=2e-5)


def test_an_unstable_rollout_is_refused():
    body, x, _, hands = random_scene(42)
    twin = twin_of(replace(body, simulation=replace(body.simulation, frame_time=1.0, substeps=1)), x, hands[0])
    with pytest.raises(InputError, match="substep must stay below"):
        rollout.roll_out(twin, hands)
