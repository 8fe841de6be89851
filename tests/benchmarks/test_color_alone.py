"""The pure parts of the benchmarks of color alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from neuspring.data.capture import Capture
from tests.benchmarks.footage_parts import summary as parts_summary
from tests.benchmarks.footage_parts import track_errors
from tests.benchmarks.one_color_camera import hand_errors, one_camera, summary
from tests.support import small
from tests.support.colored import observed, paint


def test_errors_of_tracks_are_pixels_of_training_frames():
    seen, true = observed(), small.observations()
    still = np.repeat(true.nodes[None], seen.scenario.frame_count, axis=0)
    moved = still.copy()
    moved[:, : true.object_points.shape[1]] = true.object_points
    errors = track_errors(seen, moved)
    assert errors.max() < 1e-3
    assert len(errors) == seen.image.visible[1 : seen.scenario.train_end].sum()
    assert track_errors(seen, still).max() > 5


def test_hands_count_by_their_motion_alone():
    seen = small.observations()
    hands = seen.controller_points.astype(float)
    poses = np.zeros((len(hands), 1, 7))
    # Anywhere in the hand: only its way counts.
    poses[:, 0, :3] = hands.mean(axis=1) + np.array([0.0, 0.03, 0.05])
    truth = SimpleNamespace(hand_poses=poses)
    assert hand_errors(truth, seen)[1] == pytest.approx(0.0, abs=1e-6)
    off = np.linspace(0, 0.02, len(hands))[:, None, None] * [0.0, 0.0, 1.0]
    mean, last = hand_errors(truth, replace(seen, controller_points=hands + off))
    assert last == pytest.approx(0.02, abs=1e-6)
    assert mean == pytest.approx(np.linspace(0, 0.02, len(hands))[1:].mean(), abs=1e-6)


def test_a_capture_of_one_camera_has_its_color_and_masks(tmp_path):
    capture = paint(tmp_path / "painted", frames=5)
    color = one_camera(capture, tmp_path / "scene_color", depth=False)
    assert not color.has_depth
    np.testing.assert_array_equal(Capture.load(color.folder).mask("0", 3), capture.mask("0", 3))


def test_tables_average_over_scenes():
    errors = pd.DataFrame(
        [("a", "color", "m", 0, "hands, mean", 10.0), ("b", "color", "m", 0, "hands, mean", 20.0)],
        columns=["scene", "arm", "method", "seed", "metric", "value_mm"],
    )
    assert "| 15.0 " in summary(errors)
    runs = pd.DataFrame(
        [("a", "m", seed, "ok", 0.5 + 0.1 * seed, 0.3, 2.0) for seed in (0, 1)],
        columns=["scenario", "method", "seed", "status", "iou", "future", "points"],
    )
    assert "0.550 ± 0.071" in parts_summary(runs)
    # Paired by scenario: better by 0.1 and 0.3, whose 95 % t interval is 0.2 ± 12.706 · 0.1.
    pairs = [("a", "search_only", 0.4), ("b", "search_only", 0.6), ("a", "m", 0.5), ("b", "m", 0.9)]
    runs = pd.DataFrame([(case, name, 0, "ok", iou, 0.3, 2.0) for case, name, iou in pairs], columns=runs.columns)
    assert "+0.200 [-1.071, +1.471]" in parts_summary(runs)
    assert "[" not in parts_summary(runs[runs["scenario"] == "a"])
