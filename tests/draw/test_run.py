"""Figures exist, contain what they claim, and allow equal values, one region and divergence."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib import image
from matplotlib import pyplot as plt
from matplotlib.colors import LogNorm

from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.draw import run as figures
from neuspring.draw.benchmark import curves_figure
from neuspring.draw.scene import ShownRun, chosen_frames
from neuspring.draw.twin import histogram, region_colors, stiffness_limits
from neuspring.physics.topology import piecewise_topology, regions
from tests.support import small

HISTORIES = {
    "search": pd.DataFrame(
        {"step": [0, 1, 0, 1], "metric": ["cost", "cost", "best_cost", "best_cost"], "value": [2e-3, 1e6, 2e-3, 2e-3]}
    ),
    "fit": pd.DataFrame(
        {"step": [0, 1, 0, 1], "metric": ["loss", "loss", "rollout_loss", "rollout_loss"], "value": [4e-3, 1e-4, 5e-3, 3e-3]}
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


def check_pictures(paths) -> set[str]:
    """Names of the files; each must be a picture of sensible size with something in it."""
    for path in paths:
        pixels = image.imread(path)
        height, width = pixels.shape[:2]
        assert 300 < width < 2200 and 150 < height < 1600, path
        assert pixels[..., :3].std() > 0.02, path
        assert path.stat().st_size < 3e6, path
    return {path.name for path in paths}


def test_a_full_run_has_every_picture(tmp_path):
    paths = figures.run_figures(observed(), predicted(), HISTORIES, "m", tmp_path / "plots", twin=regional(3), searched=3e3)
    assert check_pictures(paths) == NAMES == set(figures.RUN_FIGURES)
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
    figure = figures.motion_figure(observed(), diverged, "m")
    words = {text.get_text() for axis in figure.axes for text in axis.texts}
    words |= {text for axis in figure.axes for text in (axis.get_title(), axis.get_ylabel())}
    assert {"diverged", "frame 3, 0.10 s", "observed", "m"} <= words
    plt.close(figure)


def test_the_motion_picture_says_how_far_nodes_are_from_their_points():
    figure = figures.motion_figure(observed(), predicted(), "m")
    assert [text.get_text() for axis in figure.axes for text in axis.texts if text.get_text().endswith("mm")] == [
        "0.0 mm",
        *["10.0 mm"] * (len(chosen_frames(observed().scenario, small.FRAMES)) - 1),
    ]
    plt.close(figure)


@pytest.mark.parametrize(
    ("train_end", "frames", "expected"),
    [
        (70, 100, {0: "start", 69: "end of training", 84: "middle of the future", 99: "last frame"}),
        (100, 100, {0: "start", 99: "end of training"}),
        (70, 40, {0: "start", 39: "last before divergence"}),
        (70, 70, {0: "start", 69: "end of training"}),
    ],
)
def test_the_frames_of_the_motion_picture(train_end, frames, expected):
    assert chosen_frames(replace(observed().scenario, frame_count=100, train_end=train_end), frames) == expected


@pytest.mark.parametrize("values", [5e3, 0.0, 1e-30, 1e5])
def test_equal_stiffness_is_one_bar_and_one_color(tmp_path, values):
    twin = with_stiffness(truth(), values)
    paths = figures.run_figures(observed(), None, {}, "m", tmp_path, twin=twin, searched=values)
    assert check_pictures(paths) == {"topology.png", "stiffness.png"}
    low, high = stiffness_limits(twin.material.stiffness)
    assert 0 < low < high <= 10 * low
    assert max(bars(twin.material.stiffness)) == sum(bars(twin.material.stiffness)) == len(twin.material.stiffness)


def bars(stiffness: np.ndarray) -> list[float]:
    """Heights of the histogram's bars."""
    figure, axis = plt.subplots()
    histogram(axis, np.asarray(stiffness, float), LogNorm(*stiffness_limits(stiffness)), None)
    plt.close(figure)
    return [bar.get_height() for bar in axis.patches]


def test_the_color_range_holds_most_springs_and_not_the_outliers():
    stiffness = np.concatenate([np.geomspace(1e3, 1e4, 1000), [0.0, 1e-9]])
    low, high = stiffness_limits(stiffness)
    assert 900 < low < 1100 and 9000 < high <= 1e4
    assert sum(bars(stiffness)) == len(stiffness)


def test_the_searched_stiffness_is_marked():
    twin = regional(2)
    figure = figures.stiffness_figure(observed(), ShownRun("m", twin.topology.nodes[None], twin), 3e3)
    axis = next(axis for axis in figure.axes if "searched, 3000" in axis.get_xlabel())
    assert [float(line.get_xdata()[0]) for line in axis.lines] == [3e3]
    plt.close(figure)


def test_a_twin_without_object_springs_has_no_stiffness_picture(tmp_path):
    twin = truth()
    kept = slice(twin.topology.object_spring_count, None)
    topology = replace(twin.topology, springs=twin.topology.springs[kept], rest_lengths=twin.topology.rest_lengths[kept])
    material = replace(twin.material, stiffness=twin.material.stiffness[kept], dashpot=twin.material.dashpot[kept])
    bare = replace(twin, topology=topology, material=material)
    assert check_pictures(figures.run_figures(observed(), None, {}, "m", tmp_path, twin=bare)) == {"topology.png"}


@pytest.mark.parametrize("count", [1, 2, 14])
def test_regions_have_names_and_colors_of_their_own(count):
    twin = regional(count)
    body = figures._from_two_sides(observed(), ShownRun("m", twin.topology.nodes[None], twin), "m", "region")
    figure = figures.twin_figure(body, figures.RUN_WIDTH)
    names = [text.get_text() for text in figure.axes[-1].get_legend().get_texts()]
    assert len(names) == count + (count > 1) and ("between" in names) == (count > 1)
    assert len(np.unique(region_colors(count), axis=0)) == count
    plt.close(figure)


def test_curves_are_of_what_the_history_has():
    history = pd.DataFrame({"step": [0, 1, 0, 1], "metric": ["loss", "loss", "mask", "mask"], "value": [1.0, 0.5, 9.0, 9.0]})
    assert {name: list(line) for name, line in figures.history_lines(history).items()} == {"loss": [1.0, 0.5]}
    search = figures.history_lines(HISTORIES["search"])
    assert list(search) == ["best cost so far"]
    figure = curves_figure({"search": search, "fit": figures.history_lines(HISTORIES["fit"])})
    assert [axis.get_yscale() for axis in figure.axes] == ["linear", "log"] and len(figure.axes[1].lines) == 2
    plt.close(figure)
