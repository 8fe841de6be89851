"""The page in a real browser, by mouse and keys, beside a server with a stand-in for the masks' method."""

import json

import numpy as np
import pytest

from tests.extensions.annotate.served import show
from tests.support.browser import chromium

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
CONTROL, SHIFT = 2, 8


class Page:
    """Actions of a user on the page."""

    def __init__(self, browser, client):
        self.browser, self.client = browser, client
        show(browser, client)

    def at(self, *point):
        """Position of a pixel of the frame in the window."""
        return tuple(self.browser.run(f"annotate.view.toWindow({[float(value) for value in point]})"))

    def drag(self, *points):
        self.browser.drag(*[self.at(*point) for point in points])

    def text(self, selector):
        return self.browser.run(f"document.querySelector({json.dumps(selector)}).textContent")

    def saved(self):
        self.shown("#saved", "Annotations saved")

    def marks(self, camera="0"):
        return self.client.get("/api/masks")["marks"]["cameras"].get(camera, [])

    def told(self, text):
        """Wait until the page says something."""
        self.browser.wait(f"document.getElementById('messages').textContent.includes({json.dumps(text)})")

    def press(self, choice):
        """Press a button of a message."""
        found = f"[...document.querySelectorAll('#messages button')].find((one) => one.textContent === '{choice}')"
        self.browser.run(f"{found}.click()")

    def shown(self, selector, text):
        """Wait until an element has a text."""
        self.browser.wait(f"document.querySelector({json.dumps(selector)}).textContent === {json.dumps(text)}")


@pytest.fixture
def page(browser, client):
    return Page(browser, client)


def test_the_page_opens_without_complaints_and_fits(page):
    found = page.browser.check()
    assert found["errors"] == []
    assert found["broken"] == [] and found["outside"] == []
    assert found["needed"] == found["width"]
    assert all(url.startswith((f"http://127.0.0.1:{page.client.port}/", "about:", "blob:")) for url in found["asked"])
    assert page.text("#name") == "thing"


def test_without_the_token_the_page_says_what_to_do(browser, client):
    browser.run("sessionStorage.clear()")
    browser.open("about:blank", 1280, 800)
    browser.open(f"http://127.0.0.1:{client.port}/#guess", 1280, 800)
    browser.wait("document.getElementById('messages').textContent.includes('Open the address that neuspring annotate printed')")


def test_every_kind_of_mark_is_drawn_with_the_mouse(page):
    page.drag((10, 12), (30, 20), (50, 42))
    page.browser.key("2")
    page.browser.key("c")
    page.drag((70, 30))
    page.browser.key("3")
    page.browser.key("s")
    page.drag((20, 80), (40, 82), (60, 80))
    page.browser.key("1")
    page.browser.key("p")
    for corner in ((80, 50), (110, 50), (110, 80), (80, 80)):
        page.drag(corner)
    page.browser.key("Enter")
    page.saved()
    box, click, scribble, polygon = page.marks()
    assert (box["label"], box["kind"], click["label"], click["kind"]) == ("object", "box", "hand", "click")
    assert (scribble["label"], scribble["kind"], polygon["label"], polygon["kind"]) == ("ignore", "scribble", "object", "polygon")
    np.testing.assert_allclose(box["points"], [[10, 12], [50, 42]], atol=0.15)
    np.testing.assert_allclose(click["points"], [[70, 30]], atol=0.15)
    np.testing.assert_allclose(scribble["points"], [[20, 80], [40, 82], [60, 80]], atol=0.15)
    np.testing.assert_allclose(polygon["points"], [[80, 50], [110, 50], [110, 80], [80, 80]], atol=0.15)
    assert page.browser.run("document.querySelectorAll('#marks li').length") == 4


