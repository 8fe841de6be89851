"""Segmentation without a network on a video with known masks, and implausible masks."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.checks.masks import mask_facts
from neuspring.checks.perceived import look_at_masks
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture, Writer
from neuspring.data.frames import overlap
from neuspring.perception import segment_opencv
from tests.support.captures import describe, entry
from tests.support.filmed import FRAMES, film

SIZE = (48, 64)
PIECES = 5


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film"), cameras=2, missing={1: (3,)})


WRONG = ("background in the mask", "mask flickers", "hands too large", "hands inside the object", "labels are noise")


def agreement(capture, labels, camera, frame, label):
    return overlap(labels[frame] == label, capture.mask(camera, frame) == label)


@pytest.mark.parametrize("camera", ["0", "1"])
def test_object_and_hand_are_found_and_told_apart(capture, camera):
    labels = segment_opencv.segment(capture, camera)
    for frame in range(FRAMES):
        if capture.has(camera, frame):
            assert agreement(capture, labels, camera, frame, OBJECT) > 0.9
            assert agreement(capture, labels, camera, frame, HANDS) > 0.85
        else:
            assert not labels[frame].any()


def test_an_empty_table_has_no_object(tmp_path):
    writer = Writer(tmp_path, describe(cameras=(entry("0", 64, 48),), masks=False))
    for frame in range(5):
        writer.frame("0", frame, np.full((48, 64, 3), 120, np.uint8), np.full((48, 64), 900, np.uint16))
    with pytest.raises(InputError, match=r"an object more than 12 mm above the table z = 0 is required; received nothing"):
        segment_opencv.segment(writer.finish(), "0")


def test_without_a_hand_s_color_all_is_object(capture, capsys, monkeypatch):
    monkeypatch.setattr(segment_opencv, "HAND_HUE", (100.0, 110.0))
    labels = segment_opencv.segment(capture, "0")
    assert set(np.unique(labels)) == {0, OBJECT}
    assert "nothing above the table has the color of hands (hue in [100.0, 110.0] degrees" in capsys.readouterr().out


def test_small_pieces_of_hand_color_belong_to_the_object():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:30, 5:35] = OBJECT
    labels[10:14, 5:9] = HANDS
    labels[5:25, 40:55] = HANDS
    tidy = segment_opencv._tidy(labels)
    assert (tidy[10:14, 5:9] == OBJECT).all()
    assert (tidy[5:25, 40:55] == HANDS).all()


def test_small_holes_are_filled_and_large_ones_stay():
    seen = np.zeros((80, 120), bool)
    seen[5:75, 5:115] = True
    seen[10:12, 10:12] = False
    seen[20:30, 20:40] = False
    filled = seen | segment_opencv._holes(seen)
    assert filled[10:12, 10:12].all()
    assert not filled[20:30, 20:40].any()
    assert not filled[:5].any()


def scene(folder):
    """A toy that goes right, held by a hand with a sleeve that reaches the border, and a box that is not marked."""
    writer = Writer(folder, describe(cameras=(entry("0", 64, 48),), masks=False))
    labels = np.zeros((PIECES, *SIZE), np.uint8)
    for frame in range(PIECES):
        left = 10 + 2 * frame
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
            labels[frame][part] = {"toy": OBJECT, "box": 0}.get(name, HANDS)
        writer.frame("0", frame, image, depth)
    return writer.finish(), labels


def wrong(capture, labels):
    """Names of the findings of masks that cannot be right."""
    return [one.name for one in look_at_masks(capture, "0", labels, mask_facts(capture, "0", labels)) if one.name in WRONG]


def test_masks_that_can_be_right_have_no_findings(tmp_path):
    capture, labels = scene(tmp_path)
    facts = mask_facts(capture, "0", labels)
    assert wrong(capture, labels) == []
    assert facts["area_jumps"] == 0
    assert facts["object_at_border"] == 0


def test_masks_that_cannot_be_right_are_found(tmp_path):
    capture, labels = scene(tmp_path)
    broken = labels.copy()
    broken[:, :3] = OBJECT
    broken[1::2, 5:12, 5:60] = OBJECT
    names = [one.name for one in look_at_masks(capture, "0", broken, mask_facts(capture, "0", broken))]
    assert [name for name in names if name in WRONG] == ["background in the mask", "mask flickers", "labels are noise"]
    assert len(set(names)) == len(names) and not {"object at the border", "mask jumps"} & set(names), "it is said once"
    assert mask_facts(capture, "0", broken)["object_at_border"] > 0.25
    print_on_toy = np.zeros_like(labels)
    print_on_toy[:, 10:30, 10:40], print_on_toy[:, 15:20, 15:20] = OBJECT, HANDS
    assert mask_facts(capture, "0", print_on_toy)["hands_inside"] == 1
    assert wrong(capture, print_on_toy) == ["hands inside the object"]
    mostly_hand = np.full_like(labels, HANDS)
    mostly_hand[:, 10:14, 10:14] = OBJECT
    assert "hands too large" in wrong(capture, mostly_hand)


def test_a_single_frame_is_no_error(tmp_path):
    capture, labels = scene(tmp_path)
    assert wrong(Capture(capture.folder, replace(capture.description, frame_count=1)), labels[:1]) == []
    camera = replace(capture.description.cameras[0], missing=tuple(range(PIECES)))
    none = Capture(capture.folder, replace(capture.description, cameras=(camera,)))
    assert look_at_masks(none, "0", labels, mask_facts(none, "0", labels)) == []
