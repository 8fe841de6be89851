"""Training losses against golden values (tests/golden/m05) and their rules."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.config import Losses
from neuspring.twin import losses
from neuspring.twin.candidates import candidate
from neuspring.twin.fit import TwinFit
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import roll_out
from tests.support import small

GOLDEN = {float: 1e-12, "float32": 1e-5}
"""Relative: the golden README accepts 1e-5 from float32; values are float64 sums of some 100 terms of float32 inputs."""
CASES = range(3)


@pytest.fixture(scope="module")
def golden():
    with np.load(Path(__file__).parents[1] / "golden/m05_train_losses.npz", allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def dtype(request):
    return request.param


def tolerance(dtype: torch.dtype) -> float:
    return GOLDEN[float] if dtype == torch.float64 else GOLDEN["float32"]


def case(golden: dict[str, np.ndarray], k: int, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    names = ("pred", "gt", "visible", "motion_valid", "v_start", "v_end", "prev_acc")
    values = {name: torch.tensor(golden[f"{name}{k}"]) for name in names}
    return {name: value.to(dtype) if value.is_floating_point() else value for name, value in values.items()}


def assert_close(got: torch.Tensor, wanted: np.ndarray, relative: float):
    """Relative to the largest entry."""
    scale = float(np.abs(wanted).max()) or 1.0
    np.testing.assert_allclose(got.detach().double().numpy() / scale, wanted / scale, atol=relative, rtol=0)


def test_gradients_of_many_points_are_equal_in_every_call_with_two_threads():
    points = torch.rand(1, 40_000, 3, generator=torch.Generator().manual_seed(0)).expand(2, -1, -1)
    all_seen = torch.ones(points.shape[:2], dtype=torch.bool)
    loss, nodes = FrameLoss(points, all_seen, all_seen, 100, Losses(track=0.0)), points[0, :100].clone().requires_grad_()
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        first, *others = (torch.autograd.grad(loss(1, nodes), nodes)[0] for _ in range(8))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(first, other) for other in others)


@pytest.mark.parametrize("k", CASES)
def test_golden_terms(golden, k, dtype):
    """Small errors, errors beyond 1 m, nothing visible: values and gradients of each term, and their sum."""
    c = case(golden, k, dtype)
    points, visible, valid = (torch.stack([c[name]] * 2) for name in ("gt", "visible", "motion_valid"))
    loss = FrameLoss(points, visible, valid, int(golden[f"num_surface_points{k}"]), Losses())
    nodes = c["pred"].requires_grad_()
    terms = loss.terms(1, nodes, c["v_end"] - c["v_start"] - c["prev_acc"])
    for name, short in (("chamfer", "chamfer"), ("track", "track")):
        (gradient,) = torch.autograd.grad(terms[name], nodes, retain_graph=True)
        assert_close(terms[name], golden[f"exp_{short}{k}"], tolerance(dtype))
        assert_close(gradient, golden[f"exp_{short}_grad{k}"], tolerance(dtype))
    assert_close(terms["acceleration"], golden[f"exp_acc{k}"], tolerance(dtype))
    assert_close(sum(terms.values()), golden[f"exp_total{k}"], tolerance(dtype))


def test_ties_go_to_the_lowest_index():
    nodes = torch.tensor([[9.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0]])
    assert losses.nearest(torch.zeros(2, 3), nodes).tolist() == [1, 1]
    assert losses.nearest(torch.zeros(1, 3), nodes.flip(0)).tolist() == [0]


def test_the_track_loss_is_linear_beyond_one_meter():
    nodes, seen = torch.tensor([[0.5, 2.0, 0.0]], requires_grad=True), torch.ones(2, 1, dtype=torch.bool)
    value = FrameLoss(torch.zeros(2, 1, 3), ~seen, seen, 1, Losses())(1, nodes)
    assert value.item() == pytest.approx((0.5**2 / 2 + 1.5) / 3)
    value.backward()
    np.testing.assert_allclose(nodes.grad, [[0.5 / 3, 1 / 3, 0.0]])


def test_nothing_seen_is_zero_with_a_gradient():
    nodes = torch.rand(4, 3, requires_grad=True)
    nobody = torch.zeros(2, 2, dtype=torch.bool)
    total = FrameLoss(torch.rand(2, 2, 3), nobody, nobody, 3, Losses())(1, nodes)
    total.backward()
    assert total.item() == 0.0
    assert not nodes.grad.any()


def frame_loss(*, frozen: bool = False, weights: Losses | None = None) -> tuple[FrameLoss, torch.Tensor]:
    """Three frames of two points; frame 1 sees both, frame 2 sees one; one motion is valid in each of frames 0 and 1."""
    points = torch.tensor([[[0.0, 0, 0], [1, 0, 0]], [[0.1, 0, 0], [1.1, 0, 0]], [[0.2, 0, 0], [1.2, 0, 0]]])
    visible = torch.tensor([[True, True], [True, True], [False, True]])
    valid = torch.tensor([[True, True], [False, True], [False, False]])
    nodes = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.2, 0.0, 0]])
    return FrameLoss(points, visible, valid, 2, weights or Losses(), frozen), nodes


def test_frames_use_their_visibility_and_the_motion_before():
    loss, nodes = frame_loss()
    near, moved = loss.terms(1, nodes).values()
    assert near.item() == pytest.approx(0.01)
    assert moved.item() == pytest.approx(2 * 0.005 / 6)
    near, moved = loss.terms(2, nodes).values()
    # Only point 1 is visible, and node 2, which would be nearer, is not surface; only its motion 1 -> 2 is valid.
    assert near.item() == pytest.approx(0.04)
    assert moved.item() == pytest.approx(0.02 / 3)
    assert loss(2, nodes).item() == pytest.approx(0.04 + 0.02 / 3)


def test_frozen_counts_divide_by_frame_one():
    """Released quirk 4: frame 2 sees one point and one motion, but is divided by frame 1's two and two."""
    plain, nodes = frame_loss()
    frozen, _ = frame_loss(frozen=True)
    assert torch.equal(frozen(1, nodes), plain(1, nodes))
    for got, wanted in zip(frozen.terms(2, nodes).values(), plain.terms(2, nodes).values(), strict=True):
        assert got.item() == pytest.approx(wanted.item() / 2)


