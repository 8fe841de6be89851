"""Trajectories of points: lost markers, exchanged labels and faulty streams are told from plain motion."""

import numpy as np
import pytest

from neuspring.checks import examine
from neuspring.checks.moving import Moving
from tests.support.real import HANDS

FRAMES, RATE = 60, 30.0
LOST, HELD, STEP, SWAPPED = "lost points as numbers", "held value", "step far beyond the others", "labels swapped"


def lifted():
    """Six markers [T, 6, 3] on a beam of 0.2 m whose end is lifted by 0.12 m within a second, with noise of 0.2 mm."""
    beam = np.stack([np.linspace(0.02, 0.19, 6), np.tile([0.02, 0.06], 3), np.full(6, 0.041)], axis=1)
    height = 0.12 * np.clip((np.arange(FRAMES) - 5) / 30, 0, 1)
    points = np.repeat(beam[None], FRAMES, axis=0)
    points[..., 2] += height[:, None] * (beam[:, 0] / 0.2)
    return points + np.random.default_rng(3).normal(0, 2e-4, points.shape)


def gripped():
    """Four points [T, 4, 3] of a gripper that waits, lifts and waits, without noise: equal to the bit at both ends."""
    height = 0.12 * np.clip((np.arange(FRAMES) - 5) / 30, 0, 1)
    jaws = np.array([[0.2, y, z] for y in (0.02, 0.06) for z in (0.01, 0.03)])
    return jaws + height[:, None, None] * np.array([0.0, 0.0, 1.0])


def seen(points, rate=RATE):
    return examine("moving", "file", Moving(points, rate), "Write null")


def put(value, frames, points):
    """These entries are `value`."""

    def change(given):
        given[frames, points] = value
        return given

    return change


def held(first, last, points):
    """Points stay where they are in frame `first`."""
    return lambda given: put(given[first, points], slice(first, last + 1), points)(given)


def exchanged(frames, points, by):
    return lambda given: put(given[frames][:, by], frames, points)(given)


def after_a_gap(given):
    return put(np.nan, slice(15, 25), [1, 3])(exchanged(slice(25, None), [1, 3], [3, 1])(given))


FAULTS = {
    "zeros": (lifted, put(0.0, slice(12, 20), 2), LOST, "error", 1, tuple(range(12, 20))),
    "zeros in every other frame": (lifted, put(0.0, slice(0, None, 2), 3), LOST, "error", 30, tuple(range(0, 60, 2))),
    "one number in one frame": (lifted, put(-1.0, 12, 2), LOST, "error", 1, (12,)),
    "a far place": (lifted, put([0.0, 0.0, -9.9], slice(12, 20), 2), LOST, "error", 1, tuple(range(12, 20))),
    "a pose that is lost twice": (gripped, put(gripped()[0] - 0.1, [20, 40], slice(None)), LOST, "error", 8, (20, 40)),
    "a stream that stops": (gripped, held(10, 33, slice(None)), HELD, "warning", 4, (10,)),
    "a gap filled with the last place": (lifted, held(11, 39, 2), HELD, "warning", 1, (11,)),
    "three labels": (lifted, exchanged(slice(25, None), [0, 2, 4], [2, 4, 0]), SWAPPED, "warning", None, (25,)),
    "two labels for a while": (lifted, exchanged(slice(20, 23), [1, 3], [3, 1]), SWAPPED, "warning", None, (20, 23)),
    "two labels after a gap": (lifted, after_a_gap, SWAPPED, "warning", None, (25,)),
    "a reflex": (lifted, put(lifted()[20, 3] + 0.05, 20, 3), STEP, "warning", None, (20, 21)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_motion_capture_does_is_named_once(fault):
    right, change, name, level, value, frames = FAULTS[fault]
    (found,) = seen(change(right()))
    assert (found.name, found.level, found.frames) == (name, level, frames)
    assert value in (None, found.value)


@pytest.mark.parametrize("right", [lifted, lambda: np.tile(gripped(), (1, 2, 1)) + np.repeat([0.0, 0.03], 4)[:, None]])
def test_an_order_that_changes_from_frame_to_frame_is_an_error(right):
    points, rng = right(), np.random.default_rng(0)
    (found,) = seen(np.stack([rng.permutation(row) for row in points]))
    assert (found.name, found.level) == (SWAPPED, "error") and len(found.frames) > 0.9 * FRAMES
    assert "in frames 1 to " in found.text and "times as large as in the best order" in found.text
    assert found.value > 2 * FRAMES and found.remedy.startswith("Write each point at the same index")


def test_points_are_named():
    swapped = seen(exchanged(slice(25, None), [0, 4], [4, 0])(lifted()))[0].text
    assert "(point 0 in frame 25, point 4 in frame 25)" in swapped
    zeros = seen(put(0.0, slice(30, 41), 4)(lifted()))[0].text
    assert "point 4 from frame 30 on is [0.0, 0.0, 0.0]" in zeros and zeros.endswith("Write null.")


RIGHT = {
    "markers": lifted(),
    "a gripper": gripped(),
    "a gripper that starts at the origin": gripped() - gripped()[0, 0],
    "whole millimeters": np.round(lifted(), 3),
    "each row four times": np.repeat(lifted(), 4, axis=0),
    "gaps": put(np.nan, slice(30, 41), 4)(lifted()),
    "one point": gripped()[:, :1],
    "three frames": lifted()[:3],
    "one frame": lifted()[:1],
    "nothing": lifted()[:, :0],
    "nothing seen": lifted() * np.nan,
    "rest": np.repeat(lifted()[:1], FRAMES, axis=0),
}


@pytest.mark.parametrize("name", RIGHT)
def test_motion_is_no_fault(name):
    assert seen(RIGHT[name]) == []


@pytest.mark.skipif(not HANDS.is_dir(), reason="the hands are not part of the repository")
@pytest.mark.parametrize("scene", ["single_lift_sloth", "double_lift_sloth", "single_push_sloth"])
def test_real_hands_and_annotated_points_have_no_findings(scene):
    for file in ("controller", "landmarks"):
        rows = np.loadtxt(HANDS / scene / f"{file}.txt")[:, 1:]
        points = rows.reshape(len(rows), -1, 3) / 1e4
        points[(points == 0).all(axis=2)] = np.nan
        assert seen(points) == []
