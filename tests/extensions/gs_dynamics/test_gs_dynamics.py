"""GS-Dynamics: its graph, its network's symmetries, windows and losses worked out by hand; training recovers a known network,
continues after a kill and ends by name; rollouts hold, step and stay rigid."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neuspring.baselines import TrainingRequest
from neuspring.config import Config
from neuspring.config.extensions import Baselines
from neuspring.extensions.gs_dynamics import model as gs
from neuspring.extensions.gs_dynamics import train as training
from neuspring.extensions.gs_dynamics.train import past
from tests.support import scenarios

RULES = gs.resolve(gs.GsDynamicsTraining(width=16), "sloth")[0]


def cloud(count=12, seed=0):
    """Points [N, 3] in a cube of 10 cm."""
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 0.1


def graph_of(points, tools, rules=RULES):
    return gs.connect(points[None], torch.ones(1, len(points), dtype=torch.bool), tools[None], rules)


def pairs(graph):
    return set(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True))


@torch.no_grad()
def moves(points, tools, rules=RULES):
    """Displacements of random weights: two earlier positions, and an action that differs from tool to tool."""
    drift = torch.linspace(0.02, 0, 3, dtype=points.dtype)[:, None, None] * torch.tensor([0.5, 0.2, -0.3])
    history = torch.cat([points, tools])[None] - drift
    action = 0.01 * (tools - tools.mean(dim=0)) / 0.05
    network = gs.Dynamics.of(rules, gs.Dynamics.initial(rules, 3).weights.to(points.dtype))
    return network(graph_of(points, tools, rules), history, action)


def test_a_particle_is_the_first_of_its_own_neighbors():
    line = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0.03, 0, 0], [0.5, 0, 0]])
    far = torch.full((1, 3), 9.0)
    graph = graph_of(line, far, replace(RULES, neighbors=2, radius=0.08))
    assert pairs(graph) == {(0, 0), (1, 1), (2, 2), (3, 3), (0, 1), (1, 0), (2, 1)}, "receivers first; nearest is not mutual"
    narrow = graph_of(line, far, replace(RULES, neighbors=3, radius=0.015))
    assert pairs(narrow) == {(0, 0), (1, 1), (2, 2), (3, 3), (0, 1), (1, 0)}


def test_tools_and_particles_feel_each_other_and_tools_do_not_feel_tools():
    points, tools = torch.tensor([[0.0, 0, 0], [0.3, 0, 0]]), torch.tensor([[0.02, 0, 0], [0.03, 0, 0]])
    rules = replace(RULES, radius=0.05, neighbors=1)
    assert pairs(graph_of(points, tools, rules)) == {(0, 0), (1, 1), (0, 2), (2, 0), (0, 3), (3, 0)}


def test_windows_of_a_batch_do_not_touch():
    points, used = torch.zeros(2, 3, 3), torch.tensor([[True, False, True], [True, True, False]])
    graph = gs.connect(points, used, torch.zeros(2, 1, 3), RULES)
    assert graph.particles == 4
    part = torch.tensor([0, 0, 1, 1, 0, 1])
    assert (part[graph.receivers] == part[graph.senders]).all() and len(graph.receivers) == 2 * (4 + 4)


def test_particles_are_spread_until_they_cover():
    points = torch.stack([torch.linspace(0, 1, 11), torch.zeros(11), torch.zeros(11)], dim=1)[None].repeat(2, 1, 1)
    usable = torch.ones(2, 11, dtype=torch.bool)
    usable[1, 10] = False
    first = torch.tensor([0, 2])
    chosen, used = gs.sample(points, usable, 3, 0.0, first)
    assert chosen.tolist() == [[0, 10, 5], [2, 9, 5]] and used.all()
    chosen, used = gs.sample(points, usable, 11, 0.45, first)
    assert chosen[0][used[0]].tolist() == [0, 10, 5] and chosen[1][used[1]].tolist() == [2, 9]
    assert training.pick(usable, torch.tensor([0.0, 0.999])).tolist() == [0, 9]


def test_input_sizes_are_those_of_the_public_code():
    points, tools = cloud(), cloud(2, 1)
    history, graph = torch.cat([points, tools]).expand(3, -1, -1), graph_of(points, tools)
    short = replace(RULES, heights=False)
    assert gs.node_inputs(RULES, graph, history, tools).shape == (14, 14) and RULES.node_size == 14
    assert gs.node_inputs(short, graph, history, tools).shape == (14, 5) and short.node_size == 5
    assert gs.edge_inputs(graph, history).shape[1] == 14 == RULES.edge_size
    of_node = gs.node_inputs(RULES, graph, history, tools)[12]
    assert of_node.tolist() == pytest.approx([0, 1, *[float(tools[0, 2])] * 3, *[0] * 6, *tools[0].tolist()])
    full = gs.resolve(gs.GsDynamicsTraining(), "sloth")[0]
    assert gs.weight_count(full) == len(gs.Dynamics.initial(full, 0).weights) == 2_904_579


def test_weights_keep_their_order_in_the_vector_and_their_first_draws():
    """Saved models depend on the order; a run can be repeated only if the draws stay."""
    network = gs.Dynamics.initial(replace(RULES, width=4), 5)
    encoders = [f"{part}.{i}" for part in ("node", "edge") for i in (0, 2, 4)]
    layers = [*encoders, "relation", "particle", "head.0", "head.2", "head.4"]
    names = [name for name, _ in network.named_parameters()]
    assert names == [f"{layer}.{part}" for layer in layers for part in ("weight", "bias")]
    first = 4 * (RULES.node_size + 1)
    draws = torch.rand(first, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(network.weights[:first], (draws * 2 - 1) / RULES.node_size**0.5, rtol=0, atol=0)
    again = gs.Dynamics.of(network.rules, network.weights)
    torch.testing.assert_close(again.state_dict(), network.state_dict(), rtol=0, atol=0)
    last = (again.head[-1].weight.flatten(), again.head[-1].bias)
    torch.testing.assert_close(torch.cat(last), network.weights[-15:], rtol=0, atol=0)


def test_the_order_of_particles_does_not_matter():
    points, tools = cloud(), cloud(3, 1)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(moves(points[order], tools), moves(points, tools)[order], rtol=0, atol=1e-14)


def test_shifts_along_the_ground_change_nothing_and_heights_do():
    points, tools = cloud(), cloud(3, 1)
    along, upwards = torch.tensor([3.0, -7.0, 0.0]), torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(moves(points + along, tools + along), moves(points, tools), rtol=0, atol=1e-13)
    assert float((moves(points + upwards, tools + upwards) - moves(points, tools)).abs().max()) > 1e-5
    short = replace(RULES, heights=False)
    torch.testing.assert_close(moves(points + upwards, tools + upwards, short), moves(points, tools, short), rtol=0, atol=1e-13)


def test_yaw_is_learned_and_not_built_in():
    points, tools, quarter = cloud(), cloud(3, 1), torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    assert float((moves(points @ quarter.T, tools @ quarter.T) - moves(points, tools) @ quarter.T).abs().max()) > 1e-4
    settings = gs.GsDynamicsTraining(width=8, noise=0.0, batch=4)
    rules, recipe = gs.resolve(settings, "sloth")
    windows = training.Windows.of(walk(10), settings, "cpu")
    turned, plain = (
        training.draw(windows, rules, replace(recipe, yaw=yaw), torch.Generator().manual_seed(0)) for yaw in (True, False)
    )
    torch.testing.assert_close(turned.history[..., 2], plain.history[..., 2])
    assert pairs(turned.graph) == pairs(plain.graph)
    particles = turned.graph.particles
    for shown in (turned, plain):
        assert len(shown.targets) == 5 and shown.history.shape[1] == particles + 4 * 2
    # Targets, tools and history of a window turn as one: products of their displacements stay.
    products = [
        ((batch.targets[0] - batch.history[2, :particles]) * batch.history.diff(dim=0)[1, :particles]).sum(dim=1)
        for batch in (turned, plain)
    ]
    torch.testing.assert_close(*products, rtol=0, atol=1e-9)
    assert float((turned.targets - plain.targets).abs().max()) > 0.01


def walk(frames, count=30):
    """A cloud that follows two tools, 12 mm per frame."""
    way = 0.012 * np.arange(frames)[:, None, None] * np.array([1.0, 0, 0])
    points, tools = ((cloud(n, seed).numpy() + way).astype(np.float32) for n, seed in ((count, 0), (2, 1)))
    return training.Tracks(points, np.ones((frames, count), dtype=bool), tools, 0)


def test_steps_of_a_window_are_of_tool_motion():
    way = np.array([0.0, 0.004, 0.0101, 0.0125, 0.0205, 0.0285])
    tools = np.zeros((6, 2, 3))
    tools[:, 1, 0] = way
    assert past(tools, 4, 0.01) == [0, 2, 4]
    assert past(tools, 2, 0.01) == [0, 0, 2] and past(tools, 1, 0.01) == [1, 1, 1]
    assert training.ahead(tools, 0, 0.01, 5) == [2, 4, 5, 5, 5], "the last frame needs three quarters of a step"
    assert training.ahead(tools, 0, 0.01, 1) == [2] and training.ahead(tools, 5, 0.01, 5) == []
    frames = training.window_frames(tools, gs.GsDynamicsTraining())
    assert frames[:, 2].tolist() == [0, 1, 2, 3, 4] and frames.shape == (5, 8)
    assert training.window_frames(tools[:, :1], gs.GsDynamicsTraining()).shape == (0, 8)


def test_unseen_tracks_are_no_particles_and_no_targets(monkeypatch):
    tracks = walk(12)
    visible = tracks.visible.copy()
    visible[6, :5] = False
    points = np.where(visible[..., None], tracks.points, 100.0).astype(np.float32)
    hidden = replace(tracks, points=points, visible=visible)
    settings = gs.GsDynamicsTraining(width=8, batch=16, noise=0.0)
    rules, recipe = gs.resolve(settings, "sloth")
    windows = training.Windows.of(hidden, settings, "cpu")
    touched = (windows.frames == 6).any(dim=1)
    assert touched.any() and not windows.usable[touched, :5].any() and windows.usable[~touched].all()
    batch = training.draw(windows, rules, recipe, torch.Generator().manual_seed(0))
    assert batch.history.abs().max() < 1 and batch.targets.abs().max() < 1 and batch.known.all()
    # Too few are seen throughout: those seen in the history take part, and what is not seen is no target.
    monkeypatch.setattr("neuspring.extensions.gs_dynamics.train.MIN_VISIBLE", 28)
    windows = training.Windows.of(hidden, settings, "cpu")
    in_history = (windows.frames[:, :3] == 6).any(dim=1)
    assert not windows.usable[in_history, :5].any() and windows.usable[~in_history].all()
    batch = training.draw(windows, replace(rules, coverage=0.0), recipe, torch.Generator().manual_seed(0))
    assert batch.history.abs().max() < 1
    assert (batch.known == (batch.targets.abs().amax(dim=2) < 50)).all() and not batch.known.all()
    assert float(training.position_loss(batch.targets[3] + 0.5, batch.targets[3], batch.known[3])) == pytest.approx(0.25, rel=1e-3)


def test_tracks_of_unusual_length_are_dropped_unless_all_move_as_one():
    still, ahead_of = np.zeros((5, 9, 3)), np.arange(5)[:, None] * np.array([1, 1.1, 0.9, 1, 1.05, 0.95, 1, 5, 0])
    seen = np.ones((5, 9), dtype=bool)
    seen[1:, 0] = False
    points = still + ahead_of[..., None] * [0.01, 0, 0]
    assert training.ordinary(points, seen, 3.0).tolist() == [False, True, True, True, True, True, True, False, False]
    assert training.ordinary(points, seen, 0.0).all()
    assert training.ordinary(points[:, [3, 3, 3]], seen[:, 1:4], 3.0).all()


def test_smoothing_stays_within_what_is_seen():
    points = np.zeros((6, 1, 3), dtype=np.float32)
    points[:, 0, 0] = [0, 3, 0, 99, 6, 0]
    visible = np.array([True, True, True, False, True, True])[:, None]
    assert training.smoothed(points, visible, 1)[:, 0, 0].tolist() == [1.5, 1, 1.5, 99, 3, 3]
    np.testing.assert_array_equal(training.smoothed(points, visible, 0), points)


def test_the_losses_by_hand():
    # Two particles that feel themselves, each other, and one of them a tool, node 2.
    graph = gs.ParticleGraph(torch.tensor([0, 1, 0, 1, 0, 2]), torch.tensor([0, 1, 1, 0, 2, 0]), 2)
    before = torch.tensor([[3.0, 0, 0], [3, 4, 0]])
    assert float(training.length_loss(graph, before + torch.tensor([3.0, 0, 0]), before)) == 0
    stretched = torch.tensor([[3.0, 0, 0], [3, 6, 0]], requires_grad=True)
    loss = training.length_loss(graph, stretched, before)
    assert float(loss.detach()) == pytest.approx(2 * 4 / 4)
    loss.backward()
    wanted = torch.tensor([[0.0, -2, 0], [0, 2, 0]])
    # Edges of length 0 have none.
    torch.testing.assert_close(stretched.grad, wanted)
    after, target = torch.ones(4, 3), torch.zeros(4, 3)
    after[0] = 2
    assert float(training.position_loss(after, target, torch.tensor([True, True, False, False]))) == pytest.approx((4 + 1) / 2)


def test_presets_and_what_replaces_them():
    named = [gs.preset_name(name) for name in ("rope", "DLO1", "cloth", "package", "sloth", "blob")]
    assert named == ["rope", "rope", "cloth", "cloth", "animals", "animals"]
    rules, recipe = gs.resolve(gs.GsDynamicsTraining(noise=0.0, neighbors=9), "cloth")
    assert (rules.neighbors, rules.particles, recipe.noise, recipe.length_weight, recipe.batch) == (9, 150, 0.0, 0.1, 64)
    assert not gs.resolve(gs.GsDynamicsTraining(), "rope")[0].heights and rules.heights


# Training and rollouts ---------------------------------------------------------------------------------------------------

PLAIN = gs.GsDynamicsTraining(
    width=24, batch=4, epochs=4, updates_per_epoch=3, noise=0.0, yaw=False, outlier_deviations=0.0,
    length_weight=0.0, future=1, learning_rate=3e-3,
)  # fmt: skip
SMALL = replace(gs.resolve(PLAIN, "sloth")[0], coverage=0.0)


@pytest.fixture
def plain(monkeypatch):
    """Tracks are taken as they are, all are particles, and a checkpoint is written after each epoch."""
    monkeypatch.setattr("neuspring.extensions.gs_dynamics.model.COVERAGE", 0.0)
    monkeypatch.setattr("neuspring.extensions.gs_dynamics.train.SMOOTHING_PASSES", 0)
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 1)


def corners(count, seed):
    """Points [N, 3] float32 in a cube of 10 cm."""
    return np.random.default_rng(seed).uniform(0, 0.1, (count, 3)).astype(np.float32)


def capture(points, tools, train_end=None):
    """Observations of points [T, N, 3] that are always visible, and two more nodes."""
    about = {"category": "sloth", "train_end": train_end or len(points)}
    return scenarios.seen(points, tools, about, surface_points=corners(1, 8), interior_points=corners(1, 9))


def hands(frames, motion=0.012):
    """Three tools [T, 3, 3] on a winding way, `motion` m per frame."""
    angle = 0.6 * np.arange(frames)
    steps = motion * np.stack([np.cos(angle), np.sin(angle), 0.5 * np.sin(0.7 * angle)], axis=1)
    steps *= motion / np.linalg.norm(steps, axis=1, keepdims=True)
    return (corners(3, 1)[None] + np.cumsum(steps, axis=0)[:, None] - steps[0]).astype(np.float32)


def train(seen, settings, seed=0, partial=None):
    facts = {"seed": seed, "device": "cpu", "partial": partial, "key": lambda: "key"}
    chosen = Config(baselines=Baselines(gs_dynamics=settings))
    return training.train(TrainingRequest(observations=seen, settings=chosen, **facts))


def rolled(model, seen):
    return gs.predict(model, seen, None, "cpu")


def pushes(amount):
    """A network that moves all by `amount` m along x in every step."""
    weights = np.zeros(gs.weight_count(SMALL), dtype=np.float32)
    weights[-3] = amount
    return gs.GsDynamicsModel(weights=weights, rules=SMALL)


def one_step(model, points, tools, frame):
    """Displacements after `frame`, all points being particles."""
    frames = [max(frame - 2, 0), max(frame - 1, 0), frame]
    past, held = torch.tensor(points[frames]), torch.tensor(tools)
    graph = gs.connect(past[-1:], torch.ones(1, points.shape[1], dtype=torch.bool), held[frame][None], model.rules)
    return model.dynamics("cpu")(graph, torch.cat([past, held[frames]], dim=1), held[frame + 1] - held[frame])


@torch.no_grad()
def taught(frames, count=20):
    """Output of a network with known random weights for a cloud: points [T, N, 3] and tools [T, C, 3], m.

    Its head is set so that the first displacements are 5 mm, and 0 on average.
    """
    weights, head = 1.7 * gs.Dynamics.initial(SMALL, 11).weights, slice(-3 - 3 * SMALL.width, -3)
    weights[-3:] = 0
    tools, points = hands(frames), np.repeat(corners(count, 0)[None], frames, axis=0)
    first = one_step(gs.GsDynamicsModel(weights=weights.numpy(), rules=SMALL), points, tools, 0)
    scale = 0.005 / (first - first.mean(dim=0)).norm(dim=1).mean()
    weights[head], weights[-3:] = weights[head] * scale, -first.mean(dim=0) * scale
    teacher = gs.GsDynamicsModel(weights=weights.numpy(), rules=SMALL)
    for frame in range(frames - 1):
        points[frame + 1] = points[frame] + one_step(teacher, points, tools, frame).numpy()
    return points, tools


@torch.no_grad()
def relative_error(model, points, tools):
    """Mean error of all single steps, relative to how much displacements differ from their mean."""
    wanted = np.diff(points, axis=0)
    found = np.stack([one_step(model, points, tools, frame).numpy() for frame in range(len(wanted))])
    size = np.linalg.norm(wanted - wanted.mean(axis=(0, 1)), axis=2).mean()
    return float(np.linalg.norm(found - wanted, axis=2).mean() / size)


@pytest.mark.usefixtures("plain")
def test_what_a_known_network_made_is_fitted_back():
    points, tools = taught(12)
    sizes = np.linalg.norm(np.diff(points, axis=0), axis=2)
    assert 0.005 < sizes.mean() < 0.03 and points.std(axis=1).min() > 0.01
    trained = train(capture(points, tools), replace(PLAIN, epochs=9, updates_per_epoch=40))
    assert not trained.failure and trained.facts["windows"] == 11
    assert relative_error(trained.model, points, tools) < 0.15


@pytest.mark.usefixtures("plain")
def test_a_killed_training_continues_to_the_same_model(tmp_path):
    points, tools = corners(25, 0)[None] + hands(8)[:, :1] - hands(8)[:1, :1], hands(8)
    noisy = replace(PLAIN, noise=0.002, yaw=True, length_weight=0.1, future=2)
    seen, partial = capture(points, tools), tmp_path / "partial.npz"
    whole = train(seen, noisy, 3)
    np.testing.assert_array_equal(train(seen, noisy, 3).model.weights, whole.model.weights)
    assert (train(seen, noisy, 4).model.weights != whole.model.weights).any()
    train(seen, replace(noisy, epochs=2), 3, partial)
    continued = train(seen, noisy, 3, partial)
    assert continued.attempts == 2 and continued.history.equals(whole.history)
    assert list(whole.history) == ["step", "loss", "position_loss", "length_loss"]
    np.testing.assert_array_equal(continued.model.weights, whole.model.weights)


@pytest.mark.usefixtures("plain")
def test_nothing_after_the_training_frames_is_learned_and_only_frame_0_is_rolled_out():
    points, tools = corners(25, 0)[None] + hands(9)[:, :1] - hands(9)[:1, :1], hands(9)
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


@pytest.mark.usefixtures("plain")
def test_training_that_cannot_go_on_says_so_and_keeps_what_it_had():
    points, tools = corners(25, 0)[None].repeat(4, axis=0), hands(4)
    # Hands that never move a step: nothing is to be learned, and the model's answer is to hold.
    resting = capture(points, hands(4, 0.001))
    still = train(resting, PLAIN)
    assert not still.failure and len(still.history) == 0 and "loss" in still.history
    assert np.ptp(rolled(still.model, resting).trajectory.positions, axis=0).max() == 0
    # Hands that move after the training frames alone: it never learned what to do, and still it does nothing at random.
    late = np.concatenate([hands(4, 0.001), hands(4) + np.array([0.05, 0, 0])])
    moving = capture(corners(25, 0)[None].repeat(8, axis=0), late, train_end=4)
    unprepared = train(moving, PLAIN)
    assert unprepared.failure == "training did not start: no window of a tool that moves 0.01 m in 4 training frames"
    assert np.ptp(rolled(unprepared.model, moving).trajectory.positions, axis=0).max() < 1e-6
    start = gs.Dynamics.initial(SMALL, 0).weights.numpy()
    wild = train(capture(points, tools), replace(PLAIN, learning_rate=1e30))
    assert wild.failure == "training ended early: the loss is not finite (epoch 0, update 1)"
    np.testing.assert_array_equal(wild.model.weights, start)


def test_points_wait_while_the_tools_move_less_than_a_step():
    # 4 mm per frame: steps in frames 3, 6 and 9.
    tools = corners(3, 1)[None] + 0.004 * np.arange(12)[:, None, None] * np.array([0, 1.0, 0])
    seen = capture(corners(25, 0)[None].repeat(12, axis=0), tools.astype(np.float32))
    found = rolled(pushes(0.006), seen)
    along = (found.trajectory.positions - seen.nodes)[:, :, 0]
    assert found.facts["executed_steps"] == 3 and found.facts["tools"] == 3 and found.facts["particles"] == 27
    np.testing.assert_allclose(along.T - np.minimum(np.arange(12), 9) * 0.002, 0, atol=1e-7)
    assert np.abs((found.trajectory.positions - seen.nodes)[:, :, 1:]).max() < 1e-7


def test_points_that_leave_the_scene_end_the_rollout_by_name():
    seen = capture(corners(25, 0)[None].repeat(8, axis=0), hands(8, 0.006))
    trajectory = rolled(pushes(6.0), seen).trajectory
    assert trajectory.diverged_frame == 4 and trajectory.positions.shape == (4, 27, 3)
    assert trajectory.reason == "node 0 left the scene in frame 4" and trajectory.frame_count == 8
    lost = rolled(pushes(3e38), seen).trajectory
    assert lost.diverged_frame == 2 and len(lost.positions) == 2


@pytest.mark.usefixtures("plain")
def test_upside_down_the_same_happens():
    points, tools = corners(25, 0)[None].repeat(6, axis=0), hands(6)
    seen = capture(points, tools)
    turned = {
        name: gs.upright(getattr(seen, name), "-z")
        for name in ("object_points", "controller_points", "surface_points", "interior_points")
    }
    under = replace(seen, **turned, scenario=replace(seen.scenario, up="-z"))
    models = [train(each, PLAIN).model for each in (seen, under)]
    np.testing.assert_array_equal(models[0].weights, models[1].weights)
    above, below = (rolled(models[0], each).trajectory.positions for each in (seen, under))
    np.testing.assert_array_equal(gs.upright(below, "-z"), above)


def test_structure_points_follow_a_rigid_motion_of_particles_exactly():
    turn, shift = Rotation.from_rotvec([0.4, -0.8, 0.3]).as_matrix(), np.array([0.02, 0.0, -0.01])
    particles, points = corners(20, 0) + 0.5, corners(200, 5) + 0.5
    before, after = torch.tensor(particles), torch.tensor((particles @ turn.T + shift).astype(np.float32))
    graph = gs.connect(before[None], torch.ones(1, 20, dtype=torch.bool), torch.zeros(1, 1, 3), SMALL)
    moved = gs.carry(torch.tensor(points), before, gs.turns(graph, before, after), after - before)
    np.testing.assert_allclose(moved.numpy(), points @ turn.T + shift, rtol=0, atol=2e-6)


def test_particles_on_a_line_turn_by_the_least_angle_and_lone_ones_do_not():
    line = torch.tensor([[0.02 * i, 0, 0] for i in range(5)] + [[3.0, 0, 0]])
    bent = torch.tensor([[0, 0.02 * i, 0] for i in range(5)] + [[3.0, 1, 0]])
    graph = gs.connect(line[None], torch.ones(1, 6, dtype=torch.bool), torch.zeros(1, 1, 3), SMALL)
    found = gs.turns(graph, line, bent)
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(found[:5], quarter.expand(5, -1, -1), rtol=0, atol=1e-6)
    torch.testing.assert_close(found[5], torch.eye(3))
