"""The ray caster against closed forms, and the sensor's flaws."""

import numpy as np
import pytest

from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, OBJECT
from neuspring.scenes.render import Part, Renderer, looking, measured, quantized
from neuspring.scenes.shapes import sphere, surface
from tests.support.captures import K


@pytest.fixture(scope="module")
def ball():
    vertices, faces = surface(sphere((0, 0, 0), 0.06), (-0.08,) * 3, (0.08,) * 3, 0.004)
    part = Part(vertices, faces, np.full((len(vertices), 3), 0.5), OBJECT, (30.0, 0.3))
    behind = Part(vertices * 0.3, faces, np.full((len(vertices), 3), 0.5), HANDS, (30.0, 0.3))
    renderer = Renderer([part, behind])
    renderer.move([vertices + np.array([0, 0, 0.3]), vertices * 0.3 + np.array([0.12, 0, 0.3])])
    return renderer


def camera(eye, target):
    return Camera("0", 120, 68, K, looking(np.array(eye, float), np.array(target, float)))


def test_depth_of_a_sphere_and_of_the_table(ball):
    view = ball.render(camera((-0.6, 0.0, 0.5), (0, 0, 0.3)))
    of = camera((-0.6, 0.0, 0.5), (0, 0, 0.3))
    y, x = np.nonzero(view.label == OBJECT)
    points = of.lift(np.stack([x, y], axis=1).astype(float), view.depth[y, x].astype(float))
    distance = np.linalg.norm(points - [0, 0, 0.3], axis=1)
    np.testing.assert_allclose(distance[view.slope[y, x] > 0.3], 0.06, atol=5e-4)
    y, x = np.nonzero((view.label == 0) & (view.depth > 0))
    points = of.lift(np.stack([x, y], axis=1).astype(float), view.depth[y, x].astype(float))
    np.testing.assert_allclose(points[:, 2], 0.0, atol=2e-5)


def test_what_is_in_front_hides_what_is_behind(ball):
    front, side = (ball.render(camera(eye, (0, 0, 0.3))) for eye in ((-0.6, 0.0, 0.3), (0.0, -0.6, 0.3)))
    assert not (front.label == HANDS).any()
    assert (side.label == HANDS).sum() > 20


def test_texture_sticks_to_the_material():
    vertices, faces = surface(sphere((0, 0, 0), 0.06), (-0.08,) * 3, (0.08,) * 3, 0.004)
    renderer = Renderer([Part(vertices, faces, np.full((len(vertices), 3), 0.5), OBJECT, (30.0, 0.6))])
    pictures = []
    for shift in ((0, 0, 0.3), (0.05, 0.02, 0.35)):
        renderer.move([vertices + shift])
        of = camera(np.array([0.6, 0.0, 0.5]) + shift - [0, 0, 0.3], shift)
        view = renderer.render(of)
        pictures.append(np.where((view.label == OBJECT)[..., None], view.color, 0).astype(int))
    # Light comes from far, so a ball seen the same way looks the same wherever it is.
    # Rounding moves a pixel now and then to the other side of a shadow's edge.
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.05
    assert np.abs(pictures[0] - pictures[1]).max() <= 10
    assert pictures[0][..., 0][pictures[0][..., 0] > 0].std() > 5


def test_the_sensor_is_unbiased_noisier_far_away_and_repeatable():
    slope = np.ones((120, 160))
    deviations = {}
    for depth in (0.5, 1.3):
        values = measured(np.full(slope.shape, depth), slope, 0.001, np.random.default_rng(0)) * 0.001
        inside = values[values > 0]
        assert inside.mean() == pytest.approx(depth, abs=2e-4)
        deviations[depth] = inside.std()
    assert deviations[0.5] == pytest.approx(0.0008, rel=0.2)
    assert deviations[1.3] == pytest.approx(0.0008 + 0.0019 * 0.9**2, rel=0.2)
    again = [measured(np.full(slope.shape, 0.5), slope, 0.001, np.random.default_rng(3)) for _ in range(2)]
    np.testing.assert_array_equal(*again)


def test_edges_and_grazing_surfaces_lose_depth_and_nothing_stays_nothing():
    depth, slope = np.full((80, 80), 0.6), np.ones((80, 80))
    depth[:, 40:], depth[:10] = 0.9, 0.0
    slope[60:] = 0.05
    values = measured(depth, slope, 0.001, np.random.default_rng(0))
    assert not values[:9].any()
    assert not values[60:].any()
    assert 0.3 < (values[15:55, 39:41] == 0).mean() < 0.9
    assert (values[15:55, :30] == 0).mean() < 0.05


def test_depth_is_stored_in_its_unit():
    np.testing.assert_array_equal(quantized(np.array([0.0, 0.5004, 0.5006, 100.0]), 0.001), [0, 500, 501, 65535])
