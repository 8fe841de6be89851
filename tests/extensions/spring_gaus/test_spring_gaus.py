"""Spring-Gaus: its forces in closed form, the kernel against the reference, binding, training that cannot end silently, and the
features of VGG16 on weights made here."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import digest_file
from neuspring.extensions.spring_gaus import baseline
from neuspring.extensions.spring_gaus.model import (
    AnchorGraph,
    AnchorParameters,
    AnchorPhysics,
    Follower,
    SpringGausModel,
    SpringGausTraining,
    choose_anchors,
    contraction,
    roll_out,
    soft_vector,
)
from neuspring.extensions.spring_gaus.physics import MIN_ANCHOR_LENGTH, SLACK, AnchorSolver
from neuspring.extensions.spring_gaus.train import FEATURE_WEIGHT, Problem, SpringGausTrainer, load_features, run, silhouette_loss
from tests.support.devices import DEVICES

FRAME = 1 / 30
SMALL = SpringGausTraining(anchors=72, neighbors=12, full_neighbors=8, substeps=150, damping=1.0)


def bar(height=0.3, seed=0):
    """A jittered lattice of 72 points [N, 3], m."""
    lattice = np.stack(np.meshgrid(np.arange(8), np.arange(3), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 3)
    jitter = np.random.default_rng(seed).uniform(-0.002, 0.002, lattice.shape)
    return lattice * 0.02 + jitter + [0, 0, height]


def model_of(anchors, controllers, settings=SMALL, **changed):
    graph = AnchorGraph.between(anchors, controllers, settings.neighbors)
    world = {"frame_time": FRAME, "up_sign": 1.0, "gravity": 9.8, "ground": True} | changed
    return SpringGausModel.start(graph, AnchorPhysics(**world, link_stiffness=3e3), settings)


def test_the_soft_vector_at_its_start():
    eta = soft_vector(torch.zeros(1), 20, 16)
    assert eta[:16].tolist() == [1.0] * 16
    assert eta[16:].tolist() == pytest.approx([1, 0.811, 0.586, 0.318], abs=5e-4)
    # It falls with rank, and never leaves [0, 1].
    steep = soft_vector(torch.tensor([5.0]), 20, 16)
    assert (steep.diff() <= 0).all() and steep.min() >= 0 and steep.max() <= 1


def test_the_order_of_anchors_yaw_and_which_way_is_up_change_nothing_else():
    anchors, frames = bar(height=0.05), 12
    hands = (anchors[:3] + 0.004)[None] + 0.01 * np.arange(frames)[:, None, None] * np.array([0.3, 0.2, 1.0])
    moved, _ = roll_out(model_of(anchors, hands[0]), hands, "cpu")
    order = np.random.default_rng(3).permutation(len(anchors))
    mixed, _ = roll_out(model_of(anchors[order], hands[0]), hands, "cpu")
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    turned, _ = roll_out(model_of(anchors @ turn.T, hands[0] @ turn.T), hands @ turn.T, "cpu")
    mirror = np.array([1.0, 1.0, -1.0])
    below, _ = roll_out(model_of(anchors * mirror, hands[0] * mirror, up_sign=-1.0), hands * mirror, "cpu")
    torch.testing.assert_close(below * torch.tensor(mirror, dtype=torch.float32), moved)
    assert float((moved[-1] - moved[0]).norm(dim=1).mean()) > 0.03, "there is a motion to compare"
    np.testing.assert_allclose(mixed.numpy(), moved.numpy()[:, order], atol=2e-4)
    np.testing.assert_allclose(turned.numpy(), moved.numpy() @ turn.T, atol=2e-4)


def on(device, model, hands):
    """Positions over all frames, and gradients of the first one by everything that is trained, on a device."""
    moved, reason = roll_out(model, hands, device)
    assert not reason
    values = {name: tensor.requires_grad_() for name, tensor in model.tensors(device).items()}
    # Away from rest: springs as good as unstretched exert no force, and rounding would choose which.
    noise = np.random.default_rng(1).normal(size=(2, *model.anchors.shape))
    x = torch.tensor(model.anchors + 0.002 * noise[0], dtype=torch.float32, device=device).requires_grad_()
    v = torch.tensor(0.1 * noise[1], dtype=torch.float32, device=device)
    begin, end = torch.tensor(hands[:2], dtype=torch.float32, device=device)
    after, speed = AnchorSolver(model, model, model.substeps, device).frame(model.parameters(values), x, v, begin, end)
    (100 * after.square().sum() + (speed * torch.arange(3, device=device)).sum()).backward()
    return [moved.cpu(), *(tensor.grad.cpu() for tensor in (x, *values.values()) if tensor.grad is not None)]


@pytest.mark.parametrize("gpu", DEVICES[1:])
def test_a_gpu_moves_a_lifted_bar_as_the_cpu_does(gpu):
    anchors = bar(height=0.05)
    hands = (anchors[:3] + 0.004)[None] + 0.01 * np.arange(12)[:, None, None] * np.array([0.3, 0.2, 1.0])
    (found, *gradients), (wanted, *expected) = (on(device, model_of(anchors, hands[0]), hands) for device in (gpu, "cpu"))
    # Where the state of every frame was moved by 1e-6 of itself on the CPU: 5e-7 m, and 2e-3 of the largest entry.
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
    for gradient, own in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, own, rtol=0, atol=5e-3 * float(own.abs().max()))


def parameters(anchors, ranks, dtype=torch.float64):
    soft = torch.linspace(1, 0.3, ranks, dtype=dtype)
    scalars = (torch.tensor(value, dtype=dtype) for value in (0.02, 0.5))
    return AnchorParameters(torch.full((anchors,), 100.0, dtype=dtype), soft, *scalars)


def reference_substep(
    graph,
    physics,
    parameters,
    x,
    v,
    controllers,
    step,
):
    """(x, v) [N, 3] after one substep of `step` s, under controllers [C, 3] at its end.

    In torch: differentiable, in any precision.
    """
    neighbors = torch.tensor(graph.neighbors, device=x.device).long()
    rest = torch.tensor(graph.lengths, dtype=x.dtype, device=x.device)
    offset = x[neighbors] - x[:, None]
    length = offset.norm(dim=2)
    n = offset / length.clamp(min=MIN_ANCHOR_LENGTH)[..., None]
    stretch = length - rest
    stiff = parameters.stiffness[:, None] / rest * parameters.soft * stretch
    pull = torch.where(stretch.abs() < SLACK, 0.0, stiff * (1 + stretch.abs() / rest) ** physics.exponent)
    closing = ((v[neighbors] - v[:, None]) * n).sum(dim=2)
    force = ((pull + parameters.damping / rest * closing)[..., None] * n).sum(dim=1)
    anchor = torch.tensor(np.repeat(np.arange(len(graph.anchors)), np.diff(graph.link_starts)), device=x.device).long()
    reach = controllers[torch.tensor(graph.links, device=x.device).long()] - x[anchor]
    distance = reach.norm(dim=1, keepdim=True)
    strain = distance / torch.tensor(graph.link_lengths, dtype=x.dtype, device=x.device)[:, None] - 1
    force = force.index_add(0, anchor, reach / distance.clamp(min=MIN_ANCHOR_LENGTH) * strain * physics.link_stiffness)
    force = force + x.new_tensor([0.0, 0.0, -physics.up_sign * physics.gravity])
    v = v + step * force
    x = x + step * v
    if physics.ground:
        below = (physics.up_sign * x[:, 2:] <= 0).expand(-1, 3)
        x = torch.where(below, x * x.new_tensor([1.0, 1.0, 0.0]), x)
        slowed = torch.cat([v[:, :2] * parameters.friction, torch.zeros_like(v[:, 2:])], dim=1)
        v = torch.where(below, slowed, v)
    return x, v


@pytest.mark.parametrize(
    ("dtype", "close", "exponent"), [(torch.float64, 1e-11, 0.5), (torch.float64, 1e-11, 2.0), (torch.float32, 3e-5, 0.0)]
)
def test_a_frame_and_its_gradient_are_those_of_the_reference(dtype, close, exponent):
    anchors = bar(height=0.0)
    controllers = anchors[:3] + 0.01
    graph = AnchorGraph.between(anchors, controllers, 8)
    physics = AnchorPhysics(frame_time=FRAME, link_stiffness=300.0, exponent=exponent)
    solver, draw = AnchorSolver(graph, physics, 20, dtype=dtype), torch.Generator().manual_seed(0)
    noise = torch.randn(2, len(anchors), 3, generator=draw, dtype=torch.float64).to(dtype)
    x, v = torch.tensor(graph.anchors, dtype=dtype) + 0.002 * noise[0], 0.1 * noise[1]
    found = parameters(len(anchors), 8, dtype)
    leaves = [x, v, found.stiffness, found.soft, found.damping, found.friction]
    for leaf in leaves:
        leaf.requires_grad_()
    begin = torch.tensor(controllers, dtype=dtype)
    end = begin + 0.003

    def slowly():
        at, speed = x, v
        for k in range(20):
            f = (k + 1) / 20
            at, speed = reference_substep(graph, physics, found, at, speed, begin * (1 - f) + end * f, FRAME / 20)
        return at, speed

    results = []
    for at, speed in (slowly(), solver.frame(found, x, v, begin, end)):
        loss = 100 * at.square().sum() + (speed * torch.arange(3)).sum()
        results.append([at.detach(), speed.detach(), *torch.autograd.grad(loss, leaves)])
    assert (results[0][0][:, 2] == 0).any(), "the ground is part of it"
    for wanted, received in zip(*results, strict=True):
        torch.testing.assert_close(received, wanted, rtol=0, atol=close * float(wanted.abs().max()))


def test_a_gradient_after_another_frame_is_still_its_own():
    anchors = bar()
    model = replace(model_of(anchors, anchors[:3] + 0.005), link_stiffness=300.0)
    solver = AnchorSolver(model, model, 30, dtype=torch.float64)
    x = torch.tensor(model.anchors, dtype=torch.float64, requires_grad=True)
    hand, found = torch.tensor(anchors[:3] + 0.005), parameters(72, 12)

    def gradient(between):
        after, speed = solver.frame(found, x, torch.zeros_like(x), hand, hand)
        if between:
            solver.frame(found, x + 0.01, speed, hand, hand)
        return torch.autograd.grad(after.square().sum(), x)[0]

    torch.testing.assert_close(gradient(True), gradient(False), rtol=0, atol=0)


def test_binding_by_absolute_positions_shrinks_what_follows_and_says_so():
    anchors = bar()
    follower = Follower(anchors + 0.004, anchors, 16, "cpu")
    np.testing.assert_allclose(follower.weights.sum(dim=1), 1, rtol=1e-6)
    facts = contraction(anchors + 0.004, follower(torch.tensor(anchors)).numpy())
    assert facts["frame0_size_ratio"] < 0.95 and facts["frame0_shift"] > 0.004
    assert contraction(anchors, anchors) == {"frame0_shift": 0.0, "frame0_size_ratio": 1.0}


def test_anchors_lie_in_different_cells_of_the_coarsest_grid_that_has_enough():
    points = np.random.default_rng(0).uniform(0, 0.05, (4000, 3))
    few = choose_anchors(points, 50, np.random.default_rng(1))
    assert len(few) == 50 and len(np.unique(np.floor(few / 0.01), axis=0)) == 50
    assert len(np.unique(choose_anchors(points, 500, np.random.default_rng(1)), axis=0)) == 500
    # There are no more cells than points.
    assert len(choose_anchors(points[:10], 50, np.random.default_rng(1))) <= 10
    with pytest.raises(NumericalFailure, match=r"more anchors than neighbors \(20\) are required; received 3"):
        AnchorGraph.between(bar()[:3], np.zeros((1, 3)), 20)


def swing(frames):
    """Three controllers [T, 3, 3], m, at the bar's end, that move up and down."""
    height = 0.02 * np.sin(0.2 * np.arange(frames))
    return ((bar()[:3] + 0.001)[None] + height[:, None, None] * [0, 0, 1]).astype(np.float32)


