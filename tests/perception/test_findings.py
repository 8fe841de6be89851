"""Findings of the steps of perception, each provoked once: its name and level."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.checks.masks import mask_facts
from neuspring.checks.perceived import look_at_lifted, look_at_masks, look_at_observations, look_at_tracks
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, finding, findings_as_facts, findings_of, refuse_errors
from neuspring.core.records import Recorder
from neuspring.data.capture import HANDS, OBJECT, Capture, Writer
from neuspring.data.results import ShapePrior
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


def scene() -> np.ndarray:
    """Labels of an object of 30 x 30 pixels with a hand beside it."""
    labels = np.zeros((FRAMES, *SIZE), np.uint8)
    labels[:, 30:60, 40:70] = OBJECT
    labels[:, 30:60, 75:100] = HANDS
    return labels


def looked_at(capture, labels: np.ndarray) -> list[Finding]:
    return look_at_masks(capture, "0", labels, mask_facts(capture, "0", labels))


def said(findings: list[Finding]) -> set[str]:
    """Level and name of each."""
    return {f"{one.level}: {one.name}" for one in findings}


def moved_to_the_border(labels):
    labels[2:, 30:60, :] = np.roll(labels[2:, 30:60, :], -40, axis=2)


def emptied(labels):
    labels[3:][labels[3:] == OBJECT] = 0


def split(labels):
    labels[:, 2:22, 2:22] = OBJECT


def shrunk(labels):
    labels[2, 30:47, 40:70] = 0


def sleeves(labels):
    labels[:, :29] = labels[:, 62:] = HANDS


def without_hand(labels):
    labels[0][labels[0] == HANDS] = 0


def tiny(labels):
    labels[labels == OBJECT] = 0
    labels[:, 40:50, 40:50] = OBJECT


def test_good_masks_have_no_findings_and_holes_of_depth_are_said(capture):
    assert looked_at(capture, scene()) == []
    for frame in range(FRAMES):
        depth = np.full(SIZE, 800, np.uint16)
        depth[30:45, 40:70] = 0
        cv2.imwrite(str(capture.path("depth", "0", frame)), depth)
    assert "warning: depth holes" in said(looked_at(capture, scene()))


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (moved_to_the_border, "object at the border"),
        (emptied, "object missing"),
        (split, "two objects"),
        (shrunk, "mask jumps"),
        (sleeves, "hands too large"),
        (without_hand, "no hand in frame 0"),
        (tiny, "small object"),
    ],
)
def test_masks_that_cannot_be_right_are_said(capture, spoil, name):
    labels = scene()
    spoil(labels)
    assert f"warning: {name}" in said(looked_at(capture, labels))


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
        writer.frame("0", frame, image.astype(np.uint8), np.full(SIZE, 800, np.uint16))
    return writer.finish()


def both_squares(upper: int = OBJECT) -> np.ndarray:
    """Labels of `moving`: the lower square is the object, and the upper one what is said."""
    labels = np.zeros((LONG, *SIZE), np.uint8)
    labels[:, TOP + SIDE : SIZE[0], LEFT : LEFT + SIDE] = OBJECT
    for frame in range(LONG):
        labels[frame, TOP : TOP + SIDE, LEFT + frame : LEFT + frame + SIDE] = upper
    return labels


def test_what_moves_at_the_object_and_lies_in_no_mask_is_said(moving):
    """A corner that is lifted and lost, and a hand that comes in unmarked, look alike: the picture changes where no mask is."""
    name = "motion outside of the masks"
    for right in (both_squares(), both_squares(HANDS)):
        assert name not in {one.name for one in looked_at(moving, right)}
    lost = both_squares()
    lost[4:] = np.where(both_squares(0)[4:] == 0, 0, OBJECT)
    [found] = [one for one in looked_at(moving, lost) if one.name == name]
    assert found.level == "warning" and "first in frame 4, more than 25%" in found.text


def test_newly_covered_parts_that_a_mask_loses_are_said(moving):
    """The mask keeps what the object covered in frame 0, and loses what it moves to."""
    right, lost = both_squares(), both_squares()
    lost[:, TOP : TOP + SIDE, LEFT + SIDE :] = 0
    assert mask_facts(moving, "0", right)["newly_kept"] > 0.9
    assert mask_facts(moving, "0", lost)["newly_kept"] < 0.05
    color = replace(moving, description=replace(moving.description, depth="none"))
    name = "newly covered parts lost"
    assert name not in {one.name for one in looked_at(color, right)}
    [found] = [one for one in looked_at(color, lost) if one.name == name]
    assert found.level == "warning" and "first in frame 2; at least 40% is expected" in found.text
    # Depth says more of masks: right ones of real RGBD film keep as little.
    assert name not in {one.name for one in looked_at(moving, lost)}


def test_an_object_that_unfolds_moves_though_it_leaves_no_place(moving, tmp_path):
    """A part that opens beside it, whether its mask has it or not."""
    capture, labels = Capture.load(shutil.copytree(moving.folder, tmp_path / "unfolds")), both_squares(0)
    first = capture.color("0", 0)
    for frame in range(LONG):
        image = first.copy()
        image[TOP : TOP + SIDE, LEFT : LEFT + SIDE] = 90
        if frame > 4:
            image[TOP + 10 : TOP + SIDE, LEFT : LEFT + SIDE] = first[TOP + 10 : TOP + SIDE, LEFT : LEFT + SIDE]
        cv2.imwrite(str(capture.path("color", "0", frame)), image)
    unfolded = labels.copy()
    unfolded[5:, TOP + 10 : TOP + SIDE, LEFT : LEFT + SIDE] = OBJECT
    for mask in (labels, unfolded):
        assert mask_facts(capture, "0", mask)["object_moves"] > 0.6


def test_a_shadow_is_not_taken_for_a_newly_covered_part(moving, tmp_path):
    capture = Capture.load(shutil.copytree(moving.folder, tmp_path / "shaded"))
    for frame in range(5, LONG):
        image = capture.color("0", frame).copy()
        image[: TOP - 2, LEFT:] = (0.6 * image[: TOP - 2, LEFT:]).astype(np.uint8)
        cv2.imwrite(str(capture.path("color", "0", frame)), image)
    assert mask_facts(capture, "0", both_squares())["newly_kept"] > 0.9


def test_tracks_that_end_where_the_picture_moves_are_said(moving):
    """Half of the points are followed to the end: those that stand still."""
    labels = both_squares()
    y, x = (values[::5] for values in np.nonzero(labels[0] == OBJECT))
    upper = y < TOP + SIDE
    pixels = np.repeat(np.stack([x, y], axis=1)[None].astype(float), LONG, axis=0)
    pixels[:, upper, 0] += np.arange(LONG)[:, None]
    visible = np.ones(pixels.shape[:2], bool)
    assert look_at_tracks(moving, "0", labels, pixels, visible) == []
    visible[5:, upper] = False
    [found] = look_at_tracks(moving, "0", labels, pixels, visible)
    assert (found.name, found.level) == ("tracks lost where it moves", "warning")
    # At first the points of the lower square are near.
    assert "first in frame 16, the part of the object that moves has followed points on less than 15% of it" in found.text


def test_an_object_that_folds_is_not_said_to_stand_still(moving):
    """Its followed points do not move; its picture does."""
    still = observed(ABOVE, SLOW, follows=False)
    assert "warning: object stands still" in said(look_at_observations(still))
    found = look_at_observations(still, mask_facts(moving, "0", both_squares())["object_moves"])
    assert said(found) == {"warning: object not followed"} and "static" not in found[0].text
    assert mask_facts(moving, "0", both_squares(HANDS))["object_moves"] == 0.0


def test_an_object_whose_points_are_lost_is_not_said_to_stand_still():
    """Those that are lost may be the ones that move."""
    still = observed(ABOVE, SLOW, follows=False)
    visibility = still.object_visibility.copy()
    visibility[2:, : len(BOX) // 4] = False
    [found] = look_at_observations(replace(still, object_visibility=visibility))
    assert found.name == "object not followed" and "up to 25% of the points are lost" in found.text


def test_lost_and_few_tracks_are_said(capture):
    labels = scene()
    y, x = (values[::10] for values in np.nonzero(labels[0] == OBJECT))
    pixels = np.repeat(np.stack([x, y], axis=1)[None].astype(float), FRAMES, axis=0)
    visible = np.ones(pixels.shape[:2], bool)
    assert look_at_tracks(capture, "0", labels, pixels, visible) == []
    visible[3:, 3:] = False
    assert said(look_at_tracks(capture, "0", labels, pixels, visible)) == {"warning: tracks lost"}
    assert said(look_at_tracks(capture, "0", labels, pixels[:, :20], np.ones((FRAMES, 20), bool))) == {"warning: few tracks"}


BOX = np.random.default_rng(0).uniform((0, 0, 0), (0.1, 0.1, 0.1), (200, 3))


def test_a_hull_of_a_sheet_is_said():
    flat = np.random.default_rng(0).uniform((0, 0, 0), (0.3, 0.25, 0.01), (1500, 3))
    hull = ShapePrior(vertices=np.eye(3), faces=np.array([[0, 1, 2]]), backend="visual_hull", facts={"cameras": 3.0})
    assert "warning: shape and category" in said(look_at_lifted(tracked(flat), hull, 1.0))
    assert "warning: shape and category" not in said(look_at_lifted(tracked(flat), no_prior(), 1.0))
    assert "warning: shape and category" not in said(look_at_lifted(tracked(flat * (1, 1, 8)), hull, 1.0))


def test_size_and_place_of_the_object_are_said():
    assert said(look_at_lifted(tracked(BOX), no_prior(), 1.0)) == {"note: size of the object"}
    assert "warning: implausible size" in said(look_at_lifted(tracked(20.0 * BOX), no_prior(), 1.0))
    below = "warning: object below the table"
    assert below in said(look_at_lifted(tracked(BOX - [0, 0, 0.06]), no_prior(), 1.0))
    # The same with z down: above and below are exchanged.
    assert below in said(look_at_lifted(tracked(BOX), no_prior(), -1.0))


def test_volume_and_invented_surface_are_said():
    facts = {"volume": 0.0286, "invented_share": 0.93, "cameras": 1.0}
    prior = ShapePrior(vertices=np.zeros((3, 3)), faces=np.array([[0, 1, 2]]), backend="visual_hull, back: none", facts=facts)
    assert {"warning: volume of the hull", "warning: invented surface"} < said(look_at_lifted(tracked(BOX), prior, 1.0))
    half = replace(prior, facts={"volume": 0.002, "invented_share": 0.5, "cameras": 1.0})
    assert said(look_at_lifted(tracked(BOX), half, 1.0)) == {"note: size of the object", "note: invented surface"}


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


@pytest.mark.parametrize(("count", "frames", "level"), [(3, 20, "warning"), (1, 20, "note")])
def test_a_hand_on_the_object_without_controllers_is_said(count, frames, level):
    short = tracked(BOX)
    many = {name: np.repeat(getattr(short, name)[:1], frames, axis=0) for name in ("object_points", "object_visibility")}
    many |= {"object_motion_valid": np.ones((frames, len(BOX)), bool), "controller_points": np.zeros((frames, 3, 3))}
    long = replace(short, **many, facts={"stray_hand_frames": float(count), "stray_hand_first": 2.0})
    [found] = [one for one in look_at_lifted(long, no_prior(), 1.0) if one.name == "hand without controllers"]
    assert found.level == level and f"in {count} training frames, first in frame 2" in found.text


def observed(hand: np.ndarray, step: np.ndarray, rate: float = 30.0, follows: bool = True) -> Observations:
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
