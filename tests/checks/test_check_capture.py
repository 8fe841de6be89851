"""check-data on capture folders: a good one has measurements only, every other finding is provoked once; checks as data."""

import json
import re
import shutil
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring import checks, registry
from neuspring.checks import examine
from neuspring.checks.masks import Shown
from neuspring.checks.table import on_table
from neuspring.checks.things import Sample, extents, in_cm, lifted, of_body
from neuspring.core.checks import Check
from neuspring.core.geometry import rigid_inverse
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture, Writer
from neuspring.intake.check import check_layout
from tests.support.captures import describe, entry
from tests.support.filmed import film
from tests.support.findings import holds, of_level, serious

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    return film(tmp_path_factory.mktemp("filmed") / "film", cameras=2)


@pytest.fixture
def both(filmed, tmp_path):
    """Both cameras, to change."""
    return Capture.load(shutil.copytree(filmed.folder, tmp_path / "film"))


@pytest.fixture
def capture(both):
    """One camera of it."""
    edit(both, lambda values: values.update(cameras=values["cameras"][:1]))
    return Capture.load(both.folder)


def edit(capture, change) -> None:
    path = capture.folder / CAPTURE
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def moved(change, camera=0):
    """A change of one camera's pose."""

    def apply(values):
        entry = values["cameras"][camera]
        entry["camera_to_world"] = change(np.array(entry["camera_to_world"])).tolist()

    return apply


