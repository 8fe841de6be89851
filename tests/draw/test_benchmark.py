"""Pictures of benchmarks: errors against the number of regions, ratios with their intervals."""

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt

from neuspring.draw import benchmark as figures
from neuspring.report import summary as tables
from neuspring.scores.metrics import SCORE_COLUMNS
from neuspring.scores.numbers import Numbers
from neuspring.scores.runs import Collected
from tests.support.study_runs import collected


def chamfer(values: dict[tuple[str, str, int], float], **options) -> Collected:
    """Future Chamfer distances in meters, and reconstruction ones half as large."""
    found = collected(values, **options)
    future = found.scores.assign(metric="chamfer")
    past = future.assign(task="reconstruction", value=future["value"] / 2)
    # Other metrics must not reach the picture.
    return Collected(pd.concat([future, past, found.scores])[list(SCORE_COLUMNS)], found.runs)


STUDY = {
    ("a", "clusters_1", 0): 0.010,
    ("a", "clusters_1", 1): 0.014,
    ("a", "clusters_10", 0): 0.020,
    ("a", "clusters_10", 1): 0.020,
    ("b", "clusters_1", 0): 0.030,
    ("b", "clusters_1", 1): 0.030,
    ("b", "clusters_10", 0): 0.040,
    ("b", "clusters_10", 1): 0.048,
    ("a", "search_only", 0): 0.9,
    ("a", "clusters_x", 0): 0.9,
}


def test_cluster_curves_are_the_means_and_deviations_over_seeds():
    table = figures.cluster_curves(chamfer(STUDY).scores).set_index(["scenario", "task", "clusters"])
    expected = {("a", 1): (12, 8**0.5), ("a", 10): (20, 0), ("b", 1): (30, 0), ("b", 10): (44, 32**0.5)}
    # Over scenarios: the seeds' means of K = 1 are 20 and 22 mm, of K = 10 they are 30 and 34 mm.
    expected |= {("", 1): (21, 2**0.5), ("", 10): (32, 8**0.5)}
    assert len(table) == 2 * len(expected)
    for (scenario, clusters), (mean, deviation) in expected.items():
        for task, factor in (("future", 1.0), ("reconstruction", 0.5)):
            row = table.loc[(scenario, task, clusters)]
            assert row["mean"] == pytest.approx(factor * mean)
            assert row["std"] == pytest.approx(factor * deviation)


@pytest.mark.parametrize(
    ("methods", "made"),
    [(("clusters_1", "clusters_10", "search_only"), True), (("clusters_1", "search_only"), False), (("search_only",), False)],
)
def test_the_cluster_picture_is_made_for_two_counts_or_more(tmp_path, methods, made):
    found = chamfer({key: value for key, value in STUDY.items() if key[1] in methods})
    (tmp_path / "clusters.png").write_text("of an earlier run")
    tables.write(Numbers(everything=found, baseline="search_only"), tmp_path)
    assert (tmp_path / "clusters.png").exists() == made
    assert ("(clusters.png)" in (tmp_path / "summary.md").read_text()) == made
    if made:
        assert (tmp_path / "clusters.png").stat().st_size > 5000


@pytest.mark.parametrize("scenarios", [1, 4, 5])
def test_few_scenarios_have_a_panel_each_and_many_share_one(scenarios):
    values = {(f"s{i}", f"clusters_{k}", 0): 0.01 * (i + k) for i in range(scenarios) for k in (1, 2, 10)}
    figure = figures.clusters_figure(chamfer(values).scores)
    alone = scenarios <= 4
    assert len(figure.axes) == (scenarios if alone else 1)
    lines = figure.axes[0].lines
    assert len(lines) == (2 if alone else 2 * scenarios + 2)
    # The last line is the future's; thin lines of single scenarios come before the mean.
    k, mean = (np.asarray(values, float) for values in lines[-1].get_data())
    assert k.tolist() == [1, 2, 10]
    np.testing.assert_allclose(mean, 10.0 * (k + (0 if alone else (scenarios - 1) / 2)))
    plt.close("all")


def test_a_pair_that_one_count_failed_is_left_out_for_all_of_them(monkeypatch):
    values = {key: value for key, value in STUDY.items() if key != ("a", "clusters_10", 1)}
    failed = [("a", "clusters_10", 1), *((scenario, "clusters_4", seed) for scenario in "ab" for seed in (0, 1))]
    kept = []
    monkeypatch.setattr(tables, "clusters_figure", lambda scores, note: kept.append((scores, note)))
    assert not list(tables.figures(Numbers(everything=chamfer(values, failed=tuple(failed)), baseline="search_only")))
    ((scores, note),) = kept
    assert set(zip(scores["scenario"], scores["seed"], strict=True)) == {("a", 0), ("b", 0), ("b", 1)}
    # clusters_4 finished no run: it is not drawn and holds nobody back.
    assert set(scores["method"]) == {"clusters_1", "clusters_10"}
    assert "3 of 4 pairs" in note


def test_ratios_are_drawn_with_their_intervals():
    names = ["method", "baseline", "task", "metric", "ratio", "ratio_low", "ratio_high"]
    ratios = [(task, *row) for task in ("future", "reconstruction") for row in (("far", 1.1), ("near", 0.8))]
    rows = [(m, "x", task, "track_error", r, r - 0.1, r + 0.2 - 1e-9) for task, m, r in ratios]
    figure = figures.ratios_figure(pd.DataFrame(rows, columns=names), "")
    assert [axis.get_title() for axis in figure.axes] == ["training frames", "future"]
    for axis in figure.axes:
        ((_, _, (bars,)),) = axis.containers
        np.testing.assert_allclose([segment[:, 0] for segment in bars.get_segments()], [[1.0, 1.3], [0.7, 1.0]])
        # Only the second interval leaves out 1.
        drawn = [(line.get_markerfacecolor(), list(line.get_xdata())) for line in axis.lines if line.get_marker() == "o"]
        assert drawn[1:] == [("tab:blue", [0.8]), ("white", [1.1])]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["far", "near"]
    plt.close(figure)


def test_a_picture_of_ratios_needs_three_scenarios_and_is_not_left_over(tmp_path):
    def written(scenarios: str) -> str:
        values = {(s, m, 0): v for s in scenarios for m, v in (("x", 0.01), ("y", 0.008))}
        tables.write(Numbers(everything=collected(values), baseline="x"), tmp_path)
        return (tmp_path / "summary.md").read_text()

    assert "](ratios.png)" in written("abc")
    assert (tmp_path / "ratios.png").stat().st_size > 5000
    assert "ratios.png" not in written("ab")
    assert not (tmp_path / "ratios.png").exists()
