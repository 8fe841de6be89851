"""make-capture brings hands, nodes and annotated points into a capture, with film or alone."""

import json
from pathlib import Path

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.data.capture import CONTROLLERS, NODES, TRACKS, Capture
from neuspring.extensions.make_capture.make import Intake, make_capture
from neuspring.intake.check import check_layout
from neuspring.intake.points import Hands, read, write
from tests.support import spaced as scene
from tests.support.c3d_files import write_c3d
from tests.support.desk import FRAMES, write_folders, write_poses
from tests.support.findings import serious


def brought(folder, frames=FRAMES):
    """Files of a hand, nodes and tracks, by option."""
    folder.mkdir()
    write(folder, Hands(scene.risen(scene.GRIP, frames), np.zeros((0, 0), bool), np.zeros(0, int)), scene.NODES)
    (folder / TRACKS).write_text(json.dumps(np.swapaxes(scene.risen(scene.MARKED, frames), 0, 1).tolist()))
    return {"controllers": folder / CONTROLLERS[0], "nodes": folder / NODES[0], "tracks": folder / TRACKS}


def filmed(root, depth=False, **changes):
    """One camera of the desk, and the files."""
    films = {"color": (root / "color_0",), "depth": (root / "depth_0",) if depth else ()}
    plain = {"output": root / "capture", "name": "desk", "category": "ball", "rate": 30.0} | films
    return Intake(**(plain | {"intrinsics": root / "intrinsics.json", "poses": write_poses(root / "poses.json", 1)} | changes))


def test_points_alone_become_a_capture(tmp_path, capsys):
    files = brought(tmp_path / "files", 8)
    options = [part for name, path in files.items() for part in (f"--{name}", str(path))]
    command = ["make-capture", *options, "--category", "toy", "--rate", "25", "--train-end", "5", "--mass", "0.35"]
    command += ["--output", str(tmp_path / "made")]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "4 controllers, 48 nodes, 4 annotated points, 8 frames" in said
    assert "check-data" in said
    assert "neuspring annotate" not in said
    made = Capture.load(tmp_path / "made")
    assert (made.frame_count, made.train_end, made.description.frame_rate, made.description.tracks) == (8, 5, 25.0, "train")
    assert made.description.mass == 0.35
    assert serious(check_layout(made.folder)) == []
    np.testing.assert_allclose(read(made).hands.points, scene.risen(scene.GRIP, 8))
    assert made.description.provenance["nodes file"].startswith("sha256:")
    # The files in a capture are not replaced, and what another made is not taken for its own.
    assert main([*command, "--force"]) == 2
    assert "Move them away" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"nodes": None}, r"--controllers, --nodes and --tracks are required; received no --nodes"),
        ({"up": "-z"}, r"tracks\.json.*Is up \+z.*--up"),
        ({"train_end": 90}, r"train_end: must be at most frame_count = 8"),
        ({"rate": 0.03}, r"--rate: frames per second of a camera lie between 1 and 240; received 0\.03"),
        ({"frames": "0-5"}, r"--frames: is for film, and there is none; received 0-5\. .*a row is a frame"),
        ({"pose": "standing"}, r"--pose: is for film"),
        ({"poses": Path("poses.json")}, r"--poses: is for film"),
    ],
)
def test_points_alone_are_refused_before_anything_is_written(tmp_path, changes, words):
    files = brought(tmp_path / "files", 8)
    plain = {"output": tmp_path / "made", "name": "m", "category": "toy", "rate": 30.0}
    with pytest.raises(InputError, match=words):
        make_capture(Intake(**(plain | files | changes)))
    assert not (tmp_path / "made").exists()


def test_both_counts_of_rows_are_named(tmp_path):
    files = brought(tmp_path / "files", 8)
    np.savez(files["controllers"], points=np.load(files["controllers"])["points"][:6])
    with pytest.raises(InputError, match=r"a row per frame.*received 6 rows of --controllers, 8 of --tracks"):
        make_capture(Intake(output=tmp_path / "made", name="m", category="toy", rate=30.0, **files))


def mocap(folder, rate=30.0, frames=8, unit="mm", lost=None):
    """The hand and the markers of `brought` in one C3D file, and the nodes."""
    files = brought(folder, frames)
    together = 1000 * np.concatenate([scene.risen(scene.GRIP, frames), scene.risen(scene.MARKED, frames)], axis=1)
    labels = [f"{name}{k}" for name, count in (("hand", len(scene.GRIP)), ("toy", len(scene.MARKED))) for k in range(count)]
    path = write_c3d(folder / "take.c3d", together, labels, unit, rate, lost)
    hand, toy = (",".join(label for label in labels if label.startswith(name)) for name in ("hand", "toy"))
    return {"controllers": Path(f"{path}#{hand}"), "nodes": files["nodes"], "tracks": Path(f"{path}#{toy}")}


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_motion_capture_alone_becomes_a_capture(tmp_path, rate):
    lost = np.zeros((8, len(scene.GRIP) + len(scene.MARKED)), bool)
    lost[5:, -1] = True
    files = mocap(tmp_path / "files", rate, lost=lost)
    options = [part for name, path in files.items() for part in (f"--{name}", str(path))]
    command = ["make-capture", *options, "--category", "toy", "--output", str(tmp_path / "made")]
    assert main(command) == 0
    made = Capture.load(tmp_path / "made")
    assert (made.frame_count, made.description.frame_rate) == (8, rate)
    space = read(made)
    np.testing.assert_allclose(space.hands.points, scene.risen(scene.GRIP, 8), atol=1e-6)
    right = scene.risen(scene.MARKED, 8)
    right[5:, -1] = np.nan
    np.testing.assert_allclose(space.tracks, right, atol=1e-6)
    assert json.loads((made.folder / TRACKS).read_text())[-1][5:] == [None] * 3
    assert made.description.provenance["controllers file"] == made.description.provenance["tracks file"]
    assert serious(check_layout(made.folder)) == []
    assert main([*command, "--force", "--rate", "30"]) == 2


