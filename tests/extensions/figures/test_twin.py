"""Twins in color: stiffer springs are lighter on one scale for all, regions have the colors of the report, near covers far."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection

from neuspring.draw.scene import ShownRun, ShownScene, part, seen_from
from neuspring.draw.sheet import CONTROLLER
from neuspring.draw.twin import CROSSING, TwinPicture, region_colors, twin_figure
from neuspring.extensions.figures.filmed import SurfacePicture, finer
from neuspring.report.shown import find
from neuspring.twin.body import lines_of
from tests.extensions.rods.ropes import rod_results
from tests.support.shown import painter

LUMA = np.array([0.2126, 0.7152, 0.0722])


def uneven(scenario):
    """The scenario's scene and runs: springs from 100 N to 10 kN, nodes in three regions along the rope."""
    paints = painter(scenario, (0,))
    takes = []
    for take in paints.takes:
        twin = take.twin
        stiffness = np.geomspace(100, 1e4, len(twin.topology.springs)).astype(np.float32)
        order = np.argsort(np.argsort(twin.topology.nodes[:, 0]))
        labels = (3 * order // len(order)).astype(np.int32)
        material, topology = replace(twin.material, stiffness=stiffness), replace(twin.topology, labels=labels)
        takes.append(replace(take, twin=replace(twin, material=material, topology=topology)))
    return paints.scene, takes


def test_stiffer_springs_are_lighter(plain):
    scene, takes = uneven(plain)
    body = TwinPicture([(scene, take) for take in takes], 0, ("stiffness",))
    light = body.spring_colors(takes[0], "stiffness")[:, :3] @ LUMA
    inside = takes[0].twin.material.stiffness[: len(light)]
    assert (np.diff(light) >= -1e-9).all() and light[-1] > light[0] + 0.5
    assert body.norm.vmin >= 90 and body.norm.vmax <= 1.1 * inside.max()


def test_regions_have_a_color_each_and_springs_between_them_are_dark(plain):
    scene, takes = uneven(plain)
    body, labels = TwinPicture([(scene, take) for take in takes], 0, ("region",)), takes[0].twin.topology.labels
    assert np.array_equal(body.node_colors(takes[0], "region"), region_colors(3)[labels])
    ends = labels[takes[0].twin.topology.springs[: takes[0].twin.topology.object_spring_count]]
    colors, same = body.spring_colors(takes[0], "region"), ends[:, 0] == ends[:, 1]
    assert np.array_equal(colors[same], region_colors(3)[ends[same, 0]])
    assert (~same).any() and (colors[~same] == CROSSING).all()


def test_columns_of_methods_rows_of_quantities_and_a_legend_for_each(plain):
    scene, takes = uneven(plain)
    figure = twin_figure(TwinPicture([(scene, take) for take in takes], 0, ("stiffness", "region")), 5.0)
    panels = [axis for axis in figure.axes if axis.get_xlim()[0] == -0.5]
    assert len(panels) == 4 and figure.get_figwidth() == pytest.approx(5.0)
    (bar,) = (axis for axis in figure.axes if axis not in panels)
    assert bar.get_ylabel() == "stiffness [N]" and bar.get_yscale() == "log"
    legend = panels[3].get_legend()
    assert [text.get_text() for text in legend.texts] == ["region 0", "region 1", "region 2", "between"]
    # Dots are where the camera sees the nodes, the nearest drawn last; hands are red.
    dots, hands = (found for found in panels[2].collections if isinstance(found, PathCollection))
    depth = scene.view.project(takes[0].positions[0].astype(float))[1]
    expected = scene.view.project(takes[0].positions[0][np.argsort(-depth)].astype(float))[0]
    assert np.allclose(dots.get_offsets(), expected)
    assert np.allclose(hands.get_facecolor()[0], plt.matplotlib.colors.to_rgba(CONTROLLER))
    (lines,) = (found for found in panels[0].collections if isinstance(found, LineCollection))
    assert len(lines.get_segments()) == takes[0].twin.topology.object_spring_count


def test_a_surface_has_the_colors_of_its_nodes(video):
    scene, takes = uneven(video)
    axis = plt.figure().add_axes((0, 0, 1, 1))
    SurfacePicture([(scene, take) for take in takes], 4, ("region",), style="splats").paint(axis, scene, takes[0], "region")
    shown = np.asarray(axis.images[0].get_array())
    opaque = np.unique(shown.reshape(-1, 3), axis=0).astype(float) / 255
    for color in region_colors(3)[:, :3]:
        assert np.abs(opaque - color).max(axis=1).min() < 0.05


@pytest.mark.parametrize("clamped", [False, True])
def test_a_rod_is_drawn_as_its_center_line_colored_by_its_bending_stiffness(tmp_path, clamped):
    found = find([rod_results(tmp_path, clamped=clamped)])
    (run,) = found.runs
    take, rod = ShownRun("rod", run.trajectory.positions, run.twin), run.twin.body
    scene = ShownScene.from_side(found.observations, [take], [0])
    uneven = replace(run.twin, body=replace(rod, bending=np.linspace(1, 2, len(rod.bending)) * rod.bending))
    take = replace(take, twin=uneven)
    lines = lines_of(uneven)
    assert lines.inner == len(rod.lengths) == len(lines.pairs) - len(uneven.topology.springs)
    points = lines.points(take.positions[0], found.observations.controller_points[0])
    # A tube's nodes are not even at its ends.
    tolerance = 1e-6 if clamped else 2e-3
    np.testing.assert_allclose(points[lines.pairs[: lines.inner, 0]], rod.vertices[:-1], atol=tolerance)
    body = TwinPicture([(scene, take)], 0, ("stiffness", "region"))
    assert (np.diff(body.spring_colors(take, "stiffness")[:, :3] @ LUMA) > 0).all()
    drawn = twin_figure(body, 5.0)
    drawn_lines = [len(one.get_segments()) for one in drawn.axes[0].collections if isinstance(one, LineCollection)]
    assert drawn_lines == [lines.inner]


def test_finer_pictures_show_the_same_points():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    inner = part(seen_from(points, "+z", 0.0, 0.0), (100, 200, 700, 900))
    fine = finer(inner, 1000)
    assert (fine.width, fine.height) == (1200, 1400)
    # The border of a picture is half a pixel away from the center of its outer pixels.
    assert np.abs((fine.project(points)[0] + 0.5) / 2 - 0.5 - inner.project(points)[0]).max() < 1e-6
    assert finer(inner, 600).width == 600
