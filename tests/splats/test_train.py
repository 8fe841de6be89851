"""Training: known splats are recovered, density adapts, losses are what they say, bad views are named."""

import dataclasses

import numpy as np
import pytest
import torch

from neuspring.config.images import Appearance
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.scenes.render import looking
from neuspring.scores.pictures import psnr
from neuspring.splats.draw import prune_by_opacity
from neuspring.splats.losses import Shot, loss
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.train import SplatRates, Statistics, densify, extent_of, first_splats, train
from neuspring.splats.view import C0, View, harmonic_colors
from tests.support.filmed import EYES, intrinsics

SIZE = (96, 64)
HELD_OUT = (0.1, -0.55, 0.35)
FAST = SplatRates(iterations=300, degree=0)


@pytest.fixture
def dense(monkeypatch):
    """Sets when and where density adapts: `dense(FROM=5)` sets train.DENSIFY_FROM."""

    def change(**values):
        for name, value in values.items():
            monkeypatch.setattr(f"neuspring.splats.train.{name}", value)

    return change


def view_from(eye, size=SIZE):
    return View.of(looking(np.array(eye), np.array([0.0, 0.0, 0.06])), intrinsics(size), *size)


def known_splats(count=200):
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(count, 3))
    means = 0.06 * towards / np.linalg.norm(towards, axis=1, keepdims=True) * [1.3, 1, 0.8] + [0, 0, 0.06]
    shades = (rng.uniform(0.1, 0.9, (count, 1, 3)) - 0.5) / C0
    return Splats(
        means=means,
        quaternions=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.log(rng.uniform(0.006, 0.012, (count, 1))),
        opacity_logits=rng.uniform(0.5, 3.0, count),
        harmonics=shades,
    )


def shot_of(splats, view, name="0", hands=None):
    """Image of splats; the mask is where they cover more than half."""
    with torch.no_grad():
        rendered = Gaussians.of(splats).draw(view)
    mask = (rendered.alpha > 0.5).numpy()
    color = np.round(255 * rendered.rgb.clamp(0, 1).numpy()).astype(np.uint8)
    covered = np.zeros_like(mask) if hands is None else hands
    return Shot.of(name, view, color, mask & ~covered, covered, rendered.depth.numpy(), 0.0)


def shots_of(splats):
    return [shot_of(splats, view_from(eye), str(k)) for k, eye in enumerate(EYES)]


def quality(splats, shot):
    with torch.no_grad():
        rendered = Gaussians.of(splats).draw(shot.view)
    return float(psnr((rendered.rgb * shot.mask[..., None]).permute(2, 0, 1), shot.color.permute(2, 0, 1)))


def test_known_splats_are_recovered_from_three_views():
    truth = known_splats()
    shots, held_out = shots_of(truth), shot_of(truth, view_from(HELD_OUT))
    rng = np.random.default_rng(1)
    points = truth.means + rng.normal(0, 0.002, truth.means.shape)
    start = first_splats(points, rng.uniform(0.3, 0.7, (len(points), 3)), FAST, 0.002)
    # No part of the loss may ask for hard edges, which the truth does not have.
    settings = dataclasses.replace(FAST, mask=0.0, position_rate=1e-3, scale_rate=0.01, opacity_rate=0.05, color_rate=0.02)
    splats = train(start, shots, settings, 0, "warp").splats
    assert min(quality(splats, shot) for shot in shots) > 35
    # Three views leave freedom; the fourth must still look alike.
    assert quality(splats, held_out) > 25


def test_training_is_deterministic_and_follows_its_seed(dense):
    truth = known_splats(40)
    shots = shots_of(truth)
    dense(DENSIFY_FROM=5, DENSIFY_EVERY=10, DENSIFY_GRADIENT=1e-5)
    settings = dataclasses.replace(FAST, iterations=40, degree=1)
    start = first_splats(truth.means, np.full((40, 3), 0.5), settings, 0.002)
    one, same, other = (train(start, shots, settings, seed, "warp").splats for seed in (0, 0, 1))
    assert np.array_equal(one.means, same.means)
    assert np.array_equal(one.harmonics, same.harmonics)
    assert one.means.shape != other.means.shape or not np.array_equal(one.means, other.means)


