"""Findings of the steps of perception, each provoked once, with its text."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, finding, findings_of, refuse_errors, told
from neuspring.core.records import Recorder
from neuspring.data.capture import HANDS, OBJECT, Writer
from neuspring.perception.findings import look_at_lifted, look_at_masks, look_at_observations, look_at_tracks, mask_facts
from neuspring.perception.results import LiftedTracks, ShapePrior
from neuspring.perception.shape import no_prior
from tests.support.captures import FRAMES, describe, entry

SIZE = (90, 120)


@pytest.fixture
def capture(tmp_path):
    """A camera with depth everywhere."""
    intrinsics = ((150.0, 0.0, 59.5), (0.0, 150.0, 44.5), (0.0, 0.0, 1.0))
    camera = replace(entry(width=SIZE[1], height=SIZE[0]), intrinsics=intrinsics)
    writer = Writer(tmp_path, describe(cameras=(camera,)))
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


def texts(findings: list[Finding]) -> str:
    return "\n".join(map(str, findings))


def test_good_masks_have_no_findings(capture):
    assert looked_at(capture, scene()) == []


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


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (
            moved_to_the_border,
            "object at the border: the object touches the image border in 3 frames, first in frame 2; what is outside is neither",
        ),
        (emptied, "object missing: almost nothing of the object in 2 frames, first in frame 3"),
        (split, "two objects: the object's mask of frame 0 has 2 pieces far apart"),
        (shrunk, "mask jumps: the object's area changes 2.3-fold from frame 1 to 2 (so in 2 frames); less than 2-fold is expected"),
        (sleeves, "hands too large: hands (label 2) of 2159 cm², 8.4 times the object's pixels; less than 1200 cm² and 12 times"),
        (without_hand, "no hand in frame 0: no pixel with label 2 in frame 0"),
        (tiny, "small object: 100 pixels of object in frame 0; at least 200 are expected. Film from nearer by."),
    ],
)
def test_masks_that_cannot_be_right_are_said(capture, spoil, text):
    labels = scene()
    spoil(labels)
    assert f"warning: camera 0: {text}" in texts(looked_at(capture, labels))


def test_an_object_without_depth_is_said(capture):
    for frame in range(FRAMES):
        depth = np.full(SIZE, 800, np.uint16)
        depth[30:45, 40:70] = 0
        cv2.imwrite(str(capture.path("depth", "0", frame)), depth)
    assert "depth holes: 50% of the object's pixels have no depth (frame 0: 50%); at most 40% are expected" in texts(
        looked_at(capture, scene())
    )


def test_lost_and_few_tracks_are_said():
    labels = scene()
    y, x = (values[::10] for values in np.nonzero(labels[0] == OBJECT))
    pixels = np.repeat(np.stack([x, y], axis=1)[None].astype(float), FRAMES, axis=0)
    visible = np.ones(pixels.shape[:2], bool)
    assert look_at_tracks("0", labels, pixels, visible) == []
    visible[3:, 3:] = False
    assert "tracks lost: 3% of the object's points are followed in frame 3; few in 2 frames" in texts(
        look_at_tracks("0", labels, pixels, visible)
    )
    few = look_at_tracks("0", labels, pixels[:, :20], np.ones((FRAMES, 20), bool))
    assert "few tracks: 20 points are followed on the object; at least 50 are expected" in texts(few)


BOX = np.random.default_rng(0).uniform((0, 0, 0), (0.1, 0.1, 0.1), (200, 3))


def lifted(points: np.ndarray = BOX) -> LiftedTracks:
    count = len(points)
    return LiftedTracks(
        object_points=np.repeat(points[None], FRAMES, axis=0),
        object_visibility=np.ones((FRAMES, count), bool),
        object_motion_valid=np.ones((FRAMES, count), bool),
        object_colors=np.zeros((count, 3)),
        controller_points=np.zeros((FRAMES, 1, 3)),
        cloud=points,
        cloud_colors=np.zeros((count, 3)),
        backend="x",
    )


def test_size_and_place_of_the_object_are_said():
    good = look_at_lifted(lifted(), no_prior(), 1.0)
    assert [one.level for one in good] == ["note"]
    assert "size of the object: 9 x 9 x 9 cm" in texts(good)
    assert "implausible size" not in texts(good)
    large = texts(look_at_lifted(lifted(20.0 * BOX), no_prior(), 1.0))
    assert "warning: object in frame 0: implausible size: 18" in large
    below = texts(look_at_lifted(lifted(BOX - [0, 0, 0.06]), no_prior(), 1.0))
    assert "object below the table: it reaches 5." in below
    # The same with z down: above and below are exchanged.
    assert "object below the table" in texts(look_at_lifted(lifted(), no_prior(), -1.0))


def test_volume_and_invented_surface_are_said():
    facts = {"volume": 0.0286, "invented_share": 0.93, "cameras": 1.0}
    prior = ShapePrior(vertices=np.zeros((3, 3)), faces=np.array([[0, 1, 2]]), backend="visual_hull, back: none", facts=facts)
    said = texts(look_at_lifted(lifted(), prior, 1.0))
    assert "warning: shape: volume of the hull: 28.6 liters; at most 12 liters are expected of a thing that hands hold" in said
    assert "warning: shape: invented surface: no camera saw 93% of the surface (visual_hull, back: none); at most 80%" in said
    half = replace(prior, facts={"volume": 0.002, "invented_share": 0.5, "cameras": 1.0}, backend="visual_hull, back: fraction")
    said = texts(look_at_lifted(lifted(), half, 1.0))
    assert "note: shape: invented surface: no camera saw 50% of the surface (visual_hull, back: fraction)" in said
    assert "volume" not in said


def test_distrusted_motion_and_lost_points_are_said():
    tracks = lifted()
    spoiled = replace(tracks, object_motion_valid=np.zeros((FRAMES, 200), bool))
    assert "motion not trusted: 0% of the object's motions are trusted" in texts(look_at_lifted(spoiled, no_prior(), 1.0))
    visible = np.ones((FRAMES, 200), bool)
    visible[3:, 2:] = False
    said = texts(look_at_lifted(replace(tracks, object_visibility=visible), no_prior(), 1.0))
    assert "points lost: 1% of the object's points are seen in frame 3; few in 2 frames" in said
    assert "End the capture before frame 3." in said


def test_a_hand_that_grips_elsewhere_is_said():
    said = texts(look_at_lifted(replace(lifted(), facts={"grip_elsewhere": 3.0}), no_prior(), 1.0))
    assert "warning: controllers: grip elsewhere: in frame 3 a hand comes back to another part of the object" in said
    assert "End the capture before frame 3." in said


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


def test_a_good_grip_has_no_findings():
    assert look_at_observations(observed(ABOVE, SLOW)) == []


@pytest.mark.parametrize(
    ("observations", "text"),
    [
        (
            observed(ABOVE + np.array([0, 0, 0.06]), SLOW),
            "controllers hold nothing: in frame 0 none of 3 has a point of the object within 4 cm",
        ),
        (observed(ABOVE, 0.0 * SLOW), "controllers stand still: they move 0.0 mm; at least 5 mm"),
        (observed(ABOVE, SLOW, follows=False), "object stands still: the object moves 0.0 mm in the training frames"),
        (observed(ABOVE, SLOW, rate=3000.0), "controllers too fast: 30 m/s between frames"),
    ],
)
def test_implausible_hands_are_said(observations, text):
    assert text in texts(look_at_observations(observations))


def test_a_hand_that_never_comes_near_is_refused():
    found = look_at_observations(observed(ABOVE + np.array([0, 0, 0.5]), SLOW))
    with pytest.raises(InputError, match=r"hand far from the object: the hand is never nearer to the object than 5\d cm"):
        refuse_errors(found)


def test_findings_are_printed_kept_and_found_again(tmp_path, capsys):
    one = finding("a thing", "warning", "camera 0", "5 of it", "at most 3", "Look at it.")
    recorder = Recorder("segment", tmp_path / "scene" / "perception" / "0" / "masks.json")
    recorder.output.parent.mkdir(parents=True)
    recorder.save(facts={"x": 1.0} | told([one]))
    assert capsys.readouterr().out == "warning: camera 0: a thing: 5 of it; at most 3. Look at it.\n"
    assert findings_of(tmp_path, "scene") == [one]
    assert told([]) == {}
    (tmp_path / "scene" / "observations.json").write_text("{")
    assert findings_of(tmp_path, "scene") == [one]
