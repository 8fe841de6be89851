"""Exportable runs, and the errors for all others."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.artifacts import Trajectory
from neuspring.core.errors import InputError
from neuspring.core.records import Recorder, StageRecord
from neuspring.extensions.exports.source import chosen_frames, read_source
from tests.extensions.exports import exported


@pytest.fixture
def folder(tmp_path):
    return exported.run_folder(tmp_path / "results")


def test_a_run_has_its_motion_hands_and_splats(folder):
    source = read_source(folder)
    assert source.name == "scene_neuspring_0"
    assert source.positions.shape == (exported.FRAMES, exported.NODES, 3)
    assert np.array_equal(source.positions, Trajectory.load(folder / "trajectory.npz").positions)
    assert source.hands.shape == (exported.FRAMES, 1, 3) and source.holds.all()
    moved = dict(source.moved_splats([0, 3]))
    assert sorted(moved) == [0, 3] and source.splats is not None
    shift = np.linalg.norm(moved[3].means.mean(0) - moved[0].means.mean(0))
    assert shift == pytest.approx(np.linalg.norm((source.positions[3] - source.positions[0]).mean(0)), rel=0.5)


def test_the_twin_may_be_of_another_folder_of_the_scenario(folder):
    """Methods with the same fit share it; the run's record names it by digest."""
    shared = folder.parents[1] / "owner" / "0"
    shared.mkdir(parents=True)
    for name in ("fit.json", "twin.npz"):
        (folder / name).rename(shared / name)
    assert len(read_source(folder).positions) == exported.FRAMES


def test_a_twin_alone_is_known_in_frame_0(folder, tmp_path):
    (folder / "rollout.json").unlink()
    for path in (folder, folder / "twin.npz"):
        source = read_source(path)
        assert source.positions.shape[0] == 1 and source.splats is None
        with pytest.raises(InputError, match=r"splats are required.*appearance/<seed>/splats.ply"):
            source.moved_splats([0])


TOTAL = 0.35
"""kg."""


def weighed(mass=TOTAL):
    """A change of observations: their capture says the mass."""
    return lambda seen: replace(seen, scenario=replace(seen.scenario, mass=mass))


@pytest.mark.parametrize(("known", "given"), [(TOTAL, []), (None, ["--mass", str(TOTAL)]), (5.0, ["--mass", str(TOTAL)])])
def test_every_format_holds_the_mass_of_the_capture_or_the_given_one(tmp_path, capsys, known, given):
    """Options have priority over the capture."""
    mujoco = pytest.importorskip("mujoco", reason="mujoco-core is not installed (extra `export`)")
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (extra `export`)")
    folder, out = exported.run_folder(tmp_path / "results", with_splats=False, change=weighed(known)), tmp_path / "out"
    for to, output in (("npz", "plain"), ("mujoco", "mujoco"), ("usd", "twin.usda")):
        assert main(["export", str(folder), "--to", to, "--output", str(out / output), *given]) == 0
    assert capsys.readouterr().out.count("Mass: 0.35 kg in all\nNext: ") == 3
    described, arrays, _ = exported.described(out / "plain")
    assert described["mass"]["value"] == pytest.approx(TOTAL, rel=1e-6)
    stage = usd.Stage.Open(str(out / "twin.usda"))
    stored = stage.GetPrimAtPath("/Twin/Nodes").GetAttribute("primvars:mass").Get()
    for masses in (arrays["mass"], mujoco.MjModel.from_xml_path(str(out / "mujoco" / "twin.xml")).body_mass, np.array(stored)):
        assert masses.sum(dtype=float) == pytest.approx(TOTAL, rel=1e-6)
    stiffness = exported.rope().material.stiffness
    factor = TOTAL / exported.rope().material.mass.sum(dtype=float)
    np.testing.assert_allclose(arrays["stiffness"], stiffness * factor, rtol=1e-6)


@pytest.mark.parametrize("mass", ["0", "-1", "nan", "inf"])
def test_a_mass_that_is_none_is_refused(folder, tmp_path, capsys, mass):
    assert main(["export", str(folder), "--to", "npz", f"--mass={mass}", "--output", str(tmp_path / "out")]) == 2
    assert "--mass: must be a positive number of kg" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "frames"), [(None, list(range(7))), ("2", [2]), ("1:4", [1, 2, 3]), ("0:7:3", [0, 3, 6])], ids=str
)
def test_frames(folder, words, frames):
    assert chosen_frames(words, read_source(folder), "") == frames


@pytest.mark.parametrize("words", ["7", "0:8", "3:3", "4:2", "0:5:0", "-1", "a", "", "1:2:3:4"])
def test_frames_that_are_not_there(folder, words):
    with pytest.raises(InputError, match="frames of 0 to 6"):
        chosen_frames(words, read_source(folder), "")


def diverged(folder):
    rollout = folder / "rollout.json"
    trajectory = Trajectory.load(folder / "trajectory.npz")
    short = replace(trajectory, positions=trajectory.positions[:3], diverged_frame=3, reason="node 1 left the scene in frame 3")
    short.save(folder / "trajectory.npz")
    old = StageRecord.load(rollout)
    record = Recorder("rollout", rollout)
    record.inputs = old.inputs
    record.save({"trajectory": folder / "trajectory.npz"}, failure="rollout: diverged")


def failed_fit(folder):
    Recorder("fit", folder / "fit.json").save(failure="all candidates diverged")
    (folder / "rollout.json").unlink()


def baseline(folder):
    Recorder("train", folder / "train.json").save()
    for name in ("fit.json", "rollout.json"):
        (folder / name).unlink()


def older(folder):
    values = json.loads((folder / "rollout.json").read_text())
    (folder / "rollout.json").write_text(json.dumps(values | {"format": 0}))


def other_observations(folder):
    with (folder.parents[1] / "observations.npz").open("ab") as stream:
        stream.write(b"more")


BROKEN = {
    "no folder": (shutil.rmtree, "no such file or folder"),
    "empty folder": (
        lambda folder: [path.unlink() for path in folder.iterdir()],
        "must be the run of a method that fits a twin; received none",
    ),
    "no twin": (lambda folder: (folder / "twin.npz").unlink(), "Delete .*fit.json and rerun the command"),
    "no record of the twin": (lambda folder: (folder / "fit.json").unlink(), "the record of its model must be in"),
    "no observations": (
        lambda folder: (folder.parents[1] / "observations.npz").unlink(),
        "the observations of the run must exist",
    ),
    "other observations": (other_observations, "Rerun the workflow"),
    "diverged": (diverged, "diverged: node 1 left.*name .*twin.npz"),
    "failed": (failed_fit, "a failure: all candidates diverged"),
    "baseline": (baseline, "a baseline's model"),
    "older": (older, "this version reads records of format"),
    "not a twin": (
        lambda folder: shutil.copy(folder / "trajectory.npz", folder / "twin.npz"),
        "Delete .*fit.json and rerun the command",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_cannot_be_exported(folder, kind):
    spoil, message = BROKEN[kind]
    spoil(folder)
    with pytest.raises(InputError, match=message):
        read_source(folder)


def test_without_output_no_format_writes_over_another(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for to, frames in (("npz", "2"), ("newton", "0:3"), ("mujoco", "0:4")):
        assert main(["export", str(folder), "--to", to, "--frames", frames]) == 0
    counts = {path.parent.name: len(np.load(path)["frame"]) for path in (tmp_path / "export").rglob("arrays.npz")}
    assert counts == {"scene_neuspring_0_npz": 1, "scene_neuspring_0_newton": 3, "scene_neuspring_0_mujoco": 4}
