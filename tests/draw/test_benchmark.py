"""Figures of benchmarks: errors against the number of regions, ratios with their intervals."""

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt

from neuspring.draw.benchmark import clusters_figure, ratios_figure
from neuspring.report.tables import Compared, write
from tests.support.study_runs import collected

CD = ("future", "chamfer")


def test_the_error_is_drawn_against_the_number_of_regions():
    scenarios = 5
    values = {
        (f"s{i}", f"clusters_{k}", seed): {CD: 0.01 * (i + k) + 0.002 * seed, ("future", "track_error"): 9.0}
        for i in range(scenarios)
        for k in (10, 1, 5)
        for seed in (0, 1)
    }
    figure = clusters_figure(collected(values | {("s0", "search_only", 0): {CD: 0.9}}).rows)
    k, mean = figure.axes[0].lines[0].get_data()
    assert list(k) == [1, 5, 10]
    np.testing.assert_allclose(mean, 10.0 * (np.array(k) + 2) + 1)
    plt.close("all")
    assert clusters_figure(collected({("a", "clusters_2", 0): {CD: 0.1}, ("a", "search_only", 0): {CD: 0.1}}).rows) is None


def test_ratios_are_drawn_with_their_intervals():
    rows = [
        {"method": m, "task": task, "metric": "track_error", "ratio": r, "ratio_low": r - 0.1, "ratio_high": r + 0.2 - 1e-9}
        for task in ("future", "reconstruction")
        for m, r in (("far", 1.1), ("near", 0.8))
    ]
    figure = ratios_figure(pd.DataFrame(rows), "x")
    assert [axis.get_title() for axis in figure.axes] == ["training frames", "future"]
    for axis in figure.axes:
        bars, markers = axis.collections
        np.testing.assert_allclose([segment[:, 0] for segment in bars.get_segments()], [[1.0, 1.3], [0.7, 1.0]])
        np.testing.assert_allclose(markers.get_offsets()[:, 0], [1.1, 0.8])
        # Only the second interval excludes 1.
        assert (markers.get_facecolors()[0, :3] == 1).all() and not (markers.get_facecolors()[1, :3] == 1).all()
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["far", "near"]
    plt.close(figure)


def test_a_figure_of_ratios_needs_three_scenarios_and_is_not_left_over(tmp_path):
    def written(scenarios: str) -> str:
        values = {(s, m, 0): v for s in scenarios for m, v in (("x", 0.01), ("y", 0.008))}
        write(Compared(table=collected(values), baseline="x"), tmp_path)
        return (tmp_path / "summary.md").read_text()

    assert "](ratios.png)" in written("abc") and (tmp_path / "ratios.png").stat().st_size > 5000
    assert "ratios.png" not in written("ab") and not (tmp_path / "ratios.png").exists()
