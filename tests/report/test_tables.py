"""Tables compare like with like, and never hide a gap."""

import json

import numpy as np
import pandas as pd
import pytest

from neuspring.report.tables import summary as tables
from neuspring.scores.metrics import COLUMNS
from neuspring.scores.runs import Collected, collect
from neuspring.scores.statistics import paired_differences, resampled_means
from tests.support.study_runs import collected


def test_paired_differences_use_the_same_scenario_and_seed():
    values = {("a", "x", 0): 0.010, ("a", "y", 0): 0.008, ("b", "x", 0): 0.100, ("b", "y", 0): 0.098}
    row = paired_differences(collected(values).scores, "x").iloc[0]
    assert row["difference"] == pytest.approx(-0.002)
    assert row["low"] == pytest.approx(-0.002)
    assert row["high"] == pytest.approx(-0.002)
    assert row["relative"] == pytest.approx(-0.002 / 0.055)


def test_the_interval_covers_the_mean_of_noisy_differences():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(60):
        deltas = rng.normal(0.001, 0.002, 20)
        values = {(f"s{i}", m, 0): 0.05 + (d if m == "y" else 0.0) for i, d in enumerate(deltas) for m in ("x", "y")}
        row = paired_differences(collected(values).scores, "x").iloc[0]
        hits += row["low"] <= 0.001 <= row["high"]
    # 95 % nominal; with 60 trials, below 50 has a probability under 1e-3 even at the bootstrap's usual 92 %.
    assert hits >= 50


def test_seeds_of_one_scenario_are_not_independent():
    values = {("a", m, seed): 0.01 + (0.001 if m == "y" else 0) for m in ("x", "y") for seed in range(5)}
    row = paired_differences(collected(values).scores, "x").iloc[0]
    assert row["scenarios"] == 1
    assert np.isnan(row["low"])


def test_the_relative_difference_weighs_scenarios_equally():
    values = {("a", "x", 0): 0.1, ("a", "y", 0): 0.09}
    values |= {("b", m, seed): v for m, v in (("x", 0.01), ("y", 0.009)) for seed in range(3)}
    row = paired_differences(collected(values).scores, "x").iloc[0]
    assert row["difference"] == pytest.approx(-0.0055)
    assert row["relative"] == pytest.approx(-0.1)


def test_the_ratio_weighs_a_scenario_of_large_errors_like_another():
    values = {
        ("a", "x", 0): 1.0,
        ("a", "y", 0): 2.0,
        ("b", "x", 0): 0.01,
        ("b", "y", 0): 0.005,
        ("c", "x", 0): 0.01,
        ("c", "y", 0): 0.005,
    }
    row = paired_differences(collected(values).scores, "x").iloc[0]
    assert row["difference"] > 0
    assert row["ratio"] == pytest.approx((2 * 0.5 * 0.5) ** (1 / 3))
    assert pytest.approx(row["ratio_low"]) == 0.5
    assert row["ratio_low"] < row["ratio"] < row["ratio_high"] <= 2.0
    perfect = paired_differences(collected(values | {("c", "y", 0): 0.0}).scores, "x").iloc[0]
    assert np.isnan(perfect["ratio"])
    assert np.isfinite(perfect["difference"])
    assert "0.794 [" in tables.summary_text(collected(values), "x")


def test_the_interval_over_seeds_alone_has_the_width_of_their_mean():
    """Twelve scenarios alike but for independent noise of three seeds: the variance of resampled means is that of both levels."""
    rng = np.random.default_rng(1)
    runs = [rng.normal(size=3) for _ in range(12)]
    within = np.mean([part.var() / 3 for part in runs]) / 12
    between = np.var([part.mean() for part in runs]) / 12
    means = resampled_means([part[None] for part in runs], np.random.default_rng(0))
    assert means.var() == pytest.approx(within + between, rel=0.05)


def with_images(lpips: str = "computed", quirks: tuple[str, ...] = ()) -> Collected:
    """Two scenarios, two methods; the second scenario has no images."""
    base = collected({(s, m, 0): 0.01 for s in ("a", "b") for m in ("x", "y")})
    facts = {"backend": "warp", "masks": "given", "views": ["0"], "lpips": lpips, "quirks": list(quirks), "unseen_surface": 0.25}
    runs = base.runs.assign(images=[json.dumps(facts if s == "a" else None) for s in base.runs["scenario"]])
    values = {"psnr": (30.0, 33.0), "ssim": (0.9, 0.95), "iou": (0.8, 0.9)} | (
        {"lpips": (0.1, 0.05)} if lpips == "computed" else {}
    )
    rows = [
        ("a", "rope", m, 0, task, metric, pair[k], "1", 10)
        for metric, pair in values.items()
        for k, m in enumerate(("x", "y"))
        for task in ("reconstruction", "future")
    ]
    return Collected(pd.concat([base.scores, pd.DataFrame(rows, columns=list(COLUMNS))], ignore_index=True), runs)


def test_pictures_have_a_table_of_their_own():
    text = tables.summary_text(with_images(), "x")
    assert "Of 2 scenarios 1 have scores of pictures." in text
    assert "Cameras scored: 0; masks: given; rasterizer: warp; none of the released evaluation's quirks." in text
    (row,) = [line for line in text.splitlines() if line.startswith("| y ") and "33.00" in line and "0.0500" in line]
    assert "0.9500 (0.9500)" in row
    assert "Part of the surface that no camera sees in frame 0: a 25%." in text
    # Runs are those with images; a percentage of decibels would mean nothing.
    assert row.endswith("| 1/1  |")
    assert "+3.00" in text
    assert "+3.00 (" not in text
    assert "+3.00" in text


