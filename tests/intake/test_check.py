"""check-data on cases, C3D files and folders: what the readers refuse, with file and key."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.findings import broken, note
from neuspring.intake import check, phystwin_raw
from neuspring.intake.check import Layout, check_layout, render
from neuspring.registry import Registry
from tests.support.c3d_files import write_c3d
from tests.support.filmed import film, write_raw
from tests.support.findings import holds, of_level, serious
from tests.support.phystwin_case import dump, stored, write_case, write_json

K = [[60.0, 0.0, 30.0], [0.0, 60.0, 20.0], [0.0, 0.0, 1.0]]


def put(key, index, value):
    def change(data):
        data[key][index] = value
        return data

    return change


def trust_hidden(data):
    frame, point = np.argwhere(~data["object_visibilities"])[0]
    data["object_motions_valid"][frame - 1, point] = True
    return data


def of_data(change):
    return lambda folder: dump(folder / "final_data.pkl", change(stored(folder)))


def of_json(name, value):
    return lambda folder: write_json(folder / name, value)


def of_pickle(name, value):
    return lambda folder: dump(folder / name, value)


FAULTS = [
    (of_data(put("object_points", (3, 0, 0), np.nan)), "final_data.pkl", "object_points: every coordinate must be finite"),
    (of_data(put("object_visibilities", (0, 5), False)), "final_data.pkl", "visible in frame 0.* received 1"),
    (of_data(trust_hidden), "final_data.pkl", "if its point is visible.* received 1"),
    (of_data(put("object_points", (slice(None), slice(None), 2), 0.1)), "final_data.pkl", "up is -z.* received 0.1"),
    (
        of_data(lambda d: d | {"controller_points": d["controller_points"][:, :0]}),
        "final_data.pkl",
        "controller point is required; received none",
    ),
    (of_data(lambda d: d | {"surface_points": d["surface_points"][:, :2]}), "final_data.pkl", "surface_points"),
    (of_data(lambda d: d | {"object_motions_valid": d["object_motions_valid"][1:]}), "final_data.pkl", "object_motions_valid"),
    (of_data(lambda d: d | {"interior_points": "text"}), "final_data.pkl", "received str"),
    (of_data(lambda d: {k: v for k, v in d.items() if k != "controller_points"}), "final_data.pkl", "this key is missing"),
    (of_data(lambda d: d | {"object_visibilities": d["object_visibilities"].astype(int)}), "final_data.pkl", "a bool array"),
    (of_data(lambda _: [1, 2]), "final_data.pkl", "dict of arrays"),
    (of_json("split.json", {"train": [0, 7], "test": [7, 11]}), "split.json", "test: whole numbers"),
    (of_json("split.json", {"train": [0, 1], "test": [1, 10]}), "split.json", "train: whole numbers"),
    (of_pickle("calibrate.pkl", [np.eye(4)] * 2), "calibrate.pkl", "a list of 3"),
    (of_pickle("calibrate.pkl", [np.eye(4)] * 2 + [np.diag([1.0, 1.0, 2.0, 1.0])]), "calibrate.pkl", "camera 2: .*rotation"),
    (of_json("metadata.json", {"intrinsics": [K] * 3, "WH": [64], "frame_num": 10, "fps": 30}), "metadata.json", "WH"),
    (of_json("metadata.json", {"intrinsics": [K] * 3, "WH": [64, 48], "frame_num": 10, "fps": -1}), "metadata.json", "fps"),
    (of_pickle("gt_track_3d.pkl", np.zeros((10, 5, 2))), "gt_track_3d.pkl", r"\[10, K, 3\]"),
    (of_pickle("gt_track_3d.pkl", np.full((10, 5, 3), np.inf)), "gt_track_3d.pkl", "NaN where unseen"),
    (lambda folder: (folder / "calibrate.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR."), "calibrate.pkl", "global os.system"),
]


@pytest.mark.parametrize(("damage", "file", "words"), FAULTS, ids=[f"{k}-{f[1]}" for k, f in enumerate(FAULTS)])
def test_what_a_reader_refuses_is_an_error_with_file_and_key(tmp_path, damage, file, words):
    folder = write_case(tmp_path)
    damage(folder)
    (found,) = of_level(check_layout(folder), "error")
    assert found.startswith(f"{file}: ") and re.search(words, found)


def test_a_conforming_case_has_only_notes_and_optional_files_may_be_missing(tmp_path):
    folder = write_case(tmp_path)
    assert serious(check_layout(folder)) == [] and render(check_layout(folder)).endswith("0 errors, 0 warnings")
    for name in ("gt_track_3d.pkl", "calibrate.pkl", "metadata.json"):
        (folder / name).unlink()
    assert serious(check_layout(folder)) == []


RAW_FAULTS = {
    "mask/mask_info_1.json": ({"0": "toy", "1": "Hand"}, "exactly one detection, the object,"),
    "mask/mask_info_0.json": ({"cam_idx": 0}, "Name these folders: 0, 1"),
    "metadata.json": ({"intrinsics": [K] * 2, "frame_num": 2, "fps": 15}, "WH: two positive"),
    "split.json": ({"train": [0, 1]}, "train: whole numbers"),
    "depth/1/0.npy": (np.zeros((90, 160), np.float32), "depth must be 16-bit counts; received float32"),
}


@pytest.mark.parametrize("file", [None, *RAW_FAULTS])
def test_a_raw_case_of_two_cameras_is_checked_by_the_reader_of_its_capture(tmp_path, file):
    case = write_raw(film(tmp_path / "capture", cameras=2, up="-z"), tmp_path / "case")
    if file is None:
        assert render(check_layout(case)) == "0 errors, 0 warnings"
        return
    value, words = RAW_FAULTS[file]
    np.save(case / file, value) if file.endswith("npy") else write_json(case / file, value)
    (found,) = of_level(check_layout(case), "error")
    with pytest.raises(InputError) as error:
        phystwin_raw.convert("a", "toy", case, tmp_path / "converted")
    assert words in found and found.partition(": ")[2] == str(error.value).partition(": ")[2]
    assert not (tmp_path / "converted").exists()


def test_a_case_a_folder_of_cases_and_a_root(tmp_path):
    first, second = write_case(tmp_path, "a"), write_case(tmp_path, "b", frames=20)
    (second / "final_data.pkl").unlink()
    assert of_level(check_layout(first), "error") == []
    for folder in (first.parent, tmp_path):
        assert [d.where for d in check_layout(folder) if d.level == "error"] == [str(second / "final_data.pkl")]


def test_folders_without_data_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such path"):
        check_layout(tmp_path / "absent")
    with pytest.raises(InputError, match=r"final_data\.pkl"):
        check_layout(tmp_path)
    (tmp_path / "data" / "different_types").mkdir(parents=True)
    with pytest.raises(InputError, match="at least one case"):
        check_layout(tmp_path)


def test_a_package_adds_a_layout(tmp_path, monkeypatch):
    mine = Layout(lambda path: path.suffix == ".mine", lambda path, config: [note(path, f"read with {config.data_root}")])
    monkeypatch.setattr(check, "LAYOUTS", Registry("layouts", {"mine": mine}, Layout))
    (tmp_path / "a.mine").write_text("")
    assert [one.text for one in check_layout(tmp_path / "a.mine")] == [f"read with {Config().data_root}"]


def test_markers_of_c3d_files_one_by_one_with_labels_and_as_a_folder(tmp_path):
    rest = np.array([[0.0, 0, 0], [300, 0, 0], [300, 200, 0], [0, 200, 100]])
    way = rest + 50 * np.sin(np.arange(60) / 5)[:, None, None]
    way[30, 1] += 400
    lost = np.zeros((60, 4), bool)
    lost[50:, 2] = True
    path = write_c3d(tmp_path / "take.c3d", way, ["base", "tip - 1", "tip - 2", "elbow"], rate=100.0, lost=lost)
    found = check_layout(path)
    assert holds(found, "note", "take.c3d", "60 frames of 100 Hz, within ", "base, tip - 1, tip - 2, elbow; lost: tip - 2 in 10")
    assert holds(found, "warning", "take.c3d", "point 1 in frame 30", "select other markers: FILE.c3d#LABEL")
    assert [one.text for one in check_layout(tmp_path)] == [one.text for one in found]
    (alone,) = check_layout(Path(f"{path}#base,elbow"))
    assert "of 2 markers: base, elbow; lost: none" in alone.text
    assert holds(check_layout(Path(f"{path}#hand")), "error", "take.c3d#hand", "Labels: base")


def test_render_groups_by_file():
    one, two = Path("b.pkl"), Path("a.pkl")
    text = render([broken(one, "", "x"), note(two, "y"), replace(note(one, "z"), level="warning")])
    assert text == "a.pkl\n  note     y\nb.pkl\n  error    x\n  warning  z\n1 error, 1 warning"
    assert render([]) == "0 errors, 0 warnings"
