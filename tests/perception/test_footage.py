"""Masks and tracks on real color film, where it is: figures of perception/README.md, with a margin."""

import numpy as np
import pytest

from neuspring.checks.masks import mask_facts
from neuspring.checks.perceived import look_at_masks
from neuspring.data.capture import OBJECT, Writer
from results.published.footage.film import Points, carried, film, truths
from tests.support.captures import describe, entry
from tests.support.films import Errors, newly_covered, overlaps, stepwise
from tests.support.real import FOOTAGE

pytestmark = pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
MASKS = {
    "double_lift_cloth_1": (0.97, 0.88),
    "double_lift_sloth": (0.80, 0.93),
    "double_lift_zebra": (0.84, 0.96),
    "single_lift_cloth_4": (0.95, 0.94),
    "single_lift_rope": (0.79, 0.96),
    "single_push_rope_4": (0.86, 0.96),
}
"""Least mean IoU of object and of hands over the four frames; as measured, less 0.02 to 0.04."""
LOST = {"double_lift_cloth_1": 0.15, "double_lift_sloth": 0.6, "double_lift_zebra": 0.15, "single_lift_rope": 0.15}
"""Largest share of marked places that a tracker may give up; as measured, plus 0.07 to 0.1."""
MEDIAN = 4.0
"""Largest median error, pixels, of points that stay visible: what was aimed at."""


def points(case: str) -> Points:
    return Points.load(FOOTAGE / "tracks" / f"{case}.json")


def test_what_is_counted():
    own = points("double_lift_sloth")
    frames = own.frames[-1] + 1
    truth = np.nan_to_num(own.xy)
    places, visible = np.zeros((frames, len(own.names), 2)), np.zeros((frames, len(own.names)), bool)
    places[own.frames] = truth.transpose(1, 0, 2) + np.array([3.0, 4.0])
    visible[own.frames[1:]] = np.arange(len(own.names)) != 0
    found = Errors.of(own, places, visible)
    assert (found.median, found.most) == pytest.approx((5.0, 5.0))
    assert found.lost == pytest.approx(own.sure[0, 1:].sum() / own.sure[:, 1:].sum())
    assert found.hidden == "2 of 2"


def test_drawn_masks_keep_what_is_newly_covered_and_masks_of_frame_0_do_not(tmp_path):
    """The check needs no truth; here it is known. Eight times the last frame, because a check of one frame says nothing."""
    case = "single_lift_rope"
    colors, drawn = film(FOOTAGE, case), truths(FOOTAGE, case)
    last, count = max(drawn), 9
    height, width = drawn[0].shape
    writer = Writer(tmp_path, describe(frame_count=count, cameras=(entry(width=width, height=height),), depth="none"))
    for frame in range(count):
        writer.frame("0", frame, colors[last if frame else 0], None)
    capture, labels = writer.finish(), np.stack([drawn[0], *[drawn[last]] * (count - 1)])
    assert mask_facts(capture, "0", labels)["newly_kept"] > 0.8
    lost = np.where((labels == OBJECT) & (labels[0] != OBJECT), 0, labels)
    facts = mask_facts(capture, "0", lost)
    assert facts["newly_kept"] < 0.1
    assert "newly covered parts lost" in {one.name for one in look_at_masks(capture, "0", lost, facts)}


def test_newly_covered_pixels_are_those_beyond_frame_0():
    truth = {0: np.zeros((4, 6), np.uint8), 5: np.zeros((4, 6), np.uint8)}
    truth[0][:, :2], truth[5][:, 1:5] = OBJECT, OBJECT
    labels = np.stack([truth[0]] * 5 + [np.where(np.arange(6) < 4, truth[5], 0)])
    assert newly_covered(labels, truth) == [pytest.approx(2 / 3)]


@pytest.mark.slow
@pytest.mark.parametrize("case", MASKS)
def test_masks_and_tracks_of_a_whole_film(case):
    colors = film(FOOTAGE, case)
    labels = carried(colors, case)
    objects, hands = overlaps(labels, truths(FOOTAGE, case)).mean(axis=0)
    assert objects > MASKS[case][0]
    assert hands > MASKS[case][1]
    if case in LOST:
        own = points(case)
        found = Errors.of(own, *stepwise(colors, labels, own.xy[:, 0]))
        assert found.median < MEDIAN
        assert found.lost < LOST[case]
