"""The playground in a real browser: it loads, switches change the scene, it is scrubbed, and a twin is pulled and swings back."""

from contextlib import contextmanager

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.play.page import Page
from neuspring.play.results import find
from neuspring.play.serve import address, start
from tests.support.browser import Browser, chromium
from tests.support.played import results
from tests.support.pointing import WINDOW, choose_tab, pixel, press, pull, until

PATIENCE = 180.0
RUN = "baseline/0"
pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")


def text(words: str) -> str:
    """A script that tells whether the page says this."""
    return f"document.body.innerText.includes({words!r})"


def switch(words: str) -> str:
    """A script that clicks the checkbox of a name."""
    label = f"[...document.querySelectorAll('label')].find((one) => one.textContent.trim() === {words!r})"
    # The label and its box are in one row of the panel.
    up = "while (!row.querySelector('input')) row = row.parentElement; row.querySelector('input').click()"
    return f"{{ let row = {label}; {up} }}"


@contextmanager
def opened(folder):
    """A page with one run, and a browser that shows it."""
    server = start("127.0.0.1", 0)
    page = Page(server, find([results(folder) / "baseline" / "0"]))
    try:
        with Browser(served=True, webgl=True, patience=PATIENCE) as browser:
            browser.open(address(server), *WINDOW)
            until(server.get_clients)
            browser.wait(text("training frame 0 of 7"), PATIENCE)
            yield server, page, browser
    finally:
        page.close()
        server.stop()


def test_switches_change_what_is_drawn_and_scrubbing_moves_it(tmp_path):
    with opened(tmp_path) as (server, page, browser):
        body = page.player._bodies[RUN]
        before = body.nodes.batched_positions.copy()
        browser.key("ArrowRight")
        browser.wait(text("training frame 1 of 7"), PATIENCE)
        assert (body.nodes.batched_positions != before).any()
        browser.key("End")
        browser.wait(text("future frame 7 of 7"), PATIENCE)
        # The address that a report links to.
        assert page.player.clock.frame == 7
        choose_tab(browser, "Show")
        browser.wait(text("Observed points"), PATIENCE)
        drawn = seen(browser, server, tmp_path / "before.png", lambda count: count > 500)
        for part in ("Nodes", "Springs", "Observed points"):
            browser.run(switch(part))
        until(lambda: not (body.nodes.visible or body.springs.visible or page.player.around.points.visible))
        assert seen(browser, server, tmp_path / "after.png", lambda count: count < 0.6 * drawn)


def seen(browser, server, path, enough) -> int:
    """How many pixels of the scene have a color, once they are so many."""
    wide = next(iter(server.get_clients().values())).camera.image_width

    def count() -> int:
        browser.screenshot(path)
        scene = cv2.imread(str(path))[:, :wide].astype(int)
        found = int((np.ptp(scene, axis=2) > 40).sum())
        return found if enough(found) else 0

    return until(count)


def test_a_drag_pulls_the_twin_and_a_release_lets_it_swing(tmp_path):
    with opened(tmp_path) as (server, page, browser):
        page.panel.start(RUN)
        live, camera = page.panel.live, next(iter(server.get_clients().values())).camera
        until(lambda: live.simulator.frame > 30)
        x, y = pixel(camera, live.simulator.positions[len(live.simulator.positions) // 2])
        with pull(browser, x, y, 0, -90):
            until(lambda: live.simulator.grabbed >= 0)
            node, begun = live.simulator.grabbed, live.simulator.frame
            until(lambda: live.simulator.frame > begun + 30)
            held = live.simulator.positions[node].copy()
            assert live.latency > 0
        until(lambda: live.simulator.grabbed < 0)
        released = live.simulator.frame
        until(lambda: live.simulator.frame > released + 30)
        assert np.linalg.norm(live.simulator.positions[node] - held) > 0.01
        # A second browser sees the same, and may not take what the first one holds.
        with Browser(served=True, webgl=True, patience=PATIENCE) as second:
            second.open(address(server), *WINDOW)
            until(lambda: len(server.get_clients()) == 2)
            press(browser, *pixel(camera, live.simulator.positions[node]), 0, -60)
            until(lambda: live.hold.owner is not None)
            owner = live.hold.owner
            assert not live.hold.take(owner + 1, "node", 0, live.simulator.positions[0])
        until(lambda: len(server.get_clients()) == 1)
        assert live.hold.owner == owner
        # A tab that is closed in the middle of a drag lets go.
        browser.call("Page.navigate", url="about:blank")
        until(lambda: live.hold.owner is None)
