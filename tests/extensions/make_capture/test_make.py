"""From files to a capture: what is stored, the table and the board as poses, resuming, points in space, and a real recording."""

import json

import cv2
import numpy as np
import pytest

from neuspring.checks.observed import Observed, leaning
from neuspring.cli.main import main
from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.geometry import rigid_inverse
from neuspring.data.capture import CAPTURE, CONTROLLERS, NODES, RECIPE, TRACKS, Capture
from neuspring.extensions.make_capture import make
from neuspring.extensions.make_capture.make import make_capture
from neuspring.extensions.make_capture.options import Intake
from neuspring.intake.check import check_layout
from neuspring.intake.points import Hands, observe, read, write
from neuspring.scenes.sources import row_of_capture
from tests.support import spaced as scene
from tests.support.c3d_files import write_c3d
from tests.support.desk import FRAMES, LENS, K, camera, looking, seen, write_folders, write_json, write_rig
from tests.support.filmed import film, write_raw
from tests.support.findings import serious


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return write_folders(tmp_path_factory.mktemp("desk"), 2)


def given(desk, tmp_path, cameras=1, **changes):
    streams = {"color": tuple(desk / f"color_{k}" for k in range(cameras))}
    streams["depth"] = tuple(desk / f"depth_{k}" for k in range(cameras))
    rig = changes.pop("rig", None) or write_rig(tmp_path / "rig.json", cameras)
    return Intake(**({"output": tmp_path / "capture", "category": "ball", "rig": rig} | streams | changes))


def test_images_are_stored_as_they_are_with_what_was_stated(desk, tmp_path):
    capture, report = make_capture(given(desk, tmp_path, 2, frames="1-6", mass=0.2, train_end=4))
    assert (capture.frame_count, capture.train_end, capture.description.mass) == (6, 4, 0.2)
    assert capture.streams == {"color", "depth"}
    for name in "01":
        color, depth = seen(camera(int(name)), 3)
        np.testing.assert_array_equal(capture.color(name, 2), color)
        np.testing.assert_allclose(capture.depth(name, 2), depth, atol=0.0006)
        np.testing.assert_allclose(capture.cameras[name].camera_to_world, camera(int(name)).camera_to_world)
    said = capture.description.provenance
    assert said["frames"] == "6 frames, numbers 1 to 6 of the source" and said["rig file"].startswith("sha256:")
    assert report[0].startswith("frames: 6 frames") and "depth: 0.001 m per count" in report
    assert not (capture.folder / RECIPE).exists()


def test_the_table_gives_the_pose_of_one_camera(desk, tmp_path):
    rig = write_rig(tmp_path / "rig.json", poses="table", axes=None, up=None, cameras=[LENS])
    capture, report = make_capture(given(desk, tmp_path, rig=rig))
    pose, true = capture.cameras["0"].camera_to_world, camera().camera_to_world
    assert pose[2, 3] == pytest.approx(true[2, 3], abs=0.003)
    assert pose[2, :3] == pytest.approx(true[2, :3], abs=0.01)
    assert any("poses: by the table" in line for line in report)
    assert [one for one in check_layout(capture.folder) if one.level == "error"] == []


def test_a_wall_is_no_table_and_a_pixel_may_state_it(desk, tmp_path):
    above = looking(np.array([0.05, 0.049, 0.6]), np.array([0.05, 0.05, 0.0]), (0, 1, 0))
    for frame in range(FRAMES):
        view = camera()
        color, depth = seen(type(view)("0", view.width, view.height, K, above), frame)
        for kind, image in (("color", color[..., ::-1]), ("depth", np.round(1000 * depth).astype(np.uint16))):
            (tmp_path / kind).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / kind / f"{frame}.png"), image)
    streams = {"color": (tmp_path / "color",), "depth": (tmp_path / "depth",)}
    table = {"poses": "table", "cameras": [LENS]}
    with pytest.raises(InputError, match=r"the table must be seen.*it faces the camera: .*table_at"):
        make_capture(given(desk, tmp_path, **streams, rig=write_rig(tmp_path / "a.json", **table)))
    capture, _ = make_capture(given(desk, tmp_path, **streams, rig=write_rig(tmp_path / "b.json", **table, table_at=[5, 5])))
    assert capture.cameras["0"].camera_to_world[2, 3] == pytest.approx(0.6, abs=0.005)
    with pytest.raises(InputError, match="table is for one camera with depth"):
        make_capture(
            given(desk, tmp_path, 2, output=tmp_path / "c", rig=write_rig(tmp_path / "c.json", poses="table", cameras=[LENS] * 2))
        )