def pull_in(iteration, frame, anchors):
    return anchors.square().sum()


def test_what_the_model_made_itself_is_fitted_back():
    hands = swing(12)
    start = model_of(bar(), hands[0])
    truth = replace(start, kappa=np.full(72, 3.1), theta=np.full(1, np.exp(1.3)))
    seen, _ = roll_out(truth, hands, "cpu")

    def objective(iteration, frame, anchors):
        return 1e4 * (anchors - seen[frame]).square().sum(dim=1).mean()

    settings = replace(SMALL, iterations=25, stiffness_rate=0.008, damping_rate=0.004, velocity_rate=1e-5)
    trained = run(Problem(start, hands, objective, settings))
    before, after = ((roll_out(model, hands, "cpu")[0] - seen).norm(dim=2).mean() for model in (start, trained.model))
    assert not trained.failure
    way = (seen[1:] - seen[:-1]).norm(dim=2).sum(dim=0).mean()
    assert after < 0.15 * before and after < 0.025 * way


def test_a_frame_that_fails_gets_more_substeps_and_training_never_ends_silently(capsys, monkeypatch):
    monkeypatch.setattr("neuspring.extensions.spring_gaus.train.SUBSTEPS_ADDED", 150)
    hands = swing(6)
    start = model_of(bar(), hands[0])
    settings = replace(SMALL, iterations=2, substeps=10, max_substeps=160)
    trained = run(Problem(replace(start, substeps=10), hands, pull_in, settings))
    assert not trained.failure and trained.model.substeps == 160
    assert "160 substeps from now on" in capsys.readouterr().out
    stiff = replace(start, kappa=np.full(72, 7.0), substeps=10)
    failed = run(Problem(stiff, hands, pull_in, settings))
    assert failed.failure == "training ended early: the anchors left the scene (iteration 0, frame 1, 160 substeps)"
    np.testing.assert_array_equal(failed.model.kappa, stiff.kappa)