def test_what_was_not_computed_is_said_and_never_a_number():
    text = tables.summary_text(with_images("no AlexNet weights: x is not there", ("any_alpha",)), "x")
    assert "LPIPS not computed: no AlexNet weights: x is not there" in text
    header = next(line for line in text.splitlines() if "Recon. PSNR" in line)
    assert "not computed" in next(line for line in text.splitlines() if line.startswith("| y ") and "33.00" in line)
    assert "Recon. LPIPS" in header
    assert "released quirks: any_alpha" in text


def test_scenarios_without_images_are_said_to_have_none():
    one = collected({("a", "x", 0): 0.01})
    text = tables.summary_text(Collected(one.scores, one.runs.assign(images="null")), "x")
    assert "No scores of pictures: these scenarios have no images" in text


def test_pictures_that_could_not_be_made_say_why():
    one = collected({("a", "x", 0): 0.01})
    failed = json.dumps({"failed": "appearance: step 3 removed the last splat"})
    text = tables.summary_text(Collected(one.scores, one.runs.assign(images=failed)), "x")
    assert "No scores of pictures: appearance: step 3 removed the last splat." in text


def test_a_method_that_has_not_begun_does_not_empty_the_table():
    values = {("a", "x", 0): 0.010, ("a", "y", 0): 0.008}
    text = tables.summary_text(collected(values, failed=(("a", "z", 0),)), "x")
    assert "10.00" in text
    assert "8.00" in text
    assert "a / z / seed 0: failed: diverged" in text


def test_a_pair_that_one_method_failed_is_left_out_for_all_and_listed():
    values = {("a", "x", 0): 0.010, ("a", "y", 0): 0.008, ("b", "x", 0): 0.500}
    text = tables.summary_text(collected(values, failed=(("b", "y", 0),)), "x")
    assert "10.00" in text
    assert "500" not in text
    assert "b / y / seed 0: failed: diverged" in text
    assert "1/2 (1 failed)" in text


def test_missing_runs_are_listed(tmp_path):
    found = collect(tmp_path, ["a"], ["x", "y"], [0, 1])
    assert (found.runs["status"] == "missing").all()
    text = tables.write(found, "x", tmp_path / "tables")
    assert text.count("missing: no run.json") == 4
    assert (tmp_path / "tables" / "summary.md").is_file()


def test_many_missing_runs_are_counted_and_failures_named(tmp_path):
    found = collect(tmp_path, [f"s{i}" for i in range(9)], ["x", "y"], [0])
    found.runs.loc[0, ["status", "reason"]] = ["failed", "diverged"]
    text = tables.summary_text(found, "x")
    assert "- s0 / x / seed 0: failed: diverged" in text
    assert "- 17 runs have not finished, or were not asked for (" in text
    assert "x 8" in text and "y 9" in text and "runs.csv names them" in text


def test_many_notes_are_counted_by_kind_with_the_range_of_their_numbers():
    keys = [(f"s{i}", method, 0) for i in range(9) for method in ("x", "y")]
    found = collected(dict.fromkeys(keys, 0.010))
    of_x = found.runs["method"] == "x"
    found.runs["notes"] = [
        f"fit: {10 + i}% of the springs lie at the bound; search: at an end of its range: dashpot" if x else ""
        for i, x in enumerate(of_x)
    ]
    few = tables.summary_text(found, "x")
    assert "- s0 / x / seed 0: fit: 10% of the springs" in few
    found.runs.loc[~of_x, "notes"] = "fit: no epoch was better than the search"
    many = tables.summary_text(found, "x")
    assert "- x, 9 of 9 runs: fit: 10 to 26% of the springs lie at the bound" in many
    assert "- x, 9 of 9 runs: search: at an end of its range: dashpot" in many
    assert "- y, 9 of 9 runs: fit: no epoch was better than the search" in many
    assert "s0 / x / seed 0: fit" not in many


def test_no_spread_is_shown_where_one_seed_of_several_has_finished():
    found = collected({("a", "x", 0): 0.010})
    rest = pd.DataFrame([{"scenario": "a", "method": "x", "seed": 1, "status": "missing", "reason": "", "notes": ""}])
    text = tables.summary_text(Collected(found.scores, pd.concat([found.runs, rest])), "x")
    assert "10.00 (10.00)" in text
    assert "standard deviation" not in text


def test_runs_of_different_settings_are_pointed_out():
    found = collected({("a", "x", 0): 0.010, ("a", "x", 1): 0.011, ("a", "y", 0): 0.010, ("a", "y", 1): 0.011})
    digests = [{"search": "s", "fit": "f"}, {"search": "s", "fit": "g"}, {"search": "s"}, {"search": "s"}]
    found.runs["settings"] = [json.dumps(row) for row in digests]
    assert "Runs were made with different settings (fit of x): make the older ones again" in tables.summary_text(found, "x")
    found.runs["settings"] = json.dumps(digests[0])
    assert "different settings" not in tables.summary_text(found, "x")
