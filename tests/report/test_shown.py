"""The viewable content of a results folder, and errors for damaged or hostile folders."""

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.core.records import CAPTURE_FOLDER, Recorder, digest_file
from neuspring.data.capture import CAPTURE
from neuspring.report.shown import find
from tests.support import small
from tests.support.colored import paint
from tests.support.played import record, results, spoil


@pytest.fixture
def scenario(tmp_path):
    return results(tmp_path)


def test_a_scenarios_folder_shows_one_run_of_each_of_two_methods(scenario):
    found = find([scenario])
    assert [run.name for run in found.runs] == ["neuspring/0", "baseline/0"]
    assert found.shown == ("neuspring/0", "baseline/0")
    assert all(run.twin is not None and run.trajectory is not None and not run.notes for run in found.runs)


def test_named_runs_are_the_ones_that_are_there(scenario):
    assert find([scenario / "baseline" / "0"]).shown == ("baseline/0",)
    assert find([scenario / "baseline" / "0", scenario / "neuspring" / "0"]).shown == ("neuspring/0", "baseline/0")


def test_folders_that_cannot_be_shown_are_refused_with_the_next_move(scenario, tmp_path):
    for name in ("nothing_there", "."):
        with pytest.raises(InputError, match="Give results/<scenario>"):
            find([tmp_path / name])
    with pytest.raises(InputError, match="all runs must belong to one scenario"):
        find([scenario, results(tmp_path / "more")])


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        ('"format": 2', '"format": 1', "reads records of format 2"),
        ('"trajectory.npz"', '"../../../secret.npz"', "must be in the folder of their record"),
    ],
)
def test_a_record_of_another_format_or_of_a_file_elsewhere_is_not_followed(scenario, tmp_path, old, new, note):
    (tmp_path / "secret.npz").write_bytes(b"secret")
    spoil(scenario / "baseline" / "0" / "rollout.json", old, new)
    assert note in find([scenario]).runs[1].notes[0]


def test_an_incomplete_run_says_what_it_lacks(scenario):
    (scenario / "baseline" / "0" / "trajectory.npz").unlink()
    run = find([scenario / "baseline" / "0"]).runs[0]
    assert run.trajectory is None and "no such file" in run.notes[0] and run.twin is not None


def test_a_link_out_of_the_folder_is_not_followed(scenario, tmp_path):
    outside = tmp_path / "outside.npz"
    twin = scenario / "baseline" / "0" / "twin.npz"
    twin.rename(outside)
    twin.symlink_to(outside)
    run = find([scenario]).runs[1]
    assert "twin" not in run.paths and "must be inside" in run.notes[0]


def test_a_header_that_promises_more_than_the_file_and_a_pickle_are_refused_before_memory_is_taken(scenario):
    path = scenario / "neuspring" / "0" / "twin.npz"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**15,)})
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, header.getvalue() if name == "material.stiffness.npy" else content)
    record(path.parent)
    with pytest.raises(InputError, match=r"header of material\.stiffness must match"):
        _ = find([scenario]).runs[0].twin
    np.savez(path, meta=np.array([{"kind": "twin"}], dtype=object))
    record(path.parent)
    with pytest.raises(InputError, match="must be readable"):
        _ = find([scenario]).runs[0].twin


def test_a_capture_of_ones_own_is_found_where_its_record_says(scenario, tmp_path):
    own, seen = paint(tmp_path / "captures" / "mine", frames=5), small.observations()
    origin = {CAPTURE: f"sha256:{digest_file(own.folder / CAPTURE)}"}
    path = scenario / "observations.npz"
    replace(seen, scenario=replace(seen.scenario, provenance=origin)).save(path)
    Recorder("observe", path.with_suffix(".json")).save(facts={CAPTURE_FOLDER: str(own.folder)})
    found = find([scenario])
    assert found.capture.folder == own.folder and not found.notes
    spoil(own.folder / CAPTURE, '"name": ', ' "name": ')
    assert find([scenario]).capture is None
    assert "must be the capture of this run; received a changed capture" in find([scenario]).notes[0]
    (own.folder / CAPTURE).unlink()
    assert "no cameras: " in find([scenario]).notes[0]
