"""Cameras from any side contain their scene and rotate by their angle; crops of an image match the complete image."""

import math

import numpy as np
import pytest

from neuspring.draw.scene import FLATTEST_PANEL, TALLEST_PANEL, box_around, broad_side, part, seen_from

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(60, 3)) * [0.3, 0.05, 0.1] + [1.0, 2.0, 0.4]
SUB = 1e-6
"""Pixels: rounding of double precision."""


@pytest.mark.parametrize("up", ["+z", "-z"])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (200, 35), (-70, 89), (45, -89)])
def test_all_points_are_inside_and_none_is_far_from_the_border(up, azimuth, elevation):
    camera = seen_from(POINTS, up, azimuth, elevation)
    pixels, depth = camera.project(POINTS)
    assert (depth > 0).all() and camera.sees(pixels).all()
    # The picture is filled: a point lies within a tenth of some border.
    assert min(pixels.min(), (camera.width - pixels).min()) < 0.1 * camera.width


@pytest.mark.parametrize("up", ["+z", "-z"])
def test_up_is_up_and_the_azimuth_turns_counter_clockwise(up):
    sign = 1.0 if up == "+z" else -1.0
    middle = np.zeros(3)
    box = np.array([[-0.1] * 3, [0.1] * 3])
    front = seen_from(box, up, -90.0, 10.0)
    (low, high), _ = front.project(np.array([middle, [0, 0, 0.05 * sign]]))
    assert high[1] < low[1] and abs(high[0] - low[0]) < SUB
    # From the front, the side of -y as seen with z up, +x is to the right; from +x, the front is on the left.
    assert front.camera_to_world[1, 3] * sign < 0
    assert front.project(np.array([[0.05, 0, 0]]))[0][0, 0] > low[0]
    side = seen_from(box, up, 0.0, 10.0)
    assert side.camera_to_world[0, 3] > 0
    assert side.project(np.array([[0, -0.05 * sign, 0]]))[0][0, 0] < side.project(middle[None])[0][0, 0]


@pytest.mark.parametrize("up", ["+z", "-z"])
def test_the_broad_side_shows_the_greatest_width(up):
    angle = math.radians(30)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    points = (POINTS - POINTS.mean(0)) @ turn.T

    def width(azimuth):
        direction = np.array([-math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth)) * (1 if up == "+z" else -1)])
        return np.std(points[:, :2] @ direction)

    best = broad_side(points, up)
    assert all(width(best) >= width(other) - 1e-9 for other in range(0, 360, 5))


def test_a_box_holds_its_pixels_has_a_shape_and_stays_inside_a_photo():
    camera = seen_from(POINTS, "+z", 0.0, 0.0)
    flat = np.array([[300.0, 500.0], [800.0, 510.0]])
    left, top, right, bottom = box_around(flat, camera, clip=True)
    assert left <= 300 and right > 800 and top <= 500 and bottom > 510
    assert (bottom - top) / (right - left) == pytest.approx(FLATTEST_PANEL, abs=0.01)
    tall = box_around(flat[:, ::-1], camera, clip=True)
    assert (tall[3] - tall[1]) / (tall[2] - tall[0]) == pytest.approx(TALLEST_PANEL, abs=0.01)
    corner = np.array([[0.0, 0.0], [30.0, 200.0]])
    assert box_around(corner, camera, clip=True)[:2] == (0, 0)
    assert min(box_around(corner, camera, clip=False)[:2]) < 0


def test_a_part_shows_the_same_points():
    camera = seen_from(POINTS, "+z", 0.0, 0.0)
    whole = camera.project(POINTS)[0]
    inner = part(camera, (100, 200, 700, 900))
    assert (inner.width, inner.height) == (600, 700)
    assert np.abs(inner.project(POINTS)[0] + [100, 200] - whole).max() < SUB
