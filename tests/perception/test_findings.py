"""Findings of the steps of perception, each provoked once: its name and level."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.checks.masks import mask_facts, motions
from neuspring.checks.perceived import look_at_lifted, look_at_masks, look_at_observations, look_at_tracks
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.findings import finding, findings_as_facts, findings_of, refuse_errors
from neuspring.core.records import Recorder
from neuspring.data.capture import HANDS, OBJECT, Capture, Writer
from neuspring.perception.shape import no_prior
from tests.support.captures import FRAMES, describe, entry
from tests.support.still import tracked

SIZE = (90, 120)
CAMERA = replace(entry(width=SIZE[1], height=SIZE[0]), intrinsics=((150.0, 0.0, 59.5), (0.0, 150.0, 44.5), (0.0, 0.0, 1.0)))


@pytest.fixture
def capture(tmp_path):
    """A camera with depth everywhere."""
    writer = Writer(tmp_path, describe(cameras=(CAMERA,)))
    for frame in range(FRAMES):
        writer.frame("0", frame, np.zeros((*SIZE, 3), np.uint8), np.full(SIZE, 800, np.uint16))
    return writer.finish()


def scene():
    """Labels of an object of 30 x 30 pixels with a hand beside it."""
    labels = np.zeros((FRAMES, *SIZE), np.uint8)
    labels[:, 30:60, 40:70] = OBJECT
    labels[:, 30:60, 75:100] = HANDS
    return labels


def looked_at(capture, labels):
    return look_at_masks(capture, "0", labels, mask_facts(capture, "0", labels))


def said(findings):
    """Level and name of each."""
    return {f"{one.level}: {one.name}" for one in findings}


LONG, LEFT, TOP, SIDE = 30, 20, 30, 30
"""A film of LONG frames in which a square of SIDE pixels goes right, a pixel per frame."""


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Two grained squares on a gray table, one below the other: the upper one moves, the lower one stands still."""
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.normal(0, 1, (2 * SIDE, SIDE, 3)), (0, 0), 1.5)
    grain = np.clip(128 + 60 * grain / grain.std(), 0, 255)
    writer = Writer(tmp_path_factory.mktemp("moving"), describe(frame_count=LONG, cameras=(CAMERA,)))
    for frame in range(LONG):
        image = np.full((*SIZE, 3), 90.0)
        image[TOP : TOP + SIDE, LEFT + frame : LEFT + frame + SIDE] = grain[:SIDE]
        image[TOP + SIDE : SIZE[0], LEFT : LEFT + SIDE] = grain[SIDE : SIZE[0] - TOP]
        image += rng.normal(0, 1, image.shape)
        writer.frame("0", frame, image.astype(np.uint8), np.full(SIZE, 800 + frame, np.uint16))
    return writer.finish()


def both_squares(upper=OBJECT):
    """Labels of `moving`: the lower square is the object, and the upper one what is said."""
    labels = np.zeros((LONG, *SIZE), np.uint8)
    labels[:, TOP + SIDE : SIZE[0], LEFT : LEFT + SIDE] = OBJECT
    for frame in range(LONG):
        labels[frame, TOP : TOP + SIDE, LEFT + frame : LEFT + frame + SIDE] = upper
    return labels


def test_what_moves_at_the_object_and_lies_in_no_mask_is_said(moving):
    """A lost corner and a hand without annotation have the same finding: the image changes outside the masks."""
    name = "motion outside of the masks"
    for right in (both_squares(), both_squares(HANDS)):
        assert name not in {one.name for one in looked_at(moving, right)}
    lost = both_squares()
    lost[4:] = np.where(both_squares(0)[4:] == 0, 0, OBJECT)
    [found] = [one for one in looked_at(moving, lost) if one.name == name]
    assert found.level == "warning" and "first in frame 4" in found.text


def test_an_object_that_unfolds_moves_though_it_leaves_no_place(moving, tmp_path):
    """A part that opens beside it, whether its mask has it or not."""
    capture, labels = Capture.load(shutil.copytree(moving.folder, tmp_path / "unfolds")), both_squares(0)
    first = capture.color("0", 0)
    for frame in range(LONG):
        image = first.copy()
        image[TOP : TOP + SIDE, LEFT : LEFT + SIDE] = 90
        image[0, 0] = frame
        if frame > 4:
            image[TOP + 10 : TOP + SIDE, LEFT : LEFT + SIDE] = first[TOP + 10 : TOP + SIDE, LEFT : LEFT + SIDE]
        cv2.imwrite(str(capture.path("color", "0", frame)), image)
    unfolded = labels.copy()
    unfolded[5:, TOP + 10 : TOP + SIDE, LEFT : LEFT + SIDE] = OBJECT
    for mask in (labels, unfolded):
        assert mask_facts(capture, "0", mask)["object_moves"] > 0.6


