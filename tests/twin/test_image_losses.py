"""Losses in the image: closed forms, gradients through projection and simulator, residuals, searches."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.config import Losses
from neuspring.physics.solver import solver_for
from neuspring.twin.candidates import SearchProblem, candidate
from neuspring.twin.losses import BETA, FrameLoss
from neuspring.twin.rollout import frames
from neuspring.twin.search import search
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
    for twin, outcome in zip(twins, together, strict=True):
        states = frames(twin, solver_for(twin, differentiable=False), own.hands)
        assert small.rollout_loss(loss, states, own.velocity) == pytest.approx(outcome.cost, rel=1e-5)


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
