"""Requests of the page: annotations and masks are never lost or overwritten by a stale tab."""

import json

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.extensions.annotate.server import LABEL_COLORS, overlay_png
from neuspring.perception.masks import MasksFile
from tests.extensions.annotate.served import decoded
from tests.support.moving import FRAMES

BOX = {"frame": 1, "label": "object", "kind": "box", "points": [[40, 50], [60, 70]], "radius": 3.0}
HAND = BOX | {"label": "hand", "points": [[80, 50], [100, 70]]}


def marks(*marks, camera="0"):
    return {"format": 1, "cameras": {camera: list(marks)}}


def revision(client):
    return client.get("/api/masks")["revision"]


def write_marks(client, *own, camera="0"):
    status, answer = client.post("/api/marks", revision=revision(client), marks=marks(*own, camera=camera))
    assert status == 200
    return answer["revision"]


def test_the_state_describes_the_capture_and_frames_come_as_they_are(client, capture):
    state = client.get("/api/state")
    assert (state["name"], state["frames"], state["frame_rate"]) == ("thing", FRAMES, 30.0)
    assert state["cameras"][0] == {"name": "0", "width": 128, "height": 96, "missing": [4]}
    assert state["masks"]["marks"] == {"format": 1, "cameras": {}}
    assert state["masks"]["saved"] == {}
    shown = client.image("/api/color/0/3")[..., ::-1].astype(int)
    assert np.abs(shown - capture.color("0", 3)).mean() < 2.0  # JPEG
    assert client.raw("GET", "/api/color/0/4")[0] == 404


def test_marks_are_saved_at_each_change_and_a_stale_tab_is_refused(client, capture):
    first = write_marks(client, BOX)
    assert json.loads((capture.folder / "marks.json").read_text()) == marks(BOX)
    status, answer = client.post("/api/marks", revision="none", marks=marks())
    assert (status, answer["error"]) == (409, "Another tab or program changed the file after this page read it.")
    assert client.get("/api/masks")["marks"] == marks(BOX)
    assert client.post("/api/marks", revision=first, marks=marks(BOX, HAND))[0] == 200


def test_marks_that_break_a_rule_are_refused_and_change_nothing(client, capture):
    status, answer = client.post("/api/marks", revision="none", marks={"format": 2})
    assert (status, "format" in answer["error"]) == (422, True)
    status, answer = client.post("/api/marks", revision="none", marks=marks(*[BOX] * 2001))
    assert (status, "a camera must have at most 2000 annotations; received 2001" in answer["error"]) == (422, True)
    assert not (capture.folder / "marks.json").exists()


def test_the_preview_shows_the_marks_of_the_frame(client):
    write_marks(client, BOX, HAND)
    status, headers, content = client.raw("POST", "/api/preview", json.dumps({"camera": "0", "frame": 1}).encode())
    assert (status, headers["content-type"]) == (200, "image/png")
    picture = decoded(content)
    assert tuple(picture[60, 50, 2::-1]) == LABEL_COLORS[1]
    assert tuple(picture[60, 90, 2::-1]) == LABEL_COLORS[2]
    assert picture[10, 10, 3] == 0
    status, answer = client.post("/api/preview", camera="0", frame=0)
    assert (status, "must be annotated in it" in answer["error"]) == (422, True)


@pytest.mark.parametrize(
    ("camera", "frame"), [("0", 4), ("0", 12), ("0", -1), ("0", None), ("7", 0), (None, 0), ([], 0), ("0", [])]
)
def test_previews_of_frames_that_are_not_there_are_refused(client, camera, frame):
    assert client.post("/api/preview", camera=camera, frame=frame)[0] == 404


