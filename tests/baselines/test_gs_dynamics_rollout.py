"""GS-Dynamics: training recovers a known network, continues after a kill and ends by name; rollouts hold, step and stay rigid."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neuspring.baselines import TrainingRequest
from neuspring.baselines.gs_dynamics import train as training
from neuspring.baselines.gs_dynamics.model import (
    Dynamics,
    GsDynamicsModel,
    carry,
    connect,
    predict,
    resolve,
    turns,
    upright,
    weight_count,
)
from neuspring.baselines.results import Prediction, Trained
from neuspring.config import Config
from neuspring.config.baselines import Baselines, GsDynamics
from neuspring.core.artifacts import Observations, Scenario

PLAIN = GsDynamics(
    width=24, batch=4, epochs=4, updates_per_epoch=3, noise=0.0, yaw=False, outlier_deviations=0.0,
    coverage=0.0, length_weight=0.0, future=1, learning_rate=3e-3,
)  # fmt: skip
RULES = resolve(PLAIN, "sloth")[0]


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """Tracks are taken as they are, and a checkpoint is written after each epoch."""
    monkeypatch.setattr("neuspring.baselines.gs_dynamics.train.SMOOTHING_PASSES", 0)
    monkeypatch.setattr("neuspring.baselines.results.CHECKPOINT_EVERY", 1)


def cloud(count: int, seed: int) -> np.ndarray:
    """Points [N, 3] in a cube of 10 cm."""
    return np.random.default_rng(seed).uniform(0, 0.1, (count, 3)).astype(np.float32)


def capture(points: np.ndarray, tools: np.ndarray, train_end: int | None = None) -> Observations:
    """Of points [T, N, 3] that are always seen and two nodes more."""
    frames, seen = len(points), np.ones(points.shape[:2], dtype=bool)
    end = frames if train_end is None else train_end
    scenario = Scenario(name="made", source="toy", category="sloth", frame_count=frames, train_end=end, frame_rate=30.0, up="+z")
    return Observations(
        scenario=scenario, object_points=points, object_visibility=seen, object_motion_valid=seen, controller_points=tools,
        surface_points=cloud(1, 8), interior_points=cloud(1, 9), tracks=np.zeros((frames, 0, 3)),
    )  # fmt: skip


def hands(frames: int, motion: float = 0.012) -> np.ndarray:
    """Three tools [T, 3, 3] on a winding way, `motion` m per frame."""
    angle = 0.6 * np.arange(frames)
    steps = motion * np.stack([np.cos(angle), np.sin(angle), 0.5 * np.sin(0.7 * angle)], axis=1)
    steps *= motion / np.linalg.norm(steps, axis=1, keepdims=True)
    return (cloud(3, 1)[None] + np.cumsum(steps, axis=0)[:, None] - steps[0]).astype(np.float32)


def train(seen: Observations, settings: GsDynamics, seed: int = 0, partial: Path | None = None) -> Trained:
    facts = {"seed": seed, "device": "cpu", "partial": partial, "key": lambda: "key"}
    chosen = Config(baselines=Baselines(gs_dynamics=settings))
    return training.train(TrainingRequest(observations=seen, settings=chosen, **facts))


def rolled(model: GsDynamicsModel, seen: Observations) -> Prediction:
    return predict(model, seen, None, "cpu")


def pushes(amount: float) -> GsDynamicsModel:
    """A network that moves all by `amount` m along x in every step."""
    weights = np.zeros(weight_count(RULES), dtype=np.float32)
    weights[-3] = amount
    return GsDynamicsModel(weights=weights, rules=RULES)


def one_step(model: GsDynamicsModel, points: np.ndarray, tools: np.ndarray, frame: int) -> torch.Tensor:
    """Displacements after `frame`, all points being particles."""
    frames = [max(frame - 2, 0), max(frame - 1, 0), frame]
    past, held = torch.tensor(points[frames]), torch.tensor(tools)
    graph = connect(past[-1:], torch.ones(1, points.shape[1], dtype=torch.bool), held[frame][None], model.rules)
    return model.dynamics("cpu")(graph, torch.cat([past, held[frames]], dim=1), held[frame + 1] - held[frame])


@torch.no_grad()
def taught(frames: int, count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """What a network of known random weights makes of a cloud: points [T, N, 3] and tools [T, C, 3], m.

    Its head is set so that the first displacements are 5 mm, and 0 on average.
    """
    weights, head = 1.7 * Dynamics.initial(RULES, 11).weights, slice(-3 - 3 * RULES.width, -3)
    weights[-3:] = 0
    tools, points = hands(frames), np.repeat(cloud(count, 0)[None], frames, axis=0)
    first = one_step(GsDynamicsModel(weights=weights.numpy(), rules=RULES), points, tools, 0)
    scale = 0.005 / (first - first.mean(dim=0)).norm(dim=1).mean()
    weights[head], weights[-3:] = weights[head] * scale, -first.mean(dim=0) * scale
    teacher = GsDynamicsModel(weights=weights.numpy(), rules=RULES)
    for frame in range(frames - 1):
        points[frame + 1] = points[frame] + one_step(teacher, points, tools, frame).numpy()
    return points, tools


@torch.no_grad()
def relative_error(model: GsDynamicsModel, points: np.ndarray, tools: np.ndarray) -> float:
    """Mean error of all single steps, relative to how much displacements differ from their mean."""
    wanted = np.diff(points, axis=0)
    found = np.stack([one_step(model, points, tools, frame).numpy() for frame in range(len(wanted))])
    size = np.linalg.norm(wanted - wanted.mean(axis=(0, 1)), axis=2).mean()
    return float(np.linalg.norm(found - wanted, axis=2).mean() / size)


def test_what_a_known_network_made_is_fitted_back():
    points, tools = taught(16)
    sizes = np.linalg.norm(np.diff(points, axis=0), axis=2)
    assert 0.005 < sizes.mean() < 0.03 and points.std(axis=1).min() > 0.01
    trained = train(capture(points, tools), replace(PLAIN, epochs=15, updates_per_epoch=40))
    assert not trained.failure and trained.facts["windows"] == 15
    assert relative_error(trained.model, points, tools) < 0.15


def test_a_killed_training_continues_to_the_same_model(tmp_path):
    points, tools = cloud(25, 0)[None] + hands(8)[:, :1] - hands(8)[:1, :1], hands(8)
    noisy = replace(PLAIN, noise=0.002, yaw=True, length_weight=0.1, future=2)
    seen, partial = capture(points, tools), tmp_path / "partial.npz"
    whole = train(seen, noisy, 3)
    again = train(seen, noisy, 3)
    np.testing.assert_array_equal(again.model.weights, whole.model.weights)
    assert (train(seen, noisy, 4).model.weights != whole.model.weights).any()
    train(seen, replace(noisy, epochs=2), 3, partial)
    continued = train(seen, noisy, 3, partial)
    assert continued.attempts == 2 and continued.history.equals(whole.history)
    assert list(whole.history) == ["step", "loss", "position_loss", "length_loss"]
    np.testing.assert_array_equal(continued.model.weights, whole.model.weights)


def test_nothing_after_the_training_frames_is_learned_and_only_frame_0_is_rolled_out():
    points, tools = cloud(25, 0)[None] + hands(9)[:, :1] - hands(9)[:1, :1], hands(9)
    seen = capture(points, tools, train_end=6)
    later = np.arange(9)[:, None, None] >= 6
    spoiled = replace(
        seen,
        object_points=np.where(later, points + 5, points),
        controller_points=np.where(later, tools - 3, tools),
        object_visibility=seen.object_visibility & ~later[..., 0],
    )
    models = [train(each, PLAIN).model for each in (seen, spoiled)]
    np.testing.assert_array_equal(models[0].weights, models[1].weights)
    blind = replace(seen, object_points=points * (np.arange(9) == 0)[:, None, None])
    found = [rolled(models[0], each).trajectory.positions for each in (seen, blind)]
    np.testing.assert_array_equal(*found)
    assert found[0].shape == (9, 27, 3) and np.ptp(found[0], axis=0).max() > 1e-4
    np.testing.assert_array_equal(found[0][0], seen.nodes)


def test_training_that_cannot_go_on_says_so_and_keeps_what_it_had():
    points, tools = cloud(25, 0)[None].repeat(4, axis=0), hands(4)
    # Hands that never move a step: nothing is to be learned, and the model's answer is to hold.
    resting = capture(points, hands(4, 0.001))
    still = train(resting, PLAIN)
    assert not still.failure and len(still.history) == 0 and "loss" in still.history
    assert np.ptp(rolled(still.model, resting).trajectory.positions, axis=0).max() == 0
    # Hands that move after the training frames alone: it never learned what to do, and still it does nothing at random.
    late = np.concatenate([hands(4, 0.001), hands(4) + np.array([0.05, 0, 0])])
    moving = capture(cloud(25, 0)[None].repeat(8, axis=0), late, train_end=4)
    unprepared = train(moving, PLAIN)
    assert unprepared.failure == "training did not start: no window of a tool that moves 0.01 m in 4 training frames"
    assert np.ptp(rolled(unprepared.model, moving).trajectory.positions, axis=0).max() < 1e-6
    start = Dynamics.initial(RULES, 0).weights.numpy()
    wild = train(capture(points, tools), replace(PLAIN, learning_rate=1e30))
    assert wild.failure == "training ended early: the loss is not finite (epoch 0, update 1)"
    np.testing.assert_array_equal(wild.model.weights, start)


def test_points_wait_while_the_tools_move_less_than_a_step():
    # 4 mm per frame: steps in frames 3, 6 and 9.
    tools = cloud(3, 1)[None] + 0.004 * np.arange(12)[:, None, None] * np.array([0, 1.0, 0])
    seen = capture(cloud(25, 0)[None].repeat(12, axis=0), tools.astype(np.float32))
    found = rolled(pushes(0.006), seen)
    along = (found.trajectory.positions - seen.nodes)[:, :, 0]
    assert found.facts["executed_steps"] == 3 and found.facts["tools"] == 3 and found.facts["particles"] == 27
    np.testing.assert_allclose(along.T - np.minimum(np.arange(12), 9) * 0.002, 0, atol=1e-7)
    assert np.abs((found.trajectory.positions - seen.nodes)[:, :, 1:]).max() < 1e-7


def test_points_that_leave_the_scene_end_the_rollout_by_name():
    seen = capture(cloud(25, 0)[None].repeat(8, axis=0), hands(8, 0.006))
    trajectory = rolled(pushes(6.0), seen).trajectory
    assert trajectory.diverged_frame == 4 and trajectory.positions.shape == (4, 27, 3)
    assert trajectory.reason == "node 0 left the scene in frame 4" and trajectory.frame_count == 8
    lost = rolled(pushes(3e38), seen).trajectory
    assert lost.diverged_frame == 2 and len(lost.positions) == 2


def test_upside_down_the_same_happens():
    points, tools = cloud(25, 0)[None].repeat(6, axis=0), hands(6)
    seen = capture(points, tools)
    turned = {
        name: upright(getattr(seen, name), "-z")
        for name in ("object_points", "controller_points", "surface_points", "interior_points")
    }
    under = replace(seen, **turned, scenario=replace(seen.scenario, up="-z"))
    models = [train(each, PLAIN).model for each in (seen, under)]
    np.testing.assert_array_equal(models[0].weights, models[1].weights)
    above, below = (rolled(models[0], each).trajectory.positions for each in (seen, under))
    np.testing.assert_array_equal(upright(below, "-z"), above)


def test_structure_points_follow_a_rigid_motion_of_particles_exactly():
    turn, shift = Rotation.from_rotvec([0.4, -0.8, 0.3]).as_matrix(), np.array([0.02, 0.0, -0.01])
    particles, points = cloud(20, 0) + 0.5, cloud(200, 5) + 0.5
    before, after = torch.tensor(particles), torch.tensor((particles @ turn.T + shift).astype(np.float32))
    graph = connect(before[None], torch.ones(1, 20, dtype=torch.bool), torch.zeros(1, 1, 3), RULES)
    moved = carry(torch.tensor(points), before, turns(graph, before, after), after - before)
    np.testing.assert_allclose(moved.numpy(), points @ turn.T + shift, rtol=0, atol=2e-6)


def test_particles_on_a_line_turn_by_the_least_angle_and_lone_ones_do_not():
    line = torch.tensor([[0.02 * i, 0, 0] for i in range(5)] + [[3.0, 0, 0]])
    bent = torch.tensor([[0, 0.02 * i, 0] for i in range(5)] + [[3.0, 1, 0]])
    graph = connect(line[None], torch.ones(1, 6, dtype=torch.bool), torch.zeros(1, 1, 3), RULES)
    found = turns(graph, line, bent)
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(found[:5], quarter.expand(5, -1, -1), rtol=0, atol=1e-6)
    torch.testing.assert_close(found[5], torch.eye(3))
