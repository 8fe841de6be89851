"""Units and rates: what is guessed is said, and a scene that is no table in a room is refused with what would be plausible."""

import re

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.extensions.make_capture.table import find_rate, find_unit


def depth(value, kind=np.uint16):
    return [np.array([[0, value], [value, value]], dtype=kind)]


@pytest.mark.parametrize(
    ("value", "kind", "unit"), [(700, np.uint16, 0.001), (0.7, np.float32, 1.0), (700.0, np.float32, 0.001), (700, np.int32, 0.001)]
)
def test_a_unit_is_guessed_and_said(value, kind, unit):
    found = find_unit("depth", depth(value, kind), None)
    assert found.meters == unit
    assert "guessed from" in found.text() and "median depth 0.70 m" in found.text()


def test_a_given_unit_counts_and_that_of_the_source_is_next():
    assert find_unit("depth", depth(7000), 0.0001, 0.001).how == "given"
    text = find_unit("depth", depth(7000), None, 0.0001).text()
    assert text.startswith("0.0001 m per count (tenths of a millimeter), as the source")


@pytest.mark.parametrize(
    ("value", "given", "message"),
    [
        (900, 1.0, "received 1 m per count, which makes it 900 m. Plausible would be 0.001 (millimeters) or 0.00025"),
        (7000, 1e-6, "which makes it 0.007 m. Plausible would be 0.001 (millimeters) or 0.0001"),
        (7000, None, "cannot be guessed: whole numbers with a median of 7000. Plausible would be 0.001 (millimeters) or 0.0001"),
        (0, 0.001, "some depth is required; received 0 in every pixel"),
        (700, -1.0, "meters per count, above 0, are required; received -1.0"),
        (50, 1e-6, "No common unit"),
    ],
)
def test_units_that_cannot_be(value, given, message):
    with pytest.raises(InputError, match=re.escape(message)):
        find_unit("depth", depth(value), given)


def test_the_rate_is_given_or_of_the_video_and_falls_with_the_stride():
    assert find_rate(30.0, [None], 1) == (30.0, "30 frames per second, given")
    assert find_rate(None, [29.97, 29.97], 2)[0] == pytest.approx(14.985, abs=0.02)
    assert "the source says 60" in find_rate(30.0, [60.0], 1)[1]


@pytest.mark.parametrize(
    ("given", "known", "message"),
    [
        (None, [None], "frames per second are required: folders, and points in space, do not have them"),
        (3000.0, [None], "lie between 1 and 240; received 3000"),
        (0.033, [None], "Give the rate at which it was filmed, not a time step"),
        (None, [30.0, 60.0], "all cameras must film at one rate; received 30 and 60"),
        (None, [1000.0], "lie between 1 and 240; received 1000"),
    ],
)
def test_rates_that_cannot_be(given, known, message):
    with pytest.raises(InputError, match=re.escape(message)):
        find_rate(given, known, 1)
