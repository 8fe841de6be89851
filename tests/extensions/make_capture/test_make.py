"""make-capture from end to end: every source ends in a capture that check-data accepts; what cannot be is refused at once."""

import json
import re

import cv2
import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, RECIPE, Capture
from neuspring.extensions.make_capture import make
from neuspring.extensions.make_capture.make import Intake, make_capture
from neuspring.intake.check import check_layout
from neuspring.scenes.sources import SOURCES
from tests.extensions.make_capture.board import BOARD, LENS, board_image, depth_of_table
from tests.support.desk import FRAMES, SIZE, K, camera, counts, looking, seen, write_folders, write_json, write_poses, write_video
from tests.support.findings import serious


def intake(root, cameras=1, **changes):
    """An intake of the folders of `write_folders`."""
    films = {kind: tuple(root / f"{kind}_{k}" for k in range(cameras)) for kind in ("color", "depth")}
    plain = {"output": root / "capture", "name": "desk", "category": "ball", "rate": 30.0} | films
    return Intake(**(plain | {"intrinsics": root / "intrinsics.json"} | changes))


def test_folders_of_one_camera_become_a_capture(tmp_path):
    capture, report = make_capture(intake(write_folders(tmp_path, frames=12, first=3), frames="3-13/2"))
    about = Capture.load(capture.folder).description
    assert (about.frame_count, about.frame_rate, about.up, about.depth_unit, about.masks) == (6, 15.0, "+z", 0.001, False)
    assert capture.train_end == 4
    np.testing.assert_array_equal(capture.color("0", 2), seen(camera(), 4)[0])
    np.testing.assert_allclose(capture.depth("0", 2), counts(seen(camera(), 4)[1]) / 1000)
    assert capture.cameras["0"].camera_to_world[2, 3] == pytest.approx(camera().camera_to_world[2, 3], abs=5e-4)
    assert serious(check_layout(capture.folder)) == []
    text = "\n".join(report)
    assert "frames: 6 frames, numbers 3 to 13 of the source, one in 2; 15 frames per second, given, one in 2 of 30" in text
    assert "depth: 0.001 m per count (millimeters), guessed from whole numbers" in text
    assert "mm rms over" in text and "looking down at it by" in text
    assert about.provenance["files"].startswith("sha256:") and "mm rms over" in about.provenance["table"]
    assert not (capture.folder / RECIPE).exists()


def test_a_color_video_and_a_depth_video_become_a_capture(tmp_path):
    pictures = [seen(camera(), frame) for frame in range(FRAMES)]
    color = write_video(tmp_path / "color.mkv", [color for color, _ in pictures], "ffv1", "bgr0", rate=15)
    depth = write_video(tmp_path / "depth.mkv", [counts(depth) for _, depth in pictures], "ffv1", "gray16le", rate=15)
    lens = write_json(tmp_path / "k.json", {"K": K.tolist()})
    capture, report = make_capture(
        Intake(output=tmp_path / "capture", name="v", category="ball", color=(color,), depth=(depth,), intrinsics=lens)
    )
    assert capture.description.frame_rate == pytest.approx(15, rel=0.01)
    assert any("as the source says" in line for line in report)
    np.testing.assert_array_equal(capture.color("0", 3), pictures[3][0])
    np.testing.assert_allclose(capture.depth("0", 3), counts(pictures[3][1]) / 1000)


def test_floating_point_depth_keeps_its_digits(tmp_path):
    root = write_folders(tmp_path)
    for frame in range(FRAMES):
        np.save(root / "depth_0" / f"frame_{frame}.npy", seen(camera(), frame)[1].astype(np.float32))
        (root / "depth_0" / f"frame_{frame}.png").unlink()
    capture, report = make_capture(intake(root))
    np.testing.assert_allclose(capture.depth("0", 1), seen(camera(), 1)[1], atol=1e-6)
    assert capture.description.depth_format == "npy" and "1 m per count (meters)" in "\n".join(report)


