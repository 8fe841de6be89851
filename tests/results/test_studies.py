"""The pure parts of the studies of color alone: shifts, IoU without hands, means, differences, costs, hands, captures."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from neuspring.core.records import RECORD_FORMAT, digest_file
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.intake.check import check_layout
from neuspring.perception.marks.marks import MARKS, Marks
from results.published.footage.captures import CARRYING, write_capture
from results.published.footage.film import MARKS as MARKED
from results.published.footage.film import film
from results.published.footage.hands import COLUMNS as HAND_COLUMNS
from results.published.footage.hands import grips, hand_lines
from results.published.footage.hands import hand_errors as given_errors
from results.published.footage.make import Scores, labeled_rows
from results.published.footage.runs import PHYSTWIN, Published, Run, corrected, fitted_shift, iou_without_hands, shifted
from results.published.footage.tables import (
    COLUMNS,
    GROUPS,
    cell,
    costs,
    differences,
    mean_and_spread,
    minutes_by_job,
    shared,
    tables,
)
from results.published.one_color_camera.make import hand_errors, one_camera
from results.published.scenes.make import PHYSTWIN as RELEASED
from results.published.scenes.make import point_errors
from results.published.scenes.make import tables as scene_tables
from tests.support import small
from tests.support.colored import paint
from tests.support.findings import of_level
from tests.support.real import FOOTAGE


def block(rows: slice, columns: slice, shape: tuple[int, int] = (40, 60)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[rows, columns] = True
    return mask


def table(*rows: tuple) -> pd.DataFrame:
    """(case, method, seed, part, metric, value)."""
    named = [dict(zip(("case", "method", "seed", "part", "metric", "value"), row, strict=True)) for row in rows]
    return pd.DataFrame(named, columns=list(COLUMNS))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, -2.5), (-3.0, 2.0)])
def test_a_shift_is_found_again(shift):
    mask = block(slice(10, 22), slice(15, 40)) | block(slice(20, 31), slice(30, 36))
    labels = np.where(shifted(mask, shift), OBJECT, 0).astype(np.uint8)
    assert fitted_shift(mask, labels, most=3.0) == shift


def test_whole_shifts_move_pixels_and_half_ones_keep_those_covered_by_more_than_a_half():
    mask = block(slice(10, 20), slice(15, 25))
    assert (shifted(mask, (2, -3)) == block(slice(7, 17), slice(17, 27))).all()
    assert (shifted(mask, (0.5, 0)) == block(slice(10, 20), slice(16, 25))).all()
    color = np.where(mask[..., None], 200, 0).astype(np.uint8).repeat(3, axis=2)
    moved = shifted(color, (0.5, 0))
    assert (moved[12, 15], moved[12, 16], moved[12, 25]) == (pytest.approx(100), pytest.approx(200), pytest.approx(100))


def test_published_pictures_are_cut_out_and_moved():
    mask = block(slice(8, 16), slice(16, 32))
    one = Published(np.packbits(mask.ravel())[None], [np.full((40, 60, 3), 90, np.uint8)], (2.0, -1.0))
    rgba, moved = one.picture(0), block(slice(7, 15), slice(18, 34))
    assert (one.silhouette(0) == moved).all()
    assert (rgba == np.where(moved[..., None], [90, 90, 90, 255], 0)).all()


@pytest.mark.parametrize("drawn", [True, False])
def test_cases_without_drawn_masks_are_compared_with_carried_ones(drawn):
    labels = np.where(block(slice(10, 20), slice(10, 20)), OBJECT, 0).astype(np.uint8)
    case = SimpleNamespace(drawn={0: labels} if drawn else {}, labeled=dict.fromkeys((0, 3, 6, 9), labels))
    (row,) = labeled_rows(case, [(9, block(slice(10, 20), slice(10, 15)))])
    assert (row["part"], row["metric"], row["value"]) == ("last", "iou_drawn" if drawn else "iou_carried", 0.5)


def test_hands_count_on_neither_side():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:20, 10:20] = OBJECT
    labels[10:20, 20:30] = HANDS
    assert iou_without_hands(block(slice(10, 20), slice(10, 30)), labels) == 1
    assert iou_without_hands(block(slice(10, 20), slice(10, 15)), labels) == 0.5
    assert iou_without_hands(block(slice(10, 20), slice(5, 25)), labels) == pytest.approx(100 / 150)


def test_means_are_over_cases_and_the_spread_is_of_seeds_with_every_case():
    rows = [("a", "m", 0, "last", "iou_drawn", 0.5), ("a", "m", 1, "last", "iou_drawn", 0.7)]
    rows += [("b", "m", 0, "last", "iou_drawn", 0.8), ("b", "m", 1, "last", "iou_drawn", 0.92)]
    mean, spread, cases = mean_and_spread(table(*rows))
    assert (mean, spread, cases) == (pytest.approx(0.73), pytest.approx(np.std([0.65, 0.81], ddof=1)), 2)
    mean, spread, cases = mean_and_spread(table(*rows[:3]))
    assert mean == pytest.approx(0.7)
    assert np.isnan(spread)
    assert cases == 2
    assert cell(table(*rows), 2) == "0.73 ± 0.11"
    assert cell(table(), 2) == "–"


def test_differences_are_paired_by_case():
    rows = [
        (case, "m", seed, "future", "iou", value + seed / 10)
        for case, value in zip("abc", (0.5, 0.6, 0.4), strict=True)
        for seed in (0, 1)
    ]
    rows += [(case, PHYSTWIN, 0, "future", "iou", value) for case, value in zip("abcd", (0.5, 0.55, 0.45, 0.9), strict=True)]
    mean, low, high, count = differences(table(*rows), "m", PHYSTWIN)
    values = np.array([0.05, 0.1, 0.0])
    half = 4.302652729749464 * values.std(ddof=1) / np.sqrt(3)
    assert (mean, low, high, count) == (pytest.approx(0.05), pytest.approx(0.05 - half), pytest.approx(0.05 + half), 3)
    assert differences(table(*rows), "m", "nobody") is None
    mean, low, _, count = differences(table(rows[0], rows[6]), "m", PHYSTWIN)
    assert (mean, count) == (pytest.approx(0), 1)
    assert np.isnan(low)


@pytest.mark.parametrize("keep", [False, True])
def test_runs_of_another_machine_stay_if_they_are_to_be_kept(tmp_path, keep):
    def scores(keep: bool) -> Scores:
        return Scores(tmp_path / "scores.csv", force=False, keep=keep)

    def rows(value: float):
        return lambda: [{"part": "future", "metric": "iou", "value": value}]

    first = scores(False)
    first.add("a", "m", 0, "old", rows(0.5))
    first.add("a", "m", 1, "same", rows(0.6))
    first.add("b", "m", 0, "there", rows(0.7))
    first.save()
    second = scores(keep)
    second.add("a", "m", 0, "new", rows(0.9))
    second.add("a", "m", 1, "same", rows(99.0))
    found = second.table.set_index(["case", "seed"])["value"].to_dict()
    assert found == {("a", 0): 0.9, ("a", 1): 0.6} | ({("b", 0): 0.7} if keep else {})


def write(path, values) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"format": RECORD_FORMAT, **values}))


def test_cost_is_of_the_last_good_attempt_and_follows_the_inputs_of_records(tmp_path):
    def job(name: str, *attempts: tuple[str, float]) -> None:
        made = [
            {"started": "2026-01-01T00:00:00+00:00", "outcome": outcome, "cpu_seconds": 60.0 * cpu} for outcome, cpu in attempts
        ]
        write(tmp_path / "jobs" / f"{name}.json", {"rule": name.split("/")[0], "name": name, "log": "x", "attempts": made})

    def record(place: str, more: dict | None = None, **inputs: str) -> str:
        values = {"stage": place.rsplit("/", 1)[1], "status": "ok", "inputs": inputs} | (more or {})
        write(tmp_path / "s" / f"{place}.json", values)
        return digest_file(tmp_path / "s" / f"{place}.json")

    search, splats = record("search-uniform/0/search"), record("appearance/0/appearance")
    record("search-other/0/search", observations="another")
    fit = record("m/0/fit", search=search)
    record("m/0/rollout", fit=fit)
    record("m/0/render", appearance=splats)
    job("track/s/0", ("ok", 1.0))
    job("search/s/uniform/0", ("killed", 50.0), ("ok", 2.0), ("ok", 3.0), ("running", 9.0))
    job("search/s/other/0", ("ok", 40.0))
    job("fit/s/m/0", ("ok", 5.0))
    job("fit/s/n/0", ("transient", 70.0))
    job("rollout/s/m/0", ("ok", 0.5))
    job("render/s/m/0", ("ok", 1.5))
    job("appearance/s/appearance/0", ("ok", 4.0))
    assert minutes_by_job(tmp_path)["search/s/uniform/0"] == 3
    assert "fit/s/n/0" not in minutes_by_job(tmp_path)
    found = costs(tmp_path, [Run(tmp_path / "s" / "m" / "0")]).set_index("group")["minutes"].to_dict()
    assert np.isnan(found.pop("masks"))
    assert found == dict(zip(list(GROUPS)[1:], (1.0, 3.0, 5.0, 5.5, 0.5), strict=True))
    run = Run(tmp_path / "s" / "m" / "0")
    assert costs(tmp_path, [run], {run.scenario: 90.0}).set_index("group")["minutes"]["masks"] == 1.5


@pytest.mark.parametrize(("more", "minutes"), [({"earlier_processor_seconds": 120.0}, 2.1), ({}, np.nan)])
def test_a_fit_that_ran_together_costs_its_share_of_processor_time(tmp_path, more, minutes):
    """Never wall time: a machine on which other work runs would count that work."""
    facts = {"epochs_together": 20, **more}
    write(tmp_path / "s" / "o" / "0" / "fit.json", {"stage": "fit", "status": "ok", "seconds": 480.0, "facts": facts})
    attempt = {"started": "2026-01-01T00:00:00+00:00", "outcome": "ok", "cpu_seconds": 6.0}
    write(tmp_path / "jobs" / "fit" / "s" / "o" / "0.json", {"rule": "fit", "name": "fit/s/o/0", "log": "x", "attempts": [attempt]})
    found = costs(tmp_path, [Run(tmp_path / "s" / "o" / "0")]).set_index("group")["minutes"]["fit"]
    assert found == pytest.approx(minutes, nan_ok=True)


def test_means_compare_the_same_films_only():
    rows = [(case, "m", 0, "future", "iou", value) for case, value in zip("abc", (0.5, 0.6, 0.1), strict=True)]
    rows += [(case, PHYSTWIN, 0, "future", "iou", value) for case, value in zip("ab", (0.7, 0.9), strict=True)]
    assert sorted(set(shared(table(*rows))["case"])) == ["a", "b"]
    lines = tables(table(*rows), [])
    assert "Means leave out c: not every method has them." in lines
    cells = {line.split("|")[1].strip(): line.split("|")[2:] for line in lines if line.startswith(("| m  ", "| PhysTwin"))}
    assert [cells["m"][k].strip() for k in (0, 4)] == ["2", "0.550"]
    assert [cells[PHYSTWIN][k].strip() for k in (0, 4)] == ["2", "0.800"]


def test_the_committed_marks_lie_in_frame_0_alone():
    """Else a film stands in a table of its own."""
    assert len(list((MARKED / "phystwin_camera0").glob("*.json"))) == 12
    assert corrected() == []


def test_a_given_grip_is_the_mean_of_its_points_near_the_object():
    nodes, centers = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.01], [1.0, 0.0, 0.0]])
    far = [[0.0, 0.0, 0.2], [0.0, 0.0, 0.3]]
    near = [[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.02, 0.0, 0.0], [0.02, 0.02, 0.0]]
    other = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.3], [1.0, 0.3, 0.0], [1.0, 0.6, 0.0]]
    points = np.array([*far, *near, *other])
    found = grips(centers, np.stack([points, points + np.array([0.0, 0.0, 0.1])]), nodes)
    np.testing.assert_allclose(found[0], [[0.01, 0.01, 0.0], [1.0, 0.1, 0.1]])
    np.testing.assert_allclose(found[1] - found[0], [[0.0, 0.0, 0.1]] * 2)
    with pytest.raises(ValueError, match="hand 1: no given point"):
        grips(np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]]), points[None], nodes)


def test_hands_that_are_shifted_are_off_and_their_way_is_not():
    owner, given = np.array([0, 0, 0]), np.zeros((4, 3, 3)) + 0.01 * np.arange(4)[:, None, None]
    image = SimpleNamespace(hand_of=owner, hands=1)
    seen = SimpleNamespace(image=image, controller_points=given + np.array([0.0, 0.0, 0.005]))
    found = list(given_errors(seen, given, np.zeros((1, 3))))
    assert [frame for _, frame, *_ in found] == [0, 1, 2, 3]
    np.testing.assert_allclose([row[2:] for row in found], [[5.0, 0.0]] * 4, atol=1e-9)
    rows = [("shifted", hand, frame, "future" if frame > 2 else "training", *e) for hand, frame, *e in found]
    (line,) = [line for line in hand_lines(pd.DataFrame(rows, columns=list(HAND_COLUMNS))) if "shifted" in line]
    assert [cell.strip() for cell in line.split("|")[3:-1]] == ["5", "5", "5", "5", "0", "0", "0"]


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
    assert not color.has_depth
    np.testing.assert_array_equal(Capture.load(color.folder).mask("0", 3), capture.mask("0", 3))


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
def test_a_film_becomes_a_capture_of_color_alone(tmp_path):
    case = "single_lift_rope"
    capture = write_capture(FOOTAGE, tmp_path, case, 5)
    about = capture.description
    assert (about.depth, about.up, about.category, about.name, about.masks) == ("none", "-z", "rope", case, True)
    assert float(about.provenance[CARRYING]) > 0
    np.testing.assert_array_equal(capture.color("0", 4), film(FOOTAGE, case, 5)[4])
    assert (capture.mask("0", 4) == 1).sum() > 3000
    Marks.load(capture.folder / MARKS).require(capture)
    found = check_layout(capture.folder)
    assert of_level(found, "error") == []
    # The README of the footage back-projects the white rope onto the table: 38.7 cm from tip to tip (nobody measured it with a
    # ruler). The mask ends within three pixels of 2 mm at both ends, and the size is told in whole centimeters.
    (length,) = (int(size[1]) for text in of_level(found, "note") if (size := re.search(r"object size on the table (\d+) x", text)))
    assert length == pytest.approx(38.7, abs=1.2 + 0.5)


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
