"""Pieces of automatic masks judged over a video, and what is said of masks that cannot be right."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.config.perception import OpenCvSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture, Writer
from neuspring.perception.findings import WRONG, look_at_masks, mask_facts
from neuspring.perception.segment_opencv import _region, _slim, _thin, changing, sort_pieces
from tests.support.captures import describe, entry

SIZE = (48, 64)
FRAMES = 5


def scene(folder, *, moving=True):
    """A toy that goes right, held by a hand with a sleeve that reaches the border, and a box that stands still."""
    writer = Writer(folder, describe(cameras=(entry("0", 64, 48),), masks=False))
    labels = np.zeros((FRAMES, *SIZE), np.uint8)
    for frame in range(FRAMES):
        left = 10 + (2 * frame if moving else 0)
        image, depth = np.full((*SIZE, 3), 120, np.uint8), np.full(SIZE, 900, np.uint16)
        parts = {
            "toy": (slice(20, 32), slice(left, left + 12)),
            "hand": (slice(20, 28), slice(left + 12, left + 18)),
            "sleeve": (slice(22, 27), slice(left + 18, 64)),
            "box": (slice(36, 46), slice(4, 24)),
        }
        for shade, (name, part) in enumerate(parts.items()):
            image[part] = 30 + 50 * shade
            # Hand and sleeve reach over things.
            depth[part] = 800
            labels[frame][part] = HANDS if name == "hand" else OBJECT
        # The sleeve is striped, so that it is seen to move.
        image[22:27, left + 18 :: 4] = 250
        writer.frame("0", frame, image, depth)
    return writer.finish(), labels


def test_with_all_settings_off_labels_are_left_alone(tmp_path):
    capture, labels = scene(tmp_path)
    assert sort_pieces(capture, "0", labels, OpenCvSegmentation()) is labels


def test_a_sleeve_that_moves_and_touches_the_hand_is_hand(tmp_path):
    capture, labels = scene(tmp_path)
    sorted_ = sort_pieces(capture, "0", labels, OpenCvSegmentation(sleeves=True))
    assert (sorted_[0][22:27, 40:64] == HANDS).all()
    assert (sorted_[0][20:32, 10:22] == OBJECT).all()
    assert (sorted_[0][36:46, 4:24] == OBJECT).all()
    assert (labels[0][22:27, 40:64] == OBJECT).all(), "the labels that were given are left alone"


def test_what_never_moves_is_clutter(tmp_path):
    capture, labels = scene(tmp_path)
    assert changing(capture, "0")[24, 12]
    assert not changing(capture, "0")[40, 12]
    sorted_ = sort_pieces(capture, "0", labels, OpenCvSegmentation(clutter="drop"))
    assert not sorted_[:, 36:46, 4:24].any()
    assert (sorted_[2][20:32, 14:26] == OBJECT).all()


@pytest.mark.parametrize(("rule", "toy"), [("moving", True), ("nearest_hand", True), ("largest", False)])
def test_one_object_is_taken_and_named(tmp_path, capsys, rule, toy):
    capture, labels = scene(tmp_path)
    sorted_ = sort_pieces(capture, "0", labels, OpenCvSegmentation(sleeves=True, object=rule))
    for frame in range(FRAMES):
        assert (sorted_[frame, 24, 12 + 2 * frame] == OBJECT) == toy
        assert (sorted_[frame, 40, 12] == OBJECT) != toy
    out = capsys.readouterr().out
    assert f"frame 0: 2 pieces; taken ({rule}): {144 if toy else 200} pixels" in out
    assert f"left: {200 if toy else 144} pixels" in out


def test_a_region_of_interest_in_pixels_and_on_the_table(tmp_path):
    capture, _ = scene(tmp_path)
    box = _region(capture, "0", 0, OpenCvSegmentation(boxes={"0": (10.0, 20.0, 21.0, 31.0)}))
    assert box.sum() == 144
    assert box[20:32, 10:22].all()
    everywhere = _region(capture, "0", 0, OpenCvSegmentation(boxes={"1": (0.0, 0.0, 1.0, 1.0)}))
    assert everywhere.all()
    # The camera stands at (0.1, 0.2, 0.9) m, looks down and has 40 px / m at 1 m: x = 0.1 + z (u - 31.5) / 40.
    half = _region(capture, "0", 0, OpenCvSegmentation(table=((0.1, 9.0), (-9.0, 9.0))))
    assert half[:, 32:].all()
    assert not half[:, :32].any()
    with pytest.raises(InputError, match=r"opencv\.boxes\.0: must hold a pixel of the image of 64 x 48"):
        _region(capture, "0", 0, OpenCvSegmentation(boxes={"0": (70.0, 0.0, 80.0, 9.0)}))


def test_a_rope_of_two_pixels_is_kept_whole():
    image = np.full((40, 60, 3), 180, np.uint8)
    ratio, height = np.full((40, 60), -2.0), np.full((40, 60), 0.001)
    image[20:22, 5:55], ratio[20:22, 5:55] = (200, 60, 60), 2.5
    height[20:22, 5:55] = 0.008
    ratio[5, 5] = 2.0
    found = _thin(image, ratio, height, OpenCvSegmentation(thin=True))
    assert found[20:22, 5:55].all()
    assert found.sum() == 100


def test_fingers_at_a_thin_rope_are_hand():
    labels = np.zeros((40, 60), np.uint8)
    labels[14:26, 40:52] = labels[20:22, 5:55] = labels[30:38, 5:15] = OBJECT
    labels[2:14, 40:52] = HANDS
    slim = _slim(labels)
    assert (slim[15:25, 41:51] == HANDS).all()
    assert (slim[20:22, 5:36] == OBJECT).all()
    assert (slim[30:38, 5:15] == OBJECT).all(), "what is wide and touches no hand is left alone"


def wrong(capture, labels: np.ndarray) -> list[str]:
    """Names of the findings of masks that cannot be right."""
    return [one.name for one in look_at_masks(capture, "0", labels, mask_facts(capture, "0", labels)) if one.name in WRONG]


def test_masks_that_can_be_right_have_no_findings(tmp_path):
    capture, labels = scene(tmp_path)
    kept = sort_pieces(capture, "0", labels, OpenCvSegmentation(sleeves=True, clutter="drop"))
    facts = mask_facts(capture, "0", kept)
    assert wrong(capture, kept) == []
    assert facts["area_jumps"] == 0
    assert facts["object_at_border"] == 0


def test_masks_that_cannot_be_right_are_found(tmp_path):
    capture, labels = scene(tmp_path)
    broken = labels.copy()
    broken[:, :3] = OBJECT
    broken[1::2, 5:12, 5:60] = OBJECT
    assert wrong(capture, broken) == ["background in the mask", "mask flickers", "labels are noise"]
    assert mask_facts(capture, "0", broken)["object_at_border"] > 0.25
    print_on_toy = np.zeros_like(labels)
    print_on_toy[:, 10:30, 10:40], print_on_toy[:, 15:20, 15:20] = OBJECT, HANDS
    assert mask_facts(capture, "0", print_on_toy)["hands_inside"] == 1
    assert wrong(capture, print_on_toy) == ["hands inside the object"]
    mostly_hand = np.full_like(labels, HANDS)
    mostly_hand[:, 10:14, 10:14] = OBJECT
    assert "hands too large" in wrong(capture, mostly_hand)


def test_what_is_wrong_is_said_once(tmp_path):
    capture, labels = scene(tmp_path)
    broken = labels.copy()
    broken[:, :3] = OBJECT
    broken[1::2, 5:12, 5:60] = OBJECT
    names = [one.name for one in look_at_masks(capture, "0", broken, mask_facts(capture, "0", broken))]
    assert len(set(names)) == len(names)
    assert not {"object at the border", "mask jumps"} & set(names)


def test_a_single_frame_is_no_error(tmp_path):
    capture, labels = scene(tmp_path)
    one = Capture(capture.folder, replace(capture.description, frame_count=1))
    assert wrong(one, sort_pieces(one, "0", labels[:1], OpenCvSegmentation())) == []
    camera = replace(capture.description.cameras[0], missing=tuple(range(FRAMES)))
    none = Capture(capture.folder, replace(capture.description, cameras=(camera,)))
    assert look_at_masks(none, "0", labels, mask_facts(none, "0", labels)) == []
