"""The mouse over a scene that viser draws: where a point is in the window, and drags that are held."""

import time
from contextlib import contextmanager

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

WINDOW = (1100, 720)
SMALL = (800, 480)
"""Pixels; a scene is drawn by software where there is no GPU, so that tests take a small one."""
STEPS = 6
COLORED = 40
"""Least difference of the channels of a pixel that is no shade of gray."""


def until(what, seconds=180.0):
    """The value once it is true; a busy machine draws slowly."""
    end = time.monotonic() + seconds
    while not (value := what()):
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.05)
    return value


def settled(server, browser):
    """The camera of the first browser, once the server knows the view that is drawn: its size, and a place that stays."""
    camera = next(iter(server.get_clients().values())).camera

    def steady():
        before = (camera.image_width, *camera.position)
        time.sleep(0.5)
        return before == (browser.run("document.querySelector('canvas').clientWidth"), *camera.position)

    until(steady)
    return camera


def pixel(camera, point):
    """Position of a point [3] in the window; the scene is its left part."""
    local = Rotation.from_quat(camera.wxyz, scalar_first=True).inv().apply(point - camera.position)
    wide, high = camera.image_width, camera.image_height
    focal = high / 2 / np.tan(camera.fov / 2)
    return wide / 2 + focal * local[0] / local[2], high / 2 + focal * local[1] / local[2]


def colored(browser, path):
    """Which pixels of the window [H, W] have a color, in a picture that is written to a path."""
    browser.screenshot(path)
    image = cv2.imread(str(path))
    assert image is not None
    return np.ptp(image.astype(int), axis=2) > COLORED


def until_drawn(browser, x, y, path):
    """Wait until a colored pixel is drawn at a position of the window, because browsers draw with a delay."""
    rows, columns = (slice(round(value) - 1, round(value) + 2) for value in (y, x))
    until(lambda: colored(browser, path)[rows, columns].any())


@contextmanager
def pull(browser, x, y, right, down):
    """Hold the left button from a place on, moved by so many pixels, while the block runs."""
    press(browser, x, y, right, down)
    yield
    browser._mouse("mouseReleased", x + right, y + down)


def press(browser, x, y, right, down):
    """Press the left button, and move the mouse."""
    browser._mouse("mouseMoved", x, y)
    browser._mouse("mousePressed", x, y)
    for step in range(1, STEPS + 1):
        browser._mouse("mouseMoved", x + right * step / STEPS, y + down * step / STEPS, 1)
        time.sleep(0.05)
