"""Captures of color alone: made, checked, and refused by what needs depth."""

import json
import re

import cv2
import numpy as np
import pytest

from neuspring.checks import examine
from neuspring.checks.masks import mask_facts
from neuspring.checks.perceived import look_at_masks
from neuspring.checks.table import on_table
from neuspring.core.errors import InputError
from neuspring.core.geometry import rigid_inverse
from neuspring.data.capture import CAPTURE, OBJECT, Capture
from neuspring.extensions.make_capture.formats import pairs
from neuspring.extensions.make_capture.make import Intake, make_capture
from neuspring.intake.check import check_layout
from neuspring.perception.backends import BACKENDS
from neuspring.perception.film import CameraFilm
from neuspring.perception.masks import save_masks
from tests.extensions.make_capture.board import BOARD, LENS, board_image
from tests.support.desk import FRAMES, SIZE, camera, looking, seen, write_folders, write_json, write_poses
from tests.support.findings import holds, of_level, serious

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a world with z up to one with z down."""


def intake(root, **changes):
    """Color alone of the folders of `write_folders`, with the true pose."""
    plain = {"output": root / "capture", "name": "desk", "category": "ball", "rate": 30.0, "color": (root / "color_0",)}
    plain["pose"] = "lying"
    poses = write_poses(root / "poses.json", 1) if "poses" not in changes else None
    return Intake(**(plain | {"intrinsics": root / "intrinsics.json", "poses": poses} | changes))


def disk(center=(0.05, 0.05), radius=0.14):
    """A mask of one camera of the desk: a flat disk on the table, m, and beside it a hand."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    points = on_table(camera(), np.stack([x, y], axis=-1).reshape(-1, 2))[:, :2].reshape(SIZE[1], SIZE[0], 2)
    near = np.linalg.norm(points - center, axis=-1) < radius
    hand = np.linalg.norm(points - np.array(center) - (1.2 * radius, 0), axis=-1) < 0.6 * radius
    return np.where(near, 1, np.where(hand, 2, 0)).astype(np.uint8)


@pytest.fixture
def capture(tmp_path):
    made, _ = make_capture(intake(write_folders(tmp_path)))
    save_masks(made, "0", np.stack([disk()] * FRAMES))
    return Capture.load(made.folder)


def edit(capture, change) -> None:
    path = capture.folder / CAPTURE
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def errors(capture) -> str:
    return "\n".join(of_level(check_layout(capture.folder), "error"))


@pytest.mark.parametrize(("motion", "up"), [(None, "+z"), (FLIP, "-z")])
def test_a_folder_of_color_becomes_a_capture_with_the_table_of_the_pose(tmp_path, motion, up):
    poses = write_poses(tmp_path / "poses.json", 1, motion=motion)
    made, report = make_capture(intake(write_folders(tmp_path), poses=poses))
    about = Capture.load(made.folder).description
    assert (about.depth, about.up, about.frame_count, about.provenance["table"]) == ("none", up, FRAMES, "z = 0 as given")
    assert not (made.folder / "depth").exists()
    np.testing.assert_array_equal(made.color("0", 2), seen(camera(), 2)[0])
    assert "depth: none, color alone" in report and f"poses: of poses.json, up {up}" in report
    assert any("the table is z = 0 as given, 0.6" in line for line in report)
    assert serious(check_layout(made.folder)) == []


def test_a_board_gives_the_pose(tmp_path):
    pose = looking(np.array([0.1, -0.55, 0.45]), np.array([0.1, -0.14, 0]))
    (tmp_path / "color_0").mkdir()
    for frame in range(5):
        cv2.imwrite(str(tmp_path / "color_0" / f"{frame}.png"), board_image(pose))
    write_json(tmp_path / "intrinsics.json", {"K": LENS.tolist()})
    made, report = make_capture(intake(tmp_path, poses=None, board=BOARD))
    np.testing.assert_allclose(made.cameras["0"].camera_to_world, pose, atol=4e-3)
    assert made.description.up == "+z" and not any("depth on it" in line for line in report)


