"""The two reference points: frame 0 held, and the object skinned to the controllers."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.baselines import BASELINES, REFERENCES
from neuspring.core.artifacts import Trajectory
from neuspring.scores import metrics
from tests.support import small


def predicted(name, seen):
    return BASELINES[name].predict(seen, None, None, "cpu").trajectory.positions


def test_static_holds_frame_0():
    seen = small.observations()
    found = predicted("static", seen)
    assert found.shape == (seen.scenario.frame_count, len(seen.nodes), 3)
    assert (found == seen.nodes).all()


def test_controllers_that_move_as_a_body_carry_the_object_along():
    seen = small.observations()
    frames = seen.scenario.frame_count
    turns = Rotation.from_euler("xyz", np.linspace(0, [0.3, -0.2, 0.5], frames))
    shifts = np.linspace(0, [0.1, 0.2, -0.1], frames)
    # The hand of this scene is flat; three more controllers make it a body.
    flat = seen.controller_points[0]
    hand = np.concatenate([flat, flat[:3] + np.array([0.01, 0.02, 0.03])])
    moved = np.stack([turn.apply(hand) + shift for turn, shift in zip(turns, shifts, strict=True)])
    found = predicted("controller_lbs", replace(seen, controller_points=moved))
    wanted = np.stack([turn.apply(seen.nodes) + shift for turn, shift in zip(turns, shifts, strict=True)])
    np.testing.assert_allclose(found, wanted, atol=2e-4)


def test_the_object_follows_controllers_only_while_they_hold():
    seen = small.observations()
    frames, hands = seen.scenario.frame_count, seen.controller_points.shape[1]
    still = np.repeat(seen.controller_points[:1], frames, axis=0)
    moved = still + np.arange(frames)[:, None, None] * np.array([0.01, 0.0, 0.0])
    moved[:, 0] = still[:, 0] - np.arange(frames)[:, None] * np.array([0.0, 0.0, 0.02])
    valid = np.zeros((frames, hands), bool)
    valid[2:5, 1:] = True
    found = predicted("controller_lbs", replace(seen, controller_points=moved, controller_valid=valid))
    # Held from frame 2 to 4 by those that go sideways; the first one, which goes down, never holds.
    shifts = np.clip(np.arange(frames) - 2, 0, 2)[:, None, None] * np.array([0.01, 0.0, 0.0])
    np.testing.assert_allclose(found, seen.nodes + shifts, atol=2e-4)
    every = predicted("controller_lbs", replace(seen, controller_points=moved, controller_valid=np.ones_like(valid)))
    np.testing.assert_allclose(every, predicted("controller_lbs", replace(seen, controller_points=moved)), atol=1e-6)


def test_neither_sees_more_than_frame_0_of_the_object():
    seen = small.observations()
    spoiled = replace(seen, object_points=np.concatenate([seen.object_points[:1], seen.object_points[1:] + 1.0]))
    for name in REFERENCES:
        np.testing.assert_array_equal(predicted(name, seen), predicted(name, spoiled))


def test_what_ended_early_is_held_at_its_last_frame():
    seen = small.observations()
    frames = seen.scenario.frame_count
    known = seen.nodes + np.arange(3)[:, None, None] * np.array([0.01, 0, 0])
    ended = Trajectory(positions=known, frame_count=frames, diverged_frame=3, reason="test")
    whole = metrics.last_frame_frozen(ended, seen)
    assert whole.diverged_frame is None and len(whole.positions) == frames
    np.testing.assert_array_equal(whole.positions[:3], ended.positions)
    assert (whole.positions[3:] == ended.positions[2]).all()
    # Without any frame, the rest state is what is left.
    nothing = Trajectory(positions=known[:0], frame_count=frames, diverged_frame=0, reason="test")
    for lost in (None, nothing):
        assert (metrics.last_frame_frozen(lost, seen).positions == seen.nodes).all()
