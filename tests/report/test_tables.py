"""Tables compare like with like, and never hide a gap."""

import json

import numpy as np
import pandas as pd
import pytest

from neuspring.core.table import Cell, Chip, Table
from neuspring.report.blocks import PageSection, html_page
from neuspring.report.summary import detail_blocks, errors_table, score_blocks, summary_text
from neuspring.scores.metrics import SCORE_COLUMNS
from neuspring.scores.numbers import Numbers
from neuspring.scores.runs import Collected, collect
from neuspring.scores.statistics import paired_differences, resampled_means
from tests.support.study_runs import collected, rows_of, summary, tables_in


def test_paired_differences_use_the_same_scenario_and_seed():
    values = {("a", "x", 0): 0.010, ("a", "y", 0): 0.008, ("b", "x", 0): 0.100, ("b", "y", 0): 0.098}
    row = paired_differences(collected(values).scores, "x").iloc[0]
    assert row["difference"] == pytest.approx(-0.002)
    assert row["low"] == pytest.approx(-0.002)
    assert row["high"] == pytest.approx(-0.002)


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


def test_the_difference_weighs_scenarios_equally():
    values = {("a", "x", 0): 0.1, ("a", "y", 0): 0.09}
    values |= {("b", m, seed): v for m, v in (("x", 0.01), ("y", 0.009)) for seed in range(3)}
    row = paired_differences(collected(values).scores, "x").iloc[0]
    assert row["difference"] == pytest.approx(-0.0055)


def test_errors_of_a_pair_have_ratios_and_no_second_number():
    values = {
        (scenario, m, 0): v for scenario, v in zip("abc", (1.0, 0.02, 0.03), strict=True) for m, v in (("x", v), ("y", 0.9 * v))
    }
    assert "0.900 [0.900, 0.900]" in summary(collected(values)) and "aired difference" not in summary(collected(values))


def test_the_interval_over_seeds_alone_has_the_width_of_their_mean():
    """Twelve scenarios alike but for independent noise of three seeds: the variance of resampled means is that of both levels."""
    rng = np.random.default_rng(1)
    runs = [rng.normal(size=3) for _ in range(12)]
    within = np.mean([part.var() / 3 for part in runs]) / 12
    between = np.var([part.mean() for part in runs]) / 12
    means = resampled_means([part[None] for part in runs], np.random.default_rng(0))
    assert means.var() == pytest.approx(within + between, rel=0.05)


def with_images(lpips: str = "computed") -> Collected:
    """Two scenarios, two methods; the second scenario has no images."""
    base = collected({(s, m, 0): 0.01 for s in ("a", "b") for m in ("x", "y")})
    facts = {"backend": "warp", "masks": "given", "views": ["0"], "lpips": lpips, "unseen_surface": 0.25}
    runs = base.runs.assign(images=[json.dumps(facts if s == "a" else None) for s in base.runs["scenario"]])
    values = {"psnr": (30.0, 33.0), "ssim": (0.9, 0.95), "iou": (0.8, 0.9)}
    values |= {"lpips": (0.1, 0.05)} if lpips == "computed" else {}
    rows = [
        ("a", "rope", m, 0, task, metric, pair[k], "1", 10)
        for metric, pair in values.items()
        for k, m in enumerate(("x", "y"))
        for task in ("reconstruction", "future")
    ]
    return Collected(pd.concat([base.scores, pd.DataFrame(rows, columns=list(SCORE_COLUMNS))], ignore_index=True), runs)


def test_pictures_have_a_table_of_their_own():
    benchmark = Numbers(everything=with_images(), baseline="x")
    found = tables_in([*score_blocks(benchmark), *detail_blocks(benchmark)])
    table = found["Scores of pictures"]
    row = rows_of(table)["y"]
    assert row["Recon. PSNR"].text == "33.000" and row["Recon. LPIPS"].text == "0.0500"
    assert row["Recon. SSIM"].plain == "0.9500" and row["Recon. SSIM"].mark == "best"
    # Runs are those with images; a percentage of decibels would mean nothing.
    assert row["Runs"].text == "1/1"
    assert rows_of(found["Pictures: paired difference to x"])["y"]["Recon. PSNR"].plain == "+3.000"
    assert "Of 2 scenarios 1 have scores of pictures. Cameras scored: 0; masks: given; rasterizer: warp." in table.note
    assert "frame 0: a 25%." in summary(with_images())


def test_what_was_not_computed_is_said_and_never_a_number():
    runs = with_images("no AlexNet weights: x is not there")
    table = tables_in(score_blocks(Numbers(everything=runs, baseline="x")))["Scores of pictures"]
    assert not any("LPIPS" in heading for heading in table.header)
    assert "LPIPS not computed: no AlexNet weights: x is not there" in summary(runs)


@pytest.mark.parametrize(
    ("images", "why"),
    [
        (None, "these scenarios have no images"),
        ({"failed": "appearance: step 3 removed the last splat"}, "appearance: step 3 removed"),
    ],
)
def test_where_no_picture_was_scored_the_reason_is_said(images, why):
    one = collected({("a", "x", 0): 0.01})
    assert f"No scores of pictures: {why}" in summary(Collected(one.scores, one.runs.assign(images=json.dumps(images))))


