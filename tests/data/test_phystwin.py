"""The PhysTwin reader: what a conforming case becomes, and that every refusal names the file, the key and the place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data import phystwin
from tests.support.phystwin_case import dump, edit, stored, write_case, write_json

ROW = ScenarioRow(scenario="thing", source="phystwin", category="toy", path="x", self_collision=True, ground=True)


def test_a_conforming_case(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    data = stored(folder)
    observations = phystwin.read(ROW, folder)
    assert (
        observations.scenario.frame_count,
        observations.scenario.train_end,
        observations.scenario.frame_rate,
        observations.scenario.up,
    ) == (10, 7, 30.0, "-z")
    assert observations.scenario.self_collision
    assert observations.scenario.ground
    np.testing.assert_array_equal(observations.object_points, data["object_points"].astype(np.float32))
    np.testing.assert_array_equal(observations.object_motion_valid, data["object_motions_valid"])
    assert observations.nodes.shape == (40 + 12 + 6, 3)
    assert observations.surface_count == 52
    assert observations.tracks.shape == (10, 5, 3)
    assert np.isnan(observations.tracks).any()
    files = ("final_data.pkl", "split.json", "gt_track_3d.pkl", "metadata.json")
    assert observations.scenario.provenance == {name: f"sha256:{digest_file(folder / name)}" for name in files}


def test_optional_files(tmp_path: Path) -> None:
    folder = write_case(tmp_path, surface=0, interior=0)
    for name in ("gt_track_3d.pkl", "metadata.json", "calibrate.pkl"):
        (folder / name).unlink()
    edit(folder, controller_mask=None, object_colors=None)
    observations = phystwin.read(ROW, folder)
    assert observations.tracks.shape == (10, 0, 3)
    assert observations.scenario.frame_rate == phystwin.RELEASED_FRAME_RATE
    assert len(observations.nodes) == 40


def test_frame_rate_comes_from_the_metadata(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "metadata.json", {"fps": 15})
    assert phystwin.read(ROW, folder).scenario.frame_rate == 15.0


def test_a_frame_without_a_visible_point_is_readable(tmp_path: Path) -> None:
    folder = write_case(tmp_path)
    data = stored(folder)
    data["object_visibilities"][4] = False
    data["object_motions_valid"][3:5] = False
    data["object_points"][4] = 0
    edit(folder, **data)
    assert not phystwin.read(ROW, folder).object_visibility[4].any()


def changed(key: str, index: Any, value: Any) -> Callable[[dict[str, np.ndarray]], np.ndarray]:
    """A change of some entries of one array."""

    def change(data: dict[str, np.ndarray]) -> np.ndarray:
        result = data[key].copy()
        result[index] = value
        return result

    return change


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("object_points", changed("object_points", (3, 17, 1), np.nan), r"object_points.*finite.*nan at frame 3, point 17"),
        ("object_points", changed("object_points", (0, 2, 0), np.inf), r"object_points.*inf at frame 0, point 2"),
        ("controller_points", changed("controller_points", (5, 4, 2), -np.inf), r"controller_points.*-inf at frame 5, point 4"),
        ("surface_points", changed("surface_points", (3, 0), np.nan), r"surface_points.*nan at point 3"),
        ("object_points", lambda d: d["object_points"][..., :2], r"object_points.*3 entries along axis 2"),
        ("object_points", lambda d: d["object_points"][0], r"object_points.*shape must be \[T, No, 3\]"),
        ("controller_points", lambda d: d["controller_points"][:-1], r"controller_points.*10 entries along axis 0"),
        ("object_visibilities", lambda d: d["object_visibilities"].astype(np.uint8), r"object_visibilities.*dtype.*bool.*uint8"),
        ("object_points", lambda d: d["object_points"].astype(int), r"object_points.*dtype must be floating"),
        ("object_points", lambda d: d["object_points"].tolist(), r"object_points.*array .* is required; received list"),
        ("controller_points", lambda d: d["controller_points"][:, :0], r"controller_points.*at least one controller"),
        ("object_visibilities", changed("object_visibilities", (0, 5), False), r"object_visibilities.*frame 0.*point 5"),
        ("interior_points", lambda _: None, r"interior_points: this key is missing"),
        ("object_motions_valid", lambda _: None, r"object_motions_valid: this key is missing"),
    ],
)
def test_bad_arrays_are_refused(tmp_path: Path, key: str, change: Callable[[Any], Any], message: str) -> None:
    folder = write_case(tmp_path)
    edit(folder, **{key: change(stored(folder))})
    with pytest.raises(InputError, match=rf"final_data\.pkl: {message}"):
        phystwin.read(ROW, folder)


@pytest.mark.parametrize(
    ("split", "message"),
    [
        ({"train": [0, 11], "test": [7, 10]}, r"train: .*10 frames.*\[0, 11\]"),
        ({"train": [0, 7], "test": [7, 12]}, r"test: .*10 frames.*\[7, 12\]"),
        ({"train": [-1, 7], "test": [7, 10]}, r"train: .*\[-1, 7\]"),
        ({"train": [0, 1], "test": [1, 10]}, r"train: at least one frame after frame 0"),
        ({"train": [0, 7.0], "test": [7, 10]}, r"train: two whole numbers"),
        ({"test": [7, 10]}, r"train: two whole numbers.*nothing"),
        ([0, 7], r"a JSON object.*list"),
    ],
)
def test_bad_splits_are_refused(tmp_path: Path, split: Any, message: str) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "split.json", split)
    with pytest.raises(InputError, match=rf"split\.json: {message}"):
        phystwin.read(ROW, folder)


@pytest.mark.parametrize(
    ("tracks", "message"),
    [
        (np.zeros((9, 5, 3)), "has 10 frames"),
        (np.zeros((10, 5, 2)), r"\[T, K, 3\]"),
        (np.zeros((10, 5, 3), int), "floating point"),
        (np.full((10, 5, 3), np.inf), "inf at frame 0, point 0"),
        ([1, 2], "list"),
    ],
)
def test_bad_tracks_are_refused(tmp_path: Path, tracks: Any, message: str) -> None:
    folder = write_case(tmp_path)
    dump(folder / "gt_track_3d.pkl", tracks)
    with pytest.raises(InputError, match=rf"gt_track_3d\.pkl: .*{message}"):
        phystwin.read(ROW, folder)


@pytest.mark.parametrize("fps", [0, -1, "30", True, float("nan"), 10**400])
def test_bad_frame_rates_are_refused(tmp_path: Path, fps: Any) -> None:
    folder = write_case(tmp_path)
    write_json(folder / "metadata.json", {"fps": fps})
    with pytest.raises(InputError, match=r"metadata\.json: fps"):
        phystwin.read(ROW, folder)


@pytest.mark.parametrize("name", ["final_data.pkl", "split.json"])
def test_missing_and_damaged_files_are_named(tmp_path: Path, name: str) -> None:
    folder = write_case(tmp_path)
    (folder / name).write_bytes((folder / name).read_bytes()[:10])
    with pytest.raises(InputError, match=name):
        phystwin.read(ROW, folder)
    (folder / name).unlink()
    with pytest.raises(InputError, match=rf"{name}.*readable.*No such file"):
        phystwin.read(ROW, folder)
