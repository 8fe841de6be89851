"""Captures of scenes with hands in space: points alone of any folder of that form, film and both where there is a film."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from neuspring.data.capture import CAPTURE
from neuspring.intake.check import check_layout
from neuspring.intake.phystwin import released_cases
from neuspring.intake.points import read
from results.published.scenes.captures import add_hands, folders_of, moving, write_points
from tests.support import spaced as scene
from tests.support.colored import paint
from tests.support.findings import serious
from tests.support.real import HANDS

FRAMES = 68
"""As many as single_push_sloth has."""


@pytest.fixture
def folder(tmp_path):
    return published(tmp_path / "given" / "set" / "single_push_sloth")


def published(case, up=-1):
    """A case as it is published: integers of 0.1 mm; point 1 is not visible in frame 2."""
    case.mkdir(parents=True)
    mirror = np.array([1, up, up])
    hands, marked = (np.round(1e4 * scene.risen(p, FRAMES) * mirror).astype(int) for p in (scene.GRIP, scene.MARKED))
    marked[2, 1] = 0
    for name, points in (("controller.txt", hands), ("landmarks.txt", marked)):
        lines = [" ".join(map(str, [t, *row.ravel()])) for t, row in enumerate(points)]
        (case / name).write_text("\n".join(lines) + "\n")
    np.savetxt(case / "rest.txt", np.round(1e4 * scene.NODES * mirror).astype(int), fmt="%d")
    return case


def test_any_folder_of_that_form_is_a_case_and_its_split_is_the_released_one(folder, tmp_path):
    assert folders_of(tmp_path / "given") == {"single_push_sloth": folder}
    made = write_points(folder, tmp_path / "captures", "single_push_sloth")
    assert serious(check_layout(made.folder)) == []
    assert (made.frame_count, made.train_end) == (FRAMES, int(released_cases()["single_push_sloth"]["train_end"]))
    assert (made.description.up, made.description.category, made.description.cameras) == ("-z", "sloth", ())
    space = read(made)
    np.testing.assert_allclose(space.hands.points[1], scene.risen(scene.GRIP, 2)[1] * [1, -1, -1])
    assert np.isnan(space.tracks[2, 1]).all()
    assert len(space.nodes) == len(scene.NODES)


def test_lines_without_their_frames_number_are_refused(folder):
    path = folder / "controller.txt"
    path.write_text("\n".join(line.split(" ", 1)[1] for line in path.read_text().splitlines()))
    with pytest.raises(ValueError, match="a line per frame, from 0"):
        moving(path)


def test_rows_of_film_differ_in_what_teaches_and_share_the_hands(tmp_path):
    folder = published(tmp_path / "upright", up=1)
    film = paint(tmp_path / "captures" / "thing_film", category="toy", frames=10).folder
    both = shutil.copytree(film, tmp_path / "captures" / "thing_both")
    made = {name: add_hands(path, folder, both=name == "both") for name, path in (("film", film), ("both", both))}
    spaces = {name: read(capture) for name, capture in made.items()}
    np.testing.assert_array_equal(spaces["film"].hands.points, spaces["both"].hands.points)
    assert [space.tracks.shape[1] for space in spaces.values()] == [0, 4]
    assert [len(space.nodes) for space in spaces.values()] == [0, len(scene.NODES)]
    # In both rows the points are there to be scored.
    assert all(capture.tracks().shape == (10, 4, 3) for capture in made.values())
    names = [json.loads((capture.folder / CAPTURE).read_text())["name"] for capture in made.values()]
    assert names == ["thing_film", "thing_both"]


@pytest.mark.skipif(not HANDS.is_dir(), reason="needs the published hands")
@pytest.mark.parametrize("case", ["single_lift_sloth", "double_lift_sloth"])
def test_the_published_scenes_are_plausible(tmp_path, case):
    made = write_points(folders_of(HANDS)[case], tmp_path, case)
    assert serious(check_layout(made.folder)) == []
    row = released_cases()[case]
    assert (made.frame_count, made.train_end) == (int(row["frames"]), int(row["train_end"]))
    assert read(made).tracks.shape[1] == 9
    assert read(made).hands.points.shape[1] == 30