def test_damping_that_is_clamped_can_come_back():
    hands = swing(3)
    start = replace(model_of(bar(), hands[0]), theta=np.ones(1))
    sign = [-1.0]

    def objective(iteration, frame, anchors):
        # First less damping is wanted, then more: what moves by itself is what damping slows.
        return sign[0] * (anchors - torch.tensor(start.anchors)).square().sum()

    settings = replace(SMALL, iterations=1, damping_rate=0.01)
    training = SpringGausTrainer(Problem(start, hands, objective, settings))
    training.epoch(0)
    first = training.values["theta"].item()
    sign[0] = -sign[0]
    for number in range(1, 12):
        training.epoch(number)
    found = [first, training.values["theta"].item()]
    assert min(found) >= 1.0 and max(found) > 1.0


def test_a_failure_keeps_the_parameters_of_the_last_complete_iteration():
    hands = swing(6)

    def objective(iteration, frame, anchors):
        return anchors.square().sum() * (float("nan") if (iteration, frame) == (1, 3) else 1.0)

    settings = replace(SMALL, iterations=3, max_substeps=150)
    start = model_of(bar(), hands[0])
    failed = run(Problem(start, hands, objective, settings))
    whole = run(Problem(start, hands, objective, replace(settings, iterations=1)))
    assert "not finite" in failed.failure and len(failed.history) == 1
    for name in ("kappa", "theta", "velocity"):
        np.testing.assert_array_equal(getattr(failed.model, name), getattr(whole.model, name))