@pytest.mark.parametrize("scale", [0.0002500000118743628, 4000])
def test_the_depth_scale_of_the_intrinsics_is_the_unit(tmp_path, scale):
    root = write_folders(tmp_path, unit=0.00025)
    lens = write_json(tmp_path / "k.json", json.loads((root / "intrinsics.json").read_text()) | {"depth_scale": scale})
    with pytest.raises(InputError, match=r"k\.json: its unit of depth must be that of --depth-unit, 0\.001 m.*received 0\.00025"):
        make_capture(intake(root, intrinsics=lens, depth_unit=0.001))
    for given in (None, 0.00025):
        capture, _ = make_capture(intake(root, intrinsics=lens, depth_unit=given, output=tmp_path / str(given)))
        assert capture.description.depth_unit == pytest.approx(0.00025, rel=1e-6)
    wrong = write_json(tmp_path / "k.json", json.loads(lens.read_text()) | {"depth_scale": 1.0})
    with pytest.raises(InputError, match=r"k\.json: the unit that it says: .*received 1 m per count.*Plausible would be.*0\.00025"):
        make_capture(intake(root, intrinsics=wrong, output=tmp_path / "wrong"))


@pytest.mark.parametrize("key", ["camera_to_world", "world_to_camera"])
def test_two_cameras_with_poses(tmp_path, key):
    root = write_folders(tmp_path, cameras=2)
    capture, report = make_capture(intake(root, 2, poses=write_poses(tmp_path / "poses.json", key=key)))
    np.testing.assert_allclose(capture.cameras["1"].camera_to_world, camera(1).camera_to_world, atol=1e-9)
    assert serious(check_layout(capture.folder)) == []
    assert sum((line.startswith("camera ") and "mm above z = 0" in line) or "mm below z = 0" in line for line in report) == 2


def test_poses_of_a_world_that_is_elsewhere_need_level(tmp_path):
    root = write_folders(tmp_path, cameras=2)
    motion = looking(np.array([0.3, 0.2, 1.0]), np.array([0.1, 0.4, 0.7]))
    poses = write_poses(tmp_path / "poses.json", motion=motion)
    with pytest.raises(InputError, match=r"the table that the camera sees must be z = 0.*--level"):
        make_capture(intake(root, 2, poses=poses))
    assert not (tmp_path / "capture").exists()
    capture, report = make_capture(intake(root, 2, poses=poses, level=True))
    assert any(line.startswith("leveled: the world was turned by") for line in report)
    assert serious(check_layout(capture.folder)) == []
    one, two = (view.camera_to_world for view in capture.cameras.values())
    right = np.linalg.inv(camera(0).camera_to_world) @ camera(1).camera_to_world
    np.testing.assert_allclose(np.linalg.inv(one) @ two, right, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": None}, "intrinsics of camera 0 are required"),
        ({"depth_unit": 1.0}, "Plausible would be 0.001 (millimeters)"),
        ({"frames": "0-2"}, "a capture needs at least 5 frames"),
        ({"train_end": 100}, "train_end: must be at most frame_count = 7; received 100"),
        ({"name": "a b"}, "--name: letters, digits, '.', '_' and '-' are required"),
    ],
)
def test_what_is_refused_before_anything_is_written(tmp_path, changes, message):
    root = write_folders(tmp_path)
    with pytest.raises(InputError, match=re.escape(message)):
        make_capture(intake(root, **changes))
    assert not (tmp_path / "capture").exists()


def test_two_cameras_without_poses_and_depth_that_is_not_aligned(tmp_path):
    root = write_folders(tmp_path, cameras=2)
    with pytest.raises(InputError, match=r"the poses of 2 cameras are required; received none. Give --poses FILE, or --board"):
        make_capture(intake(root, 2))
    cv2.imwrite(str(root / "depth_0" / "frame_0.png"), np.full((30, 40), 700, np.uint16))
    with pytest.raises(InputError, match="depth must be aligned to color, pixel by pixel; received 40 x 30 for 80 x 60"):
        make_capture(intake(root))


def test_a_capture_is_not_overwritten_and_masks_never(tmp_path):
    root = write_folders(tmp_path)
    capture, _ = make_capture(intake(root))
    before = (capture.folder / CAPTURE).read_text()
    with pytest.raises(InputError, match=r"--output must be a new or empty folder; received a capture.*--force"):
        make_capture(intake(root, rate=15.0))
    assert (capture.folder / CAPTURE).read_text() == before
    assert make_capture(intake(root, rate=15.0, force=True))[0].description.frame_rate == 15.0
    (capture.folder / "mask").mkdir()
    with pytest.raises(InputError, match="--force does not remove masks, marks, clicks or tracks; received mask"):
        make_capture(intake(root, force=True))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(InputError, match=r"received other files. Choose another folder"):
        make_capture(intake(root, output=tmp_path / "other", force=True))