def below(root):
    """A pose that looks up, away from the table."""
    return write_json(root / "up.json", {"camera_to_world": [looking(np.array([0, 0, 0.5]), np.array([0.2, 0, 3.0])).tolist()]})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": None}, "--intrinsics: color alone needs the intrinsics of the camera; received none"),
        ({"poses": None}, "--poses: color alone needs the pose of the camera, in a world with the table at z = 0; received none"),
        ({"level": True}, "--level: needs depth"),
        ({"top_down": True}, "--top-down: needs depth"),
        ({"table_at": (3.0, 4.0)}, "--table-at: needs depth"),
        ({"depth_unit": 0.001}, "--depth-unit: needs depth"),
        ({"poses": below}, "up.json: cameras.0.camera_to_world: the table z = 0 must be 0.1 to 10 m away"),
    ],
)
def test_what_is_refused_before_anything_is_written(tmp_path, changes, message):
    root = write_folders(tmp_path)
    if callable(changes.get("poses")):
        changes = {"poses": changes["poses"](root)}
    with pytest.raises(InputError, match=re.escape(message)):
        make_capture(intake(root, **changes))
    assert not (tmp_path / "capture").exists()


def test_several_cameras_need_depth(tmp_path):
    with pytest.raises(InputError, match="--color: without depth one camera is required"):
        pairs([tmp_path, tmp_path], [])


def test_a_good_capture_says_how_large_the_object_is(capture):
    found = check_layout(capture.folder)
    assert serious(found) == []
    text = "color alone: table z = 0 as given, object size on the table "
    note = next(d.message for d in found if "object size" in d.message)
    assert text in note and holds(found, "note", CAPTURE, "0.35 m below the camera")
    sides = [int(side) for side in note.split("on the table ")[1].split(" cm")[0].split(" x ")]
    assert all(26 <= side <= 29 for side in sides)
    assert not any("depth" in d.message and "hole" in d.message for d in found)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda pose: FLIP @ pose, "the camera must be above the table z = 0, on the side of it that is up; received"),
        (lambda pose: pose @ FLIP, "the table z = 0 must be 0.1 to 10 m away in the center of the image; received a view past it"),
        (lambda pose: pose + 40 * np.outer([0, 0, 1, 0], [0, 0, 0, 1]), "the table z = 0 must be 0.1 to 10 m away in the center"),
    ],
)
def test_a_camera_that_does_not_look_at_the_table(capture, change, message):
    pose = change(capture.cameras["0"].camera_to_world)
    edit(capture, lambda values: values["cameras"][0].update(camera_to_world=pose.tolist()))
    assert message in errors(capture)


Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From a world with z up to one with y up."""
MEANT = "up should point up in the image; received a camera that is turned by"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (rigid_inverse, "This looks like a world-to-camera matrix. Invert it"),
        (lambda pose: Y_UP @ pose, "a pose in a world with y up. Multiply it from the left by [[1, 0, 0, 0], [0, 0, -1, 0]"),
        (lambda pose: Y_UP @ pose @ FLIP, "a pose in a world with y up, for OpenGL's axes"),
        (lambda pose: pose @ FLIP, "a matrix for OpenGL's axes (y up, z backward). Change"),
        (lambda pose: pose @ np.diag([-1.0, -1, 1, 1]), "If the camera is mounted so, go on"),
    ],
)
def test_a_pose_of_another_kind_is_named_with_its_file(tmp_path, change, message):
    pose = change(camera().camera_to_world)
    poses = write_json(tmp_path / "mine.json", {"camera_to_world": [pose.tolist()]})
    try:
        text = "\n".join(make_capture(intake(write_folders(tmp_path), poses=poses))[1])
        made = Capture.load(tmp_path / "capture")
        assert holds(check_layout(made.folder), "warning", CAPTURE, message, "cameras.0.camera_to_world (poses of mine.json)")
        assert MEANT in text and "warning: " in text
    except InputError as error:
        text = str(error)
        assert text.startswith(f"{poses}: cameras.0.camera_to_world")
    assert message in text


@pytest.mark.parametrize(
    ("factor", "words"), [(8.0, "hands too large"), (0.2, "small: hands (label 2)"), (5.0, "implausible size: 13")]
)
def test_poses_of_another_scale_show_in_the_hands_and_the_size(capture, factor, words):
    def scaled(values):
        for row in values["cameras"][0]["camera_to_world"][:3]:
            row[3] *= factor

    edit(capture, scaled)
    assert holds(check_layout(capture.folder), "warning", CAPTURE, words)


def test_a_mask_above_the_horizon(capture):
    flat = looking(np.array([0.05, -0.5, 0.1]), np.array([0.05, 0.3, 0.0]))
    edit(capture, lambda values: values["cameras"][0].update(camera_to_world=flat.tolist()))
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[5:40, 30:50] = OBJECT
    cv2.imwrite(str(capture.path("mask", "0", 0)), mask)
    assert "every pixel of the object in frame 0 must look at the table z = 0; received" in errors(capture)


def strip(length, width):
    """A mask of the desk: a band on the table of these sides, m."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    points = on_table(camera(), np.stack([x, y], axis=-1).reshape(-1, 2))[:, :2].reshape(SIZE[1], SIZE[0], 2)
    return (np.abs(points) < (length / 2, width / 2)).all(axis=-1).astype(np.uint8)