def test_a_killed_training_continues_to_the_same_model(tmp_path, monkeypatch):
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 1)
    monkeypatch.setattr("neuspring.extensions.spring_gaus.train.SUBSTEPS_RAISED", (1,))
    hands = swing(6)
    start = model_of(bar(), hands[0])
    partial = tmp_path / "partial.npz"

    def objective(iteration, frame, anchors):
        if iteration == stop:
            raise KeyboardInterrupt
        return anchors.square().sum()

    settings = replace(SMALL, iterations=4, substeps=50)
    stop = 4
    whole = run(Problem(start, hands, objective, settings))
    stop = 2
    with pytest.raises(KeyboardInterrupt):
        run(Problem(start, hands, objective, settings), partial, "key")
    stop = 4
    continued = run(Problem(start, hands, objective, settings), partial, "key")
    assert continued.attempts == 2 and continued.model.substeps == 100
    for name in ("kappa", "soft", "theta", "rho", "velocity"):
        np.testing.assert_array_equal(getattr(continued.model, name), getattr(whole.model, name))
    assert continued.history.equals(whole.history)


@pytest.fixture
def network():
    """Layers 0 to 8 of torchvision's `features`, with random weights."""
    torch.manual_seed(0)
    convolutions = [torch.nn.Conv2d(before, after, 3, padding=1) for before, after in ((3, 64), (64, 64), (64, 128), (128, 128))]
    first, second, third, fourth = convolutions
    relu, pool = torch.nn.ReLU(), torch.nn.MaxPool2d(2, 2)
    return torch.nn.Sequential(first, relu, second, relu, pool, third, relu, fourth, relu)


