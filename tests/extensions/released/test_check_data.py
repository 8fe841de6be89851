"""check-data: the layout and checks 1 to 4 against the release, on a case with released results."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuspring.intake.check import check_layout as check
from tests.support.findings import holds, of_level, serious
from tests.support.phystwin_case import dump, write_case, write_json, write_raw_frame, write_results


def test_a_conforming_case_has_only_notes_and_names_what_was_skipped(tmp_path: Path) -> None:
    findings = check(write_case(tmp_path))
    assert serious(findings) == []
    for number in (1, 2, 3, 4):
        assert any(f"check {number} skipped" in text for text in of_level(findings, "note"))


def test_a_refused_case_is_reported_once_and_skips_the_checks(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "split.json", {"train": [0, 70], "test": [7, 10]})
    findings = check(folder)
    assert len(of_level(findings, "error")) == 1
    assert any("conformance checks 1 to 4 skipped" in text for text in of_level(findings, "note"))


def test_a_case_outside_a_root_has_no_results(tmp_path: Path) -> None:
    folder = write_case(tmp_path, "a")
    (tmp_path / "elsewhere").mkdir()
    folder.rename(tmp_path / "elsewhere" / "a")
    assert any("no experiments folder" in text for text in of_level(check(tmp_path / "elsewhere"), "note"))


def test_sizes_of_a_released_case_are_compared(tmp_path: Path) -> None:
    findings = check(write_case(tmp_path, "single_push_rope_4"))
    for column, expected in (("frames", 83), ("train_end", 58), ("object_points", 839), ("nodes", 855)):
        assert holds(findings, "error", "final_data.pkl", column, str(expected))


def test_released_results_of_several_cases(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_results(write_case(tmp_path, name))
    findings = check(tmp_path)
    assert serious(findings) == []
    assert holds(findings, "note", "best_199.pth", "object springs", "as the released", "against the checkpoint")
    assert holds(findings, "note", "inference.pkl", "future chamfer")
    # The prediction moves rigidly with the observed points, so tracks are met to float32 rounding.
    assert holds(findings, "note", "inference.pkl", "future track_error: 0.000000 m, over 3 frames")
    words = ("future chamfer", "scenario-weighted over 2 scenarios", "published 0.0115793 over 22")
    assert holds(findings, "note", tmp_path.name, *words)
    assert holds(findings, "note", tmp_path.name, "future track_error", "published 0.0220186 over 22")


def test_bad_results_are_reported(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    write_results(folder)
    prediction = tmp_path / "experiments" / folder.name / "inference.pkl"
    dump(tmp_path / "experiments_optimization" / folder.name / "optimal_params.pkl", {"object_radius": 10**400, "unknown": 1})
    rest = np.zeros((10, 58, 3))
    dump(prediction, rest)
    findings = check(folder)
    assert holds(findings, "error", "inference.pkl", "frame 0 must equal", "other nodes in frame 0: 58")
    assert holds(findings, "warning", "inference.pkl", "float32")
    assert holds(findings, "error", "optimal_params.pkl", "object_radius", "finite")
    assert holds(findings, "error", "optimal_params.pkl", "drag_damping", "missing")
    assert holds(findings, "warning", "optimal_params.pkl", "unknown")
    dump(prediction, rest[:, :5])
    assert holds(check(folder), "error", "inference.pkl", "(10, 58, 3)", "(10, 5, 3)")


def test_bad_raw_files_are_reported(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    write_raw_frame(folder, mirrored=False)
    np.save(folder / "depth" / "0" / "0.npy", np.zeros((48, 64)))
    assert holds(check(folder), "error", "0.npy", "uint16", "float64")
    np.save(folder / "depth" / "0" / "0.npy", np.zeros((5, 5), np.uint16))
    assert holds(check(folder), "error", "0.npy", "camera 0 has images of 64 x 48", "5 x 5")
    (folder / "cotracker" / "0.npz").write_bytes(b"PK\x03\x04 damaged")
    assert holds(check(folder), "error", "0.npz", "NumPy file")
