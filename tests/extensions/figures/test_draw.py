"""The command draw: files that are written and read back, what is drawn by default, and every bad input by its text."""

import re
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image

from neuspring.cli.main import main

PDF_INCH = 72


def test_a_strip_as_pdf_is_one_page_of_the_asked_width_with_text(video, tmp_path, capsys):
    path = tmp_path / "deep" / "strip.pdf"
    words = ["draw", "strip", str(video), "--methods", "neuspring", "baseline", "--labels", "ours", "PhysTwin"]
    assert main([*words, "--width", "5", "--frames", "7", "0", "7", "--output", str(path)]) == 0
    told = capsys.readouterr().out
    assert "2 frames, 5.00 x" in told and "splats" in told and "Caption: small, camera 0, frames 0, 7;" in told
    content = path.read_bytes()
    assert content.startswith(b"%PDF-") and content.rstrip().endswith(b"%%EOF")
    assert len(re.findall(rb"/Type /Page\b", content)) == 1
    box = [float(value) for value in re.search(rb"/MediaBox \[([^\]]*)\]", content)[1].split()]
    assert box[2] == pytest.approx(5 * PDF_INCH)
    # Text is text, in fonts that journals take: TrueType inside, no type 3.
    assert b"/FontFile2" in content and b"/Type3" not in content
    first = content
    assert main([*words, "--width", "5", "--frames", "0", "7", "--output", str(path)]) == 0
    assert path.read_bytes() == first


def test_a_scenario_without_images_is_drawn_as_nodes_from_its_broad_side(plain, tmp_path, capsys):
    assert main(["draw", "strip", str(plain), "--dpi", "60", "--output", str(tmp_path / "strip.png")]) == 0
    told = capsys.readouterr().out
    assert "nodes" in told and "camera view" in told and "frames 0, 4, 6, 7" in told and "Distance of nodes" in told


def test_a_twin_from_any_camera(video, tmp_path, capsys):
    pictures = []
    for name, view in (("a", []), ("b", ["--camera", "0"]), ("c", ["--azimuth", "10", "--elevation", "60"])):
        path = tmp_path / f"{name}.png"
        assert main(["draw", "twin", str(video), *view, "--frame", "4", "--dpi", "60", "--output", str(path)]) == 0
        pictures.append(cv2.imread(str(path)))
    assert np.array_equal(pictures[0], pictures[1]) and pictures[0].shape != pictures[2].shape
    assert "frame 4, camera view" in capsys.readouterr().out
    path = tmp_path / "surface.png"
    words = ["--as", "splats", "--by", "region", "--dpi", "60", "--output", str(path)]
    assert main(["draw", "twin", str(video), *words]) == 0
    assert path.is_file()


def test_a_film_of_one_run_folder(video, tmp_path, capsys):
    path = tmp_path / "film.gif"
    assert main(["draw", "film", str(video / "baseline" / "0"), "--frames", "0", "3", "--width", "240", "--output", str(path)]) == 0
    told = capsys.readouterr().out
    assert "2 frames of 240 x" in told and " MB" in told
    with Image.open(path) as film:
        assert film.n_frames == 2


def test_frames_of_splats_are_pictures_of_any_camera(video, tmp_path):
    options = ["--capture", str(video / "capture" / "capture.json"), "--camera", "0", "--frames", "0", "3"]
    options += ["--appearance", str(video / "appearance" / "0" / "appearance.json")]
    options += ["--rollout", str(video / "baseline" / "0" / "rollout.json")]
    assert main(["draw", "frames", *options, "--output", str(tmp_path / "new")]) == 0
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["00000.png", "00003.png"]


