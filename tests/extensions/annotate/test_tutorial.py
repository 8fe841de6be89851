"""The steps of the page on own videos run as printed and in order, on frames as a camera writes them.

A stand-in for the user draws an outline of the object and a line along the hand.
"""

import json
import re
import shlex
from contextlib import redirect_stdout
from importlib.resources import files
from io import StringIO

import cv2
import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.extensions.annotate.server import Server
from neuspring.perception.marks import MARKS, Mark, Marks
from tests.support.filmed import film
from tests.support.project import copy_workflow

PAGE = files("neuspring.extensions.own_video").joinpath("README.md").read_text()
SIZE = (240, 160)
OUTLINE = 2.0
"""How far, pixels, the drawn outline may be off."""


def shown():
    """The commands of the last section, in words; a backslash at the end of a line continues it."""
    block = re.findall(r"```\n(.*?)```", PAGE, re.DOTALL)[-1]
    return [shlex.split(line) for line in block.replace("\\\n", " ").splitlines()]


def camera_files(folder):
    """Write the files of the page: color and depth (mm) as numbered PNG, rig.json; returns the video with its true masks."""
    filmed = film(folder / "film", cameras=1, sizes=[SIZE])
    for kind in ("color", "depth"):
        (folder / "FILES" / kind).mkdir(parents=True)
    for frame in range(filmed.frame_count):
        depth = np.round(1000 * filmed.depth("0", frame)).astype(np.uint16)
        for kind, image in (("color", filmed.color("0", frame)[..., ::-1]), ("depth", depth)):
            assert cv2.imwrite(str(folder / "FILES" / kind / f"{frame:06d}.png"), image)
    k = filmed.cameras["0"].intrinsics
    lens = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "width": SIZE[0], "height": SIZE[1]}
    stated = json.loads(re.search(r"`(\{.*\})`", PAGE)[1])
    stated["cameras"][0] |= lens
    (folder / "FILES" / "rig.json").write_text(json.dumps(stated))
    return filmed


def draw(folder, mask):
    """Marks on frame 0, as a user draws them: an outline of the object, a line along the hand."""
    contours, _ = cv2.findContours((mask == OBJECT).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = cv2.approxPolyDP(max(contours, key=cv2.contourArea), OUTLINE, True)[:, 0]
    hand = np.argwhere(mask == HANDS)[:, ::-1]
    ends = [np.quantile(hand, share, axis=0) for share in (0.4, 0.6)]
    marks = [("object", "polygon", outline), ("hand", "scribble", ends)]
    own = [
        Mark(frame=0, label=label, kind=kind, points=tuple((float(x), float(y)) for x, y in points), radius=OUTLINE)
        for label, kind, points in marks
    ]
    Marks(cameras={"0": tuple(own)}).save(folder / MARKS)


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The project's folder after the steps before the workflow, with their output."""
    project = copy_workflow(tmp_path_factory.mktemp("tutorial") / "project")
    filmed = camera_files(project)
    said = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(project)
        patch.delenv("DISPLAY", raising=False)
        patch.setattr(Server, "serve_forever", lambda _: draw(project / "captures" / "my_toy", filmed.mask("0", 0)))
        for program, *words in shown()[:-1]:
            assert program == ".venv/bin/neuspring"
            with redirect_stdout(StringIO()) as stream:
                status = main(words)
            said[words[0]] = stream.getvalue()
            assert status == 0, stream.getvalue()
    return project, filmed, said


def test_every_step_is_tried_here():
    """The workflow takes minutes, and is tried in its parts: the dry run and the rest in tests/dag."""
    assert [words[1] for words in shown()] == ["make-capture", "annotate", "mask", "check-data", "--profile"]


def test_the_capture_is_what_was_filmed_and_the_masks_are_right(followed):
    project, filmed, said = followed
    capture = Capture.load(project / "captures" / "my_toy")
    assert capture.frame_count == filmed.frame_count
    height = capture.cameras["0"].camera_to_world[2, 3] - filmed.cameras["0"].camera_to_world[2, 3]
    assert abs(height) < 2e-3
    assert "table: " in said["make-capture"] and "depth: " in said["make-capture"]
    assert "Annotate captures/my_toy at http://127.0.0.1:" in said["annotate"]
    assert "captures/my_toy/mask_0.png" in said["mask"]
    assert (capture.folder / "mask_0.png").exists()
    assert "0 errors" in said["check-data"] and "no masks yet" not in said["check-data"]
    for frame in range(capture.frame_count):
        for label in (OBJECT, HANDS):
            ours, true = (masks.mask("0", frame) == label for masks in (capture, filmed))
            assert (ours & true).sum() / (ours | true).sum() > 0.9, (frame, label)