@pytest.mark.parametrize(
    ("given", "changes", "words"),
    [
        (
            {"rate": 100.0},
            {"rate": 30.0},
            r"--controllers: .*take\.c3d#hand0.* the capture's rate.*received 100 Hz, not 30\. Leave",
        ),
        ({"unit": ""}, {}, r"POINT:UNITS must be one of m cm mm.*Say it, .*take\.c3d#unit=mm,hand0"),
        ({"frames": 9}, {"tracks": None}, r"--controllers, --nodes and --tracks are required; received no --tracks"),
        ({"lost": 0}, {}, r"hand0: a controller must be seen in every frame; received lost in 2 frames, first in 3\. Fill"),
    ],
)
def test_motion_capture_that_does_not_fit_is_refused_before_anything_is_written(tmp_path, given, changes, words):
    if "lost" in given:
        lost = np.zeros((8, len(scene.GRIP) + len(scene.MARKED)), bool)
        lost[3:5, given["lost"]] = True
        given = {"lost": lost}
    files = mocap(tmp_path / "files", **given)
    with pytest.raises(InputError, match=words):
        make_capture(Intake(**({"output": tmp_path / "made", "category": "toy"} | files | changes)))
    assert not (tmp_path / "made").exists()


def test_motion_capture_beside_film_has_its_frames_and_its_rate(tmp_path):
    root = write_folders(tmp_path)
    made, _ = make_capture(filmed(root, **mocap(root / "files", frames=FRAMES)))
    assert made.tracks().shape == (FRAMES, 4, 3)
    for number, (given, words) in enumerate((({"rate": 120.0}, "120 Hz, not 30"), ({"frames": FRAMES + 1}, f"{FRAMES} "))):
        with pytest.raises(InputError, match=words):
            make_capture(filmed(root, output=root / "other", **mocap(root / f"{number}", **({"frames": FRAMES} | given))))
    assert not (root / "other").exists()


def test_what_hangs_has_no_table(tmp_path):
    """A body that begins 40 cm below z = 0 is refused with the option that says that there is no table."""
    files = brought(tmp_path / "files", 8)
    for name in ("controllers", "nodes"):
        np.savez(files[name], points=np.load(files[name])["points"] + [0, 0.3, -0.4])
    listed = json.loads(files["tracks"].read_text())
    files["tracks"].write_text(json.dumps([[p and [p[0], p[1] + 0.3, p[2] - 0.4] for p in track] for track in listed]))
    plain = {"output": tmp_path / "made", "name": "m", "category": "toy", "rate": 30.0}
    with pytest.raises(InputError, match="--no-table"):
        make_capture(Intake(**plain, **files))
    made, _ = make_capture(Intake(**plain, **files, no_table=True))
    assert made.description.ground is False
    assert serious(check_layout(made.folder)) == []


def test_with_film_the_table_stands_in_the_capture(tmp_path):
    root = write_folders(tmp_path)
    with pytest.raises(InputError, match=r"--no-table: is for points in space alone.*ground: false"):
        make_capture(filmed(root, no_table=True, **brought(root / "files")))


@pytest.mark.parametrize("teach", [False, True])
def test_points_come_with_film(tmp_path, teach):
    root = write_folders(tmp_path)
    made, _ = make_capture(filmed(root, teach=teach, **brought(root / "files")))
    space = read(made)
    assert len(space.hands.points) == made.frame_count == FRAMES
    assert len(space.nodes) == len(scene.NODES)
    assert made.description.tracks == ("train" if teach else "score")
    assert made.tracks().shape == (FRAMES, 4, 3)
    assert space.tracks.shape[1] == (4 if teach else 0)


@pytest.mark.parametrize(
    ("changes", "frames", "words"),
    [
        ({"depth": True, "poses": None}, FRAMES, r"--controllers: .*need the world of the cameras: --poses or --board"),
        ({"depth": True, "level": True}, FRAMES, r"--controllers: .*without --level"),
        ({}, FRAMES + 1, rf"controllers\.npz: {FRAMES} frames are required.*received {FRAMES + 1}"),
    ],
)
def test_points_that_do_not_fit_the_film_are_refused_before_an_image_is_written(tmp_path, changes, frames, words):
    root = write_folders(tmp_path)
    with pytest.raises(InputError, match=words):
        make_capture(filmed(root, **(brought(root / "files", frames) | changes)))
    assert not (root / "capture").exists()
