"""Pictures of the playground for its page: `python -m results.published.play.make RESULTS/SCENARIO OUTPUT`.

A headless Chromium opens the page as a user does. The scenario should be synthetic, with splats, and have runs of `neuspring` and
`baseline`; pictures of real footage are not for this repository.
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
"""JPEG's quality."""
PATIENCE = 900.0
SECONDS = 20
"""Seconds that a picture is given."""
CLOSE_NOTES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach((one) => one.click())"


def main() -> None:
    """Take all pictures."""
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
    """A twin that is pulled too far."""
    page.begin(page.player.runs[0])
    one = page.live
    assert one is not None
    until(lambda: one.simulator.frame > 5, PATIENCE)
    camera = next(iter(server.get_clients().values())).camera
    x = one.simulator.positions
    node = int(np.argmax(x[:, 2]))
    with pull(browser, *pixel(camera, x[node]), 120, -150):
        until(lambda: one.simulator.grabbed >= 0, PATIENCE)
        begun = one.simulator.frame
        until(lambda: one.simulator.frame > begun + 25, PATIENCE)
        settle()
        save(browser, output / "live.jpg")
    page.end()


def future_frame(page: Page) -> int:
    """A frame some way behind the border."""
    clock = page.player.clock
    return min(clock.border + (clock.count - clock.border) // 2, clock.count - 1)


def change(page: Page, **parts: bool) -> None:
    """Switch what is shown."""
    for name, on in parts.items():
        page.parts[name].value = on
    page._changed()


def settle() -> None:
    """Wait until a browser that draws by software has drawn."""
    time.sleep(SECONDS)


def save(browser: Browser, path: Path) -> None:
    """The window as JPEG."""
    picture = path.with_suffix(".png")
    browser.screenshot(picture)
    image = cv2.imread(str(picture))
    assert image is not None
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    picture.unlink()
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