def test_an_interrupted_call_goes_on_where_it_was(tmp_path, monkeypatch):
    root = write_folders(tmp_path)
    whole, _ = make_capture(intake(root, output=tmp_path / "whole"))
    written, write = [], make.Writer.frame

    def stop_after_four(self, camera, frame, *images):
        if len(written) == 4:
            raise KeyboardInterrupt
        written.append(frame)
        write(self, camera, frame, *images)

    monkeypatch.setattr(make.Writer, "frame", stop_after_four)
    with pytest.raises(KeyboardInterrupt):
        make_capture(intake(root))
    assert not (tmp_path / "capture" / CAPTURE).exists()
    (tmp_path / "capture" / "color" / "0" / "00003.png").write_bytes(b"half")
    monkeypatch.setattr(make.Writer, "frame", lambda *a: (written.append(a[2]), write(*a)))
    capture, _ = make_capture(intake(root))
    assert written == [0, 1, 2, 3, 3, 4, 5, 6]
    assert capture.description.provenance["images"] == whole.description.provenance["images"]


def test_an_unfinished_capture_is_no_capture_for_anybody(tmp_path):
    make.prepare(tmp_path / "capture", {"frames": 7}, force=False)
    said = "a whole capture is required; received one that make-capture has not finished. Give the same make-capture command again"
    for refuse in (Capture.load, SOURCES["capture"].required):
        with pytest.raises(InputError, match=said):
            refuse(tmp_path / "capture")
    for folder in (tmp_path / "capture", tmp_path):
        text = f"error: {tmp_path / 'capture'}: {said}: it goes on where it stopped."
        assert [str(one) for one in check_layout(folder)] == [text]
    assert make.prepare(tmp_path / "capture", {"frames": 7}, force=False)