def test_the_number_of_splats_grows_where_they_are_too_coarse(dense):
    truth = known_splats()
    shots = shots_of(truth)
    settings = dataclasses.replace(FAST, iterations=160, position_rate=1e-3)
    start = first_splats(truth.means[::10], np.full((20, 3), 0.5), settings, 0.002)
    fixed = train(start, shots, settings, 0, "warp")
    dense(DENSIFY_FROM=40, DENSIFY_EVERY=40)
    grown = train(start, shots, settings, 0, "warp")
    assert len(grown.splats.means) > 2 * len(start.means) == 2 * grown.first
    assert grown.history["loss"][-1] < fixed.history["loss"][-1]
    assert grown.history["splats"][-1] == len(grown.splats.means)


def named(splats):
    return dict(vars(Gaussians.of(splats)))


def test_densify_clones_small_splits_large_and_removes_faint_and_huge():
    splats = known_splats(6)
    logits, scales = splats.opacity_logits.copy(), np.log(np.array([0.001, 0.02, 0.001, 0.001, 0.3, 0.001]))[:, None]
    logits[2] = -8.0
    splats = dataclasses.replace(splats, opacity_logits=logits, log_scales=scales)
    pulled = torch.tensor([1.0, 1.0, 0, 0, 0, 0])
    statistics = Statistics(pulled, torch.ones(6), torch.tensor([0, 0, 0, 0.5, 0, 0]))
    generator = torch.Generator().manual_seed(0)
    stay, added = densify(named(splats), statistics, Appearance(), 1.0, False, generator)
    # 1 is split, 2 is faint; the large ones stay before the first reset.
    assert stay.tolist() == [True, False, False, True, True, True]
    assert added["means"].shape == (3, 3)
    assert torch.equal(added["means"][0], named(splats)["means"][0])
    assert np.allclose(torch.exp(added["log_scales"][1:]), 0.02 / 1.6)
    assert (added["means"][1:] - named(splats)["means"][1]).norm(dim=1).max() < 5 * 0.02
    stay, _ = densify(named(splats), statistics, Appearance(), 1.0, True, generator)
    assert stay.tolist() == [True, False, False, False, False, True]
    with pytest.MonkeyPatch.context() as few:
        few.setattr("neuspring.splats.train.MOST_SPLATS", 6)
        stay, added = densify(named(splats), statistics, Appearance(), 1.0, False, generator)
    assert len(added["means"]) == 0
    # New splats are judged as old ones are: no clone of a faint one, no huge child.
    statistics.pull[2] = statistics.pull[4] = 1.0
    _, added = densify(named(splats), statistics, Appearance(), 1.0, True, generator)
    assert torch.sigmoid(added["opacity_logits"]).min() > 0.005
    assert torch.exp(added["log_scales"]).max() < 0.1


