"""Screenshots of the playground for its page: `python -m results.published.play.make RESULTS/SCENARIO OUTPUT`.

A headless Chromium opens the page. The scenario should be synthetic, with splats and runs of `neuspring` and `baseline`. Do not
commit screenshots of real video.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from neuspring.extensions.play.page import Page
from neuspring.extensions.play.serve import address, start
from neuspring.report.shown import find
from tests.support.browser import Browser
from tests.support.pointing import WINDOW, pixel, pull, until

QUALITY = 82
"""JPEG quality."""
PATIENCE = 900.0
SECONDS = 20
"""Seconds to wait for a screenshot."""
CLOSE_NOTES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach((one) => one.click())"


def main() -> None:
    """Take all screenshots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("output", type=Path)
    a = parser.parse_args()
    a.output.mkdir(parents=True, exist_ok=True)
    found = find([a.scenario])
    server = start("127.0.0.1", 0)
    page = Page(server, found)
    try:
        with Browser(served=True, webgl=True, patience=PATIENCE) as browser:
            browser.open(address(server), *WINDOW)
            until(server.get_clients, PATIENCE)
            recording(page, browser, a.output)
            live(page, browser, server, a.output)
    finally:
        page.close()
        server.stop()


def recording(page: Page, browser: Browser, output: Path) -> None:
    """Springs by stiffness, then splats, in a future frame."""
    browser.run(CLOSE_NOTES)
    page.show(future_frame(page))
    # The page fades in at first.
    settle()
    settle()
    save(browser, output / "recording.jpg")
    change(page, splats=True, springs=False)
    settle()
    save(browser, output / "splats.jpg")
    change(page, splats=False, springs=True)


def live(page: Page, browser: Browser, server, output: Path) -> None:
    """A twin under a strong pull."""
    page.begin(page.player.runs[0])
    session = page.live
    assert session is not None
    until(lambda: session.simulator.frame > 5, PATIENCE)
    camera = next(iter(server.get_clients().values())).camera
    x = session.simulator.positions
    node = int(np.argmax(x[:, 2]))
    with pull(browser, *pixel(camera, x[node]), 120, -150):
        until(lambda: session.simulator.grabbed >= 0, PATIENCE)
        begun = session.simulator.frame
        until(lambda: session.simulator.frame > begun + 25, PATIENCE)
        settle()
        save(browser, output / "live.jpg")
    page.end()


def future_frame(page: Page) -> int:
    """A frame in the middle of the future."""
    clock = page.player.clock
    return min(clock.border + (clock.count - clock.border) // 2, clock.count - 1)


def change(page: Page, **parts: bool) -> None:
    """Show or hide parts of the page."""
    for name, on in parts.items():
        page.parts[name].value = on
    page._changed()


def settle() -> None:
    """Wait until a browser with software rendering has drawn."""
    time.sleep(SECONDS)


def save(browser: Browser, path: Path) -> None:
    """Save the window as JPEG."""
    picture = path.with_suffix(".png")
    browser.screenshot(picture)
    image = cv2.imread(str(picture))
    assert image is not None
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    picture.unlink()
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
