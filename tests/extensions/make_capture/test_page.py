"""The commands of the page's section run as they stand, on a film written out as plain folders, and on a bag."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import trimesh

from neuspring.cli.main import main
from neuspring.data import capture as capture_module
from neuspring.data.capture import Capture
from neuspring.intake.points import read
from tests.support.bags import desk, recorded
from tests.support.desk import FRAMES, write_json
from tests.support.filmed import film

PAGE = Path(capture_module.__file__).with_name("README.md").read_text()
SECTION = PAGE.split("## From a camera to a capture")[1].split("\n## ")[0]


def test_the_commands_of_the_page(tmp_path, monkeypatch, capsys):
    original = film(tmp_path / "film", cameras=1)
    view = original.cameras["0"]
    k = view.intrinsics
    for kind in ("color", "depth"):
        (tmp_path / "FILES" / kind).mkdir(parents=True)
    for frame in range(original.frame_count):
        # The numbers of the page's window; depth as npy of counts, to show that kinds may differ.
        name = f"{250 + frame:06d}"
        cv2.imwrite(str(tmp_path / "FILES" / "color" / f"{name}.jpg"), original.color("0", frame)[..., ::-1])
        counts = cv2.imread(str(original.path("depth", "0", frame)), cv2.IMREAD_UNCHANGED)
        np.save(tmp_path / "FILES" / "depth" / f"{name}.npy", counts)
    write_json(tmp_path / "FILES" / "intrinsics.json", {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]})
    monkeypatch.chdir(tmp_path)
    commands = re.search(r"```\n(neuspring make-capture.*?)```", SECTION, re.DOTALL)[1].replace("\\\n", " ").splitlines()
    assert [shlex.split(command)[1] for command in commands] == ["make-capture", "check-data"]
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0, capsys.readouterr()
    assert "0 errors, 0 warnings" in capsys.readouterr().out
    made = Capture.load(tmp_path / "captures" / "plush")
    assert made.frame_count == original.frame_count
    assert abs(made.cameras["0"].camera_to_world[2, 3] - view.camera_to_world[2, 3]) < 1e-3


def test_the_commands_for_ros_bags(tmp_path, monkeypatch, capsys):
    (tmp_path / "FILES").mkdir()
    with recorded(tmp_path / "FILES" / "film") as bag:
        desk(bag)
    monkeypatch.chdir(tmp_path)
    commands = re.search(r"### ROS bags.*?```\n(.*?)```", SECTION, re.DOTALL)[1].replace("\\\n", " ").splitlines()
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0, capsys.readouterr()
    assert "depth, 16uc1, 80 x 60" in capsys.readouterr().out
    assert Capture.load(tmp_path / "captures" / "plush").frame_count == FRAMES


def test_the_recipe_for_a_gripper_makes_a_capture(tmp_path, monkeypatch):
    """Its own text: a ball of 8 cm on the table, a gripper that rises with it, five markers of which one is lost."""
    recipe = re.search(r"### Hands in space.*?```python\n(.*?)```", SECTION, re.DOTALL)[1]
    monkeypatch.chdir(tmp_path)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    ball.apply_translation([0, 0, 0.04])
    ball.export("toy.ply")
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = 0.08 + 0.02 * np.arange(6)
    jaws = 0.01 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    markers = np.asarray(ball.vertices[:5]) + np.array([0, 0, 0.02]) * np.arange(6)[:, None, None]
    markers[3, 2] = np.nan
    exec(compile(recipe, "recipe", "exec"), {"poses": poses, "jaws": jaws, "markers": markers})
    files = ["--controllers", "controllers.npz", "--nodes", "nodes.npz", "--tracks", "tracks.json"]
    assert main(["make-capture", *files, "--rate", "30", "--category", "ball", "--output", "captures/ball"]) == 0
    made = read(Capture.load(tmp_path / "captures" / "ball"))
    assert 100 < len(made.nodes) < 400
    np.testing.assert_allclose(np.ptp(made.nodes, axis=0), 0.08, atol=0.012)
    np.testing.assert_allclose(made.hands.points[:, 0], [[0.01, 0, 0.08 + 0.02 * k] for k in range(6)], atol=1e-6)
    assert np.isnan(made.tracks[3, 2]).all()
    assert np.isfinite(made.tracks).sum() == 6 * 5 * 3 - 3