@pytest.mark.parametrize(
    ("of", "words", "text"),
    [
        ("plain", ["strip", "--methods", "phystwin"], "neuspring, baseline; received phystwin. Enter METHOD"),
        ("plain", ["strip", "--frames", "0", "8"], "--frames: must be 0 to 7, the frames of the scenario; received 8"),
        ("plain", ["strip", "--camera", "1"], "--camera: must be a camera of the capture (it has none); received 1"),
        ("plain", ["strip", "--as", "splats"], "received none for neuspring/0; baseline/0. Remove"),
        ("plain", ["strip", "--error", "color"], "requires splats, and photos with masks of the same camera; received nodes"),
        ("plain", ["strip", "--labels", "one"], "--labels: must have one name for each of 2 methods; received 1"),
        ("plain", ["strip", "--most", "-1"], "--most: must be 1e-06 to 1e+06"),
        ("plain", ["strip", "--elevation", "91"], "--elevation: must be -89 to 89 degrees; received 91"),
        ("plain", ["strip", "--dpi", "nan"], "--dpi: must be 50 to 1200; received nan"),
        (
            "plain",
            ["strip", "--output", "strip.gif"],
            "must end in .pdf, .png, .jpg or .svg; received strip.gif.",
        ),
        ("plain", ["film", "--width", "40", "--output", "film.gif"], "--width: must be 160 to 1920; received 40"),
        ("plain", ["film", "--megabytes", "nan", "--output", "film.gif"], "--megabytes: must be 0.001 to 100"),
        ("plain", ["twin", "--as", "splats"], "Remove --as splats to draw springs"),
        ("video", ["strip", "--camera", "9"], "must be a camera of the capture (0); received 9"),
        ("video", ["strip", "--camera", "0", "--azimuth", "20"], "--camera: cannot be combined with --azimuth and --elevation"),
        ("video", ["strip", "--azimuth", "20", "--error", "color"], "received camera view without photos or masks"),
    ],
)
def test_bad_input_says_what_and_what_to_do(request, of, words, text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = [] if "--output" in words else ["--output", "picture.png"]
    assert main(["draw", words[0], str(request.getfixturevalue(of)), *words[1:], *output]) == 2
    assert text in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_a_run_lacks_is_named(plain, tmp_path, capsys):
    scenario = tmp_path / "small"
    shutil.copytree(plain, scenario)
    (scenario / "baseline" / "0" / "twin.npz").unlink()
    (scenario / "neuspring" / "0" / "trajectory.npz").unlink()
    twin, strip = (
        ["draw", kind, str(scenario), "--output", str(tmp_path / f"{kind}.png"), "--methods"] for kind in ("twin", "strip")
    )
    assert main([*twin, "baseline"]) == 2
    assert "--methods baseline/0: must have a twin; received no twin" in capsys.readouterr().err
    assert main([*strip, "neuspring"]) == 2
    assert "--methods neuspring/0: must have a prediction; received no prediction" in capsys.readouterr().err
    # A strip needs no twin, and a twin in frame 0 no prediction.
    assert main([*strip, "baseline", "--dpi", "60"]) == 0
    assert main([*twin, "neuspring", "--dpi", "60"]) == 0


def test_a_damaged_splat_file_and_a_missing_folder(video, tmp_path, capsys):
    scenario = tmp_path / "small"
    shutil.copytree(video, scenario)
    path = scenario / "appearance" / "0" / "splats.ply"
    path.write_bytes(path.read_bytes()[:-50])
    output = ["--output", str(tmp_path / "strip.png")]
    assert main(["draw", "strip", str(scenario), "--as", "splats", *output]) == 2
    assert "none for neuspring/0, no splats: " in capsys.readouterr().err
    # Without the wish for splats nodes are drawn, and the reason is told.
    assert main(["draw", "strip", str(scenario), "--dpi", "60", *output]) == 0
    assert "Drawing nodes, because there are no splats for neuspring/0" in capsys.readouterr().out
    assert main(["draw", "strip", str(tmp_path / "nowhere"), *output]) == 2
    assert "or a run <scenario>/<method>/<seed>; received no such folder" in capsys.readouterr().err