def test_hands_hide_pixels_around_them_which_are_not_compared_and_wrong_sizes_are_named():
    truth = known_splats()
    covered = np.zeros((SIZE[1], SIZE[0]), bool)
    covered[:, : SIZE[0] // 2] = True
    with torch.no_grad():
        shot, settings = shot_of(truth, view_from(EYES[0]), hands=covered), Appearance()
        moved = dataclasses.replace(truth, harmonics=-truth.harmonics)
        right, wrong = (Gaussians.of(splats).draw(shot.view) for splats in (truth, moved))
        # Wrong colors behind the hand alone cost nothing.
        patched = dataclasses.replace(right, rgb=torch.where(torch.tensor(covered)[..., None], wrong.rgb, right.rgb))
        assert float(loss(patched, shot, settings)) == float(loss(right, shot, settings))
        assert float(loss(wrong, shot, settings)) > float(loss(right, shot, settings)) + 0.001
    size, view = (SIZE[1], SIZE[0]), view_from(EYES[0])
    color, mask, hands, depth = np.zeros((*size, 3), np.uint8), np.ones(size, bool), np.zeros(size, bool), np.ones(size)
    hands[30, 40] = True
    shot = Shot.of("0", view, color, mask & ~hands, hands, depth, 4.0)
    assert float((1 - shot.known).sum()) == 16
    only = np.zeros(size, bool)
    only[30, 42] = True
    for unseen in (np.zeros(size, bool), only):
        assert Shot.of("0", view, color, unseen, hands, depth, 8.0) is None
    with pytest.raises(InputError, match=r"camera 0, image of frame 0.*\(64, 96\).*\(10, 96\)"):
        Shot.of("0", view, color[:10], mask, hands, depth, 4.0)


def test_training_that_breaks_is_a_numerical_failure(dense):
    truth = known_splats(40)
    shots = shots_of(truth)
    start = first_splats(truth.means, np.full((40, 3), 0.5), FAST, 0.002)
    with pytest.raises(NumericalFailure, match="splats are not finite"):
        train(start, shots, dataclasses.replace(FAST, scale_rate=1e4), 0, "warp")
    dense(DENSIFY_FROM=5, DENSIFY_EVERY=10, PRUNE_OPACITY=0.95)
    with pytest.raises(NumericalFailure, match="removed the last splat"):
        train(start, shots, FAST, 0, "warp")


def test_the_first_splats_follow_the_points_the_extent_the_cameras_and_faint_ones_are_left_out():
    shots, eyes, splats = [shot_of(known_splats(), view_from(eye)) for eye in EYES], np.array(EYES), known_splats(10)
    assert extent_of(shots) == pytest.approx(1.1 * np.linalg.norm(eyes - eyes.mean(0), axis=1).max(), rel=1e-4)
    assert extent_of(shots[:1]) == pytest.approx(np.linalg.norm(eyes[0] - [0, 0, 0.06]), rel=0.2)
    logits = np.where(np.arange(10) < 4, -5, splats.opacity_logits)
    assert len(prune_by_opacity(dataclasses.replace(splats, opacity_logits=logits)).means) == 6
    with pytest.raises(NumericalFailure, match="no splat"):
        prune_by_opacity(dataclasses.replace(splats, opacity_logits=logits - 10))
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(0, 0.1, (500, 3)), rng.uniform(0, 1, (500, 3))
    every = first_splats(points, colors, Appearance(), 0.002)
    assert np.allclose(every.means, points)
    assert np.allclose(harmonic_colors(torch.tensor(every.harmonics), torch.ones(500, 3), 3), colors, atol=1e-5)
    fewer = first_splats(points, colors, Appearance(spacing=10), 0.002)
    assert 60 < len(fewer.means) <= 216
    assert fewer.log_scales.mean() > every.log_scales.mean()
    with pytest.raises(InputError, match="more than 3 points"):
        first_splats(points[:2], colors[:2], Appearance(), 0.002)


def test_a_fixed_radius_stays_whatever_is_trained(dense):
    shots = shots_of(known_splats())
    dense(DENSIFY_FROM=10, DENSIFY_EVERY=10, DENSIFY_UNTIL=60, DENSIFY_GRADIENT=1e-6, SPLIT_SIZE=1e-4)
    settings = dataclasses.replace(FAST, iterations=60, fixed_radius=0.004)
    start = first_splats(known_splats().means, np.full((200, 3), 0.5), settings, 0.01)
    result = train(start, shots, settings, 0, "warp")
    assert len(result.splats.means) > 200, "what is too coarse is cloned, however large"
    np.testing.assert_allclose(np.exp(result.splats.log_scales), 0.004, rtol=1e-6)
