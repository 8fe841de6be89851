"""The playground in a real browser: it loads, keys move it, and a twin is pulled, swings back and is let go."""

from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.extensions.play.page import Page
from neuspring.extensions.play.serve import address, start
from neuspring.report.shown import find
from tests.support.browser import Browser, chromium
from tests.support.played import results
from tests.support.pointing import SMALL, pixel, press, pull, settled, until, until_drawn

PATIENCE = 180.0
RUN = "baseline/0"
HEIGHT = 0.03
"""m that a drag lifts a node at least."""
pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")


def text(words):
    """A script that tells whether the page says this."""
    return f"document.body.innerText.includes({words!r})"


@contextmanager
def opened(folder):
    """A page with one run, and a browser that shows it."""
    server = start("127.0.0.1", 0)
    page = Page(server, find([results(folder) / "baseline" / "0"]))
    try:
        with Browser(served=True, webgl=True, patience=PATIENCE) as browser:
            browser.open(address(server), *SMALL)
            until(server.get_clients)
            browser.wait(text("training frame 0 of 7"), PATIENCE)
            yield server, page, browser
    finally:
        page.close()
        server.stop()


@pytest.mark.slow
def test_the_keys_move_the_recording_and_a_drag_pulls_a_live_twin(tmp_path):
    with opened(tmp_path) as (server, page, browser):
        body = page.player._bodies[RUN]
        before = body.nodes.batched_positions.copy()
        browser.key("ArrowRight")
        browser.wait(text("training frame 1 of 7"), PATIENCE)
        assert (body.nodes.batched_positions != before).any()
        live, (x, y) = begun(server, page, browser, tmp_path)
        rest = live.simulator.positions.copy()
        with pull(browser, x, y, 0, -90):
            until(lambda: live.simulator.grabbed >= 0)
            node = live.simulator.grabbed
            until(lambda: live.simulator.positions[node, 2] > rest[node, 2] + HEIGHT)
            later(live, 10)
            held = live.simulator.positions[node].copy()
        until(lambda: live.simulator.grabbed < 0)
        until(lambda: live.simulator.positions[node, 2] < held[2] - 0.5 * HEIGHT)
        assert np.isfinite(live.simulator.positions).all() and not live.message
        live.reset()
        until(lambda: live.simulator.frame < 10)
        later(live, 30)
        press(browser, x, y, 0, -60)
        until(lambda: live.simulator.grabbed >= 0)
        browser.call("Page.navigate", url="about:blank")
        # Nobody watches any more, so that the twin rests and nobody holds it.
        until(lambda: live.grab.owner is None and not page.player.watched.is_set())


def begun(server, page, browser, folder):
    """A live twin at rest, and where the browser draws its nearest node."""
    camera = settled(server, browser)
    page.begin(RUN)
    live = page.live
    later(live, 30)
    x = live.simulator.positions
    place = pixel(camera, x[np.linalg.norm(x - camera.position, axis=1).argmin()])
    until_drawn(browser, *place, folder / "begun.png")
    return live, place


def later(live, frames):
    """Let the twin go on for some frames."""
    wanted = live.simulator.frame + frames
    until(lambda: live.simulator.frame >= wanted)