def test_marks_are_carried_looked_at_and_saved(client, capture):
    write_marks(client, BOX)
    assert client.post("/api/masks/save")[0] == 422
    assert client.raw("GET", "/api/overlay/carried/0/2")[0] == 404
    assert client.post("/api/carry", cameras=["0"])[0] == 200
    client.wait(lambda: client.get("/api/job")["state"] == "done")
    masks = client.get("/api/masks")
    assert masks["carried"]["0"]["doubt"] == pytest.approx(np.linspace(0, 1, FRAMES), abs=1e-3)
    assert (masks["carried"]["0"]["stale"], masks["carried"]["0"]["saved"]) == (False, False)
    assert masks["job"]["message"] == "Carried camera 0; 6 very doubtful frames. Check the listed frames, then save."
    assert (client.image("/api/overlay/carried/0/2")[..., 3] > 0).sum() == 21 * 21
    assert client.raw("GET", "/api/overlay/carried/0/4")[0] == 404
    status, answer = client.post("/api/masks/save")
    assert (status, answer) == (200, {"cameras": ["0"]})
    assert [capture.mask("0", frame).sum() for frame in (0, FRAMES - 1)] == [21 * 21] * 2
    assert MasksFile.of(capture).cameras["0"].backend == "marks"
    assert client.get("/api/masks")["carried"]["0"]["saved"]
    write_marks(client, HAND)
    assert client.get("/api/masks")["carried"]["0"]["stale"]


def test_one_thing_is_carried_at_a_time_and_can_be_stopped(client, painted):
    write_marks(client, BOX)
    painted.gate.clear()
    assert client.post("/api/carry", cameras=["0"])[0] == 200
    job = client.wait(lambda: (job := client.get("/api/job"))["done"] == 1 and job)
    assert (job["state"], job["what"], job["total"]) == ("running", "camera 0", FRAMES)
    status, answer = client.post("/api/carry", cameras=["0"])
    assert (status, "Wait for its end, or stop it" in answer["error"]) == (409, True)
    assert client.post("/api/stop")[0] == 200
    painted.gate.set()
    client.wait(lambda: client.get("/api/job")["state"] == "stopped")
    assert client.get("/api/masks")["carried"] == {}
    assert client.post("/api/carry", cameras=["0"])[0] == 200
    client.wait(lambda: client.get("/api/job")["state"] == "done")


def test_an_error_in_the_work_is_told(client, painted):
    write_marks(client, BOX)
    painted.fill = lambda *_: (_ for _ in ()).throw(InputError("camera 0", "the object must be found", "none"))
    client.post("/api/carry", cameras=["0"])
    job = client.wait(lambda: (job := client.get("/api/job"))["state"] == "failed" and job)
    assert job["message"] == "camera 0: the object must be found; received none."
    painted.fill = lambda *_: 1 / 0
    client.post("/api/carry", cameras=["0"])
    client.wait(lambda: "ZeroDivisionError" in client.get("/api/job")["message"])


@pytest.mark.parametrize(("cameras", "status"), [(["covered"], 422), ([], 422), (["7"], 404), ("0", 404), (None, 404), ([[]], 404)])
def test_only_marked_cameras_are_carried(client, cameras, status):
    write_marks(client, BOX)
    assert client.post("/api/carry", cameras=cameras)[0] == status
    assert client.get("/api/job")["state"] == "idle"


def test_borders_of_an_overlay_are_strong_and_its_inside_is_clear():
    labels = np.zeros((20, 30), np.uint8)
    labels[5:15, 5:25] = 1
    opacity = decoded(overlay_png(labels))[..., 3]
    assert opacity[5, 5] == opacity[14, 24] == 255
    assert 0 < opacity[10, 15] < 128
    assert opacity[0, 0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["nowhere"], "capture.json: this file must be readable"), (["{capture}", "--port", "70000"], "--port: must be 0 to 65535")],
)
def test_what_cannot_be_served_is_bad_input(capture, capsys, arguments, message):
    assert main(["annotate", *[word.replace("{capture}", str(capture.folder)) for word in arguments]]) == 2
    assert message in capsys.readouterr().err
