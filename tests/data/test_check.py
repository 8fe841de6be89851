"""check-data: a conforming data set has no errors or warnings; each departure is reported, all of them at once, with its level."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.cases import released_cases
from neuspring.data.check import Departure, check, render
from tests.support.phystwin_case import dump, edit, stored, write_case, write_json, write_raw_frame, write_results


def of_level(departures: list[Departure], *levels: str) -> list[str]:
    return [f"{d.file.name}: {d.message}" for d in departures if d.level in levels]


def serious(departures: list[Departure]) -> list[str]:
    return of_level(departures, "error", "warning")


def holds(departures: list[Departure], level: str, file: str, *words: str) -> bool:
    return any(d.level == level and d.file.name == file and all(w in d.message for w in words) for d in departures)


def test_a_conforming_case_has_only_notes(tmp_path: Path) -> None:
    found = check(write_case(tmp_path))
    assert serious(found) == []
    assert any("deprojection check (4) is skipped" in text for text in of_level(found, "note"))
    assert render(found).endswith("0 errors, 0 warnings")


@pytest.mark.parametrize("missing", ["gt_track_3d.pkl", "calibrate.pkl", "metadata.json"])
def test_missing_optional_files_are_notes(tmp_path: Path, missing: str) -> None:
    folder = write_case(tmp_path)
    (folder / missing).unlink()
    found = check(folder)
    assert serious(found) == []
    assert holds(found, "note", missing, "skipped")


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
    ],
)
def test_departures_of_final_data(tmp_path: Path, change: Callable[[Any], Any], level: str, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    dump(folder / "final_data.pkl", change(stored(folder)))
    assert holds(check(folder), level, "final_data.pkl", *words), render(check(folder))


@pytest.mark.parametrize(
    ("split", "level", "words"),
    [
        ({"frame_len": 10, "train": [0, 6], "test": [6, 10]}, "warning", ("train", "[0, 7]")),
        ({"frame_len": 9, "train": [0, 7], "test": [7, 10]}, "warning", ("frame_len", "10 frames")),
        ({"frame_len": 10, "train": [0, 7], "test": [7, 11]}, "error", ("test", "[7, 11]")),
        ({"frame_len": 10, "train": [0, 7]}, "error", ("test", "whole numbers")),
    ],
)
def test_departures_of_the_split(tmp_path: Path, split: Any, level: str, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "split.json", split)
    assert holds(check(folder), level, "split.json", *words)


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ([np.eye(4)] * 2, ("list of 2",)),
        (np.eye(4), ("ndarray",)),
        ([np.eye(4), np.eye(3), np.eye(4)], ("camera 1", "(3, 3)")),
        ([np.eye(4), np.eye(4), np.diag([1.0, 1.0, 2.0, 1.0])], ("camera 2", "rigid", "deviation of 3")),
        ([np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(4), np.eye(4)], ("camera 0", "rigid")),
        ([np.full((4, 4), np.nan), np.eye(4), np.eye(4)], ("camera 0", "deviation of nan")),
    ],
)
def test_departures_of_the_calibration(tmp_path: Path, cameras: Any, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    dump(folder / "calibrate.pkl", cameras)
    assert holds(check(folder), "error", "calibrate.pkl", *words)


K = [[60.0, 0.0, 30.0], [0.0, 60.0, 20.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("metadata", "level", "words"),
    [
        ({"intrinsics": [K] * 3, "WH": [64, 48]}, "warning", ("fps", "missing")),
        ({"intrinsics": [K] * 3, "WH": [64, 48], "fps": 15}, "warning", ("fps", "15")),
        ({"intrinsics": [K] * 3, "WH": [64, 48], "fps": 30, "frame_num": 3}, "warning", ("frame_num", "3")),
        ({"intrinsics": [K] * 3, "WH": [64], "fps": 30}, "error", ("WH", "[64]")),
        ({"intrinsics": [K] * 2, "WH": [64, 48], "fps": 30}, "error", ("intrinsics", "(2, 3, 3)")),
        ({"intrinsics": "K", "WH": [64, 48], "fps": 30}, "error", ("intrinsics",)),
        ({"intrinsics": [np.transpose(K).tolist()] * 3, "WH": [64, 48], "fps": 30}, "error", ("intrinsics", "fx")),
        ([1], "error", ("JSON object",)),
    ],
)
def test_departures_of_the_metadata(tmp_path: Path, metadata: Any, level: str, words: tuple[str, ...]) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "metadata.json", metadata)
    assert holds(check(folder), level, "metadata.json", *words)


def test_departures_of_the_tracks(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    tracks = np.zeros((9, 2, 3))
    tracks[1, 1, 0] = np.nan
    dump(folder / "gt_track_3d.pkl", tracks)
    found = check(folder)
    assert holds(found, "error", "gt_track_3d.pkl", "10 frames")
    assert holds(found, "warning", "gt_track_3d.pkl", "frame 1, point 1")


def test_all_departures_are_reported_at_once(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    data = stored(folder)
    data["object_points"][3, 0] = np.nan
    data["controller_points"] = data["controller_points"][:, :5]
    edit(folder, **data)
    write_json(folder / "split.json", {"train": [0, 70], "test": [7, 10]})
    (folder / "calibrate.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    text = render(check(folder))
    for word in (
        "nan at frame 3, point 0 (3 in all)",
        "[0, 70]",
        "global os.system",
        "30 controllers",
        "conformance checks 1 to 3 skipped",
    ):
        assert word in text
    assert text.splitlines()[-1] == "3 errors, 1 warning"


# --- which folders ------------------------------------------------------------------------------------------------------


def test_a_case_a_folder_of_cases_and_a_root(tmp_path: Path) -> None:
    first, second = write_case(tmp_path, "a"), write_case(tmp_path, "b", frames=20)
    (second / "final_data.pkl").unlink()
    assert of_level(check(first), "error") == []
    for folder in (first.parent, tmp_path):
        errors = [d for d in check(folder) if d.level == "error"]
        assert [d.file for d in errors] == [second / "final_data.pkl"]
    loose = tmp_path / "elsewhere"
    loose.mkdir()
    first.rename(loose / "a")
    assert any("no experiments folder" in text for text in of_level(check(loose), "note"))


def test_folders_without_data_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing there"):
        check(tmp_path / "absent")
    with pytest.raises(InputError, match=r"final_data\.pkl"):
        check(tmp_path)
    (tmp_path / "data" / "different_types").mkdir(parents=True)
    with pytest.raises(InputError, match="at least one case"):
        check(tmp_path)


def test_render_groups_by_file() -> None:
    one, two = Path("b.pkl"), Path("a.pkl")
    text = render([Departure(one, "error", "x"), Departure(two, "note", "y"), Departure(one, "warning", "z")])
    assert text == "a.pkl\n  note     y\nb.pkl\n  error    x\n  warning  z\n1 error, 1 warning"
    assert render([]) == "0 errors, 0 warnings"


# --- conformance checks -------------------------------------------------------------------------------------------------


def test_the_table_of_released_cases() -> None:
    cases = released_cases()
    assert len(cases) == 22
    assert sum(int(row["frames"]) for row in cases.values()) == 2423
    assert sum(int(row["frames"]) - int(row["train_end"]) for row in cases.values()) == 735
    assert all(int(row["train_end"]) == int(0.7 * int(row["frames"])) for row in cases.values())
    assert [name for name, row in cases.items() if not row["nodes"]] == [
        "double_lift_sloth",
        "double_stretch_sloth",
        "single_lift_sloth",
    ]


def test_sizes_of_a_released_case_are_compared(tmp_path: Path) -> None:
    found = check(write_case(tmp_path, "single_push_rope_4"))
    for column, expected in (("frames", 83), ("train_end", 58), ("object_points", 839), ("nodes", 855)):
        assert holds(found, "error", "final_data.pkl", column, str(expected))


def test_released_results_of_several_cases(tmp_path: Path) -> None:
    pytest.importorskip("neuspring.twin.topology")
    pytest.importorskip("neuspring.scores.metrics")
    for name in ("a", "b"):
        write_results(write_case(tmp_path, name))
    found = check(tmp_path)
    assert serious(found) == []
    assert holds(found, "note", "best_199.pth", "as rebuilt")
    assert holds(found, "note", "inference.pkl", "future chamfer")
    # The prediction moves rigidly with the observed points, so tracks are met to float32 rounding.
    assert holds(found, "note", "inference.pkl", "future track_error 0.000000 m over 3 frames")
    assert holds(found, "note", tmp_path.name, "equal-case mean", "0.011579")
    assert holds(found, "note", tmp_path.name, "equal-case mean", "0.022019")


def test_other_springs_are_an_error(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("neuspring.twin.topology")
    folder = write_case(tmp_path)
    write_results(folder)
    checkpoint = tmp_path / "experiments" / folder.name / "train" / "best_199.pth"
    stored_values = torch.load(checkpoint, weights_only=True)
    torch.save(stored_values | {"num_object_springs": 3}, checkpoint)
    assert holds(check(folder), "error", "best_199.pth", "rebuilt", "(3)")
    checkpoint.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    assert holds(check(folder), "error", "best_199.pth", "weights_only")


def test_bad_results_are_reported(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    write_results(folder)
    prediction = tmp_path / "experiments" / folder.name / "inference.pkl"
    dump(tmp_path / "experiments_optimization" / folder.name / "optimal_params.pkl", {"object_radius": 10**400, "unknown": 1})
    rest = np.zeros((10, 58, 3))
    dump(prediction, rest)
    found = check(folder)
    assert holds(found, "error", "inference.pkl", "frame 0 must equal", "58 other nodes")
    assert holds(found, "warning", "inference.pkl", "float32")
    assert holds(found, "error", "optimal_params.pkl", "object_radius", "finite")
    assert holds(found, "error", "optimal_params.pkl", "drag_damping", "missing")
    assert holds(found, "warning", "optimal_params.pkl", "unknown")
    dump(prediction, rest[:, :5])
    assert holds(check(folder), "error", "inference.pkl", "(10, 58, 3)", "(10, 5, 3)")


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_deprojection_convention_is_told(tmp_path: Path, mirrored: bool) -> None:
    folder = write_case(tmp_path, points=40)
    write_raw_frame(folder, mirrored=mirrored)
    winner = "the mirrored W - c_x fits better" if mirrored else "the true c_x fits better"
    found = check(folder)
    assert holds(found, "note", "0.npz", winner, "0.000000 m"), render(found)


def test_bad_raw_files_are_reported(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    write_raw_frame(folder, mirrored=False)
    np.save(folder / "depth" / "0" / "0.npy", np.zeros((5, 5)))
    assert holds(check(folder), "error", "0.npy", "uint16", "float64")
    np.save(folder / "depth" / "0" / "0.npy", np.zeros((5, 5), np.uint16))
    assert holds(check(folder), "error", "0.npy", "WH")
    (folder / "cotracker" / "0.npz").write_bytes(b"PK\x03\x04 damaged")
    assert holds(check(folder), "error", "0.npz", "NumPy file")
