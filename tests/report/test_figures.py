"""Pictures exist, hold what they say, and survive what runs can be: equal values, one region, divergence, y-down worlds."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib import image
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection

from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.report import benchmark as tables
from neuspring.report.figures import benchmark as figures_benchmark
from neuspring.report.figures import run as figures
from neuspring.report.figures import twin as figures_twin
from neuspring.report.figures import views as figures_views
from neuspring.scores.metrics import COLUMNS
from neuspring.scores.runs import Collected
from neuspring.twin.topology import piecewise_topology, regions
from tests.support import small
from tests.support.study_runs import collected

HISTORIES = {
    "search": pd.DataFrame(
        {"step": [0, 1, 0, 1], "metric": ["cost", "cost", "best_cost", "best_cost"], "value": [2e-3, 1e6, 2e-3, 2e-3]}
    ),
    "fit": pd.DataFrame(
        {"step": [0, 1, 0, 1], "metric": ["loss", "loss", "tail_loss", "tail_loss"], "value": [4e-3, 1e-4, 5e-3, 3e-3]}
    ),
}
NAMES = {"errors.png", "motion.png", "losses.png", "topology.png", "stiffness.png"}


@pytest.fixture(autouse=True)
def closed():
    yield
    left = plt.get_fignums()
    plt.close("all")
    assert not left, "figures must be closed"


def observed() -> Observations:
    return small.observations()


def truth() -> Twin:
    return small.scene().truth


def predicted(shift: float = 0.01) -> Trajectory:
    """The true motion, off by `shift` along y in all frames but the first."""
    motion = small.scene().motion.copy()
    motion[1:, :, 1] += shift
    return Trajectory(positions=motion, frame_count=len(motion))


def regional(count: int) -> Twin:
    """The true twin with a topology of `count` regions."""
    seen, twin = observed(), truth()
    labels = regions(seen.nodes, count)
    radius = list(np.linspace(0.03, 0.045, count))
    topology = piecewise_topology(seen.nodes, seen.controller_points[0], labels, radius, [12] * count, 0.03, 8)
    springs = len(topology.springs)
    material = replace(twin.material, stiffness=np.geomspace(1e2, 1e5, springs), dashpot=np.ones(springs))
    return replace(twin, topology=topology, material=material)


def with_stiffness(twin: Twin, values: np.ndarray | float) -> Twin:
    return replace(twin, material=replace(twin.material, stiffness=np.broadcast_to(values, len(twin.topology.springs))))


def turned(seen: Observations, twin: Twin, trajectory: Trajectory) -> tuple[Observations, Twin, Trajectory]:
    """The same scene in a world whose z axis points down."""
    over = np.array([1.0, -1.0, -1.0], np.float32)
    names = ("object_points", "controller_points", "surface_points", "interior_points", "tracks")
    seen = replace(seen, scenario=replace(seen.scenario, up="-z"), **{name: getattr(seen, name) * over for name in names})
    topology = replace(twin.topology, nodes=twin.topology.nodes * over, controllers=twin.topology.controllers * over)
    twin = replace(twin, topology=topology, simulation=replace(twin.simulation, up="-z"))
    return seen, twin, replace(trajectory, positions=trajectory.positions * over)


def check_pictures(paths) -> set[str]:
    """Names of the files; each must be a picture of sensible size with something in it."""
    for path in paths:
        pixels = image.imread(path)
        height, width = pixels.shape[:2]
        assert 300 < width < 2200 and 200 < height < 1600, path
        assert pixels[..., :3].std() > 0.02, path
        assert path.stat().st_size < 3e6, path
    return {path.name for path in paths}


def drawn(figure) -> np.ndarray:
    """Every point scattered in the first panel of a figure [P, 2]."""
    panel = figure.axes[0]
    return np.concatenate([np.asarray(c.get_offsets()) for c in panel.collections if not isinstance(c, LineCollection)])


def test_a_full_run_has_every_picture(tmp_path):
    paths = figures.run_figures(observed(), predicted(), HISTORIES, "m", tmp_path / "plots", twin=regional(3), searched=3e3)
    assert check_pictures(paths) == NAMES == set(figures.NAMES)
    assert sorted(paths) == sorted((tmp_path / "plots").iterdir())


def test_a_run_without_twin_and_trajectory_has_its_losses_alone(tmp_path):
    (tmp_path / "topology.png").write_text("of an earlier run")
    assert check_pictures(figures.run_figures(observed(), None, HISTORIES, "m", tmp_path)) == {"losses.png"}
    assert not (tmp_path / "topology.png").exists()
    assert figures.run_figures(observed(), None, {}, "m", tmp_path) == []


def test_a_diverged_rollout_is_drawn_as_far_as_it_went(tmp_path):
    positions = small.scene().motion[:4].astype(np.float32)
    positions[3, 5] = 90.0
    diverged = Trajectory(positions=positions, frame_count=small.FRAMES, diverged_frame=4, reason="far away")
    assert check_pictures(figures.run_figures(observed(), diverged, {}, "m", tmp_path)) == {"errors.png", "motion.png"}
    assert list(figures.chosen_frames(observed().scenario, 4)) == [0, 3]
    figure = figures._motion(observed(), diverged, "m")
    # What went far away does not shrink the rest: the rope still fills a third of the panel.
    low, high = figure.axes[0].get_xlim()
    assert high - low < 3 * np.ptp(observed().nodes[:, 0])
    plt.close(figure)


@pytest.mark.parametrize(
    ("train_end", "frames", "expected"),
    [
        (70, 100, {0: "start", 69: "end of training", 84: "middle of the future", 99: "last frame"}),
        (99, 100, {0: "start", 98: "end of training", 99: "last frame"}),
        (100, 100, {0: "start", 99: "end of training"}),
        (70, 40, {0: "start", 39: "last before divergence"}),
        (70, 70, {0: "start", 69: "end of training"}),
        (70, 1, {0: "start"}),
    ],
)
def test_the_frames_of_the_motion_picture(train_end, frames, expected):
    scenario = replace(observed().scenario, frame_count=100, train_end=train_end)
    assert figures.chosen_frames(scenario, frames) == expected


def test_error_lines_join_each_visible_point_to_its_own_node():
    seen = observed()
    hidden = seen.object_visibility.copy()
    hidden[1:, ::2] = False
    seen = replace(seen, object_visibility=hidden)
    figure = figures._motion(seen, predicted(), "m")
    columns = len(figures.chosen_frames(seen.scenario, small.FRAMES))
    assert len(figure.axes) == 2 * columns
    (lines,) = [c for c in figure.axes[2 * columns - 1].collections if isinstance(c, LineCollection)]
    segments = np.array(lines.get_segments())
    # The last panel shows y against height; the prediction is off by 10 mm in y and exact in height.
    assert len(segments) == np.count_nonzero(hidden[-1])
    assert segments[:, 1, 0] - segments[:, 0, 0] == pytest.approx(0.01, abs=1e-5)
    assert segments[:, 1, 1] == pytest.approx(segments[:, 0, 1], abs=1e-5)
    assert "track error 10.0 mm" in figure.axes[columns - 1].get_title()
    plt.close(figure)


def test_a_frame_without_annotation_does_not_claim_a_perfect_track():
    tracks = observed().tracks.copy()
    tracks[-1] = np.nan
    figure = figures._motion(replace(observed(), tracks=tracks), predicted(), "m")
    titles = [axis.get_title() for axis in figure.axes]
    assert sum("no annotated track" in title for title in titles) == 1
    plt.close(figure)


def test_height_grows_upwards_in_a_world_that_points_down(tmp_path):
    upright = (observed(), regional(2), predicted())
    over = turned(*upright)
    pairs = []
    for seen, twin, trajectory in (upright, over):
        pictures = [figures._motion(seen, trajectory, "m"), figures_twin.topology_figure(twin, "m")]
        assert all(low < high for picture in pictures for low, high in [axis.get_ylim() for axis in picture.axes])
        pairs.append([drawn(picture) for picture in pictures])
        for picture in pictures:
            plt.close(picture)
    for first, second in zip(*pairs, strict=True):
        # Nodes of one depth may change places, so heights are compared as sets.
        np.testing.assert_allclose(np.sort(first[:, 1]), np.sort(second[:, 1]), atol=1e-6)
    assert check_pictures(figures.run_figures(over[0], over[2], HISTORIES, "m", tmp_path, twin=over[1], searched=1e3)) == NAMES


@pytest.mark.parametrize("up", ["+z", "-z"])
@pytest.mark.parametrize("axis", [0, 1])
def test_views_are_not_mirrored(up, axis):
    sign = 1.0 if up == "+z" else -1.0
    top = figures_views.top_view(axis, up)
    assert top.depth(np.array([0.0, 0.0, sign])) == 1.0
    assert figures_views.side_view(axis, up).project(np.array([0.0, 0.0, sign])) == pytest.approx([0.0, 1.0])
    assert top.labels[1].startswith("−") == (np.array(top.upwards).sum() < 0)


@pytest.mark.parametrize("path", ["rope/lift/smooth", "cloth/shake/smooth", "blob/lift/smooth"])
def test_every_shape_has_two_views_at_one_scale(path):
    points = small.scene(path, frames=4).observations.nodes
    layout = figures_views.TwoViews.of(points, "+z")
    assert layout.views[0].right[figures_views.widest_axis(points)] == 1.0
    for view, bounds in zip(layout.views, layout.bounds, strict=True):
        flat = view.project(points)
        assert (flat > bounds[0]).all() and (flat < bounds[1]).all()
    assert 2.0 < layout.inches[0] < 7.0 and 1.5 < layout.inches[1] < 6.0


@pytest.mark.parametrize("values", [5e3, 0.0, 1e-30, 1e5])
def test_equal_stiffness_is_one_bar_and_one_color(tmp_path, values):
    twin = with_stiffness(truth(), values)
    assert check_pictures(figures.run_figures(observed(), None, {}, "m", tmp_path, twin=twin, searched=values)) == {
        "topology.png",
        "stiffness.png",
    }
    low, high = figures_twin.stiffness_limits(twin.material.stiffness)
    assert 0 < low < high <= 10 * low
    shown = figures_twin.floored(np.asarray(twin.material.stiffness, float))
    counts, _ = np.histogram(shown, figures_twin.histogram_edges(shown))
    assert counts.max() == counts.sum() == len(shown)


def test_the_color_range_holds_most_springs_and_not_the_outliers():
    stiffness = np.concatenate([np.geomspace(1e3, 1e4, 1000), [0.0, 1e-9]])
    low, high = figures_twin.stiffness_limits(stiffness)
    assert 900 < low < 1100 and 9000 < high <= 1e4
    counts, _ = np.histogram(figures_twin.floored(stiffness), figures_twin.histogram_edges(figures_twin.floored(stiffness)))
    assert counts.sum() == len(stiffness)


def test_springs_are_colored_by_their_own_stiffness():
    twin = regional(2)
    ends = np.concatenate([twin.topology.nodes, twin.topology.controllers])[twin.topology.springs]
    law = np.poly1d([1e4, 1e3])
    figure = figures_twin.stiffness_figure(with_stiffness(twin, law(ends[..., 0].mean(axis=1))), 3e3, "m")
    (lines,) = [c for c in figure.axes[0].collections if isinstance(c, LineCollection)]
    segments = np.array(lines.get_segments())
    assert len(segments) == twin.topology.object_spring_count
    expected = np.clip(law(segments[..., 0].mean(axis=1)), lines.norm.vmin, lines.norm.vmax)
    np.testing.assert_allclose(lines.get_array(), expected, rtol=1e-5)
    marks = [line for axis in figure.axes for line in axis.lines if "S_0" in str(line.get_label())]
    assert [float(line.get_xdata()[0]) for line in marks] == [3e3]
    plt.close(figure)


def test_a_twin_without_object_springs_has_no_stiffness_picture(tmp_path):
    twin = truth()
    kept = slice(twin.topology.object_spring_count, None)
    topology = replace(twin.topology, springs=twin.topology.springs[kept], rest_lengths=twin.topology.rest_lengths[kept])
    material = replace(twin.material, stiffness=twin.material.stiffness[kept], dashpot=twin.material.dashpot[kept])
    bare = replace(twin, topology=topology, material=material)
    assert check_pictures(figures.run_figures(observed(), None, {}, "m", tmp_path, twin=bare)) == {"topology.png"}


@pytest.mark.parametrize("count", [1, 2, 10, 14])
def test_regions_have_colors_and_lines_of_their_own(count):
    figure = figures_twin.topology_figure(regional(count), "m")
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert sum(name.startswith("region ") for name in names) == (count if count > 1 else 0)
    assert any("between regions" in name for name in names) == (count > 1)
    assert len(np.unique(figures_twin.region_colors(count), axis=0)) == count
    plt.close(figure)


def test_of_very_many_springs_a_fixed_random_part_is_drawn():
    assert figures_views.sample(100).tolist() == list(range(100)) and figures_views.sample_note(20_000) == ""
    chosen = figures_views.sample(120_000)
    assert len(np.unique(chosen)) == 20_000 and (np.diff(chosen) > 0).all()
    np.testing.assert_array_equal(chosen, figures_views.sample(120_000))
    assert "20000" in figures_views.sample_note(120_000)


@pytest.mark.parametrize("metrics", [("loss",), ("loss", "tail_loss"), ()])
def test_losses_draw_what_the_history_has(metrics):
    fit = HISTORIES["fit"]
    figure = figures._losses({"search": HISTORIES["search"], "fit": fit[fit["metric"].isin(metrics)]}, "m")
    search, second = figure.axes
    assert [text.get_text() for text in search.get_legend().get_texts()] == ["candidates", "best so far"]
    assert search.get_yscale() == "log" and search.get_ylim()[1] < 1.0
    assert len(second.lines) == len(metrics)
    assert second.get_yscale() == ("log" if metrics else "linear")
    plt.close(figure)


def test_the_loss_of_a_baseline_has_no_unit_that_it_may_not_have():
    history = pd.DataFrame({"step": [0, 1, 0, 1], "metric": ["loss", "loss", "mask", "mask"], "value": [1.0, 0.5, 9.0, 9.0]})
    figure = figures._losses({"train": history}, "m")
    (axis,) = figure.axes
    assert (axis.get_title(), axis.get_xlabel(), axis.get_ylabel()) == ("train", "step", "loss")
    assert [list(line.get_ydata()) for line in axis.lines] == [[1.0, 0.5]]
    plt.close(figure)


def chamfer(values: dict[tuple[str, str, int], float], **options) -> Collected:
    """Future Chamfer distances in meters, and reconstruction ones half as large."""
    found = collected(values, **options)
    future = found.scores.assign(metric="chamfer")
    past = future.assign(task="reconstruction", value=future["value"] / 2)
    # Other metrics must not reach the picture.
    return Collected(pd.concat([future, past, found.scores])[list(COLUMNS)], found.runs)


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
}


def test_cluster_curves_are_the_means_and_deviations_over_seeds():
    table = figures_benchmark.cluster_curves(chamfer(STUDY).scores).set_index(["scenario", "task", "clusters"])
    expected = {("a", 1): (12, 8**0.5), ("a", 10): (20, 0), ("b", 1): (30, 0), ("b", 10): (44, 32**0.5)}
    # Over scenarios: the seeds' means of K = 1 are 20 and 22 mm, of K = 10 they are 30 and 34 mm.
    expected |= {("", 1): (21, 2**0.5), ("", 10): (32, 8**0.5)}
    assert len(table) == 2 * len(expected)
    for (scenario, clusters), (mean, deviation) in expected.items():
        for task, factor in (("future", 1.0), ("reconstruction", 0.5)):
            row = table.loc[(scenario, task, clusters)]
            assert row["mean"] == pytest.approx(factor * mean)
            assert row["std"] == pytest.approx(factor * deviation)


def test_cluster_methods_are_sorted_by_number():
    assert list(
        figures_benchmark.cluster_methods(["clusters_10", "neuspring", "clusters_2", "clusters_2", "clusters_x"]).values()
    ) == [2, 5, 10]
    assert figures_benchmark.cluster_methods(["model_b", "neuspring"]) == {}


@pytest.mark.parametrize(
    ("methods", "made"),
    [(("clusters_1", "clusters_10", "search_only"), True), (("clusters_1", "search_only"), False), (("search_only",), False)],
)
def test_the_cluster_picture_is_made_for_two_counts_or_more(tmp_path, methods, made):
    found = chamfer({key: value for key, value in STUDY.items() if key[1] in methods})
    (tmp_path / "clusters.png").write_text("of an earlier run")
    tables.write(found, "search_only", tmp_path)
    assert (tmp_path / "clusters.png").exists() == made
    assert ("(clusters.png)" in (tmp_path / "summary.md").read_text()) == made
    if made:
        check_pictures([tmp_path / "clusters.png"])


@pytest.mark.parametrize("scenarios", [1, 4, 5])
def test_few_scenarios_have_a_panel_each_and_many_share_one(tmp_path, scenarios, monkeypatch):
    values = {(f"s{i}", f"clusters_{k}", 0): 0.01 * (i + k) for i in range(scenarios) for k in (1, 2, 5)}
    kept = []
    monkeypatch.setattr(figures_benchmark, "save", lambda figure, path: kept.append(figure) or path)
    tables.write(chamfer(values), "clusters_1", tmp_path)
    figure = kept[-1]
    alone = scenarios <= 4
    assert len(figure.axes) == (scenarios if alone else 1)
    lines = figure.axes[0].lines
    assert len(lines) == (2 if alone else 2 * scenarios + 2)
    # The last line is the future's; thin lines of single scenarios come before the mean.
    k, mean = (np.asarray(values, float) for values in lines[-1].get_data())
    assert k.tolist() == [1, 2, 5]
    np.testing.assert_allclose(mean, 10.0 * (k + (0 if alone else (scenarios - 1) / 2)))
    plt.close("all")


def test_a_pair_that_one_count_failed_is_left_out_for_all_of_them(tmp_path, monkeypatch):
    values = {key: value for key, value in STUDY.items() if key != ("a", "clusters_10", 1)}
    failed = [("a", "clusters_10", 1), *((scenario, "clusters_4", seed) for scenario in "ab" for seed in (0, 1))]
    kept = []
    monkeypatch.setattr(tables, "clusters_figure", lambda scores, path, note: kept.append((scores, note)))
    assert not tables.draw_clusters(chamfer(values, failed=tuple(failed)), tmp_path)
    ((scores, note),) = kept
    assert set(zip(scores["scenario"], scores["seed"], strict=True)) == {("a", 0), ("b", 0), ("b", 1)}
    # clusters_4 finished no run: it is not drawn and holds nobody back.
    assert set(scores["method"]) == {"clusters_1", "clusters_10"}
    assert "3 of 4 pairs" in note


def test_ratios_are_drawn_with_their_intervals(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(figures_benchmark, "save", lambda figure, path: kept.append(figure) or path)
    rows = [
        {
            "method": m,
            "baseline": "x",
            "task": task,
            "metric": "track_error",
            "ratio": r,
            "ratio_low": r - 0.1,
            "ratio_high": r + 0.2 - 1e-9,
        }
        for task in ("future", "reconstruction")
        for m, r in (("far", 1.1), ("near", 0.8))
    ]
    assert figures_benchmark.ratios_figure(pd.DataFrame(rows), tmp_path / "ratios.png", "") is not None
    (figure,) = kept
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
        tables.write(collected(values), "x", tmp_path)
        return (tmp_path / "summary.md").read_text()

    assert "](ratios.png)" in written("abc")
    assert (tmp_path / "ratios.png").stat().st_size > 5000
    assert "ratios.png" not in written("ab")
    assert not (tmp_path / "ratios.png").exists()