def shifted(x=0.0, y=0.0, z=0.0, tilt=0.0):
    """A motion of the world: a tilt about x, degrees, then a shift, m."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_euler("x", tilt, degrees=True).as_matrix(), (x, y, z)
    return lambda pose: motion @ pose


def enlarged(values) -> None:
    values["depth_unit"] = 0.01
    for row in values["cameras"][0]["camera_to_world"][:3]:
        row[3] *= 10


def test_a_good_film_has_measurements_only(filmed, tmp_path):
    found = check_layout(filmed.folder)
    assert serious(found) == [] == serious(check_layout(filmed.folder.parent))
    for words in (("camera 0: the table is 0 mm",), ("camera 1", "depth holes: 0%"), ("size of the object",), ("cameras 0 and 1",)):
        assert holds(found, "note", CAPTURE, *words)
    assert serious(check_layout(film(tmp_path / "down", cameras=1, up="-z").folder)) == []


@pytest.mark.parametrize(
    ("change", "name", "level", "value", "limit"),
    [
        (moved(shifted(z=0.05)), "table elsewhere", "warning", 0.05, None),
        (moved(shifted(tilt=5.0)), "table elsewhere", "warning", 0.01444, None),
        (moved(shifted(tilt=40.0)), "table elsewhere", "error", 0.1064, None),
        (lambda values: values.update(depth_unit=1.0), "depth unit", "error", 768.0, (0.1, 10.0)),
        (enlarged, "high camera", "warning", 4.0, (0.0, 3.0)),
        (enlarged, "implausible size", "warning", 1.510, None),
        (enlarged, "object high above the table", "warning", 1.392, (None, 1.2)),
        (lambda values: values.update(frame_rate=3000.0), "frame rate", "error", 3000.0, (1.0, 240.0)),
        (lambda values: values.update(frame_rate=0.033), "frame rate", "error", 0.033, (1.0, 240.0)),
        (moved(shifted(z=-0.08)), "object below the table", "warning", -0.0533, (-0.02, None)),
        (lambda values: values.update(category="Cloth"), "category", "warning", "cloth", None),
    ],
)
def test_a_description_that_contradicts_the_images(capture, change, name, level, value, limit):
    edit(capture, change)
    (found,) = (one for one in check_layout(capture.folder) if one.name == name)
    assert (Path(found.where).name, found.level, found.limit) == (CAPTURE, level, limit)
    assert found.value == (value if isinstance(value, str) else pytest.approx(value, rel=0.005))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda values: values.update(up="-z"), "up: must be the side of the table on which the cameras are: +z"),
        (moved(rigid_inverse), "what looks like a world-to-camera matrix. Invert it"),
        (moved(lambda pose: pose @ OPENGL), "what looks like a matrix for OpenGL's axes"),
        (moved(lambda pose: rigid_inverse(pose @ OPENGL)), "a world-to-camera matrix for OpenGL"),
        (lambda values: values.update(depth_unit=0.01), "Plausible would be 0.001"),
        (lambda values: values["cameras"][0]["camera_to_world"][0].__setitem__(0, 3.0), "must be a rotation"),
    ],
)
def test_a_description_whose_fault_is_known_is_explained(capture, change, words):
    edit(capture, change)
    assert holds(check_layout(capture.folder), "error", CAPTURE, words)


def second(labels, frame):
    labels[2:22, 2:22] = OBJECT
    return labels


def extended(labels, frame):
    row = int(np.nonzero((labels == OBJECT).any(axis=1))[0].mean())
    labels[row : row + 3, : int(np.nonzero(labels[row] == OBJECT)[0].min())] = OBJECT
    return labels


def reaching(labels, frame):
    """The hand with its arm, and 1 and 2 exchanged."""
    row, column = np.argwhere(labels == HANDS).mean(axis=0).astype(int)
    labels[row : row + 4, column:] = HANDS
    return np.choose(labels, [0, HANDS, OBJECT])


def hand_elsewhere(labels, frame):
    labels[labels == HANDS] = 0
    labels[-20:-2, 4:24] = HANDS
    return labels


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        (lambda labels, _: np.where(labels == OBJECT, 0, labels), "no object in frame 0", 0),
        (lambda labels, _: np.where(labels == HANDS, 0, labels), "no hand in frame 0", 0),
        (second, "two objects", 2),
        (lambda labels, frame: np.where((labels == OBJECT) & (frame > 3), 0, labels), "object missing", 2),
        (extended, "object at the border", 6),
        (reaching, "labels exchanged", 1.0),
        (lambda labels, _: np.where(labels == 0, HANDS, labels), "hands too large", 0.694),
        (hand_elsewhere, "hand far from the object", 0.212),
    ],
)
def test_masks_that_show_something_else(capture, change, name, value):
    for frame in range(capture.frame_count):
        labels = change(capture.mask("0", frame).copy(), frame)
        cv2.imwrite(str(capture.path("mask", "0", frame)), labels.astype(np.uint8))
    found = check_layout(capture.folder)
    assert of_level(found, "error") == []
    (one,) = (one for one in found if one.name == name)
    assert one.level == "warning" and one.value == pytest.approx(value, rel=0.005)


def test_what_is_wrong_with_every_mask_is_said_once(capture):
    for frame in range(capture.frame_count):
        cv2.imwrite(str(capture.path("mask", "0", frame)), np.repeat(capture.mask("0", frame)[..., None], 3, axis=2))
    found = of_level(check_layout(capture.folder), "error")
    assert len(found) == 1
    assert "00000.png: masks are gray, palette or one-bit images; received 3 channels" in found[0]
    assert found[0].endswith("The same in 5 more files of the folder.")


def test_depth_of_a_sensor_that_stands_elsewhere(capture):
    rewrite_depth(capture, lambda depth, mask: np.roll(depth, 8, axis=1))
    words = ("camera 0: depth not aligned to color", "moved 8 pixels to the left", "rs.align")
    assert holds(check_layout(capture.folder), "warning", CAPTURE, *words)


def rewrite_depth(capture, change) -> None:
    for frame in range(capture.frame_count):
        path = capture.path("depth", "0", frame)
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), change(depth, capture.mask("0", frame)).astype(np.uint16))


def test_an_object_without_depth_and_a_table_that_is_not_seen(capture):
    rewrite_depth(capture, lambda depth, mask: np.where((mask == OBJECT) & (np.arange(mask.shape[1]) % 2 == 0), 0, depth))
    assert holds(check_layout(capture.folder), "warning", CAPTURE, "depth holes: 50%", "Film from farther")
    rewrite_depth(capture, lambda depth, mask: np.where(mask == OBJECT, depth, 0))
    assert holds(check_layout(capture.folder), "note", CAPTURE, "z = 0 and up are not checked")


def test_cameras_that_disagree(both):
    edit(both, moved(shifted(x=0.05), camera=1))
    assert holds(check_layout(both.folder), "warning", CAPTURE, "cameras 0 and 1 should see the same")


def test_images_of_another_size_or_missing(both):
    cv2.imwrite(str(both.path("depth", "1", 2)), np.zeros((10, 20), np.uint16))
    both.path("color", "1", 4).unlink()
    found = check_layout(both.folder)
    assert holds(found, "error", "00002.png", "160 x 90", "received 20 x 10")
    assert holds(found, "error", "00004.png", "cameras.1.missing")


@pytest.mark.parametrize("up", ["+z", "-z"])
def test_an_object_on_something_is_said(tmp_path, up):
    capture = film(tmp_path / "film", cameras=1, up=up, stand=0.08)
    found = [one.message for one in check_layout(capture.folder) if one.level == "warning"]
    assert len(found) == 1
    assert "object above the table: " in found[0] and "on something 8.0 cm high" in found[0]


def test_an_object_in_the_air_needs_a_hand_that_holds_it(filmed):
    view = filmed.cameras["0"]
    lifted = view.camera_to_world.copy()
    lifted[2, 3] += 0.08
    depth, mask = filmed.depth("0", 0), filmed.mask("0", 0)
    for labels, words in (((OBJECT,), "begins 11 cm above the table, and no hand is near"), ((OBJECT, HANDS), "")):
        sample = Sample(np.where(np.isin(mask, labels), depth, 0.0), mask)
        found = examine("support", "object", replace(view, camera_to_world=lifted), sample, 1.0)
        assert [words in one.text for one in found] == ([True] if words else [])
        assert examine("support", "object", view, sample, 1.0) == []


def places(capture):
    """The findings about the object's size and place of a capture's only camera, by name."""
    names = ("size of the object", "implausible size", "object below the table", "stray pixels", "object above the table")
    return {one.name: one for one in check_layout(capture.folder) if one.name in names}


def far_behind(capture, frames, pixels, kept=None):
    """Give the last pixels of the object the depth of something 1.2 m behind the table; of its others only `kept` stay measured."""
    marked = []
    for frame in frames:
        path = capture.path("depth", "0", frame)
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        y, x = np.nonzero((capture.mask("0", frame) == OBJECT) & (depth > 0))
        if kept is not None:
            depth[y[kept:-pixels], x[kept:-pixels]] = 0
        depth[y[-pixels:], x[-pixels:]] += 1200
        marked.append(list(zip(x[-pixels:].tolist(), y[-pixels:].tolist(), strict=True)))
        cv2.imwrite(str(path), depth)
    return marked


@pytest.mark.parametrize("kept", [None, 40])
def test_stray_pixels_are_named_and_change_neither_size_nor_height(capture, kept):
    """Four pixels of the mask show something far below the table; where little of the object is measured they are a tenth of it."""
    before = places(capture)
    assert set(before) == {"size of the object"}
    marked = far_behind(capture, (0,), 4, kept)
    after = places(capture)
    stray = after["stray pixels"]
    assert set(after) == {"size of the object", "stray pixels"}
    assert (stray.level, stray.value, stray.frames) == ("note", 4, (0,))
    assert any(f"x {x}, y {y} of frame 0" in stray.text for x, y in marked[0])
    if kept is None:
        assert after["size of the object"].value == before["size of the object"].value


def test_sizes_and_heights_are_those_of_frame_0_and_not_of_the_way(capture):
    """In the film the hand pushes the body; what it reaches later makes it no longer."""
    own = lifted(capture.cameras["0"], Sample(capture.depth("0", 0), capture.mask("0", 0)), OBJECT)
    low, high = extents(own)
    found = places(capture)["size of the object"]
    assert found.value == in_cm(high - low) and found.frames == (0,)
    assert f"from {100 * low[2]:.1f} to {100 * high[2]:.1f} cm above the table" in found.text


def test_a_body_in_parts_and_one_of_few_points_keep_all_of_them():
    body = np.random.default_rng(0).uniform(0, 0.1, (400, 3))
    parted = np.concatenate([body, body[:40] + np.array([0.4, 0, 0])])
    few = np.array([[0.05, 0.02, 0], [0.06, 0.02, 0], [0.3, 0.1, 0], [0.5, 0.4, 0], [0.2, 0.3, 0.1]])
    sparse = np.argwhere(np.ones((6, 5, 1))) * 0.06
    strays = np.concatenate([body, [[0.0, 0, -0.7], [0.01, 0, -0.7], [0, 0.01, -0.71], [0, 0, 2.0]]])
    for unit in (1.0, 20.0, 1000.0):
        assert all(of_body(unit * points).all() for points in (body, parted, sparse, few[2:], body[:1]))
        assert of_body(unit * strays).tolist() == [True] * 400 + [False] * 4
    assert of_body(body[:0]).tolist() == []


def sheet(view):
    """A mask of 24 x 24 cm of the table beside the film's body."""
    y, x = np.mgrid[: view.height, : view.width]
    points = on_table(view, np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(view.height, view.width, 3)
    return np.where((np.abs(points[..., :2] - (0.28, 0.2)) < 0.12).all(axis=-1), OBJECT, 0).astype(np.uint8)


@pytest.mark.parametrize(("category", "words"), [("towel", "the category 'towel' makes a filled body of it"), ("cloth", "")])
def test_a_sheet_whose_category_is_a_body(capture, category, words):
    for frame in range(capture.frame_count):
        cv2.imwrite(str(capture.path("mask", "0", frame)), sheet(capture.cameras["0"]))
    edit(capture, lambda values: values.update(category=category))
    found = [text for text in of_level(check_layout(capture.folder), "warning") if "shape and category" in text]
    assert [words in text and '"category": "cloth"' in text for text in found] == [True] * bool(words)


@pytest.mark.parametrize(
    ("category", "meant"),
    [("Cloth", "cloth"), ("cloths", "cloth"), ("packge", "package"), ("Rope", "rope"), ("sloth", ""), ("bear", "")],
)
def test_a_category_that_is_nearly_another(category, meant):
    found = examine("category", "capture.json", category)
    assert [one.message.endswith(f"received {category!r}. Is {meant} meant?") for one in found] == [True] * bool(meant)


@pytest.mark.parametrize(("width", "turns"), [(0.01, 4), (0.012, 6)])
def test_a_rope_in_turns_is_no_sheet(width, turns):
    along = np.linspace(0, turns, 1500)
    middle = np.stack([0.12 * np.cos(np.pi * along), 0.04 * along, np.full(len(along), 0.008)], axis=1)
    points = middle + np.random.default_rng(0).uniform(-width / 2, width / 2, (len(along), 3))
    assert examine("sheet", "object", points, 1.0) == []


def test_times_with_one_constant_grip_are_proposed(tmp_path):
    """Of two hands one lets go in frame 20 of 60; at 10 frames/s both times last longer than a second."""
    writer = Writer(tmp_path, describe(frame_count=60, frame_rate=10.0, cameras=(entry(width=120, height=68),)))
    for frame in range(60):
        labels = np.zeros((68, 120), np.uint8)
        labels[20:50, 40:80], labels[20:40, 30:40] = OBJECT, HANDS
        labels[20:40, 80:90] = HANDS if frame < 20 else 0
        writer.frame("0", frame, np.zeros((68, 120, 3), np.uint8), np.full((68, 120), 900, np.uint16), labels)
    found = check_layout(writer.finish().folder)
    words = ("hands within 6 cm of the object, by frames: 0-19: 2, 20-59: 1.", "--frames 20-59 or --frames 0-19 --output")
    assert holds(found, "note", CAPTURE, *words)


def test_frames_are_numbers_too():
    shown = Shown(6, (40, 30))
    for frame in range(6):
        labels = np.zeros((30, 40), np.uint8)
        labels[10:30, 10:16] = OBJECT if frame < 4 else 0
        shown.see(frame, labels)
    found = {one.name: one for one in examine("masks", "camera 0", shown)}
    assert found["object missing"].frames == (4, 5)
    assert found["object at the border"].frames == (0, 1, 2, 3)
    assert (found["no hand in frame 0"].value, found["no hand in frame 0"].level) == (0.0, "warning")


def test_no_check_is_named_twice_for_one_subject_without_another_measure():
    every = [check for name in checks.CHECKS for check in (checks.CHECKS[name] if isinstance(checks.CHECKS[name], tuple) else ())]
    assert len({(check.name, check.of, check.measure) for check in every}) == len(every) > 80


def test_every_kind_of_subject_that_is_examined_has_a_check():
    every = [check for member in checks.CHECKS.values() for check in (member if isinstance(member, tuple) else (member,))]
    package = Path(checks.__file__).parents[1]
    asked = {kind for path in package.rglob("*.py") for kind in re.findall(r'\bexamine\("([^"]+)"', path.read_text())}
    assert asked - {"cases"} == {check.of for check in every} - {"cases"}  # cases: released results alone, an extension


RED = Check(
    "red object",
    "object and hands",
    lambda camera, samples, least: float(np.mean([s.color[s.mask == OBJECT][..., 0].mean() for s in samples.values()])),
    (0, 1),
    "note",
    "red of {value:.0f} in camera {0.name}; up to {high} is usual.",
)


def brought(monkeypatch, group, value):
    """As if an installed package brought a member of a group."""
    point = EntryPoint(name="mine", value=value, group=f"neuspring.{group}")
    real = registry.entry_points
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == point.group else real(group=group))


def test_a_package_adds_a_check(capture, monkeypatch):
    brought(monkeypatch, "checks", "tests.checks.test_check_capture:RED")
    own = registry.modules(checks.__name__, "checks")
    monkeypatch.setattr(checks, "CHECKS", registry.Registry("checks", own, (Check, tuple)))
    (found,) = (one for one in check_layout(capture.folder) if one.name == "red object")
    assert found.level == "note" and found.value > 1 and found.message.startswith("camera 0: red object: red of ")