def test_marks_can_be_undone_removed_and_copied(page):
    page.drag((10, 12), (50, 42))
    page.drag((60, 12), (90, 42))
    page.saved()
    page.browser.key("z", CONTROL)
    page.browser.wait("document.querySelectorAll('#marks li').length === 1")
    page.browser.key("Z", CONTROL | SHIFT)
    page.browser.wait("document.querySelectorAll('#marks li').length === 2")
    page.browser.click("#marks li:first-child button")
    page.browser.wait("document.querySelectorAll('#marks li').length === 1")
    page.browser.key("ArrowRight")
    page.browser.click("#copy")
    page.saved()
    np.testing.assert_allclose([mark["frame"] for mark in page.marks()], [0, 1])
    page.browser.key("Delete")
    page.client.wait(lambda: [mark["frame"] for mark in page.marks()] == [0])
    np.testing.assert_allclose(page.marks()[0]["points"], [[60, 12], [90, 42]], atol=0.15)


def test_frames_and_cameras_are_reached_by_keys(page):
    page.browser.key("ArrowRight", SHIFT)
    assert page.text("#frame-text") == "frame 10 of 0–11"
    page.browser.key("End")
    page.browser.key("ArrowRight")
    assert page.text("#frame-text") == "frame 11 of 0–11"
    page.browser.key("k")
    assert page.browser.run("annotate.camera") == "covered"
    page.browser.click("#overlay")  # a clicked button does not take the keys
    page.browser.key("Home")
    page.browser.key(" ")
    page.browser.wait("annotate.frame === 11 && !annotate.timeline.playing")  # it plays on from where it is put before
    assert page.browser.run("annotate.view.showOverlay") is False
    page.browser.key("k")
    page.browser.run("annotate.go(4)")
    page.shown("#hint", "This camera did not record this frame.")


def test_marks_are_previewed_carried_with_progress_and_saved(page, painted, capture):
    page.drag((40, 50), (60, 70))
    page.shown("#overlay-text", "previewed")
    painted.gate.clear()
    page.browser.click("#carry")
    page.browser.wait("!document.getElementById('progress').hidden")
    page.browser.wait("document.getElementById('progress-text').textContent.startsWith('camera 0: ')")
    painted.gate.set()
    page.shown("#overlay-text", "carried")
    page.told("Carried camera 0")
    page.browser.wait("annotate.view.overlay !== null")
    assert page.browser.run("document.querySelectorAll('#doubtful button').length") == 2
    page.browser.key("d")
    page.shown("#frame-text", "frame 11 of 0–11")
    page.browser.click("#save-masks")
    page.client.wait(lambda: capture.path("mask", "0", 11).exists())
    page.told("Saved masks of camera 0")
    page.drag((70, 50), (90, 70))
    page.saved()
    page.browser.wait("!document.getElementById('stale').hidden")


def test_an_error_is_shown_in_the_page(page):
    page.browser.click("#carry")
    page.told("Draw a box around it first")
    page.browser.click("#messages button")
    page.shown("#messages", "")


@pytest.mark.parametrize(("choice", "left"), [("Load that version", 1), ("Keep mine", 2)])
def test_two_tabs_do_not_write_over_each_other_unasked(page, choice, left):
    page.drag((10, 12), (50, 42))
    page.saved()
    theirs = page.client.get("/api/masks")
    other = {"format": 1, "cameras": {"0": [theirs["marks"]["cameras"]["0"][0] | {"frame": 7}]}}
    assert page.client.post("/api/marks", revision=theirs["revision"], marks=other)[0] == 200
    page.drag((60, 12), (90, 42))
    page.told("Another tab or program changed the annotations")
    assert page.marks()[0]["frame"] == 7
    page.press(choice)
    page.saved()
    page.client.wait(lambda: len(page.marks()) == left and page.marks()[0]["frame"] == (7 if left == 1 else 0))


def test_a_lost_server_is_told_and_the_change_is_kept(page):
    page.browser.online(False)
    page.drag((10, 12), (50, 42))
    page.told("The server does not answer")
    page.shown("#saved", "Annotations NOT saved")
    assert page.browser.run("document.querySelectorAll('#marks li').length") == 1
    page.browser.online(True)
    page.press("Try again")
    page.saved()
    assert len(page.marks()) == 1


def test_the_page_works_in_a_narrow_window(browser, client):
    show(browser, client, 500, 900)
    found = browser.check()
    assert found["needed"] == found["width"]
    assert found["errors"] == []