def test_only_pairs_that_every_method_finished_are_averaged_and_the_others_listed():
    """A method that has finished nothing does not empty the table."""
    values = {("a", "x", 0): 0.010, ("a", "y", 0): 0.008, ("b", "x", 0): 0.500}
    found = collected(values, failed=(("b", "y", 0), ("a", "z", 0)))
    rows = rows_of(errors_table(Numbers(everything=found, baseline="x")))
    assert [rows[name]["Future TE"].text for name in "xyz"] == ["10.00", "8.00", "–"]
    assert [rows[name]["Runs"].text for name in "xyz"] == ["2/2", "1/2 (1 failed)", "0/1 (1 failed)"]
    assert [rows[name]["Future TE"].mark for name in "xyz"] == ["", "best", ""]
    text = summary_text(Numbers(everything=found, baseline="x"))
    assert "- y, b / seed 0: failed: diverged\n- z, a / seed 0: failed: diverged\n" in text


def test_many_missing_runs_are_counted_and_failures_named(tmp_path):
    found = collect(tmp_path, [f"s{i}" for i in range(9)], ["x", "y"], [0])
    found.runs.loc[0, ["status", "reason"]] = ["failed", "diverged"]
    text = summary_text(Numbers(everything=found, baseline="x"))
    assert "- x, s0 / seed 0: failed: diverged\n" in text and "- x, s1 / seed 0, " in text
    assert "- y, s0 / seed 0, " in text and " and 2 more: missing" in text and " and 3 more: missing" in text


def test_many_notes_are_counted_by_kind_with_the_range_of_their_numbers():
    found = collected(dict.fromkeys([(f"s{i}", method, 0) for i in range(9) for method in ("x", "y")], 0.010))
    of_x = found.runs["method"] == "x"
    found.runs["notes"] = [
        f"fit: {10 + i}% of the springs lie at the bound; search: at an end of its range: dashpot" if x else ""
        for i, x in enumerate(of_x)
    ]
    assert "- s0 / x / seed 0: fit: 10% of the springs" in summary(found)
    found.runs.loc[~of_x, "notes"] = "fit: no epoch was better than the search"
    many = summary(found)
    assert "- x, 9 of 9 runs: fit: 10 to 26% of the springs lie at the bound" in many
    assert "- x, 9 of 9 runs: search: at an end of its range: dashpot" in many
    assert "- y, 9 of 9 runs: fit: no epoch was better than the search" in many
    assert "s0 / x / seed 0: fit" not in many


def test_no_spread_is_shown_where_one_seed_of_several_has_finished():
    found = collected({("a", "x", 0): 0.010})
    rest = pd.DataFrame([{"scenario": "a", "method": "x", "seed": 1, "status": "missing", "reason": "", "notes": ""}])
    table = errors_table(Numbers(everything=Collected(found.scores, pd.concat([found.runs, rest])), baseline="x"))
    assert rows_of(table)["x"]["Future TE"].plain == "10.00"
    assert "standard deviation" not in table.note


def test_a_table_is_drawn_as_markdown_latex_and_html():
    cell = Cell(text="1.5 ± 0.1", small=["(-2)"], chips=[Chip(text="worse", tone="bad", symbol="▼")], mark="second", value=1.5)
    rows = [[Cell(text="a|b"), cell, Cell(text="<3")], [Cell(text="a long heading of rows"), Cell(), Cell()]]
    table = Table(caption="C", header=["Method", "CD ↓", "CD ↓"], groups=["Recon.", "Future"], rows=rows, note="50 % of a_b")
    head, rule, first, second = table.markdown()
    assert first == "| a\\|b   | <ins>1.5 ± 0.1 (-2): worse</ins> | <3          |"
    assert second == "| *a long heading of rows* | | |" and len(head) == len(rule) == len(first)
    latex = table.latex("label", "T & U")
    assert r"a$|$b & \underline{1.5 $\pm$ 0.1 ($-$2): worse} & $<$3 \\" in latex
    assert r"\multicolumn{1}{c}{Reconstruction \& Resimulation}" in latex and r"\caption{\textbf{T \& U.} 50 \% of a\_b}" in latex
    page = html_page("", "", [PageSection(key="a", title="A", blocks=[table])])
    assert page.count("<table") == 2 and "<caption><span>C: Future Prediction</span></caption>" in page
    assert '<td data-value="1.5"><b>1.5 ± 0.1</b><span class="hidden"> (second)</span><small>(-2)</small>' in page
    assert '<span class="chip bad"><span aria-hidden="true">▼</span> worse</span>' in page and "&lt;3" in page


def test_runs_of_different_settings_are_pointed_out():
    found = collected({("a", "x", 0): 0.010, ("a", "x", 1): 0.011, ("a", "y", 0): 0.010, ("a", "y", 1): 0.011})
    digests = [{"search": "s", "fit": "f"}, {"search": "s", "fit": "g"}, {"search": "s"}, {"search": "s"}]
    found.runs["settings"] = [json.dumps(row) for row in digests]
    assert "Runs were made with different settings (fit of x): make the older ones again" in summary(found)
    found.runs["settings"] = json.dumps(digests[0])
    assert "different settings" not in summary(found)
