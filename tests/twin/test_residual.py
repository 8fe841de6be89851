"""A learned correction of center lines: it turns with the motion, finds what is planted, and leaves noise and clamps alone."""

import numpy as np
import pytest

from neuspring.core.artifacts import Residual
from neuspring.core.errors import InputError
from neuspring.twin.residual import apply, features, fit

DT, FRAMES, VERTICES = 0.01, 40, 8
FREE = np.isin(np.arange(VERTICES), [2, 3, 4, 5])


def rollout(seed: int, amplitude: float = 0.1) -> np.ndarray:
    """A smooth motion of a bent line [T, V, 3] whose ends never lie above each other."""
    rng = np.random.default_rng(seed)
    along, time = np.linspace(0, 1, VERTICES), DT * np.arange(FRAMES)
    shape = np.stack([along, 0 * along, 0.8 - np.sin(np.pi * along)], axis=1)
    phases, speeds = rng.uniform(0, 2 * np.pi, (2, 3, 3)), rng.uniform(5, 20, (3, 3))
    modes = np.sin(np.pi * np.outer(along, [1, 2, 3]) + phases[0, :, 0])
    return shape + amplitude * np.einsum("vm,tmi->tvi", modes, np.sin(time[:, None, None] * speeds + phases[1]))


def planted(lines, weights):
    """Targets to which a correction of these weights leads."""
    return [apply(Residual(weights=weights, ridge=0.0, left_out=0.0), line, DT, FREE) for line in lines]


def test_features_stay_when_the_motion_is_turned_about_the_vertical_and_moved_sideways():
    line = rollout(0)
    c, s = np.cos(2.1), np.sin(2.1)
    turned = line @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [3.0, -2.0, 0.0]
    before, after = (features(each, DT, FREE) for each in (line, turned))
    assert before.shape[:2] == (FRAMES, 4)
    np.testing.assert_allclose(after, before, atol=1e-7)
    tilted = line @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    assert np.abs(features(tilted, DT, FREE) - before).max() > 0.1


def test_the_correction_turns_with_the_motion_and_leaves_held_vertices():
    line = rollout(1)
    weights = np.random.default_rng(0).normal(size=(features(line, DT, FREE).shape[2], 3)) * 1e-4
    learned = Residual(weights=weights, ridge=0.1, left_out=0.5)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    corrected = apply(learned, line, DT, FREE)
    np.testing.assert_allclose(apply(learned, line @ turn.T, DT, FREE), corrected @ turn.T, atol=1e-9)
    np.testing.assert_array_equal(corrected[:, ~FREE], line[:, ~FREE])
    np.testing.assert_array_equal(corrected[0], line[0])
    assert np.abs(corrected - line)[:, FREE].max() > 1e-3


def test_a_planted_correction_is_found_on_clips_that_were_not_seen(tmp_path):
    lines = [rollout(seed) for seed in range(8)]
    weights = np.zeros((features(lines[0], DT, FREE).shape[2], 3))
    # A lag: 2 ms of the velocity, which is the second group of features.
    weights[3:12:3] = 0.002 * np.eye(3)
    targets = planted(lines, weights)
    learned = fit(lines[:6], targets[:6], list("abcdef"), DT, FREE)
    assert learned.left_out < 0.01
    learned.save(tmp_path / "residual.npz")
    again = Residual.load(tmp_path / "residual.npz")
    for line, target in zip(lines[6:], targets[6:], strict=True):
        assert np.abs(apply(again, line, DT, FREE) - target).max() < 0.05 * np.abs(line - target).max()


def test_noise_is_not_learned():
    rng = np.random.default_rng(1)
    lines = [rollout(seed) for seed in range(6)]
    targets = [line + 0.01 * rng.normal(size=line.shape) for line in lines[:4]]
    learned = fit(lines[:4], targets, list("abcd"), DT, FREE)
    changes = [np.abs(apply(learned, line, DT, FREE) - line)[:, FREE].mean() for line in lines]
    assert learned.left_out > 0.95 and max(changes) < 0.002
    signs = (1, -1, 1, -1, 1, -1)
    opposite = [line + sign * 0.01 * FREE[:, None] for line, sign in zip(lines, signs, strict=True)]
    learned = fit(lines, opposite, list("abcdef"), DT, FREE)
    assert learned.left_out >= 1 and not learned.weights.any(), "what does not carry over to another clip is no correction"


def test_clips_of_a_group_are_left_out_together_and_count_alike():
    lines = [rollout(seed) for seed in range(4)]
    weights = np.zeros((features(lines[0], DT, FREE).shape[2], 3))
    weights[3:12:3] = 0.002 * np.eye(3)
    targets = planted(lines, weights)
    # The same clip twice would teach itself.
    alone = fit([lines[0], lines[0], lines[1]], [targets[0], targets[0], targets[1]], ["a", "b", "c"], DT, FREE)
    together = fit([lines[0], lines[0], lines[1]], [targets[0], targets[0], targets[1]], ["a", "a", "c"], DT, FREE)
    assert alone.left_out < together.left_out
    # A clip whose rollout is far off, and the other way, does not outweigh two others.
    wild = [*targets[:2], lines[2] - 100 * (targets[2] - lines[2])]
    corrected = apply(fit(lines[:3], wild, list("abc"), DT, FREE), lines[3], DT, FREE)
    left = ((corrected - targets[3]) ** 2).sum() / ((lines[3] - targets[3]) ** 2).sum()
    assert left < 0.5


def test_ends_above_each_other_keep_the_last_direction():
    line = rollout(2, amplitude=0.0)
    line[5:, -1, :2] = line[5:, 0, :2]
    found = features(line, DT, FREE)
    assert np.isfinite(found).all()
    # Behind height, velocity, acceleration and curvature stands the vector to the first held vertex.
    vectors = found[1:, :, 30:39] / found[1:, :, -3:-2]
    np.testing.assert_allclose(vectors[4:], vectors[:1] + 0 * vectors[4:], atol=1e-12)
    assert np.abs(vectors[0, :, 0]).min() > 0.01


def test_what_cannot_be_corrected_is_refused():
    line = rollout(0)
    with pytest.raises(InputError, match="both ends of the line must be held"):
        features(line, DT, np.arange(VERTICES) > 1)
    with pytest.raises(InputError, match="at least two training clips"):
        fit([line, line], [line, line], ["a", "a"], DT, FREE)
