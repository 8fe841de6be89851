"""GS-Dynamics: its graph, its network's symmetries, training windows and losses, against values worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.baselines.gs_dynamics.model import (
    Dynamics,
    Graph,
    GsDynamicsModel,
    Rules,
    connect,
    edge_inputs,
    node_inputs,
    preset_name,
    resolve,
    sample,
    weight_count,
)
from neuspring.baselines.gs_dynamics.train import (
    Tracks,
    Windows,
    ahead,
    draw,
    length_loss,
    ordinary,
    past,
    pick,
    position_loss,
    smoothed,
    window_frames,
)
from neuspring.config.baselines import GsDynamics
from neuspring.core.errors import InputError

RULES, RECIPE = resolve(GsDynamics(width=16), "sloth")


def cloud(count: int = 12, seed: int = 0) -> torch.Tensor:
    """Points [N, 3] in a cube of 10 cm."""
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 0.1


def graph_of(points: torch.Tensor, tools: torch.Tensor, rules: Rules = RULES) -> Graph:
    return connect(points[None], torch.ones(1, len(points), dtype=torch.bool), tools[None], rules)


def pairs(graph: Graph) -> set[tuple[int, int]]:
    return set(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True))


@torch.no_grad()
def moves(points: torch.Tensor, tools: torch.Tensor, rules: Rules = RULES) -> torch.Tensor:
    """Displacements of random weights: two earlier positions, and an action that differs from tool to tool."""
    drift = torch.linspace(0.02, 0, 3, dtype=points.dtype)[:, None, None] * torch.tensor([0.5, 0.2, -0.3])
    history = torch.cat([points, tools])[None] - drift
    action = 0.01 * (tools - tools.mean(dim=0)) / 0.05
    network = Dynamics.of(rules, Dynamics.initial(rules, 3).weights.to(points.dtype))
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
    graph = connect(points, used, torch.zeros(2, 1, 3), RULES)
    assert graph.particles == 4
    part = torch.tensor([0, 0, 1, 1, 0, 1])
    assert (part[graph.receivers] == part[graph.senders]).all() and len(graph.receivers) == 2 * (4 + 4)


def test_particles_are_spread_until_they_cover():
    points = torch.stack([torch.linspace(0, 1, 11), torch.zeros(11), torch.zeros(11)], dim=1)[None].repeat(2, 1, 1)
    usable = torch.ones(2, 11, dtype=torch.bool)
    usable[1, 10] = False
    first = torch.tensor([0, 2])
    chosen, used = sample(points, usable, 3, 0.0, first)
    assert chosen.tolist() == [[0, 10, 5], [2, 9, 5]] and used.all()
    chosen, used = sample(points, usable, 11, 0.45, first)
    assert chosen[0][used[0]].tolist() == [0, 10, 5] and chosen[1][used[1]].tolist() == [2, 9]
    assert pick(usable, torch.tensor([0.0, 0.999])).tolist() == [0, 9]


def test_input_sizes_are_those_of_the_public_code():
    points, tools = cloud(), cloud(2, 1)
    history, graph = torch.cat([points, tools]).expand(3, -1, -1), graph_of(points, tools)
    short = replace(RULES, heights=False)
    assert node_inputs(RULES, graph, history, tools).shape == (14, 14) and RULES.node_size == 14
    assert node_inputs(short, graph, history, tools).shape == (14, 5) and short.node_size == 5
    assert edge_inputs(graph, history).shape[1] == 14 == RULES.edge_size
    of_node = node_inputs(RULES, graph, history, tools)[12]
    assert of_node.tolist() == pytest.approx([0, 1, *[float(tools[0, 2])] * 3, *[0] * 6, *tools[0].tolist()])
    full = resolve(GsDynamics(), "sloth")[0]
    assert weight_count(full) == len(Dynamics.initial(full, 0).weights) == 2_904_579


def test_weights_keep_their_order_in_the_vector_and_their_first_draws():
    """Saved models depend on the order; a run can be repeated only if the draws stay."""
    network = Dynamics.initial(replace(RULES, width=4), 5)
    encoders = [f"{part}.{i}" for part in ("node", "edge") for i in (0, 2, 4)]
    layers = [*encoders, "relation", "particle", "head.0", "head.2", "head.4"]
    names = [name for name, _ in network.named_parameters()]
    assert names == [f"{layer}.{part}" for layer in layers for part in ("weight", "bias")]
    first = 4 * (RULES.node_size + 1)
    draws = torch.rand(first, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(network.weights[:first], (draws * 2 - 1) / RULES.node_size**0.5, rtol=0, atol=0)
    again = Dynamics.of(network.rules, network.weights)
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
    settings = GsDynamics(width=8, noise=0.0, batch=4)
    rules, recipe = resolve(settings, "sloth")
    windows = Windows.of(walk(10), settings, "cpu")
    turned, plain = (draw(windows, rules, replace(recipe, yaw=yaw), torch.Generator().manual_seed(0)) for yaw in (True, False))
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


def walk(frames: int, count: int = 30) -> Tracks:
    """A cloud that follows two tools, 12 mm per frame."""
    way = 0.012 * np.arange(frames)[:, None, None] * np.array([1.0, 0, 0])
    points, tools = ((cloud(n, seed).numpy() + way).astype(np.float32) for n, seed in ((count, 0), (2, 1)))
    return Tracks(points, np.ones((frames, count), dtype=bool), tools, 0)


def test_steps_of_a_window_are_of_tool_motion():
    way = np.array([0.0, 0.004, 0.0101, 0.0125, 0.0205, 0.0285])
    tools = np.zeros((6, 2, 3))
    tools[:, 1, 0] = way
    assert past(tools, 4, 0.01) == [0, 2, 4]
    assert past(tools, 2, 0.01) == [0, 0, 2] and past(tools, 1, 0.01) == [1, 1, 1]
    assert ahead(tools, 0, 0.01, 5) == [2, 4, 5, 5, 5], "the last frame needs three quarters of a step"
    assert ahead(tools, 0, 0.01, 1) == [2] and ahead(tools, 5, 0.01, 5) == []
    frames = window_frames(tools, GsDynamics())
    assert frames[:, 2].tolist() == [0, 1, 2, 3, 4] and frames.shape == (5, 8)
    assert window_frames(tools[:, :1], GsDynamics()).shape == (0, 8)


def test_unseen_tracks_are_no_particles_and_no_targets(monkeypatch):
    tracks = walk(12)
    visible = tracks.visible.copy()
    visible[6, :5] = False
    points = np.where(visible[..., None], tracks.points, 100.0).astype(np.float32)
    hidden = replace(tracks, points=points, visible=visible)
    settings = GsDynamics(width=8, batch=16, noise=0.0)
    rules, recipe = resolve(settings, "sloth")
    windows = Windows.of(hidden, settings, "cpu")
    touched = (windows.frames == 6).any(dim=1)
    assert touched.any() and not windows.usable[touched, :5].any() and windows.usable[~touched].all()
    batch = draw(windows, rules, recipe, torch.Generator().manual_seed(0))
    assert batch.history.abs().max() < 1 and batch.targets.abs().max() < 1 and batch.known.all()
    # Too few are seen throughout: those seen in the history take part, and what is not seen is no target.
    monkeypatch.setattr("neuspring.baselines.gs_dynamics.train.MIN_VISIBLE", 28)
    windows = Windows.of(hidden, settings, "cpu")
    in_history = (windows.frames[:, :3] == 6).any(dim=1)
    assert not windows.usable[in_history, :5].any() and windows.usable[~in_history].all()
    batch = draw(windows, replace(rules, coverage=0.0), recipe, torch.Generator().manual_seed(0))
    assert batch.history.abs().max() < 1
    assert (batch.known == (batch.targets.abs().amax(dim=2) < 50)).all() and not batch.known.all()
    assert float(position_loss(batch.targets[3] + 0.5, batch.targets[3], batch.known[3])) == pytest.approx(0.25, rel=1e-3)


def test_tracks_of_unusual_length_are_dropped_unless_all_move_as_one():
    still, ahead_of = np.zeros((5, 9, 3)), np.arange(5)[:, None] * np.array([1, 1.1, 0.9, 1, 1.05, 0.95, 1, 5, 0])
    seen = np.ones((5, 9), dtype=bool)
    seen[1:, 0] = False
    points = still + ahead_of[..., None] * [0.01, 0, 0]
    assert ordinary(points, seen, 3.0).tolist() == [False, True, True, True, True, True, True, False, False]
    assert ordinary(points, seen, 0.0).all()
    assert ordinary(points[:, [3, 3, 3]], seen[:, 1:4], 3.0).all()


def test_smoothing_stays_within_what_is_seen():
    points = np.zeros((6, 1, 3), dtype=np.float32)
    points[:, 0, 0] = [0, 3, 0, 99, 6, 0]
    visible = np.array([True, True, True, False, True, True])[:, None]
    assert smoothed(points, visible, 1)[:, 0, 0].tolist() == [1.5, 1, 1.5, 99, 3, 3]
    np.testing.assert_array_equal(smoothed(points, visible, 0), points)


def test_the_length_loss_by_hand():
    # Two particles that feel themselves, each other, and one of them a tool, node 2.
    graph = Graph(torch.tensor([0, 1, 0, 1, 0, 2]), torch.tensor([0, 1, 1, 0, 2, 0]), 2)
    before = torch.tensor([[3.0, 0, 0], [3, 4, 0]])
    assert float(length_loss(graph, before + torch.tensor([3.0, 0, 0]), before)) == 0
    stretched = torch.tensor([[3.0, 0, 0], [3, 6, 0]], requires_grad=True)
    loss = length_loss(graph, stretched, before)
    assert float(loss.detach()) == pytest.approx(2 * 4 / 4)
    loss.backward()
    wanted = torch.tensor([[0.0, -2, 0], [0, 2, 0]])
    # Edges of length 0 have none.
    torch.testing.assert_close(stretched.grad, wanted)


def test_the_mean_of_errors_by_hand():
    after, target = torch.ones(4, 3), torch.zeros(4, 3)
    known = torch.tensor([True, True, False, False])
    after[0] = 2
    assert float(position_loss(after, target, known)) == pytest.approx((4 + 1) / 2)


def test_presets_and_what_replaces_them():
    named = [preset_name(GsDynamics(), name) for name in ("rope", "DLO1", "cloth", "package", "sloth", "blob")]
    assert named == ["rope", "rope", "cloth", "cloth", "animals", "animals"]
    rules, recipe = resolve(GsDynamics(preset="cloth", noise=0.0, neighbors=9), "rope")
    assert (rules.neighbors, rules.particles, recipe.noise, recipe.length_weight, recipe.batch) == (9, 150, 0.0, 0.1, 64)
    assert not resolve(GsDynamics(), "rope")[0].heights and rules.heights


def test_wrong_settings_and_weights_are_refused():
    with pytest.raises(InputError, match="tools: unknown key"):
        config.parse(GsDynamics, {"tools": "centroids"}, "here")
    with pytest.raises(InputError, match=r"gs_dynamics.weights: \d+ weights are required; received 7"):
        GsDynamicsModel(weights=np.zeros(7), rules=RULES)
