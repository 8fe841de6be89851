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


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_pixels_are_inches_times_dots(plain, tmp_path, ending):
    path = tmp_path / f"strip.{ending}"
    assert main(["draw", "strip", str(plain), "--width", "4", "--dpi", "100", "--output", str(path)]) == 0
    with Image.open(path) as picture:
        assert picture.width == 400 and picture.height > 200
        assert np.asarray(picture.convert("RGB")).std() > 10


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
    words = ["--as", "splats", "--by", "region", "--background", "image", "--dpi", "60", "--output", str(path)]
    assert main(["draw", "twin", str(video), *words]) == 0
    assert path.is_file()


def test_a_film_of_one_run_folder(video, tmp_path, capsys):
    path = tmp_path / "film.gif"
    assert main(["draw", "film", str(video / "baseline" / "0"), "--frames", "0", "3", "--width", "240", "--output", str(path)]) == 0
    told = capsys.readouterr().out
    assert "2 frames of 240 x" in told and "kB" in told
    with Image.open(path) as film:
        assert film.n_frames == 2


def test_frames_of_splats_are_pictures_of_any_camera(video, tmp_path):
    options = ["--capture", str(video / "capture" / "capture.json"), "--camera", "0", "--frames", "0", "3"]
    options += ["--appearance", str(video / "appearance" / "0" / "appearance.json")]
    options += ["--rollout", str(video / "baseline" / "0" / "rollout.json")]
    assert main(["draw", "frames", *options, "--output", str(tmp_path / "new")]) == 0
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["00000.png", "00003.png"]


def test_a_picture_without_its_kind_is_refused_with_the_kinds(capsys):
    assert main(["draw", "--help"]) == 2
    assert "draw film or draw frames or draw strip or draw twin" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["strip", "--methods", "phystwin"], "has the methods neuspring, baseline; received phystwin. Name METHOD or METHOD/SEED"),
        (["strip", "--frames", "0", "8"], "--frames: the scenario has the frames 0 to 7; received 8"),
        (["strip", "--camera", "1"], "--camera: must be a camera of the capture: there is none; received 1. Give --azimuth"),
        (["strip", "--as", "splats"], "of a scenario with images; received none for neuspring/0; baseline/0. Leave out"),
        (["strip", "--error", "color"], "--error color: needs splats, and photos with masks of the same camera; received nodes"),
        (["strip", "--background", "image"], "--background image: needs a camera of a capture"),
        (["strip", "--labels", "one"], "--labels: one name for each of 2 methods is required; received 1"),
        (["strip", "--most", "-1"], "--most: must be above 0"),
        (["strip", "--dpi", "nan"], "--dpi: must be 50 to 1200; received nan"),
        (["twin", "--frame", "-1"], "--frame: the scenario has the frames 0 to 7; received -1"),
        (["twin", "--as", "splats"], "Leave out --as splats to draw springs"),
        (["film", "--width", "5"], "--width: must be 160 to 1920; received 5"),
        (["film", "--speed", "0"], "--speed: must be 0.05 to 8"),
        (["film", "--megabytes", "nan"], "--megabytes: must be 0.001 to 100"),
    ],
)
def test_bad_input_says_what_and_what_to_do(plain, words, text, tmp_path, capsys):
    path = tmp_path / f"picture.{'gif' if words[0] == 'film' else 'png'}"
    assert main(["draw", words[0], str(plain), *words[1:], "--output", str(path)]) == 2
    assert text in capsys.readouterr().err
    assert not path.exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--camera", "9"], "must be a camera of the capture: 0; received 9"),
        (["--camera", "0", "--azimuth", "20"], "--camera: excludes --azimuth and --elevation"),
        (["--azimuth", "20", "--error", "color"], "received camera view without photos or masks. Take --error distance"),
    ],
)
def test_bad_input_of_a_filmed_scenario(video, words, text, tmp_path, capsys):
    assert main(["draw", "strip", str(video), *words, "--output", str(tmp_path / "strip.pdf")]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "name", "text"),
    [
        ("strip", "strip.bmp", "--output: the file must end in .pdf, .png, .jpg or .svg; received strip.bmp."),
        ("strip", "strip.gif", "received strip.gif. neuspring draw film writes .gif"),
        ("film", "film.png", "the file must end in .mp4 or .gif; received film.png. neuspring draw strip writes .png"),
        ("twin", "folder.pdf", "--output: must be a file; received the folder"),
        ("twin", "file/twin.pdf", "this folder must be writable"),
    ],
)
def test_files_that_cannot_be_written_are_refused_first(kind, name, text, tmp_path, capsys):
    (tmp_path / "folder.pdf").mkdir()
    (tmp_path / "file").write_text("")
    assert main(["draw", kind, str(tmp_path / "no-results"), "--output", str(tmp_path / name)]) == 2
    assert text in capsys.readouterr().err


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
    assert "Nodes are drawn, since there are no splats for neuspring/0" in capsys.readouterr().out
    assert main(["draw", "strip", str(tmp_path / "nowhere"), *output]) == 2
    assert "or a run <scenario>/<method>/<seed>; received no such folder" in capsys.readouterr().err