def stored(network, folder):
    path = folder / "vgg16.pth"
    torch.save({f"features.{name}": value for name, value in network.state_dict().items()}, path)
    return path


def test_features_are_those_of_the_network(network, tmp_path):
    features = load_features(stored(network, tmp_path), "cpu")
    pictures = torch.rand(2, 3, 20, 28, generator=torch.Generator().manual_seed(1))
    shift, scale = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    wanted = network((pictures - shift[:, None, None]) / scale[:, None, None])
    assert wanted.shape == (2, 128, 10, 14)
    torch.testing.assert_close(features(pictures), wanted)


def test_the_term_of_the_loss_is_weighted_and_differentiable(network, tmp_path):
    features = load_features(stored(network, tmp_path), "cpu")
    drawn = torch.rand(16, 24, generator=torch.Generator().manual_seed(2), requires_grad=True)
    mask = (drawn.detach() > 0.5).float()
    term = silhouette_loss(drawn, mask, features) - silhouette_loss(drawn, mask, None)
    found = features(torch.stack([drawn, mask])[:, None].expand(-1, 3, -1, -1))
    torch.testing.assert_close(term, FEATURE_WEIGHT * (found[0] - found[1]).square().mean(), rtol=1e-4, atol=1e-6)
    term.backward()
    assert drawn.grad.abs().sum() > 0


def test_a_file_is_known_by_its_digest_and_a_damaged_one_is_named(network, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert "vgg16-397923af.pth is not there" in baseline.find_vgg16()
    path = tmp_path / "hub" / "checkpoints" / baseline.VGG16
    path.parent.mkdir(parents=True)
    stored(network, tmp_path).rename(path)
    assert "vgg16-397923af.pth has SHA-256" in baseline.find_vgg16()
    monkeypatch.setattr(baseline, "DIGEST", digest_file(path)[:8])
    assert baseline.find_vgg16() == path
    damaged = stored(network[:-2], tmp_path)
    with pytest.raises(InputError, match=r"`features\.7\.weight` must be a finite float tensor \[128, 128, 3, 3\]"):
        load_features(damaged, "cpu")
