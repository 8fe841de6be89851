"""The pure parts of the comparison with PhysTwin: shifts, IoU without hands, means, differences, strips, names of jobs."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from neuspring.data.capture import HANDS, OBJECT
from tests.benchmarks.beside_cost import GROUPS, cost_lines, costs, merged, minutes_by_job
from tests.benchmarks.beside_data import LEFT_OUT, PHYSTWIN, STILL, Published, Run, fitted_shift, iou_without_hands, shifted
from tests.benchmarks.beside_phystwin import Scores, labeled_rows
from tests.benchmarks.beside_strips import WHITE, frames_shown, layout, over_white, surroundings
from tests.benchmarks.beside_tables import COLUMNS, cell, differences, mean_and_spread, tables


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


def test_hands_count_on_neither_side():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:20, 10:20] = OBJECT
    labels[10:20, 20:30] = HANDS
    assert iou_without_hands(block(slice(10, 20), slice(10, 30)), labels) == 1
    assert iou_without_hands(block(slice(10, 20), slice(10, 15)), labels) == 0.5
    assert iou_without_hands(block(slice(10, 20), slice(5, 25)), labels) == pytest.approx(100 / 150)


def test_published_pictures_are_cut_out_and_moved():
    mask = block(slice(8, 16), slice(16, 32))
    right = np.full((40, 60, 3), 90, np.uint8)
    one = Published(np.packbits(mask.ravel())[None], [right], (2.0, -1.0))
    rgba = one.picture(0)
    assert (one.silhouette(0) == block(slice(7, 15), slice(18, 34))).all()
    assert (rgba[..., 3] == np.where(one.silhouette(0), 255, 0)).all()
    assert (rgba[..., :3] == np.where(one.silhouette(0)[..., None], 90, 0)).all()


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


def test_tables_leave_cases_out_of_means_and_put_methods_first():
    rows = []
    for case, value in (("a", 0.6), (LEFT_OUT[0], 0.1)):
        for method in (PHYSTWIN, STILL, "m"):
            rows += [(case, method, 0, part, "iou_drawn", value) for part in ("0", "1/3", "2/3", "last")]
            rows += [
                (case, method, 0, part, metric, value)
                for part in ("reconstruction", "future")
                for metric in ("iou", "psnr", "ssim")
            ]
    rows += [("a", "m", 0, part, f"points_{name}", 3.0) for part in ("last", "later") for name in ("median", "mean", "count")]
    text = "\n".join(tables(table(*rows), ["a note"]))
    first = next(line for line in text.splitlines() if line.startswith("| m "))
    assert first.split("|")[2:7] == [f" {cell:5s} " for cell in ("1", "0.600", "0.600", "0.600", "0.600")]
    assert text.index("| m ") < text.index(f"| {PHYSTWIN}") < text.index(f"| {STILL}")
    assert f"| {LEFT_OUT[0]} " in text
    assert "- a note" in text
    assert "Paired differences" in "\n".join(tables(table(*rows), []))


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


@pytest.mark.parametrize("drawn", [True, False])
def test_cases_without_drawn_masks_are_compared_with_carried_ones(drawn):
    labels = np.where(block(slice(10, 20), slice(10, 20)), OBJECT, 0).astype(np.uint8)
    case = SimpleNamespace(drawn={0: labels} if drawn else {}, labeled=dict.fromkeys((0, 3, 6, 9), labels))
    rows = list(labeled_rows(case, [(9, block(slice(10, 20), slice(10, 15)))]))
    assert [(row["part"], row["metric"], row["value"]) for row in rows] == [("last", "iou_drawn" if drawn else "iou_carried", 0.5)]


def test_no_scores_make_no_tables():
    assert not any(line.startswith("|") for line in tables(table(), []))


def test_strips_show_first_and_last_frames_around_the_object():
    assert frames_shown(62) == [0, 12, 24, 37, 49, 61]
    rows, columns = surroundings([block(slice(10, 12), slice(3, 5)), block(slice(30, 31), slice(40, 41))], margin=4)
    assert (rows, columns) == (slice(6, 35), slice(0, 45))
    assert surroundings([np.zeros((4, 4), bool)]) == (slice(None), slice(None))
    observed = np.full((4, 6, 3), 100, np.uint8)
    rgba = np.zeros((4, 6, 4), np.uint8)
    rgba[:, :3] = [10, 20, 30, 255]
    drawn = over_white(observed, rgba)
    assert (drawn[:, :3] == [10, 20, 30]).all()
    assert (drawn[:, 3:] == round((1 - WHITE) * 100 + WHITE * 255)).all()
    strip = layout({"observed": [observed] * 2, "m": [drawn] * 2}, [0, 5], 3)
    assert strip.dtype == np.uint8
    bars = strip[2, [10, -10]].astype(int)
    assert bars[0, 2] > bars[0, 0]
    assert bars[1, 0] > bars[1, 2]


def write(path, values) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"format": 1, **values}))


def test_cost_is_of_the_last_good_attempt_and_follows_the_inputs_of_records(tmp_path):
    from neuspring.core.records import digest_file

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
    assert found == dict(zip(GROUPS, (1.0, 3.0, 5.0, 5.5, 0.5), strict=True))
    # Of a launch of several fits, the fit's record has its share.
    fit = record("o/0/fit", {"seconds": 480.0, "facts": {"epochs_together": 20}}, search=search)
    record("o/0/rollout", fit=fit)
    job("fit/s/o/0", ("ok", 0.1))
    assert costs(tmp_path, [Run(tmp_path / "s" / "o" / "0")]).set_index("group")["minutes"]["fit"] == 8


def test_costs_of_two_machines_are_one_table():
    def cost(*rows: tuple) -> pd.DataFrame:
        return pd.DataFrame(rows, columns=["scenario", "method", "seed", "group", "minutes"])

    earlier = cost(("s", "neuspring", 0, "search", 50.0), ("s", "neuspring", 1, "search", 3.0), ("s", "static", 0, "search", 0.0))
    both = merged(cost(("s", "neuspring", 0, "search", 1.0)), earlier)
    assert both[["method", "minutes"]].to_numpy().tolist() == [["static", 0.0], ["neuspring", 1.0], ["neuspring", 3.0]]
    line = next(line for line in cost_lines(both) if line.startswith("| s "))
    assert [cell.strip() for cell in line.split("|")[2:-1]][:3] == ["2", "–", "2.0"]
    assert cost_lines(cost()) == []
