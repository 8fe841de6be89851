"""Segmentation without a network on a film whose masks are known, pieces that are judged over a video, and what cannot be right."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.config.perception import OpenCvSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture, Writer
from neuspring.perception import segment_opencv
from neuspring.perception.findings import WRONG, look_at_masks, mask_facts
from neuspring.perception.frames import overlap
from tests.support.captures import describe, entry
from tests.support.filmed import FRAMES, film

SIZE = (48, 64)
PIECES = 5


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film"), cameras=2, missing={1: (3,)})


def agreement(capture, labels, camera: str, frame: int, label: int) -> float:
    return overlap(labels[frame] == label, capture.mask(camera, frame) == label)


@pytest.mark.parametrize("camera", ["0", "1"])
def test_object_and_hand_are_found_and_told_apart(capture, camera):
    labels = segment_opencv.segment(capture, camera, OpenCvSegmentation())
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
        segment_opencv.segment(writer.finish(), "0", OpenCvSegmentation())


def test_without_a_hand_s_color_all_is_object_and_the_settings_are_named(capture, capsys):
    labels = segment_opencv.segment(capture, "0", OpenCvSegmentation(hand_hue=(100.0, 110.0)))
    assert set(np.unique(labels)) == {0, OBJECT}
    assert "nothing above the table has the color of hands (hue in [100.0, 110.0] degrees" in capsys.readouterr().out


def test_small_pieces_of_hand_color_belong_to_the_object():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:30, 5:35] = OBJECT
    labels[10:14, 5:9] = HANDS
    labels[5:25, 40:55] = HANDS
    tidy = segment_opencv._tidy(labels, OpenCvSegmentation())
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


def scene(folder, *, moving=True):
    """A toy that goes right, held by a hand with a sleeve that reaches the border, and a box that stands still."""
    writer = Writer(folder, describe(cameras=(entry("0", 64, 48),), masks=False))
    labels = np.zeros((PIECES, *SIZE), np.uint8)
    for frame in range(PIECES):
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


def test_a_sleeve_that_moves_and_touches_the_hand_is_hand(tmp_path):
    capture, labels = scene(tmp_path)
    assert segment_opencv.sort_pieces(capture, "0", labels, OpenCvSegmentation()) is labels
    sorted_ = segment_opencv.sort_pieces(capture, "0", labels, OpenCvSegmentation(sleeves=True))
    assert (sorted_[0][22:27, 40:64] == HANDS).all()
    assert (sorted_[0][20:32, 10:22] == OBJECT).all()
    assert (sorted_[0][36:46, 4:24] == OBJECT).all()
    assert (labels[0][22:27, 40:64] == OBJECT).all(), "the labels that were given are left alone"


def test_what_never_moves_is_clutter(tmp_path):
    capture, labels = scene(tmp_path)
    assert segment_opencv.changing(capture, "0")[24, 12]
    assert not segment_opencv.changing(capture, "0")[40, 12]
    sorted_ = segment_opencv.sort_pieces(capture, "0", labels, OpenCvSegmentation(clutter="drop"))
    assert not sorted_[:, 36:46, 4:24].any()
    assert (sorted_[2][20:32, 14:26] == OBJECT).all()


@pytest.mark.parametrize(("rule", "toy"), [("moving", True), ("nearest_hand", True), ("largest", False)])
def test_one_object_is_taken_and_named(tmp_path, capsys, rule, toy):
    capture, labels = scene(tmp_path)
    sorted_ = segment_opencv.sort_pieces(capture, "0", labels, OpenCvSegmentation(sleeves=True, object=rule))
    for frame in range(PIECES):
        assert (sorted_[frame, 24, 12 + 2 * frame] == OBJECT) == toy
        assert (sorted_[frame, 40, 12] == OBJECT) != toy
    out = capsys.readouterr().out
    assert f"frame 0: 2 pieces; taken ({rule}): {144 if toy else 200} pixels" in out
    assert f"left: {200 if toy else 144} pixels" in out


def test_a_region_of_interest_in_pixels_and_on_the_table(tmp_path):
    capture, _ = scene(tmp_path)
    box = segment_opencv._region(capture, "0", 0, OpenCvSegmentation(boxes={"0": (10.0, 20.0, 21.0, 31.0)}))
    assert box.sum() == 144
    assert box[20:32, 10:22].all()
    everywhere = segment_opencv._region(capture, "0", 0, OpenCvSegmentation(boxes={"1": (0.0, 0.0, 1.0, 1.0)}))
    assert everywhere.all()
    # The camera stands at (0.1, 0.2, 0.9) m, looks down and has 40 px / m at 1 m: x = 0.1 + z (u - 31.5) / 40.
    half = segment_opencv._region(capture, "0", 0, OpenCvSegmentation(table=((0.1, 9.0), (-9.0, 9.0))))
    assert half[:, 32:].all()
    assert not half[:, :32].any()
    with pytest.raises(InputError, match=r"opencv\.boxes\.0: must hold a pixel of the image of 64 x 48"):
        segment_opencv._region(capture, "0", 0, OpenCvSegmentation(boxes={"0": (70.0, 0.0, 80.0, 9.0)}))


def test_a_rope_of_two_pixels_is_kept_whole():
    image = np.full((40, 60, 3), 180, np.uint8)
    ratio, height = np.full((40, 60), -2.0), np.full((40, 60), 0.001)
    image[20:22, 5:55], ratio[20:22, 5:55] = (200, 60, 60), 2.5
    height[20:22, 5:55] = 0.008
    ratio[5, 5] = 2.0
    found = segment_opencv._thin(image, ratio, height, OpenCvSegmentation(thin=True))
    assert found[20:22, 5:55].all()
    assert found.sum() == 100


def test_fingers_at_a_thin_rope_are_hand():
    labels = np.zeros((40, 60), np.uint8)
    labels[14:26, 40:52] = labels[20:22, 5:55] = labels[30:38, 5:15] = OBJECT
    labels[2:14, 40:52] = HANDS
    slim = segment_opencv._slim(labels)
    assert (slim[15:25, 41:51] == HANDS).all()
    assert (slim[20:22, 5:36] == OBJECT).all()
    assert (slim[30:38, 5:15] == OBJECT).all(), "what is wide and touches no hand is left alone"


def wrong(capture, labels: np.ndarray) -> list[str]:
    """Names of the findings of masks that cannot be right."""
    return [one.name for one in look_at_masks(capture, "0", labels, mask_facts(capture, "0", labels)) if one.name in WRONG]


def test_masks_that_can_be_right_have_no_findings(tmp_path):
    capture, labels = scene(tmp_path)
    kept = segment_opencv.sort_pieces(capture, "0", labels, OpenCvSegmentation(sleeves=True, clutter="drop"))
    facts = mask_facts(capture, "0", kept)
    assert wrong(capture, kept) == []
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
    one = Capture(capture.folder, replace(capture.description, frame_count=1))
    assert wrong(one, segment_opencv.sort_pieces(one, "0", labels[:1], OpenCvSegmentation())) == []
    camera = replace(capture.description.cameras[0], missing=tuple(range(PIECES)))
    none = Capture(capture.folder, replace(capture.description, cameras=(camera,)))
    assert look_at_masks(none, "0", labels, mask_facts(none, "0", labels)) == []
