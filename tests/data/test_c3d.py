"""Markers of C3D files: where they are lost, their unit, labels, counts."""

import sys
from pathlib import Path

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.c3d import Markers, is_c3d, plain_file
from tests.support.c3d_files import write_c3d

POINTS = np.arange(10 * 3 * 3, dtype=float).reshape(10, 3, 3) + 1
LABELS = ("LASI", "RASI", "C7")


@pytest.mark.parametrize(("unit", "meters"), [("mm", 0.001), ("cm", 0.01), ("m", 1.0), ("MM", 0.001)])
def test_frames_come_first_in_meters_with_the_rate_of_the_file(tmp_path, unit, meters):
    read = Markers.read(write_c3d(tmp_path / "a.c3d", POINTS, LABELS, unit, 120.0))
    np.testing.assert_allclose(read.points, POINTS * meters, rtol=1e-6)
    assert (read.labels, read.rate) == (LABELS, 120.0)


def test_a_lost_marker_has_a_negative_residual_and_one_at_the_origin_is_seen(tmp_path):
    points, lost = POINTS.copy(), np.zeros((10, 3), bool)
    points[4, 1], lost[6:8, 2], points[2, 0, 1] = 0, True, np.nan
    read = Markers.read(write_c3d(tmp_path / "a.c3d", points, LABELS, lost=lost)).points
    assert read[4, 1].tolist() == [0, 0, 0]
    missing = np.isnan(read).any(axis=2)
    assert np.argwhere(missing).tolist() == [[2, 0], [6, 2], [7, 2]]
    assert (np.isnan(read).all(axis=2) == missing).all()


def test_labels_choose_and_go_on_in_a_second_list_above_255(tmp_path):
    many = np.arange(6 * 300 * 3, dtype=float).reshape(6, 300, 3)
    path = write_c3d(tmp_path / "a.c3d", many, [f"M{k}" for k in range(300)])
    read = Markers.read(Path(f"{path}#M299,M254,M255"))
    np.testing.assert_allclose(read.points, many[:, [299, 254, 255]] / 1000, rtol=1e-6)
    with pytest.raises(InputError, match=r"each label must name exactly one marker; received 'M300'\. Labels: M0 "):
        Markers.read(Path(f"{path}#M300"))
    twice = write_c3d(tmp_path / "b.c3d", POINTS, ("A", "A", "B"))
    with pytest.raises(InputError, match="received 'A'"):
        Markers.read(Path(f"{twice}#A"))


@pytest.mark.parametrize("rest", ["", ",RASI"])
def test_a_unit_that_is_not_said_is_asked_for_and_the_answer_works(tmp_path, rest):
    path = write_c3d(tmp_path / "a.c3d", POINTS, LABELS, "")
    with pytest.raises(
        InputError, match=rf"POINT:UNITS.*received none in the file, none in the path\. State the unit: {path}#unit=mm{rest}"
    ) as error:
        Markers.read(Path(f"{path}{rest.replace(',', '#')}"))
    answer = str(error.value).rpartition("State the unit: ")[2].rstrip(".")
    read = Markers.read(Path(answer)).points
    np.testing.assert_allclose(read, (POINTS[:, [1]] if rest else POINTS) / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("unit", "given", "move"), [("m", "#unit=mm", "Remove unit="), ("furlong", "", "Export"), ("", "#unit=ft", "State the")]
)
def test_a_unit_that_contradicts_or_is_unknown_is_refused(tmp_path, unit, given, move):
    path = write_c3d(tmp_path / "a.c3d", POINTS, LABELS, unit)
    with pytest.raises(InputError, match=f"POINT:UNITS.*{move}"):
        Markers.read(Path(f"{path}{given}"))


def test_frames_beyond_the_counter_of_the_format_are_missed(tmp_path):
    """The library writes all of them, and reads 65,535."""
    frames = np.zeros((66_000, 1, 3))
    with pytest.raises(InputError, match=r"at most 65,535.; received 660\d\d frames, 65535 counted"):
        Markers.read(write_c3d(tmp_path / "a.c3d", frames, ["A"]))
    assert len(Markers.read(write_c3d(tmp_path / "b.c3d", frames[:65_535], ["A"])).points) == 65_535


def test_the_header_says_where_data_start_and_which_frame_is_first(tmp_path):
    """OptiTrack leaves POINT:DATA_START 0; a cut of a take begins at a later frame."""
    path = write_c3d(tmp_path / "a.c3d", POINTS, LABELS)
    whole = bytearray(path.read_bytes())
    place = whole.index(b"DATA_START") + len(b"DATA_START") + 4
    assert whole[place : place + 2] == whole[16:18]
    whole[place : place + 2] = bytes(2)
    whole[6:8] = (101).to_bytes(2, "little")
    whole[8:10] = (110).to_bytes(2, "little")
    path.write_bytes(whole)
    read = Markers.read(path)
    assert (read.first, len(read.points)) == (101, 10)


def test_a_file_of_an_sgi_processor_is_refused_with_the_way_out(tmp_path):
    path = write_c3d(tmp_path / "a.c3d", POINTS, LABELS)
    whole = bytearray(path.read_bytes())
    whole[512 * (whole[0] - 1) + 3] = 86
    path.write_bytes(whole)
    with pytest.raises(InputError, match=r"received SGI .* Export the file for Intel"):
        Markers.read(path)


def test_paths_with_and_without_labels():
    assert [is_c3d(Path(name)) for name in ("a.c3d", "b/A.C3D#L", "a.c3d#unit=mm", "a.csv", "c3d", "a.c3d/tracks.json")] == [
        True
    ] * 3 + [False] * 3
    assert plain_file(Path("b/A.C3D#unit=mm,L")) == Path("b/A.C3D") and plain_file(Path("a.csv")) == Path("a.csv")


def test_what_is_no_c3d_file_and_no_library(tmp_path, monkeypatch):
    (tmp_path / "a.c3d").write_bytes(b"nothing of the kind")
    for name in ("a.c3d", "absent.c3d"):
        with pytest.raises(InputError, match=f"{name}: a C3D file is required"):
            Markers.read(tmp_path / name)
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(InputError, match=r"package ezc3d: the extra \[recordings\] is required"):
        Markers.read(tmp_path / "a.c3d")
