"""MuJoCo: its rollout of the exported model against ours, with the same time step, and where the two must differ."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from neuspring.export import mujoco as export
from neuspring.export.source import read_source
from tests.support import exported

mujoco = pytest.importorskip("mujoco", reason="mujoco-core is not installed (extra `export`)")

SWING, DRAG, GROUND, SOFT = 5e-7, 2e-5, 0.03, 0.01
"""m, over six frames of 60 steps: without drag; with a linear drag of 1.5 / s, whose steps are of first order in MuJoCo; on the
ground; how deep nodes sink into it. Measured: 3.3e-8, 5.7e-6 (1.9e-6 with 240 steps), 0.015 and 0.0052."""


def simulate(folder):
    """Positions [F, N, 3] by MuJoCo of what was exported, as the page says."""
    model = mujoco.MjModel.from_xml_path(str(folder / "twin.xml"))
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    arrays = np.load(folder / "arrays.npz")
    settings = json.loads((folder / "description.json").read_text())["settings"]
    substeps, hands = settings["substeps"]["value"], arrays["hands"].astype(float)
    frames = [arrays["nodes"]]
    for begin, end in itertools.pairwise(hands):
        for step in range(substeps):
            data.mocap_pos[:] = begin + (end - begin) * (step + 1) / substeps
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        frames.append(data.xpos[1 : 1 + len(arrays["nodes"])].copy())
    return np.stack(frames)


def rollouts(tmp_path, *, ground=False, frame_time=1 / 30, substeps=60, **material):
    twin = exported.stretched(exported.rope(ground=ground, frame_time=frame_time, substeps=substeps), 1.1)
    twin = replace(twin, material=replace(twin.material, **material))
    source = read_source(exported.run_folder(tmp_path, twin, with_splats=False))
    export.write(source, range(exported.FRAMES), tmp_path / "out")
    return source.positions, simulate(tmp_path / "out")


def difference(ours, theirs):
    """The largest difference of a coordinate, m."""
    return np.abs(ours - theirs).max()


def test_without_drag_and_ground_mujoco_swings_as_we_do(tmp_path):
    ours, theirs = rollouts(tmp_path, drag=0.0)
    assert difference(ours, theirs) < SWING
    assert np.abs(ours[-1] - ours[0]).max() > 0.05


def test_linear_drag_differs_by_the_time_step(tmp_path):
    coarse, fine = (np.abs(np.subtract(*rollouts(tmp_path / str(substeps), substeps=substeps))).max() for substeps in (60, 240))
    assert fine < coarse < DRAG and fine < coarse / 2


def test_the_ground_holds_but_bounces_differently(tmp_path):
    ours, theirs = rollouts(tmp_path, ground=True)
    assert ours[:, :, 2].min() < 0.005, "our rope reaches the ground"
    assert theirs[:, :, 2].min() > -SOFT
    assert difference(ours, theirs) < GROUND


def test_a_first_velocity_is_a_keyframe(tmp_path):
    source = read_source(exported.run_folder(tmp_path, with_splats=False))
    moving = replace(source, velocity=np.full(source.velocity.shape, 0.25))
    model = mujoco.MjModel.from_xml_string(export.mjcf(moving))
    assert np.allclose(model.key_qvel, 0.25) and not mujoco.MjModel.from_xml_string(export.mjcf(source)).nkey