def test_an_object_is_not_at_rest_where_no_new_image_shows_it(moving, tmp_path):
    capture = Capture.load(shutil.copytree(moving.folder, tmp_path / "stuck"))
    for frame in range(11, LONG):
        shutil.copyfile(capture.path("color", "0", 10), capture.path("color", "0", frame))
    assert [motion.frame for motion in motions(capture, "0", both_squares())] == list(range(11))
    (found,) = (one for one in looked_at(capture, both_squares()) if one.name == "repeated images")
    assert found.frames == tuple(range(11, LONG)) and "color, frames 11 to 29" in found.text


def test_lost_tracks_are_reported(capture):
    labels = scene()
    y, x = (values[::10] for values in np.nonzero(labels[0] == OBJECT))
    pixels = np.repeat(np.stack([x, y], axis=1)[None].astype(float), FRAMES, axis=0)
    visible = np.ones(pixels.shape[:2], bool)
    assert look_at_tracks(capture, "0", labels, pixels, visible) == []
    visible[3:, 3:] = False
    assert said(look_at_tracks(capture, "0", labels, pixels, visible)) == {"warning: points lost"}


BOX = np.random.default_rng(0).uniform((0, 0, 0), (0.1, 0.1, 0.1), (200, 3))


def test_size_and_place_of_the_object_are_said():
    assert said(look_at_lifted(tracked(BOX), no_prior(), 1.0)) == {"note: size of the object"}
    assert "warning: size of the object" in said(look_at_lifted(tracked(20.0 * BOX), no_prior(), 1.0))
    below = "warning: object below the table"
    assert below in said(look_at_lifted(tracked(BOX - [0, 0, 0.06]), no_prior(), 1.0))
    # The same with z down: above and below are exchanged.
    assert below in said(look_at_lifted(tracked(BOX), no_prior(), -1.0))


VISIBLE = np.ones((FRAMES, 200), bool)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"object_motion_valid": ~VISIBLE}, "motion not trusted"),
        ({"object_visibility": VISIBLE & ((np.arange(FRAMES) < 3)[:, None] | (np.arange(200) < 2))}, "points lost"),
        ({"facts": {"grip_elsewhere": 3.0}}, "grip elsewhere"),
    ],
)
def test_lifted_tracks_that_cannot_be_right_are_said(changes, name):
    assert f"warning: {name}" in said(look_at_lifted(replace(tracked(BOX), **changes), no_prior(), 1.0))


def observed(hand, step, rate=30.0, follows=True):
    """A box of points and three controllers at `hand`, which move by `step` per frame; the box with them if it follows."""
    motion = np.arange(FRAMES)[:, None, None] * step
    return Observations(
        scenario=Scenario(
            name="x", source="capture", category="toy", frame_count=FRAMES, train_end=FRAMES, frame_rate=rate, up="+z"
        ),
        object_points=BOX + motion * follows,
        object_visibility=np.ones((FRAMES, len(BOX)), bool),
        object_motion_valid=np.ones((FRAMES, len(BOX)), bool),
        controller_points=hand + 0.01 * np.eye(3) + motion,
        surface_points=np.zeros((0, 3)),
        interior_points=np.zeros((0, 3)),
        tracks=np.zeros((FRAMES, 0, 3)),
    )


ABOVE, SLOW = np.array([0.05, 0.05, 0.11]), np.array([0.0, 0.0, 0.01])


@pytest.mark.parametrize(
    ("observations", "name"),
    [
        (observed(ABOVE, SLOW), None),
        (observed(ABOVE + np.array([0, 0, 0.06]), SLOW), "controllers hold nothing"),
        (observed(ABOVE, 0.0 * SLOW), "controllers stand still"),
        (observed(ABOVE, SLOW, follows=False), "object stands still"),
        (observed(ABOVE, SLOW, rate=3000.0), "controllers too fast"),
    ],
)
def test_implausible_hands_are_said(observations, name):
    found = said(look_at_observations(observations))
    assert f"warning: {name}" in found if name else not found


def test_a_hand_that_never_comes_near_is_refused():
    with pytest.raises(InputError, match="hand far from the object"):
        refuse_errors(look_at_observations(observed(ABOVE + np.array([0, 0, 0.5]), SLOW)))


def test_findings_are_printed_kept_and_found_again(tmp_path, capsys):
    one = finding("a thing", "warning", "camera 0", "5 of it", "at most 3", "Look at it.")
    recorder = Recorder("segment", tmp_path / "scene" / "perception" / "0" / "masks.json")
    recorder.output.parent.mkdir(parents=True)
    recorder.save(facts={"x": 1.0} | findings_as_facts([one]))
    assert capsys.readouterr().out == "warning: camera 0: a thing: 5 of it; at most 3. Look at it.\n"
    assert findings_of(tmp_path, "scene") == [one]
    assert findings_as_facts([]) == {}
    (tmp_path / "scene" / "observations.json").write_text("{")
    assert findings_of(tmp_path, "scene") == [one]
