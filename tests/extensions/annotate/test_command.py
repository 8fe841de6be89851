"""`neuspring annotate` as a user has it: the command, a real browser, the real method, on a synthetic capture."""

import os
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.files import write_text
from neuspring.data.capture import HANDS, OBJECT, Capture
from tests.support.browser import Browser, chromium
from tests.support.filmed import film

IOU = 0.95
MARGIN = 3.0
"""Pixels between what is marked and its box."""


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A capture of two cameras whose masks were taken away, and the masks [T, H, W] by camera."""
    capture = film(tmp_path_factory.mktemp("film"), cameras=2, sizes=[(320, 180)] * 2)
    frames = range(capture.frame_count)
    truth = {name: np.stack([capture.mask(name, frame) for frame in frames]) for name in capture.cameras}
    shutil.rmtree(capture.folder / "mask")
    path = capture.folder / "capture.json"
    write_text(path, path.read_text().replace('"masks": true', '"masks": false'))
    return Capture.load(capture.folder), truth


@pytest.fixture
def address(filmed):
    """What the command prints, in a process of its own; it must end well with Ctrl-C."""
    command = [sys.executable, "-m", "neuspring", "annotate", str(filmed[0].folder), "--port", "0", "--no-open"]
    options = {"stdout": subprocess.PIPE, "text": True, "env": os.environ | {"OMP_NUM_THREADS": "1"}}
    # Tests that run in the background of a shell ignore Ctrl-C, and would hand that on.
    process = subprocess.Popen(command, **options, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    try:
        line = process.stdout.readline()
        found = re.fullmatch(r"Annotate \S+ at (http://127\.0\.0\.1:\d+/#\S+) \(stop with Ctrl-C\)\n", line)
        assert found, line
        yield found[1]
        process.send_signal(signal.SIGINT)
        assert "Marks are saved" in process.communicate(timeout=60)[0]
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()


def overlap(ours: np.ndarray, truth: np.ndarray, label: int) -> float:
    """Mean intersection over union of a label over the frames."""
    one, other = ours == label, truth == label
    return float(((one & other).sum(axis=(1, 2)) / (one | other).sum(axis=(1, 2))).mean())


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
def test_two_boxes_a_camera_become_masks(filmed, address):
    capture, truth = filmed
    with Browser(served=True) as browser:
        browser.open(address, 1280, 800)
        browser.wait("document.body.dataset.ready === 'yes'")

        def drag(*points):
            browser.drag(*[browser.run(f"annotate.view.toWindow([{x}, {y}])") for x, y in points])

        for camera, labels in truth.items():
            browser.run(f"annotate.go(0, '{camera}')")
            for key, label in (("1", OBJECT), ("2", HANDS)):
                browser.key(key)
                y, x = np.nonzero(labels[0] == label)
                first, last = (x.min() - MARGIN, y.min() - MARGIN), (x.max() + MARGIN, y.max() + MARGIN)
                drag(first, np.mean([first, last], axis=0), last)
            browser.wait("document.getElementById('overlay-text').textContent === 'previewed'")
        browser.wait("document.getElementById('saved').textContent === 'Marks saved'")
        browser.click("#carry-all")
        browser.wait("Object.keys(annotate.masks.results.carried).length === 2", 300)
        browser.wait("document.getElementById('overlay-text').textContent === 'carried' && annotate.view.overlay !== null")
        browser.click("#save-masks")
        browser.wait("document.getElementById('messages').textContent.includes('Saved masks of camera 0, 1')")
        assert browser.check()["errors"] == []
    saved = Capture.load(capture.folder)
    assert saved.description.masks
    for camera, labels in truth.items():
        ours = np.stack([saved.mask(camera, frame) for frame in range(saved.frame_count)])
        for label in (OBJECT, HANDS):
            assert overlap(ours, labels, label) > IOU


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["nowhere"], "capture.json: this file must be readable"), (["{capture}", "--port", "70000"], "--port: must be 0 to 65535")],
)
def test_what_cannot_be_served_is_bad_input(filmed, capsys, arguments, message):
    assert main(["annotate", *[word.replace("{capture}", str(filmed[0].folder)) for word in arguments]]) == 2
    assert message in capsys.readouterr().err