BOARD = {"squares": [5, 7], "square": 0.04, "marker": 0.03, "dictionary": "DICT_5X5_100"}
BIG = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 319.5, "cy": 239.5, "distortion_model": "none"}
WIDE = np.array([[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1.0]])


def board_image(pose):
    """Image of a board on z = 0, its corner at the origin, its rows along x, its columns along minus y."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    print_ = cv2.aruco.CharucoBoard((5, 7), 0.04, 0.03, dictionary).generateImage((500, 700))
    to_world = np.array([[0.0004, 0, 0.0002], [0, -0.0004, -0.0002], [0, 0, 1]])
    homography = WIDE @ rigid_inverse(pose)[:3][:, [0, 1, 3]] @ to_world
    view = cv2.warpPerspective(print_, homography, (640, 480), borderValue=200, flags=cv2.INTER_AREA)
    return np.repeat(cv2.GaussianBlur(view, (3, 3), 0)[..., None], 3, axis=2)


def test_a_board_gives_the_poses(tmp_path):
    poses = [looking(np.array(eye), np.array([0.1, -0.14, 0])) for eye in ((0.1, -0.6, 0.4), (0.45, -0.4, 0.5))]
    for index, pose in enumerate(poses):
        for frame in range(5):
            path = tmp_path / f"color_{index}" / f"{frame}.png"
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), board_image(pose))
    rig = {"frame_rate": 30, "poses": "board", "board": BOARD, "cameras": [BIG, BIG | {"board_images": "color_1"}]}
    intake = {"category": "cloth", "color": (tmp_path / "color_0", tmp_path / "color_1")}
    with pytest.raises(InputError, match="none allows only one camera"):
        make_capture(Intake(output=tmp_path / "two", rig=write_json(tmp_path / "rig.json", rig), **intake))
    for index, pose in enumerate(poses):
        one = write_json(tmp_path / f"{index}.json", rig | {"cameras": rig["cameras"][index : index + 1]})
        alone = {"color": (tmp_path / f"color_{index}",), "category": "cloth", "output": tmp_path / f"capture_{index}"}
        capture, _ = make_capture(Intake(rig=one, **alone))
        np.testing.assert_allclose(capture.cameras["0"].camera_to_world, pose, atol=0.003)
    blank = write_json(tmp_path / "blank.json", rig | {"cameras": [BIG], "board": BOARD | {"dictionary": "DICT_4X4_50"}})
    with pytest.raises(InputError, match="at least 6 corners of the board must be seen"):
        make_capture(Intake(output=tmp_path / "none", rig=blank, color=(tmp_path / "color_0",), category="cloth"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"category": ""}, "--category: is required"),
        ({"color": ()}, "one of --color and --recording is required"),
        ({"shift": ("2=1",)}, r"--shift: STREAM=IMAGES is required, with a stream of 0\.depth; received 2=1"),
        ({"recording": ("x",)}, "received both"),
        ({"train_end": 90}, "train_end: must be at most"),
    ],
)
def test_options_that_cannot_be_are_refused(desk, tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        make_capture(given(desk, tmp_path, **changes))
    assert not (tmp_path / "capture" / "capture.json").exists()


def test_an_interrupted_call_resumes_and_work_of_people_is_never_replaced(desk, tmp_path, monkeypatch):
    intake = given(desk, tmp_path)
    writer, written = make.Writer.frame, []

    def stops(self, camera_, frame, *images):
        if frame == 4:
            raise KeyboardInterrupt
        written.append(frame)
        writer(self, camera_, frame, *images)

    with monkeypatch.context() as patch:
        patch.setattr(make.Writer, "frame", stops)
        with pytest.raises(KeyboardInterrupt):
            make_capture(intake)
    with pytest.raises(InputError, match="a complete capture is required"):
        Capture.load(intake.output)
    with pytest.raises(InputError, match="an unfinished capture from other input"):
        make_capture(given(desk, tmp_path, frames="0-5"))
    with monkeypatch.context() as patch:
        patch.setattr(make.Writer, "frame", lambda self, *images: (written.append(images[1]), writer(self, *images)))
        capture, _ = make_capture(intake)
    assert written == [0, 1, 2, 3, 3, 4, 5, 6], "the last image of an interrupted call may be half written"
    with pytest.raises(InputError, match=r"must be a new or empty folder; received a capture.*--force"):
        make_capture(intake)
    (capture.folder / "mask").mkdir()
    with pytest.raises(InputError, match=r"--force does not remove masks.*Move these files"):
        make_capture(given(desk, tmp_path, force=True))
    (capture.folder / "mask").rmdir()
    assert make_capture(given(desk, tmp_path, frames="0-5", force=True))[0].frame_count == 6
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="received other files"):
        make_capture(given(desk, tmp_path, output=tmp_path / "other", force=True))


def test_the_command_checks_what_it_wrote(desk, tmp_path, capsys):
    words = ["--color", f"{desk}/color_0", "--depth", f"{desk}/depth_0", "--category", "ball", "--output", f"{tmp_path}/made"]
    assert main(["make-capture", *words, "--rig", str(write_rig(tmp_path / "rig.json"))]) == 0
    said = capsys.readouterr().out
    assert "0 errors" in said and "neuspring annotate" in said and (tmp_path / "made" / "contact_sheet.jpg").exists()
    wrong = write_rig(tmp_path / "wrong.json", cameras=[LENS | {"pose": np.linalg.inv(camera().camera_to_world).tolist()}])
    assert main(["make-capture", *words, "--force", "--rig", str(wrong)]) == 2
    assert "error    camera 0: table elsewhere" in capsys.readouterr().out
    assert main(["make-capture", *words[:4], "--output", f"{tmp_path}/none", "--category", "ball"]) == 2
    assert "frame_rate: is required" in capsys.readouterr().err


def test_a_raw_case_is_converted_with_frames_that_a_camera_misses(tmp_path):
    whole = film(tmp_path / "film", cameras=2)
    case = write_raw(whole, tmp_path / "case")
    (case / "color" / "1" / "3.png").unlink()
    capture, _ = make_capture(Intake(output=tmp_path / "capture", category="toy", recording=(case,)))
    assert capture.description.masks and capture.description.up == "-z"
    assert [camera.missing for camera in capture.description.cameras] == [(), (3,)]
    np.testing.assert_array_equal(capture.mask("0", 2), whole.mask("0", 2))
    np.testing.assert_allclose(capture.depth("0", 2), whole.depth("0", 2), atol=1e-9)
    metadata = json.loads((case / "metadata.json").read_text())
    for change, words in (
        ({"fps": None}, "fps or record_hz: a positive number"),
        ({"record_hz": 29}, "fps or record_hz: a positive number .* the same for all cameras"),
        ({"WH": [64]}, "WH: two positive"),
        ({"frame_num": 1}, "frame_num"),
    ):
        (case / "metadata.json").write_text(json.dumps(metadata | change))
        with pytest.raises(InputError, match=rf"metadata\.json: {words}"):
            make_capture(Intake(output=tmp_path / "none", category="toy", recording=(case,)))
    (case / "metadata.json").write_text(json.dumps(metadata | {"depth_scale_m_per_unit": [0.00025, 0.00025]}))
    assert make_capture(Intake(output=tmp_path / "quarter", category="toy", recording=(case,)))[0].description.depth_unit == 0.00025
    np.save(case / "depth" / "0" / "0.npy", np.zeros((90, 160), np.float32))
    with pytest.raises(InputError, match=r"0\.npy: depth must be 16-bit counts; received float32.*depth_scale_m_per_unit"):
        make_capture(Intake(output=tmp_path / "float", category="toy", recording=(case,)))
    with pytest.raises(InputError, match="exactly one case, without other options, is required; received --frames"):
        make_capture(Intake(output=tmp_path / "part", category="toy", recording=(case,), frames="0-4"))


def brought(folder, frames=FRAMES):
    """Files of a hand, nodes and tracks, by option."""
    folder.mkdir()
    write(folder, Hands(scene.risen(scene.GRIP, frames), np.zeros((0, 0), bool), np.zeros(0, int)), scene.NODES)
    (folder / TRACKS).write_text(json.dumps(np.swapaxes(scene.risen(scene.MARKED, frames), 0, 1).tolist()))
    return {"controllers": folder / CONTROLLERS[0], "nodes": folder / NODES[0], "tracks": folder / TRACKS}


def of_points(tmp_path, **changes):
    files = brought(tmp_path / "files", 8) if not (tmp_path / "files").exists() else {}
    plain = {"output": tmp_path / "made", "category": "toy", "rate": 25.0, "up": "+z", "train_end": 5}
    return Intake(**(plain | files | changes))


def test_points_without_color_become_a_capture(tmp_path):
    made, _ = make_capture(of_points(tmp_path, mass=0.35))
    assert (made.frame_count, made.train_end, made.description.frame_rate, made.description.tracks) == (8, 5, 25.0, "train")
    assert made.streams == set() and serious(check_layout(made.folder)) == []
    np.testing.assert_allclose(read(made).hands.points, scene.risen(scene.GRIP, 8))
    assert made.description.provenance["nodes file"].startswith("sha256:")
    with pytest.raises(InputError, match="Move these files"):
        make_capture(of_points(tmp_path, force=True))


@pytest.mark.parametrize("up", ["+z", "-z"])
def test_a_sheet_that_leans_is_named_and_turned_below_its_hands(tmp_path, up):
    sign, angle = (1 if up == "+z" else -1), np.radians(3)
    y, down = (each.ravel() for each in np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(0.02, 0.3, 8)))
    sheet = np.stack([down * np.sin(angle), y, sign * (1 - down * np.cos(angle))], axis=1)
    hands = np.array([[0.0, -0.1, sign], [0.0, 0.1, sign]])
    (tmp_path / "files").mkdir()
    write(tmp_path / "files", Hands(np.repeat(hands[None], 8, axis=0), np.zeros((0, 0), bool), np.zeros(0, int)), sheet)
    (tmp_path / "files" / TRACKS).write_text(json.dumps(np.repeat(sheet[:, None], 8, axis=1).tolist()))
    files = {"controllers": CONTROLLERS[0], "nodes": NODES[0], "tracks": TRACKS}
    brought_here = {name: tmp_path / "files" / file for name, file in files.items()}
    for plumb, wanted in ((False, 3.0), (True, 0.0)):
        output = tmp_path / f"{plumb}"
        made, _ = make_capture(of_points(tmp_path, **brought_here, output=output, up=up, no_table=True, plumb=plumb))
        seen_now = observe(row_of_capture(output / CAPTURE), output, Config(), output)
        assert leaning(Observed(seen_now))["value"] == pytest.approx(wanted, abs=1e-3)
        np.testing.assert_allclose(made.tracks()[0], seen_now.nodes, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"nodes": None}, "points without color need --controllers, --nodes and --tracks; received no --nodes"),
        ({"up": None}, r"--up: is required.*State the axis that points up"),
        ({"rate": None}, r"--rate: rows per second are required"),
        ({"up": "-z"}, r"tracks\.json: points: lowest height above the table.*pass --up"),
        ({"frames": "0-5"}, r"--frames: requires --color.*each row is a frame"),
        ({"pose": "standing"}, "--pose: requires --color"),
    ],
)
def test_points_are_refused_before_anything_is_written(tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        make_capture(of_points(tmp_path, **changes))
    assert not (tmp_path / "made").exists()


def test_markers_of_c3d_files_are_controllers_and_tracks(tmp_path):
    files = brought(tmp_path / "files", 8)
    points = 1000 * np.concatenate([scene.risen(scene.GRIP, 8), scene.risen(scene.MARKED, 8)], axis=1)
    lost = np.zeros((8, 8), bool)
    lost[3, 5] = True
    labels = [f"J{k}" for k in range(4)] + [f"M{k}" for k in range(4)]
    path = write_c3d(tmp_path / "take.c3d", points, labels, rate=50.0, lost=lost)
    named = {"controllers": f"{path}#J0,J1,J2,J3", "tracks": f"{path}#M0,M1,M2,M3"}
    take = {name: type(path)(text) for name, text in named.items()} | {"nodes": files["nodes"], "rate": None}
    made, _ = make_capture(of_points(tmp_path, **take))
    np.testing.assert_allclose(read(made).hands.points, scene.risen(scene.GRIP, 8), atol=1e-6)
    assert made.description.frame_rate == 50 and np.isnan(made.tracks()[3, 1]).all()
    with pytest.raises(InputError, match="one rate for all files; received 50"):
        make_capture(of_points(tmp_path, **take | {"rate": 25.0, "output": tmp_path / "other"}))
