"""Annotations propagated through videos with known masks."""

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, PERSON
from neuspring.extensions.color_alone.segment import carry_film, frame_mask
from tests.support.marked import SIZE, SQUARE, Painted, mark, overlap, painted, rope


def test_an_object_and_the_hand_over_it_are_carried():
    film, heard = painted(), []
    carried = carry_film(film, SQUARE, progress=lambda done, total: heard.append((done, total)))
    for frame in range(film.count):
        assert overlap(carried.labels[frame], film.truth[frame], OBJECT) > 0.9, frame
        assert overlap(carried.labels[frame], film.truth[frame], HANDS) > 0.8, frame
    assert carried.doubt.shape == (film.count,)
    assert (carried.doubt >= 0).all()
    assert (carried.doubt <= 1).all()
    assert [done for done, _ in heard] == list(range(1, heard[0][1] + 1))
    assert heard[-1][0] == heard[-1][1]


def test_a_box_and_a_click_are_enough_for_one_frame():
    film = painted(1)
    marks = [mark("object", "box", [(15, 24), (48, 56)]), mark("hand", "scribble", [(38, 2), (38, 24)], radius=2.0)]
    labels = frame_mask(film, 0, marks)
    assert overlap(labels, film.truth[0], OBJECT) > 0.85
    assert overlap(labels, film.truth[0], HANDS) > 0.8


def test_a_frame_may_show_a_hand_alone():
    labels = frame_mask(painted(1), 0, SQUARE[1:])
    assert overlap(labels, painted(1).truth[0], HANDS) > 0.8
    assert not (labels == OBJECT).any()


def test_a_thin_rope_stays_whole():
    film = rope()
    ends = [(12, 30), (41, 37), (70, 37), (100, 31)]
    carried = carry_film(film, [mark("object", "scribble", ends, radius=1.5)])
    for frame in range(film.count):
        assert overlap(carried.labels[frame], film.truth[frame], OBJECT) > 0.7, frame


def test_a_cut_in_the_film_is_doubted_most():
    film = painted(9, hand=False)
    frames = [*film.frames[:5], *(np.ascontiguousarray(frame[:, ::-1]) for frame in film.frames[5:])]
    whole, cut = (carry_film(Painted(own, film.truth), SQUARE[:1]).doubt for own in (film.frames, frames))
    assert cut.argmax() == 5
    assert cut[5] > 0.8
    assert whole.max() < 0.4


def test_a_hand_that_is_marked_later_is_known_before_too():
    film = painted(6)
    late = mark("hand", "scribble", [(53, 2), (53, 26)], frame=5, radius=2.0)
    carried = carry_film(film, [SQUARE[0], late])
    assert overlap(carried.labels[5], film.truth[5], HANDS) > 0.7
    assert overlap(carried.labels[3], film.truth[3], HANDS) > 0.6


def test_what_a_hand_uncovers_of_a_cloth_is_object():
    """A fold beneath it has the color of the wall, and no mark knows it as the cloth's. It was taken for the wall."""
    made, (rows, columns) = painted(8, hand=False, step=0.0), np.indices(SIZE)
    cloth, fold = (
        (rows >= 24) & (rows < 68) & (columns >= 25) & (columns < 95),
        (np.abs(columns - 60) < 9) & (np.abs(rows - 42) < 9),
    )
    grain = cv2.GaussianBlur(np.random.default_rng(7).normal(0, 1, SIZE), (0, 0), 1.5)[..., None]
    for frame, image in enumerate(made.frames):
        hand = (np.abs(columns - 60) < 10) & (rows < 52 - 5 * frame)
        for place, color in ((rows < 22, (50, 75, 35)), (cloth, (100, 120, 80)), (fold, (50, 75, 35)), (hand, (190, 120, 95))):
            image[place] = np.clip(color + 25 * grain[place], 0, 255)
    outline, arm = [(25, 24), (94, 24), (94, 67), (25, 67)], [(50, 0), (69, 0), (69, 51), (50, 51)]
    marks = [mark("object", "polygon", outline, radius=2.0), mark("hand", "polygon", arm, radius=2.0)]
    assert (carry_film(made, marks).labels[-1][fold] == OBJECT).mean() > 0.7


def visited(color):
    """A film into which a sleeve comes from the right in frame 2; and where it is [T, H, W] bool."""
    made, (rows, columns) = painted(8), np.indices(SIZE)
    grain = cv2.GaussianBlur(np.random.default_rng(7).normal(0, 1, SIZE), (0, 0), 1.5)[..., None]
    sleeve = np.zeros(made.truth.shape, bool)
    for frame, image in enumerate(made.frames):
        sleeve[frame] = (columns > 112 - 10 * max(frame - 1, 0)) & (rows >= 36) & (rows < 60)
        image[sleeve[frame]] = np.clip(color + 30 * grain[sleeve[frame]], 0, 255)
        made.truth[frame][sleeve[frame]] = 0
    return made, sleeve


SLEEVE = mark("person", "scribble", [(70, 48), (108, 48)], frame=6, radius=4.0)


def test_a_person_that_is_marked_once_is_neither_object_nor_hand_in_any_frame():
    """Its sleeve has nearly the color of the hands, and counted as one."""
    film, sleeve = visited((180, 110, 92))
    plain, known = (carry_film(film, marks).labels for marks in (SQUARE, [*SQUARE, SLEEVE]))
    assert np.isin(plain[sleeve], (OBJECT, HANDS)).mean() > 0.5
    assert np.isin(known[sleeve], (OBJECT, HANDS)).mean() < 0.05
    assert all((known[frame][sleeve[frame]] == PERSON).mean() > 0.7 for frame in (4, 5, 6, 7))
    assert overlap(known[7], film.truth[7], OBJECT) > 0.85


def test_a_mark_corrects_what_was_carried():
    film = painted(5, hand=False)
    there = mark("ignore", "polygon", [(32, 24), (60, 24), (60, 56), (32, 56)], frame=4, radius=1.0)
    assert not (carry_film(film, [SQUARE[0], there]).labels[4][26:54, 34:58] == OBJECT).any()


@pytest.mark.parametrize(
    ("marks", "message"),
    [
        ([], "an object must be annotated in at least one frame; received 0"),
        (SQUARE[1:], "an object must be annotated"),
        ([mark("object", "click", [(500, 5)])], "must be inside the image of 112 x 72 pixels"),
        ([mark("object", "click", [(5, 5)], frame=99)], "must be below 3"),
    ],
)
def test_marks_that_carry_nothing_are_refused(marks, message):
    with pytest.raises(InputError, match=message):
        carry_film(painted(3), marks)


def test_a_frame_without_marks_has_no_mask_of_its_own():
    with pytest.raises(InputError, match="frame 1: an object or a hand must be annotated in it"):
        frame_mask(painted(2), 1, SQUARE)
