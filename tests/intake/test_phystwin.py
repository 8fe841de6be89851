"""The PhysTwin reader: observations of a valid case; every error names the file, the key and the position."""

import numpy as np
import pytest

from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.intake import phystwin
from tests.support.phystwin_case import edit, stored, write_case, write_json

ROW = ScenarioRow(scenario="thing", source="phystwin", category="toy", path="x", self_collision=True, ground=True)


def test_a_conforming_case(tmp_path):
    folder = write_case(tmp_path)
    write_json(folder / "metadata.json", {"fps": 15})
    data = stored(folder)
    observations = phystwin.read(ROW, folder)
    seen = observations.scenario
    assert (seen.frame_count, seen.train_end, seen.frame_rate, seen.up) == (10, 7, 15.0, "-z")
    assert seen.self_collision and seen.ground
    np.testing.assert_array_equal(observations.object_points, data["object_points"].astype(np.float32))
    np.testing.assert_array_equal(observations.object_motion_valid, data["object_motions_valid"])
    assert observations.nodes.shape == (40 + 12 + 6, 3)
    assert observations.surface_count == 52
    assert observations.tracks.shape == (10, 5, 3)
    assert np.isnan(observations.tracks).any()
    files = ("final_data.pkl", "split.json", "gt_track_3d.pkl", "metadata.json")
    assert observations.scenario.provenance == {name: f"sha256:{digest_file(folder / name)}" for name in files}


def test_controllers_whose_order_changes_from_frame_to_frame_are_refused(tmp_path):
    folder, rng = write_case(tmp_path), np.random.default_rng(0)
    edit(folder, controller_points=np.stack([rng.permutation(row) for row in stored(folder)["controller_points"]]))
    with pytest.raises(
        InputError, match=r"final_data.pkl: controller_points: each point must keep its index.*in frames 1 to 9; steps"
    ):
        phystwin.read(ROW, folder)


def test_optional_files(tmp_path):
    folder = write_case(tmp_path, surface=0, interior=0)
    for name in ("gt_track_3d.pkl", "metadata.json", "calibrate.pkl"):
        (folder / name).unlink()
    edit(folder, controller_mask=None, object_colors=None)
    observations = phystwin.read(ROW, folder)
    assert observations.tracks.shape == (10, 0, 3)
    assert observations.scenario.frame_rate == phystwin.RELEASED_FRAME_RATE
    assert len(observations.nodes) == 40


@pytest.mark.parametrize("fps", [0, -1, "30", True, float("nan"), 10**400])
def test_bad_frame_rates_are_refused(tmp_path, fps):
    folder = write_case(tmp_path)
    write_json(folder / "metadata.json", {"fps": fps})
    with pytest.raises(InputError, match=r"metadata\.json: fps"):
        phystwin.read(ROW, folder)


def test_the_table_of_released_cases():
    cases = phystwin.released_cases()
    assert len(cases) == 22
    assert sum(int(row["frames"]) for row in cases.values()) == 2423
    assert sum(int(row["frames"]) - int(row["train_end"]) for row in cases.values()) == 735
    assert all(int(row["train_end"]) == int(0.7 * int(row["frames"])) for row in cases.values())
    without = [name for name, row in cases.items() if not row["nodes"]]
    assert without == ["double_lift_sloth", "double_stretch_sloth", "single_lift_sloth"]
