"""The file of annotations: valid and invalid content, and reading after writing."""

import json

import pytest

from neuspring.core.errors import InputError
from neuspring.perception.marks import Mark, Marks, marks_digest
from tests.support.filmed import film
from tests.support.marked import mark


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film"), cameras=1, missing={0: (3,)})


def test_marks_come_back_as_they_were(tmp_path):
    own = (mark("object", "box", [(1, 2.5), (30, 40)]), mark("ignore", "scribble", [(0, 0), (5, 5), (9, 1)], 2, 1.5))
    marks = Marks(cameras={"0": own, "left": ()})
    marks.save(tmp_path / "marks.json")
    assert Marks.load(tmp_path / "marks.json") == marks
    assert marks.of("nobody") == ()


def test_marks_that_are_not_there_lead_to_the_browser(tmp_path):
    with pytest.raises(InputError, match=r"no such file. Draw them in the browser: `neuspring annotate .*`"):
        Marks.load(tmp_path / "marks.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"label": "cat"}, r"label.*'object', 'hand', 'ignore' or 'person'.*received 'cat'"),
        ({"frame": -1}, "frame.*greater than or equal to 0"),
        ({"points": ((1, 2),)}, "a box must have 2 points; received 1"),
        ({"points": ((1, 2), (1.5, 9))}, "corners of a box must be at least one pixel apart"),
        ({"kind": "polygon"}, "a polygon must have 3 points or more; received 2"),
        ({"radius": 0}, "radius.*greater than 0"),
    ],
)
def test_a_mark_that_cannot_be_is_refused_in_a_file_and_in_python(tmp_path, change, message):
    plain = {"frame": 0, "label": "object", "kind": "box", "points": ((1, 2), (30, 40))} | change
    (tmp_path / "marks.json").write_text(json.dumps({"format": 1, "cameras": {"0": [plain]}}))
    with pytest.raises(InputError, match=message):
        Marks.load(tmp_path / "marks.json")
    if message.startswith("a "):
        with pytest.raises(InputError, match=message):
            Mark(**plain)


@pytest.mark.parametrize(
    ("camera", "own", "message"),
    [
        ("7", mark("object", "click", [(5, 5)]), r"cameras\.7: the capture must have this camera; received \['0'\]"),
        ("0", mark("object", "click", [(5, 5)], frame=6), r"marks\.json, cameras\.0\[0\]\.frame: must be below 6.*received 6"),
        ("0", mark("object", "click", [(5, 5)], frame=3), "must be on recorded frames; received 3"),
        ("0", mark("object", "click", [(160, 5)]), r"points: must be inside the image of 160 x 90 pixels; received \[160"),
        ("0", mark("hand", "click", [(5, 5)]), r"an object must be annotated in at least one frame; received \['hand'\]"),
    ],
)
def test_marks_that_do_not_fit_the_capture_are_refused(capture, camera, own, message):
    with pytest.raises(InputError, match=message):
        Marks(cameras={camera: (own,)}).require(capture)


def test_the_digest_forgets_the_order_and_nothing_else():
    first, second = mark("object", "click", [(5, 5)]), mark("hand", "click", [(9, 5)])
    assert marks_digest((first, second)) == marks_digest((second, first))
    assert marks_digest((first,)) != marks_digest((mark("object", "click", [(5, 5)], radius=4.0),))
