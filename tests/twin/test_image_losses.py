"""Losses in the image: closed forms, gradients through projection and simulator, residuals, searches."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.config import Losses
from neuspring.twin.candidates import SearchProblem, candidate
from neuspring.twin.fit import TwinFit
from neuspring.twin.losses import BETA, FrameLoss
from neuspring.twin.search import search
from neuspring.twin.transfer import move
from neuspring.twin.trials import motions
from tests.support import colored, small
from tests.support.searches import assert_same_trace

ALL = Losses(image_track=1.0, silhouette=1.0)


def loss_of(weights: Losses = ALL, **image: torch.Tensor) -> FrameLoss:
    """The loss of the scene as one camera sees it, in double precision; `image` replaces what it saw."""
    loss = FrameLoss.of(colored.observed(), weights, "cpu", torch.float64)
    return replace(loss, image=replace(loss.image, **image))


def truth(frame: int) -> torch.Tensor:
    return torch.tensor(np.asarray(small.scene().observations.object_points[frame]), dtype=torch.float64)


def nodes_of(frame: int) -> torch.Tensor:
    """Nodes of frame 0, tracked ones where they are in a frame."""
    nodes = torch.tensor(colored.observed().nodes, dtype=torch.float64)
    nodes[: len(truth(frame))] = truth(frame)
    return nodes


def problem_of(**changes: object) -> SearchProblem:
    return small.search_problem(colored.observed(), **changes)


def test_tracks_of_the_truth_cost_nothing_and_a_shift_in_the_image_its_square():
    image = loss_of().image

    def cost(pixels: float) -> float:
        shifted = loss_of(pixels=image.pixels + torch.tensor([pixels, 0.0]))
        return float(shifted.terms(2, nodes_of(2))["image_track"])

    assert cost(0.0) == pytest.approx(0.0, abs=1e-12)
    error = 3.0 * image.size
    assert error < BETA
    # Half a square in one of two axes.
    assert cost(3.0) == pytest.approx(error**2 / 4, rel=1e-4)
    assert cost(100.0) == pytest.approx(BETA * (100 * image.size - BETA / 2) / 2, rel=1e-4)


def test_silhouettes_measure_distances_in_the_image():
    whole = loss_of()
    image, u = whole.image, whole.image.project(nodes_of(1))[: whole.surface]

    def cost(inside: torch.Tensor) -> float:
        loss = loss_of(inside=inside, outside=torch.zeros_like(image.outside))
        return float(loss.terms(1, nodes_of(1))["silhouette"])

    assert cost(u.expand(len(image.inside), -1, -1)) == pytest.approx(0.0, abs=1e-12)
    # One point 50 px beyond the node that is farthest to the left.
    left = u[u[:, 0].argmin()] - torch.tensor([50.0, 0.0])
    assert cost(left.expand(len(image.inside), 1, 2)) == pytest.approx((50 * image.size) ** 2, rel=1e-6)


def test_nodes_that_leave_object_and_hands_cost_their_distance():
    image = loss_of().image
    ramp = (torch.arange(image.outside.shape[2], dtype=torch.float64) * image.cell).expand(image.outside.shape)
    moved = replace(image, outside=ramp)
    u = torch.tensor([[20.0, 30.0], [41.5, 77.0]], dtype=torch.float64)
    # The center of column j is at 4 j + 1.5.
    torch.testing.assert_close(moved.distance(1, u), u[:, 0] - 1.5)
    assert float(moved.distance(1, torch.tensor([[-50.0, 30.0]], dtype=torch.float64))) == 0.0


@pytest.mark.parametrize("name", ["image_track", "silhouette"])
def test_gradients_through_the_projection(name):
    loss = loss_of(Losses(**{"image_track": 0.0, "silhouette": 0.0} | {name: 1.0}))
    rng = np.random.default_rng(0)
    x = (nodes_of(3) + 0.004 * torch.tensor(rng.normal(size=nodes_of(3).shape))).requires_grad_()
    # Large numbers, so that gradcheck's absolute tolerance says something.
    assert torch.autograd.gradcheck(lambda nodes: 1e4 * loss.terms(3, nodes)[name], (x,), eps=1e-7, atol=1e-4, rtol=1e-3)


def test_captures_with_depth_have_no_image_losses():
    assert FrameLoss.of(small.observations(), ALL, "cpu").image is None


def test_a_candidates_cost_is_that_of_its_rollout_and_of_its_residuals():
    problem = problem_of(losses=replace(ALL, acceleration=0.01))
    loss = FrameLoss.of(problem.observations, problem.losses, "cpu")
    values = problem.decode(problem.encode())
    others = values | {"stiffness": 2e4}
    twins = [candidate(problem, one) for one in (values, others)]
    together, alone = small.judge(problem, twins, loss), [small.judge(problem, [twin], loss)[0] for twin in twins]
    assert together == alone
    assert together[0].cost != together[1].cost
    own = problem.recordings[0]
    start = own.velocity
    x, v = motions(twins, own.hands, start, "cpu")
    for k, outcome in enumerate(together):
        states = [(frame, x[frame - 1, k], v[frame - 1, k]) for frame in range(1, len(x) + 1)]
        assert small.rollout_loss(loss, states, start) == pytest.approx(outcome.cost, rel=1e-5)


@pytest.mark.parametrize("name", ["image_track", "silhouette"])
def test_gradients_of_stiffness_through_projection_and_simulator(name):
    """An epoch's gradient against the slope of its loss over shifts so short that no contact begins.

    One central difference catches the kinks of nearest points: with other pixels of the silhouette it was 6 % off.
    """
    weights = Losses(**{"image_track": 0.0, "silhouette": 0.0} | {name: 1.0})
    problem = problem_of()
    twin = candidate(problem, problem.decode(problem.encode()))
    twin = replace(twin, simulation=replace(twin.simulation, substeps=100))
    settings = config.Fit(horizon=0, learning_rate=1e-12, epochs=1, global_stiffness=True)
    simulation = config.SimulationSettings(substeps=100)

    def loss_at(shift: float) -> tuple[float, float]:
        run = TwinFit(small.fit_problem(problem.observations, twin=twin, fit=settings, simulation=simulation, losses=weights))
        with torch.no_grad():
            run.parameters.factors["stiffness"] += shift
        (own,) = run.recordings
        mean = small.done(own.simulate(own.rest, range(1, own.fitted_end), own.stable(run.parameters)))[1]
        mean.backward()
        return float(mean.detach()), float(run.parameters.factors["stiffness"].grad)

    shifts = np.linspace(-0.001, 0.001, 9)
    slope = np.polyfit(shifts, [loss_at(shift)[0] for shift in shifts], 1)[0]
    assert loss_at(0.0)[1] == pytest.approx(slope, rel=0.05)


def test_a_search_reads_training_frames_alone():
    problem = problem_of(search=config.Search(rollouts=33))
    found = search(problem, 0)
    assert found.cost < 0.8 * found.trace["cost"].iloc[0]
    later = slice(problem.observations.scenario.train_end, None)
    image, hands = problem.observations.image, problem.observations.controller_points.copy()
    pixels, visible = image.pixels.copy(), image.visible.copy()
    pixels[later], visible[later], hands[later] = 7.0, True, 0.5
    spoiled = replace(problem.observations, controller_points=hands, image=replace(image, pixels=pixels, visible=visible))
    assert_same_trace(search(replace(problem, observations=spoiled), 0).trace, found.trace)


def test_recordings_of_color_alone_form_a_pool():
    alone, other = problem_of(losses=ALL), colored.observed("rope/shake/smooth")
    each = (alone, replace(alone, pool=(other,)))
    one, mean = (small.evaluated(problem, [alone.encode()])[0]["cost"] for problem in each)
    # The cost of the other recording is its own error in the image.
    twin = move(candidate(alone, alone.decode(alone.encode())), other, keep_frame_time=False)
    moved = small.judge(small.search_problem(other), [twin], FrameLoss.of(other, ALL, "cpu"))[0].cost
    assert mean == pytest.approx((one + moved) / 2, rel=1e-12)
    assert moved != one
