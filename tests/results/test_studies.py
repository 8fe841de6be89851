"""The pure parts of studies: silhouettes of rivals, IoU without hands, means, differences, captures of films, hands, scenes."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from neuspring.config.parse import read_yaml
from neuspring.core.job_records import JobRecord
from neuspring.data.capture import HANDS, OBJECT, THIN, Capture
from neuspring.intake.check import check_layout
from neuspring.intake.phystwin import released_cases
from neuspring.perception.marks import MARKS, Marks
from neuspring.scenes.sources import read_scenarios
from results.published.film22.films import DRAWN, PREFIX, category_of, film, marks_of, scaled, write_capture
from results.published.film22.films import MARKS as MARKED
from results.published.film22.make import (
    BEST,
    COLUMNS,
    CONFIG,
    NEW,
    ROOT,
    Scene,
    by_scene,
    difference,
    fitted_shift,
    hours,
    iou_without_hands,
    lines_of,
    shifted,
    silhouette,
    spread,
)
from results.published.one_color_camera.make import hand_errors, one_camera
from results.published.scenes.make import PHYSTWIN as RELEASED
from results.published.scenes.make import point_errors
from results.published.scenes.make import tables as scene_tables
from tests.support import small
from tests.support.colored import paint
from tests.support.extensions import with_extensions
from tests.support.findings import of_level
from tests.support.real import FILMS


def block(rows: slice, columns: slice, shape: tuple[int, int] = (40, 60)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[rows, columns] = True
    return mask


def scored(*rows: tuple) -> pd.DataFrame:
    """(case, method, seed, part, value), with carried masks."""
    return pd.DataFrame([(*row[:3], "carried", *row[3:]) for row in rows], columns=COLUMNS)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, -2.5), (-3.0, 2.0)])
def test_a_shift_is_found_again(shift):
    mask = block(slice(10, 22), slice(15, 40)) | block(slice(20, 31), slice(30, 36))
    labels = np.where(shifted(mask, shift), OBJECT, 0).astype(np.uint8)
    assert fitted_shift(mask, labels) == shift


def test_whole_shifts_move_pixels_and_half_ones_keep_those_covered_by_more_than_a_half():
    mask = block(slice(10, 20), slice(15, 25))
    assert (shifted(mask, (2, -3)) == block(slice(7, 17), slice(17, 27))).all()
    assert (shifted(mask, (0.5, 0)) == block(slice(10, 20), slice(16, 25))).all()


def test_a_silhouette_is_what_differs_from_the_empty_table_with_its_holes_but_not_its_specks_and_shadows():
    table = np.full((40, 60, 3), 150.0, np.float32)
    render = table.astype(np.uint8)
    render[10:30, 10:40] = [120, 130, 100]
    render[15:20, 15:20] = 148
    # Brighter by too little, and of another color at the same brightness.
    render[32:36, 45:55], render[10:30, 40:50] = 140, [165, 150, 135]
    render[2:4, 2:5] = 0
    assert (silhouette(render, table) == block(slice(10, 30), slice(10, 50))).all()


def test_hands_count_on_neither_side():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:20, 10:20] = OBJECT
    labels[10:20, 20:30] = HANDS
    assert iou_without_hands(block(slice(10, 20), slice(10, 30)), labels) == 1
    assert iou_without_hands(block(slice(10, 20), slice(10, 15)), labels) == 0.5
    assert iou_without_hands(block(slice(10, 20), slice(5, 25)), labels) == pytest.approx(100 / 150)


def test_means_are_over_the_frames_of_a_task_that_rivals_show_and_drawn_masks_meet_the_nearest_frame():
    drawn = np.where(block(slice(10, 20), slice(10, 20)), OBJECT, 0).astype(np.uint8)
    scene = Scene("a", ROOT, SimpleNamespace(train_end=3, frame_count=6), ROOT)
    scene.__dict__["drawn"] = {5: drawn}
    assert scene.means({0: 9.0, 1: 0.5, 2: 0.7, 4: 0.2}) == {"training": pytest.approx(0.6), "future": pytest.approx(0.2)}
    masks = {2: block(slice(0, 1), slice(0, 1)), 4: block(slice(10, 20), slice(10, 15))}
    assert list(scene.drawn_rows(masks)) == [("drawn", "last", 0.5)]
    assert Scene("a", ROOT, SimpleNamespace(frame_count=116), ROOT).kept[::3] == [0, 115 // 3, 2 * 115 // 3, 115]


def test_differences_are_paired_by_scene_and_the_spread_is_of_seeds_with_every_scene():
    rows = [
        (case, "m", seed, "future", value + seed / 10)
        for case, value in zip("abc", (0.5, 0.6, 0.4), strict=True)
        for seed in (0, 1)
    ]
    rows += [(case, "PhysTwin", 0, "future", value) for case, value in zip("abcd", (0.5, 0.55, 0.45, 0.9), strict=True)]
    scores = scored(*rows)
    values = np.array([0.05, 0.1, 0.0])
    half = 4.302652729749464 * values.std(ddof=1) / np.sqrt(3)
    table = by_scene(scores, "future")
    assert difference(table, "m", "PhysTwin") == f"+0.050 [{0.05 - half:+.3f}, {0.05 + half:+.3f}], 2 of 3"
    assert spread(scores, "m", "future", list("abc")) == pytest.approx(np.std([0.5, 0.6], ddof=1))
    assert np.isnan(spread(scores[scores["seed"] == 0], "m", "future", list("abc")))


def test_means_compare_the_same_scenes_only():
    rows = [
        (case, BEST, 0, part, value) for case, value in zip("abc", (0.5, 0.6, 0.1), strict=True) for part in ("training", "future")
    ]
    rows += [
        (case, "PhysTwin", 0, part, value) for case, value in zip("ab", (0.7, 0.9), strict=True) for part in ("training", "future")
    ]
    rows += [(case, "Boba", 0, part, 0.3) for case in "abc" for part in ("training", "future")]
    (first, *_) = [line for line in lines_of(scored(*rows)) if "mean, all" in line]
    assert [cell.strip() for cell in first.split("|")[1:-1]] == ["mean, all (2)", "0.550", "0.800", "0.300"]


def test_hours_are_of_finished_jobs(tmp_path):
    for name, outcome, spent in (("search/a", "ok", 3.0), ("search/b", "ok", 0.5), ("fit/a", "failed", 70.0)):
        record = JobRecord(rule=name.split("/")[0], name=name, outcome=outcome, seconds=3600 * spent)
        path = tmp_path / "jobs" / name / ("failed.json" if outcome == "failed" else "0123456789abcdef.json")
        path.parent.mkdir(parents=True)
        record.save(path)
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in hours(tmp_path)]
    assert ["search", "2", "3.50"] in lines and ["all", "2", "3.50"] in lines
    assert not any("fit" in line for line in lines)


def test_the_study_has_every_released_scene_its_best_row_and_marks_of_frame_0_alone():
    values = read_yaml(CONFIG)
    assert {name.removeprefix(PREFIX) for name in values["scenarios"]} == set(released_cases())
    assert BEST in values["methods"]
    table = read_scenarios(ROOT / "config" / "scenarios.tsv")
    for case in released_cases():
        assert (category_of(case), category_of(case) in THIN) == (table[case].category, table[case].self_collision)
        assert all(mark.frame == 0 for mark in marks_of(case, (640, 362)))
    assert {path.stem for path in (MARKED / "phystwin22_films").glob("*.json")} == set(NEW)


def test_pixels_of_a_scaled_picture_keep_their_place_in_it():
    assert scaled(np.array([-0.5, 479.5]), (848, 480), (640, 362)) == pytest.approx([-0.5, 361.5])
    (mark, *_), (drawn, *_) = marks_of("single_lift_rope", (424, 240)), marks_of("single_lift_rope", DRAWN["phystwin_camera0"])
    assert mark.radius == pytest.approx(drawn.radius / 2)
    np.testing.assert_allclose(np.array(mark.points), (np.array(drawn.points) - 0.5) / 2)


@with_extensions
@pytest.mark.skipif(not FILMS.is_dir(), reason="the films are not part of the repository")
def test_a_film_becomes_a_capture_of_color_alone(tmp_path):
    from neuspring.extensions.color_alone.first_frame import FirstFrame

    case = "single_lift_rope"
    capture = write_capture(FILMS, tmp_path, case, 5)
    about, camera = capture.description, capture.cameras["0"]
    assert (about.depth, about.up, about.category, about.name, about.masks) == ("none", "-z", "rope", f"film_{case}", True)
    assert (camera.width, camera.height) == (640, 362)
    np.testing.assert_array_equal(capture.color("0", 4), film(FILMS, case, 5)[4])
    assert (capture.mask("0", 4) == 1).sum() > 1700
    Marks.load(capture.folder / MARKS).require(capture)
    assert of_level(check_layout(capture.folder), "error") == []
    # The README of the footage back-projects the white rope onto the table: 38.7 cm from tip to tip (nobody measured it with a
    # ruler). The mask ends within three pixels of 2.6 mm at both ends.
    y, x = np.nonzero(capture.mask("0", 0) == OBJECT)
    middle = np.quantile(rope := FirstFrame.of(capture, capture.mask("0", 0)).points(np.stack([x, y], axis=1)), 0.5, axis=0)
    along = (rope - middle) @ np.linalg.svd(rope - middle, full_matrices=False)[2][0]
    assert 100 * np.ptp(along) == pytest.approx(38.7, abs=1.6 + 0.5)


def test_hands_count_by_their_motion_alone():
    seen = small.observations()
    hands = seen.controller_points.astype(float)
    poses = np.zeros((len(hands), 1, 7))
    # Anywhere in the hand: only its way counts.
    poses[:, 0, :3] = hands.mean(axis=1) + np.array([0.0, 0.03, 0.05])
    truth = SimpleNamespace(hand_poses=poses)
    assert hand_errors(truth, seen)[1] == pytest.approx(0.0, abs=1e-6)
    off = np.linspace(0, 0.02, len(hands))[:, None, None] * [0.0, 0.0, 1.0]
    mean, last = hand_errors(truth, replace(seen, controller_points=hands + off))
    assert last == pytest.approx(0.02, abs=1e-6)
    assert mean == pytest.approx(np.linspace(0, 0.02, len(hands))[1:].mean(), abs=1e-6)


def test_a_capture_of_one_camera_has_its_color_and_masks(tmp_path):
    capture = paint(tmp_path / "painted", frames=5)
    color = one_camera(capture, tmp_path / "scene_color", depth=False)
    assert "depth" not in color.streams
    np.testing.assert_array_equal(Capture.load(color.folder).mask("0", 3), capture.mask("0", 3))


def test_a_scene_stands_beside_the_released_errors_of_its_frames():
    rows = [("single_lift_sloth", "points", "neuspring", seed, "future", "track_error", 20.0 + seed) for seed in (0, 1, 2)]
    rows += [("single_lift_sloth", "film", "neuspring", 0, "future", "iou", 0.7)]
    known = {"future": 24.9, "reconstruction": 4.9}
    rows += [("single_lift_sloth", "", RELEASED, -1, task, "track_error", value) for task, value in known.items()]
    names = ["case", "saw", "method", "seed", "task", "metric", "value"]
    points, films = scene_tables(pd.DataFrame(rows, columns=names), ["static", "neuspring"])
    assert re.search(r"neuspring +\| +\| 21\.0 ± 1\.0 +\| 3 +\|", points) and re.search(r"4\.9 +\| 24\.9 +\| +\|", points)
    assert "static" not in points and "one color camera" in films and "0.700" in films


def test_a_point_follows_its_nearest_node_and_is_nowhere_after_a_divergence():
    positions = np.zeros((2, 2, 3), np.float32)
    positions[:, 1, 0] = [1.0, 1.5]
    tracks = np.array([[[0.9, 0, 0], [0.1, 0, 0]], [[0.9, 0, 0], [np.nan] * 3], [[0.9, 0, 0], [0.1, 0, 0]]])
    errors = point_errors(SimpleNamespace(positions=positions), tracks)
    np.testing.assert_allclose(errors, [[0.1, 0.1], [0.6, np.nan], [np.nan, np.nan]], atol=1e-7)
