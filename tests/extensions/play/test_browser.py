"""The playground in a real browser: it loads, switches change the scene, it is scrubbed, and a twin is pulled and swings back."""

from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.extensions.play.page import Page
from neuspring.extensions.play.serve import address, start
from neuspring.report.shown import find
from tests.support.browser import Browser, chromium
from tests.support.played import results
from tests.support.pointing import SMALL, choose_tab, colored, pixel, press, pull, settled, until, until_drawn

PATIENCE = 180.0
RUN = "baseline/0"
HEIGHT = 0.03
"""m that a drag lifts a node at least."""
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
            browser.open(address(server), *SMALL)
            until(server.get_clients)
            browser.wait(text("training frame 0 of 7"), PATIENCE)
            yield server, page, browser
    finally:
        page.close()
        server.stop()


@pytest.mark.slow
def test_switches_change_what_is_drawn_scrubbing_moves_it_and_a_drag_pulls_a_live_twin(tmp_path):
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
        drawn, before = seen(browser, server, tmp_path / "before.png", lambda count: count > 500), 0
        while drawn != before:  # all of it is there
            drawn, before = seen(browser, server, tmp_path / "before.png", lambda count: count > 500), drawn
        around = page.player.around
        shown = {"Nodes": body.nodes, "Springs": body.springs, "Observed points": around.points, "Tracks": around.tracks}
        for name, part in shown.items():
            # The page sends at most one change in 50 ms.
            browser.run(switch(name))
            until(lambda part=part: not part.visible)
        assert seen(browser, server, tmp_path / "after.png", lambda count: count < 0.85 * drawn)
        for name in ("Nodes", "Springs"):
            browser.run(switch(name))
        until(lambda: body.nodes.visible and body.springs.visible)
        live, (x, y) = begun(server, page, browser, tmp_path)
        rest = live.simulator.positions.copy()
        with pull(browser, x, y, 0, -90):
            until(lambda: live.simulator.grabbed >= 0)
            node = live.simulator.grabbed
            until(lambda: live.simulator.positions[node, 2] > rest[node, 2] + HEIGHT)
            later(live, 10)
            held = live.simulator.positions[node].copy()
            assert live.latency > 0
        until(lambda: live.simulator.grabbed < 0)
        until(lambda: live.simulator.positions[node, 2] < held[2] - 0.5 * HEIGHT)
        assert np.isfinite(live.simulator.positions).all() and not live.message


def seen(browser, server, path, enough) -> int:
    """How many pixels of the scene have a color, once they are so many."""
    wide = next(iter(server.get_clients().values())).camera.image_width

    def count() -> int:
        found = int(colored(browser, path)[:, :wide].sum())
        return found if enough(found) else 0

    return until(count)


@pytest.mark.slow
def test_one_of_two_browsers_holds_and_lets_go_when_it_is_closed_or_left(tmp_path):
    with opened(tmp_path) as (server, page, browser):
        live, (x, y) = begun(server, page, browser, tmp_path)
        (first,) = server.get_clients()
        with Browser(served=True, webgl=True, patience=PATIENCE) as second:
            second.open(address(server), *SMALL)
            second.wait(text("training frame 0 of 7"), PATIENCE)
            until(lambda: len(server.get_clients()) == 2)
            assert live.grab.take(max(server.get_clients()), "node", 0, live.simulator.positions[0])
            assert not live.grab.take(first, "node", 1, live.simulator.positions[1])
            second.close()
            until(lambda: len(server.get_clients()) == 1)
            until(lambda: live.grab.owner is None)
        press(browser, x, y, 0, -60)
        until(lambda: live.simulator.grabbed >= 0)
        assert live.grab.owner == first
        browser.call("Page.navigate", url="about:blank")
        until(lambda: live.grab.owner is None and not page.player.watched.is_set())
        # Nobody watches any more, so that the twin rests; it lets go as soon as somebody does.
        page.player.watched.set()
        until(lambda: live.simulator.grabbed < 0)
        later(live, 3)
        assert live.grab.owner is None and not live.message


def begun(server, page, browser, folder):
    """A live twin at rest, and where the browser draws its nearest node."""
    camera = settled(server, browser)
    page.panel.start(RUN)
    live = page.panel.live
    later(live, 30)
    x = live.simulator.positions
    place = pixel(camera, x[np.linalg.norm(x - camera.position, axis=1).argmin()])
    until_drawn(browser, *place, folder / "begun.png")
    return live, place


def later(live, frames: int) -> None:
    """Let the twin go on for some frames."""
    wanted = live.simulator.frame + frames
    until(lambda: live.simulator.frame >= wanted)
