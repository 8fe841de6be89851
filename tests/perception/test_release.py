"""Hands that release the object: they move away, leave the view, or return."""

import numpy as np
import pytest

from neuspring.perception.controllers import ALWAYS, SeenBody, holding

FRAMES = 30
RELEASE = 0.05


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """A hand lets go after five frames out of view."""
    monkeypatch.setattr("neuspring.perception.controllers.RELEASE_AFTER", 5)


def scene(away):
    """A body at the origin and two hands of four points, the second far to the side and always near it; the first `away` [T], m,
    from where it holds."""
    body = np.random.default_rng(0).uniform(-0.05, 0.05, (60, 3))
    aside = np.array([0.5, 0.0, 0.0])
    body = np.concatenate([body, body + aside])
    hand = np.array([[0, 0, 0.06], [0.01, 0, 0.06], [0, 0.01, 0.06], [0.01, 0.01, 0.06]])
    first = hand + away[:, None, None] * np.array([0, 0, 1.0])
    second = np.repeat((hand + aside)[None], FRAMES, axis=0)
    points = np.concatenate([first, second], axis=1)
    seen = np.ones(points.shape[:2], bool)
    bodies = np.repeat(body[None], FRAMES, axis=0)
    return points, seen, bodies, np.ones(bodies.shape[:2], bool), np.ones(FRAMES, bool)


def grips(away, train_end=FRAMES, pixels=None, **changes):
    points, seen, bodies, shown, in_view = scene(away)
    seen, in_view, bodies = changes.get("seen", seen), changes.get("in_view", in_view), changes.get("bodies", bodies)
    body = SeenBody(list(bodies[:train_end]), pixels or list(points[:train_end]), bodies, changes.get("shown", shown))
    return holding(points[:, [0, 3, 4]], (points, seen), body, in_view, RELEASE)


def held(away, train_end=FRAMES, **changes):
    found = grips(away, train_end, **changes)
    assert found.elsewhere is None and not found.strays
    return found.holds


def leaving(at):
    return 0.03 * np.maximum(np.arange(FRAMES) - at, 0)


def back_at(frame):
    away = leaving(10)
    away[frame:] = 0.0
    return away


@pytest.mark.parametrize("away", [np.zeros(FRAMES), np.full(FRAMES, 0.3), back_at(15)], ids=["stays", "never near", "back soon"])
def test_a_hand_that_stays_was_never_near_or_comes_back_soon_has_not_let_go(away):
    assert held(away) is ALWAYS


def test_a_hand_that_goes_away_lets_go_and_the_other_holds_on():
    valid = held(leaving(10))
    first = np.flatnonzero(~valid[:, 0])[0]
    assert first in (11, 12)
    assert not valid[first:, :2].any()
    assert valid[:first].all()
    assert valid[:, 2].all()


def test_the_body_is_not_read_after_the_training_frames():
    assert held(leaving(20), train_end=18) is ALWAYS
    spoiled = scene(leaving(10))[2]
    spoiled[18:] += 9.0
    np.testing.assert_array_equal(held(leaving(10), train_end=18, bodies=spoiled), held(leaving(10), train_end=18))


def test_a_hand_that_comes_back_to_the_same_place_takes_hold_again():
    valid = held(back_at(20))
    first = np.flatnonzero(~valid[:, 0])[0]
    assert first in (11, 12)
    assert valid[:first].all() and valid[20:].all()
    assert not valid[first:20, :2].any()
    assert valid[:, 2].all()


def test_a_hand_may_let_go_and_take_hold_twice():
    away = np.zeros(FRAMES)
    away[5:12] = away[18:24] = 0.3
    np.testing.assert_array_equal(held(away)[:, 0], away == 0)


def test_it_takes_hold_of_the_part_that_has_turned_to_it_only_if_that_is_the_same():
    """The body is turned over while the hand is away, so that another side of it is where the hand comes back."""
    away = back_at(20)
    bodies = scene(away)[2]
    turned = bodies.copy()
    turned[15:, :60, 2] *= -1
    found = grips(away, bodies=turned)
    assert found.elsewhere == 20
    assert not found.holds[20:, :2].any()
    # Without any followed point nobody knows.
    shown = np.ones(bodies.shape[:2], bool)
    shown[20, :60] = shown[20, 60:] = False
    assert grips(away, shown=shown).elsewhere == 20


def test_no_hold_is_taken_after_the_training_frames():
    assert held(back_at(24))[24:].all()
    assert not held(back_at(24), train_end=22)[13:, :2].any()


def test_a_hand_is_near_if_what_is_seen_of_it_is():
    """The pose of the hand is lost, and its controllers with it; masks still show it at the body."""
    points, seen, bodies, shown, in_view = scene(np.zeros(FRAMES))
    controllers = points[:, [0, 3, 4]].copy()
    controllers[12:, :2] += 0.4
    body = SeenBody(list(bodies), list(points), bodies, shown)
    assert holding(controllers, (points, seen), body, in_view, RELEASE).holds is ALWAYS


ARRIVES = 8


def test_a_hand_that_lets_go_is_not_held_by_another_that_arrives():
    """Pixels of an untracked hand must not extend the grasp of the hand that left."""
    away = leaving(10)
    arriving = np.random.default_rng(1).uniform(-0.02, 0.02, (40, 3)) - [0, 0, 0.07]
    pixels = [np.concatenate([own, arriving][: 1 + (frame >= ARRIVES)]) for frame, own in enumerate(scene(away)[0])]
    found = grips(away, pixels=pixels)
    first = np.flatnonzero(~found.holds[:, 0])[0]
    assert first in (11, 12)
    assert not found.holds[first:, :2].any() and found.holds[:, 2].all()
    assert found.strays == list(range(ARRIVES, FRAMES))


def test_pixels_apart_from_what_is_followed_of_a_hand_are_its_own_where_its_controllers_are():
    """Fingertips beyond the object, which hides the rest of them, move as their hand does."""
    bodies = scene(np.zeros(FRAMES))[2][:, :60]
    hand = np.array([[x, 0, z] for z in (0.06, 0.09, 0.12, 0.15, 0.18) for x in (0.0, 0.01)])
    points = np.repeat(hand[None], FRAMES, axis=0)
    seen = np.ones(points.shape[:2], bool)
    seen[5:, :6] = False
    tips, forearm = np.repeat(hand[:2], 20, axis=0), hand[6:]
    body = SeenBody(list(bodies), [np.concatenate([tips, forearm])] * FRAMES, bodies, np.ones(bodies.shape[:2], bool))
    found = holding(points[:, :2], (points, seen), body, np.ones(FRAMES, bool), RELEASE)
    assert found.holds is ALWAYS and not found.strays


def test_a_hand_out_of_view_lets_go_after_some_frames():
    seen = np.ones((FRAMES, 8), bool)
    seen[12:] = False
    valid = held(np.zeros(FRAMES), seen=seen, in_view=np.arange(FRAMES) < 12)
    # Five frames: 12 to 16.
    assert valid[:16].all()
    assert not valid[16:].any()
    # Tracks that are lost while masks still show a hand say nothing.
    assert held(np.zeros(FRAMES), seen=seen) is ALWAYS
