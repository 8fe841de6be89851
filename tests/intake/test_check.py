"""The layout check: a conforming data set has no errors or warnings; every finding is reported at once, with its level."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.findings import broken, note, unusual
from neuspring.intake import phystwin
from neuspring.intake.check import check_layout, render
from tests.support.c3d_files import write_c3d
from tests.support.findings import holds, of_level, serious
from tests.support.phystwin_case import dump, edit, stored, write_case, write_json


def test_a_conforming_case_has_only_notes(tmp_path: Path) -> None:
    findings = check_layout(write_case(tmp_path))
    assert serious(findings) == []
    assert render(findings).endswith("0 errors, 0 warnings")


@pytest.mark.parametrize("missing", ["gt_track_3d.pkl", "calibrate.pkl", "metadata.json"])
def test_missing_optional_files_are_notes(tmp_path: Path, missing: str) -> None:
    folder = write_case(tmp_path)
    (folder / missing).unlink()
    findings = check_layout(folder)
    assert serious(findings) == []
    assert holds(findings, "note", missing, "skipped")


def judged(folder: Path, level: str, file: str, words: tuple[str, ...]) -> None:
    """The check says so, and the reader refuses what is an error, and nothing less."""
    assert holds(check_layout(folder), level, file, *words), render(check_layout(folder))
    row = ScenarioRow(scenario="case", source="phystwin", category="rope", path=".", self_collision=False, ground=True)
    if level == "error" and "visible in both frames" not in words:  # readable, and the numbers would be wrong
        with pytest.raises(InputError, match=file):
            phystwin.read(row, folder)
    else:
        phystwin.read(row, folder)


def set_entry(key: str, index: Any, value: Any) -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    def change(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        data[key][index] = value
        return data

    return change


def hide_frame(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    data["object_visibilities"][4] = False
    data["object_motions_valid"][3:5] = False
    data["object_points"][4] = 0
    return data


def duplicate(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    data["object_points"][0, 1] = data["object_points"][0, 0]
    return data


def shuffle(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    for key in ("object_points", "object_colors", "object_visibilities", "object_motions_valid"):
        data[key] = data[key][:, ::-1]
    return data


def leave_trace(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    data["object_points"][tuple(np.argwhere(~data["object_visibilities"])[0])] = [0.01, 0.01, -0.01]
    return data


def trust_hidden(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    frame, point = np.argwhere(~data["object_visibilities"])[0]
    data["object_motions_valid"][frame - 1, point] = True
    return data


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        (set_entry("object_points", (3, 0, 0), np.nan), "error", ("object_points", "nan at frame 3, point 0")),
        (set_entry("object_visibilities", (0, 5), False), "error", ("object_visibilities", "point 5")),
        (trust_hidden, "error", ("object_motions_valid", "visible in both frames")),
        (leave_trace, "warning", ("object_points", "invisible")),
        (set_entry("object_points", (2, 0, 2), 0.004), "warning", ("object_points", "z up to 0.004 m, frame 2, point 0")),
        (set_entry("object_motions_valid", (-1, 0), True), "warning", ("object_motions_valid", "last row")),
        (hide_frame, "warning", ("object_visibilities", "none in frames 4")),
        (duplicate, "warning", ("object_points", "1 duplicates")),
        (shuffle, "warning", ("object_points", "lexicographic")),
        (lambda d: d | {"extra": 1}, "warning", ("extra", "unknown key")),
        (lambda d: d | {"controller_points": d["controller_points"][:, :20]}, "warning", ("controller_points", "20")),
        (lambda d: d | {"controller_points": d["controller_points"][:, :0]}, "error", ("controller_points", "at least one")),
        (lambda d: d | {"object_points": d["object_points"].astype(np.float32)}, "warning", ("object_points", "float64")),
        (lambda d: d | {"object_colors": d["object_colors"][:-1]}, "warning", ("object_colors", "10 entries")),
        (lambda d: d | {"surface_points": d["surface_points"][:, :2]}, "error", ("surface_points", "shape")),
        (lambda d: d | {"interior_points": "text"}, "error", ("interior_points", "received str")),
        (lambda d: {k: v for k, v in d.items() if k != "controller_points"}, "error", ("controller_points", "missing")),
        (lambda _: [1, 2], "error", ("dict of arrays", "list")),
        (lambda d: d | {"object_visibilities": d["object_visibilities"].astype(int)}, "error", ("dtype must be bool",)),
        (lambda d: d | {"object_points": d["object_points"].astype(int)}, "error", ("object_points", "floating")),
    ],
)
def test_findings_of_final_data(tmp_path: Path, change: Callable[[Any], Any], level: str, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    dump(folder / "final_data.pkl", change(stored(folder)))
    judged(folder, level, "final_data.pkl", words)


@pytest.mark.parametrize(
    ("split", "level", "words"),
    [
        ({"frame_len": 10, "train": [0, 6], "test": [6, 10]}, "warning", ("train", "[0, 7]")),
        ({"frame_len": 9, "train": [0, 7], "test": [7, 10]}, "warning", ("frame_len", "10 frames")),
        ({"frame_len": 10, "train": [0, 7], "test": [7, 11]}, "error", ("test", "[7, 11]")),
        ({"frame_len": 10, "train": [0, 7]}, "error", ("test", "whole numbers")),
        ({"train": [-1, 7], "test": [7, 10]}, "error", ("train", "[-1, 7]")),
        ({"train": [0, 1], "test": [1, 10]}, "error", ("train", "one frame after frame 0")),
        ([0, 7], "error", ("JSON object", "list")),
    ],
)
def test_findings_of_the_split(tmp_path: Path, split: Any, level: str, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "split.json", split)
    judged(folder, level, "split.json", words)


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ([np.eye(4)] * 2, ("list of 2",)),
        ([np.eye(4), np.eye(3), np.eye(4)], ("camera 1", "(3, 3)")),
        ([np.eye(4), np.eye(4), np.diag([1.0, 1.0, 2.0, 1.0])], ("camera 2", "rigid", "deviation of 3")),
        ([np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(4), np.eye(4)], ("camera 0", "rigid")),
    ],
)
def test_findings_of_the_calibration(tmp_path: Path, cameras: Any, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    dump(folder / "calibrate.pkl", cameras)
    assert holds(check_layout(folder), "error", "calibrate.pkl", *words)


K = [[60.0, 0.0, 30.0], [0.0, 60.0, 20.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("metadata", "level", "words"),
    [
        ({"intrinsics": [K] * 3, "WH": [64, 48]}, "warning", ("fps", "missing")),
        ({"intrinsics": [K] * 3, "WH": [64, 48], "fps": 15}, "warning", ("fps", "15")),
        ({"intrinsics": [K] * 3, "WH": [64, 48], "fps": 30, "frame_num": 3}, "warning", ("frame_num", "3")),
        ({"intrinsics": [K] * 3, "WH": [64], "fps": 30}, "error", ("WH", "[64]")),
        ({"intrinsics": [K] * 2, "WH": [64, 48], "fps": 30}, "error", ("intrinsics", "(2, 3, 3)")),
        ({"intrinsics": [np.transpose(K).tolist()] * 3, "WH": [64, 48], "fps": 30}, "error", ("intrinsics", "fx")),
        ([1], "error", ("JSON object",)),
    ],
)
def test_findings_of_the_metadata(tmp_path: Path, metadata: Any, level: str, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "metadata.json", metadata)
    assert holds(check_layout(folder), level, "metadata.json", *words)


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (np.zeros((10, 5, 2)), ("[T, K, 3]",)),
        (np.zeros((10, 5, 3), int), ("floating point",)),
        (np.full((10, 5, 3), np.inf), ("inf at frame 0, point 0",)),
        ([1, 2], ("list",)),
    ],
)
def test_tracks_that_are_none(tmp_path: Path, tracks: Any, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    dump(folder / "gt_track_3d.pkl", tracks)
    judged(folder, "error", "gt_track_3d.pkl", words)


def test_findings_of_the_tracks(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    tracks = np.zeros((9, 2, 3))
    tracks[1, 1, 0] = np.nan
    dump(folder / "gt_track_3d.pkl", tracks)
    findings = check_layout(folder)
    assert holds(findings, "error", "gt_track_3d.pkl", "10 frames")
    assert holds(findings, "warning", "gt_track_3d.pkl", "frame 1, point 1")


def test_all_findings_are_reported_at_once(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    data = stored(folder)
    data["object_points"][3, 0] = np.nan
    data["controller_points"] = data["controller_points"][:, :5]
    edit(folder, **data)
    write_json(folder / "split.json", {"train": [0, 70], "test": [7, 10]})
    (folder / "calibrate.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    text = render(check_layout(folder))
    assert all(word in text for word in ("nan at frame 3, point 0 (3 in all)", "[0, 70]", "global os.system", "30 controllers"))
    assert text.splitlines()[-1] == "3 errors, 1 warning"


def test_a_case_a_folder_of_cases_and_a_root(tmp_path: Path) -> None:
    first, second = write_case(tmp_path, "a"), write_case(tmp_path, "b", frames=20)
    (second / "final_data.pkl").unlink()
    assert of_level(check_layout(first), "error") == []
    for folder in (first.parent, tmp_path):
        errors = [d for d in check_layout(folder) if d.level == "error"]
        assert [d.where for d in errors] == [str(second / "final_data.pkl")]


def test_folders_without_data_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing there"):
        check_layout(tmp_path / "absent")
    with pytest.raises(InputError, match=r"final_data\.pkl"):
        check_layout(tmp_path)
    (tmp_path / "data" / "different_types").mkdir(parents=True)
    with pytest.raises(InputError, match="at least one case"):
        check_layout(tmp_path)


def test_markers_of_c3d_files_one_by_one_with_labels_and_as_a_folder(tmp_path: Path) -> None:
    rest = np.array([[0.0, 0, 0], [300, 0, 0], [300, 200, 0], [0, 200, 100]])
    way = rest + 50 * np.sin(np.arange(60) / 5)[:, None, None]
    way[30, 1] += 400
    lost = np.zeros((60, 4), bool)
    lost[50:, 2] = True
    path = write_c3d(tmp_path / "take.c3d", way, ["base", "tip - 1", "tip - 2", "elbow"], rate=100.0, lost=lost)
    found = check_layout(path)
    assert holds(found, "note", "take.c3d", "60 frames of 100 Hz, within ", "base, tip - 1, tip - 2, elbow; lost: tip - 2 in 10")
    assert holds(found, "warning", "take.c3d", "point 1 in frame 30", "leave the marker out: FILE.c3d#LABEL")
    assert [one.text for one in check_layout(tmp_path)] == [one.text for one in found]
    (alone,) = check_layout(Path(f"{path}#base,elbow"))
    assert "of 2 markers: base, elbow; none is ever lost" in alone.text
    assert holds(check_layout(Path(f"{path}#hand")), "error", "take.c3d#hand", "There are: base")


def test_render_groups_by_file() -> None:
    one, two = Path("b.pkl"), Path("a.pkl")
    text = render([broken(one, "", "x"), note(two, "y"), unusual(one, "", "z")])
    assert text == "a.pkl\n  note     y\nb.pkl\n  error    x\n  warning  z\n1 error, 1 warning"
    assert render([]) == "0 errors, 0 warnings"