@pytest.mark.parametrize(
    ("category", "mask", "words"),
    [
        ("rope", disk(), "a compact thing"),
        ("cloth", strip(0.35, 0.025), "a long thin thing"),
        ("toy", strip(0.35, 0.025), "a long thin thing"),
        ("rope", strip(0.35, 0.025), None),
        ("cloth", disk(), None),
        ("toy", disk(), None),
        ("toy", strip(0.2, 0.08), None),
        ("toy", 0 * disk(), None),
    ],
)
def test_an_outline_of_another_category(category, mask, words):
    found = examine("silhouette", "object", mask, category)
    assert [one.name for one in found] == (["outline and category"] if words else [])
    if words:
        assert words in found[0].text and repr(category) in found[0].text and "meant?" in found[0].remedy


def test_the_outline_is_checked_before_a_run_and_in_it_where_depth_judges_nothing(capture):
    edit(capture, lambda values: values.update(category="rope"))
    rope = Capture.load(capture.folder)
    assert holds(check_layout(rope.folder), "warning", CAPTURE, "outline and category")
    labels = np.stack([disk()] * FRAMES)
    names = {one.name for one in look_at_masks(rope, "0", labels, mask_facts(rope, "0", labels))}
    assert "outline and category" in names and not names & {"depth holes", "hands too large"}


def test_the_pose_of_a_body_is_asked_for_and_kept(tmp_path):
    made, _ = make_capture(intake(write_folders(tmp_path), pose=None))
    assert '"pose"' not in (made.folder / CAPTURE).read_text()
    save_masks(made, "0", np.stack([disk()] * FRAMES))
    asked = 'pose: one picture cannot say how the object is in frame 0: write "lying" or "standing"'
    assert holds(check_layout(made.folder), "warning", CAPTURE, asked)
    edit(made, lambda values: values.update(category="cloth"))
    assert not holds(check_layout(made.folder), "warning", CAPTURE, asked)
    known, _ = make_capture(intake(tmp_path, output=tmp_path / "known", pose="standing"))
    assert Capture.load(known.folder).description.pose == "standing"
    save_masks(known, "0", np.stack([disk()] * FRAMES))
    assert not holds(check_layout(known.folder), "warning", CAPTURE, asked)


def test_a_pose_is_refused_where_depth_is_measured(tmp_path):
    root = write_folders(tmp_path)
    with pytest.raises(InputError, match=r"--pose: is for color alone.*received standing"):
        make_capture(intake(root, depth=(root / "depth_0",), pose="standing"))


def test_segmentation_by_height_is_refused_at_the_start(capture):
    with pytest.raises(InputError, match=r"needs depth of every frame; received a capture of color"):
        BACKENDS["segment"]["opencv"].require(capture.folder)
    film = CameraFilm(capture, "0")
    assert film.depth(0) is None and film.height(0) is None