def test_a_replacement_that_stops_early_takes_no_image_of_the_old_capture(tmp_path, monkeypatch):
    (tmp_path / "color").mkdir()
    (tmp_path / CAPTURE).touch()
    monkeypatch.setattr(make.shutil, "rmtree", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        make.prepare(tmp_path, {"rate": 15}, force=True)
    with pytest.raises(InputError, match=r"received an unfinished capture from other input.* or give --force"):
        make.prepare(tmp_path, {"rate": 15}, force=False)


BENT = np.array([-0.3, 0.1, 0.0, 0.0, 0.0])


def bent(image):
    """A picture of the desk as a lens with the coefficients BENT shows it."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    ideal = cv2.undistortPoints(np.stack([x, y], axis=-1).reshape(-1, 1, 2), K, BENT, P=K).reshape(SIZE[1], SIZE[0], 2)
    return cv2.remap(np.ascontiguousarray(image), ideal[..., 0], ideal[..., 1], cv2.INTER_NEAREST)


def test_intrinsics_of_the_capture_are_those_given_and_fit_its_images(tmp_path):
    root = write_folders(tmp_path)
    for path in [*root.glob("color_0/*"), *root.glob("depth_0/*")]:
        cv2.imwrite(str(path), bent(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    write_json(root / "intrinsics.json", {"K": K.tolist(), "dist": BENT.tolist()})
    capture, report = make_capture(intake(root))
    np.testing.assert_array_equal(capture.cameras["0"].intrinsics, K)
    assert any(line.startswith("distortion, camera 0: removed, up to") for line in report)
    # The table is flat by these intrinsics: one of another focal length, or of an image that is still bent, is not.
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    truth = seen(camera(), 2, noise=0.0)[1]
    found = capture.depth("0", 2)
    inside = (found > 0) & (truth > 0) & (x > 12) & (x < 68) & (y > 12) & (y < 48)
    assert inside.sum() > 1500 and np.median(np.abs(found - truth)[inside]) < 0.002


def test_depth_of_a_sensor_that_stands_elsewhere(tmp_path):
    root = write_folders(tmp_path, cameras=2)
    films = {"color": (root / "color_1",), "depth": (root / "depth_1",)}
    assert not any("not aligned" in line for line in make_capture(intake(root, **films))[1])
    for path in root.glob("depth_1/*"):
        cv2.imwrite(str(path), np.roll(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), 7, axis=1))
    _, report = make_capture(intake(root, output=tmp_path / "moved", **films))
    line = next(line for line in report if "not aligned" in line)
    assert line.startswith("warning: camera 0: depth not aligned to color: edges of depth fit those of color when depth is ")
    assert "pixels to the left; as it is they must fit within 1.5% of the width. Let the camera's software align depth" in line


BOARD_POSES = [looking(np.array(eye), np.array([0.1, -0.14, 0])) for eye in ((0.1, -0.55, 0.45), (0.5, -0.1, 0.5))]


def board_folders(root, unit=0.001):
    """Two cameras that see a board in the first of their frames, and a bare table later."""
    for index, pose in enumerate(BOARD_POSES):
        for frame in range(7):
            color = board_image(pose) if frame < 2 else np.full((480, 640, 3), 128, np.uint8)
            for kind, image in (("color", color), ("depth", counts(depth_of_table(pose), unit))):
                (root / f"{kind}_{index}").mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(root / f"{kind}_{index}" / f"{frame}.png"), image)
    write_json(root / "intrinsics.json", {"K": LENS.tolist()})
    return root


def test_a_board_in_the_first_frames_or_in_images_gives_the_poses(tmp_path):
    root, board = board_folders(tmp_path), BOARD
    images = [root / f"color_{index}" / "0.png" for index in range(2)]
    for name, pictures, frames in (("frames", (), "2-6"), ("images", images, "")):
        capture, report = make_capture(intake(root, 2, output=tmp_path / name, board=board, board_images=pictures, frames=frames))
        for view, pose in zip(capture.cameras.values(), BOARD_POSES, strict=True):
            np.testing.assert_allclose(view.camera_to_world, pose, atol=4e-3)
        assert sum("corners, 0." in line and "pixels rms" in line for line in report) == 2
        assert any("of its distance" in line for line in report) == (name == "frames")
        assert capture.description.up == "+z"


def test_a_board_of_another_size_contradicts_depth(tmp_path):
    root = board_folders(tmp_path)
    board = BOARD.replace("0.04:0.03", "0.032:0.024")
    with pytest.raises(InputError, match=r"depth must place the board where its size does.*the square is 1\.25 times as long"):
        make_capture(intake(root, 2, board=board))
    with pytest.raises(InputError, match="the board of --board-images must be described"):
        make_capture(intake(root, 2, board_images=[root, root]))
    with pytest.raises(InputError, match="--table-at: is for one camera without poses"):
        make_capture(intake(root, 2, board=board, table_at=(3, 4)))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "--bag, --phystwin-raw is required, or --controllers with --nodes and --tracks; received none"),
        (["--color", "{root}/color_0", "--depth", "{root}/depth_0", "{root}/depth_0"], "as many folders or videos of depth as of"),
        (["--color", "{root}/color_0", "--depth", "{root}/nothing"], "a folder of depth images (.png .npy .tif .tiff) or a video"),
        (["--color", "{root}/color_0", "--depth", "{root}/depth_0", "--cameras", "a", "b"], "--cameras: 1 different names are"),
    ],
)
def test_bad_words_end_with_status_2(tmp_path, capsys, words, message):
    root = write_folders(tmp_path)
    filled = [word.format(root=root) for word in words]
    assert main(["make-capture", "--category", "ball", "--output", str(tmp_path / "capture"), "--rate", "30", *filled]) == 2
    assert message in capsys.readouterr().err


def test_the_command_prints_a_report_and_the_next_commands(tmp_path, capsys):
    root = write_folders(tmp_path)
    words = ["--color", f"{root}/color_0", "--depth", f"{root}/depth_0", "--intrinsics", f"{root}/intrinsics.json", "--rate", "30"]
    assert main(["make-capture", "--category", "ball", "--output", str(tmp_path / "capture"), *words]) == 0
    said = capsys.readouterr().out
    assert f"cameras: 0 {SIZE[0]} x {SIZE[1]}" in said
    assert f"neuspring check-data {tmp_path / 'capture'}" in said and f"neuspring annotate {tmp_path / 'capture'}" in said
    assert json.loads((tmp_path / "capture" / CAPTURE).read_text())["name"] == "capture"