def test_every_term_has_a_weight_of_its_name_and_a_weight_of_zero_leaves_it_out():
    assert set(losses.TERMS) == {spec.name for spec in fields(Losses)}
    for name in ("chamfer", "track"):
        loss, nodes = frame_loss(weights=replace(Losses(), **{name: 0.0}))
        full = frame_loss()[0].terms(1, nodes)
        del full[name]
        assert loss.terms(1, nodes) == full
    loss, nodes = frame_loss(weights=Losses(chamfer=0.0, track=0.0))
    assert loss(1, nodes.requires_grad_()).requires_grad, "a fit without terms stays where it is"


@dataclass(frozen=True, kw_only=True)
class Weights(Losses):
    """A weight more: the first place of a new term."""

    height: float = 1.0


def height(loss: FrameLoss, state: losses.FrameState) -> torch.Tensor:
    """The second place, with its name in TERMS: nodes are wanted in the plane z = 0.1 m."""
    return (state.x[:, 2] - 0.1).square().mean()


def test_a_new_term_is_a_weight_and_a_function(monkeypatch):
    """Search and fit follow: their costs of a rollout agree, with that of the term itself."""
    monkeypatch.setitem(losses.TERMS._own, "height", height)
    weights = Weights(chamfer=0.0, track=0.0, acceleration=0.0)
    problem = small.search_problem(losses=weights)
    twin = candidate(problem, small.start_values())
    loss = FrameLoss.of(problem.observations, weights, "cpu")
    (searched,) = small.judge(problem, [twin], loss)
    x = roll_out(twin, problem.recordings[0].hands.numpy()).positions[1:]
    expected = float(np.square(x[..., 2].astype(float) - 0.1).mean())
    assert searched.cost == pytest.approx(expected, rel=1e-5)
    fitted = small.done(TwinFit(small.fit_problem(losses=weights, twin=twin, fit=config.Fit(horizon=0))).epoch())["loss"]
    assert fitted == pytest.approx(expected, rel=1e-5)
