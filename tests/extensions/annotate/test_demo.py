"""The demo's scenes, marked with the mouse in a real browser: what a user gets for at most five marks a camera."""

import json
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring import config
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import overlap
from neuspring.perception.marks.marks import Mark
from neuspring.scenes.sources import read_scenarios
from neuspring.scenes.synthetic.make import make
from tests.extensions.annotate.served import Client, served, show
from tests.support.browser import Browser, chromium
from tests.support.project import ROOT

DEMO = config.read_yaml(ROOT / "config" / "data" / "demo.yaml")
SIZES = config.parse(config.Config, DEMO, "demo.yaml").synthetic
KEYS = {"object": "1", "hand": "2"}
LEAST = 0.95
"""Least mean overlap of a camera's masks with the truth: what was aimed at."""
MOST_MARKS = 5
OUTLINE = 1.5
"""How far, pixels, the outline that a user draws is from the truth."""


def outlines(truth: np.ndarray) -> list[Mark]:
    """At most MOST_MARKS polygons that a user would draw around what frame 0 shows, the largest first."""
    found = []
    for label, name in ((OBJECT, "object"), (HANDS, "hand")):
        contours, _ = cv2.findContours((truth == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            coarse = cv2.approxPolyDP(contour, OUTLINE, True)[:, 0]
            if len(coarse) >= 3:
                points = tuple((float(x), float(y)) for x, y in coarse)
                found.append((cv2.contourArea(contour), Mark(frame=0, label=name, kind="polygon", points=points, radius=2.0)))  # type: ignore[arg-type]
    return [own for _, own in sorted(found, key=lambda pair: -pair[0])[:MOST_MARKS]]


def corrections(marks: Sequence[Mark], truth: np.ndarray, frame: int) -> list[Mark]:
    """Outlines of what a later frame shows, as many as `marks` leave of MOST_MARKS."""
    return [replace(own, frame=frame) for own in outlines(truth)[: MOST_MARKS - len(marks)]]


def draw(browser: Browser, marks: list[Mark]) -> None:
    """Click the corners of outlines in the shown frame."""
    browser.key("p")
    for mark in marks:
        browser.key(KEYS[mark.label])
        for corner in mark.points:
            browser.drag(tuple(browser.run(f"annotate.view.toWindow({list(corner)})")))
        browser.key("Enter")


def press(browser: Browser, button: str) -> None:
    """Press a button once it can be pressed: the page learns a moment after the server that a job is done.

    Not by the mouse, because notes above the buttons come and go, and move them.
    """
    browser.wait(f"!document.querySelector('{button}').disabled")
    browser.run(f"document.querySelector('{button}').click()")


def carried(browser: Browser, client: Client, camera: str, marks: int) -> list[float]:
    """Press the button that carries this camera, once its marks are saved; the doubt of each frame."""
    client.wait(lambda: len(client.get("/api/masks")["marks"]["cameras"][camera]) == marks)
    press(browser, "#carry")

    def fresh() -> list[float] | None:
        state = client.get("/api/masks")
        own = state["carried"].get(camera)
        assert state["job"]["state"] != "failed", state["job"]
        return own["doubt"] if own and not own["stale"] and state["job"]["state"] == "done" else None

    return client.wait(fresh, 300.0)


def go(browser: Browser, frame: int, of: int) -> None:
    browser.run(f"annotate.go({frame})")
    browser.wait(f"document.querySelector('#frame-text').textContent === 'frame {frame} of 0–{of - 1}'")


@pytest.mark.slow
@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize("scenario", DEMO["scenarios"])
def test_five_marks_a_camera_give_the_masks_of_the_demo(browser, tmp_path, scenario):
    capture, _ = make(read_scenarios(ROOT / "config" / "scenarios.tsv")[scenario], SIZES, tmp_path / "capture")
    frames = capture.frame_count
    truths = {camera: np.stack([capture.mask(camera, frame) for frame in range(frames)]) for camera in capture.cameras}
    # A user's capture has no masks.
    description = json.loads((capture.folder / "capture.json").read_text())
    (capture.folder / "capture.json").write_text(json.dumps(description | {"masks": False}))
    capture = Capture.load(capture.folder)
    with served(capture) as client:
        show(browser, client)
        for camera, truth in truths.items():
            browser.wait(f"annotate.camera === '{camera}'")
            go(browser, 0, frames)
            first = outlines(truth[0])
            draw(browser, first)
            worst = int(np.argmax(carried(browser, client, camera, len(first))))
            more = corrections(first, truth[worst], worst)
            assert len(first) + len(more) <= MOST_MARKS
            go(browser, worst, frames)
            draw(browser, more)
            carried(browser, client, camera, len(first) + len(more))
            browser.key("k")
        press(browser, "#save-masks")
        browser.wait("document.getElementById('messages').textContent.includes('Saved masks')")
    made = Capture.load(capture.folder)
    for camera, truth in truths.items():
        labels = np.stack([made.mask(camera, frame) for frame in range(frames)])
        for label in (OBJECT, HANDS):
            assert np.mean([overlap(labels[k] == label, truth[k] == label) for k in range(frames)]) > LEAST
