"""The playground in a real browser: it loads, it is scrubbed, and a twin is pulled with the mouse and swings back."""

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.play.page import Page
from neuspring.play.results import find
from neuspring.play.serve import address, start
from tests.support.browser import Browser, chromium
from tests.support.played import results

WIDTH, HEIGHT = 1200, 800
pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")


def until(what, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.05)


def pixel(camera, point: np.ndarray) -> tuple[float, float]:
    """Where a point [3] is in the window."""
    local = Rotation.from_quat(camera.wxyz, scalar_first=True).inv().apply(point - camera.position)
    focal = HEIGHT / 2 / np.tan(camera.fov / 2)
    return WIDTH / 2 + focal * local[0] / local[2], HEIGHT / 2 + focal * local[1] / local[2]


def test_the_page_is_scrubbed_and_a_drag_pulls_the_twin(tmp_path):
    server = start("127.0.0.1", 0)
    page = Page(server, find([results(tmp_path) / "baseline" / "0"]))
    try:
        with Browser(served=True, webgl=True) as browser:
            browser.open(address(server), WIDTH, HEIGHT)
            until(server.get_clients)
            browser.wait("document.body.innerText.includes('training frame 0 of 7')")
            before = page.player._bodies["baseline/0"].nodes.batched_positions.copy()
            browser.key("ArrowRight")
            browser.wait("document.body.innerText.includes('training frame 1 of 7')")
            assert (page.player._bodies["baseline/0"].nodes.batched_positions != before).any()
            page.panel.start("baseline/0")
            live, camera = page.panel.live, next(iter(server.get_clients().values())).camera
            until(lambda: live.simulator.frame > 30)
            x, y = pixel(camera, live.simulator.positions[len(live.simulator.positions) // 2])
            browser._mouse("mouseMoved", x, y, 0)
            browser._mouse("mousePressed", x, y, 0)
            for step in range(1, 16):
                browser._mouse("mouseMoved", x, y - 6 * step, 0, buttons=1)
                time.sleep(0.05)
            until(lambda: live.simulator.grabbed >= 0)
            node = live.simulator.grabbed
            start_frame = live.simulator.frame
            until(lambda: live.simulator.frame > start_frame + 30)
            held = live.simulator.positions[node].copy()
            browser._mouse("mouseReleased", x, y - 90, 0)
            until(lambda: live.simulator.grabbed < 0)
            after = live.simulator.frame
            until(lambda: live.simulator.frame > after + 30)
            assert np.linalg.norm(live.simulator.positions[node] - held) > 0.01
            # A tab that is closed in the middle of a drag lets go.
            x, y = pixel(camera, live.simulator.positions[node])
            browser._mouse("mousePressed", x, y, 0)
            for step in range(1, 10):
                browser._mouse("mouseMoved", x, y - 6 * step, 0, buttons=1)
                time.sleep(0.05)
            until(lambda: live.hold.owner is not None)
        until(lambda: live.hold.owner is None)
    finally:
        page.close()
        server.stop()
