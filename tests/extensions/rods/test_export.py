"""A rod in other tools: it hangs in MuJoCo as here, viewers show the center line, and no reader treats it as springs."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.extensions.exports.formats import mujoco as mujoco_format
from neuspring.extensions.exports.formats import newton, npz, ply, usd
from neuspring.extensions.exports.source import read_source
from neuspring.extensions.rods.export import _rest
from neuspring.extensions.rods.rod import Rod
from neuspring.twin.rollout import roll_out
from tests.extensions.exports.exported import described
from tests.extensions.rods import ropes
from tests.extensions.rods.ropes import rod_results

HANGING = 0.03
"""Tolerance of the sag: MuJoCo's edges are rigid bodies with distributed mass, ours have it at their ends; its clamps are soft.
Measured: 0.021; in Newton, of the largest motion, 0.007 to 0.018."""


def source_of(tmp_path, **options):
    return read_source(rod_results(tmp_path, **options) / "rod" / "0")


def hanging(tmp_path, frames=200, move=(0.0, 0.0, 0.0), **rod):
    """A cable that swings from a level plane down between its clamps, one of which moves, as a source with its motion."""
    seen = ropes.cable(frames=frames, sag=2.0, move=move)
    level = {name: getattr(seen, name)[..., [0, 2, 1]] + [0, 0, 1] for name in ("object_points", "controller_points")}
    seen = replace(seen, **level)
    start = {"bending": 0.002, "twisting": 0.002, "drag": 8.0, "stretching": 1e5} | rod
    twin = ropes.twin(seen, replace(ropes.SETTINGS, rod=replace(ropes.ROD, **start)))
    twin.save(tmp_path / "twin.npz")
    hands, positions = seen.controller_points, roll_out(twin, seen.controller_points).positions
    moved = {"positions": positions, "hands": hands, "holds": np.ones(hands.shape[:2], bool), "frames": np.arange(frames)}
    return replace(read_source(tmp_path / "twin.npz"), **moved)


@pytest.mark.parametrize("rest", ["straight", "first_frame"])
def test_a_cable_hangs_between_its_clamps_in_mujoco_as_here(tmp_path, rest):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (extra `export`)")
    source = hanging(tmp_path, rest=rest)
    ours = source.positions[-1]
    model = mujoco.MjModel.from_xml_string(mujoco_format.mjcf(source))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    sites = [model.site(f"node{n}").id for n in range(len(ours))]
    # Bodies have the unloaded lengths, which are those of frame 0 here.
    np.testing.assert_allclose(data.site_xpos[sites], source.twin.topology.nodes, atol=1e-6)
    model.dof_damping[6:] = np.maximum(model.dof_damping[6:], 3e-3)
    mujoco.mj_step(model, data, 12_000)
    assert np.abs(data.qvel).max() < 1e-2, "it hangs still"
    sag = 1.0 - ours[:, 2].min()
    assert sag > 0.01
    assert np.abs(data.site_xpos[sites] - ours).max() < HANGING * sag


def test_a_joint_without_moments_has_the_unloaded_curvatures():
    k = np.array([[0, 0], [0.3, -0.2], [0, 0.5], [0, 0]])
    turns = _rest(k)
    for (k1, k2), turn in zip(k[1:-1], turns, strict=True):
        before, after = np.eye(3), turn.as_matrix()
        binormal = 2 * np.cross(before[:, 0], after[:, 0]) / (1 + before[:, 0] @ after[:, 0])
        m1, m2 = before[:, 1] + after[:, 1], before[:, 2] + after[:, 2]
        np.testing.assert_allclose([binormal @ m2 / 2, -binormal @ m1 / 2], [k1, k2], atol=1e-12)


def test_a_rod_that_slips_is_only_exported_with_its_law(tmp_path):
    source = hanging(tmp_path, frames=5)
    twin = source.twin
    source = replace(source, twin=replace(twin, body=replace(twin.body, slip=np.array([[0.5, 0.1]]), slip_twist=0.7)))
    with pytest.raises(InputError, match=r"no branches that slip.*received 1.*npz.*fit\.rod\.slip = 0"):
        mujoco_format.mjcf(source)
    with pytest.raises(InputError, match="--to newton: the twin must be a lattice; received rod"):
        newton.write(source, range(2), tmp_path / "newton")
    npz.write(source, range(2), tmp_path / "out")
    said, arrays, _ = described(tmp_path / "out")
    assert said["version"] == 2
    assert arrays["rod_slip"].tolist() == [[0.5, 0.1]]
    assert said["settings"]["slip_twist"]["value"] == 0.7
    assert any("branch that slips" in law for law in said["equations"])


def test_a_rope_with_hands_loads_in_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (extra `export`)")
    source = source_of(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(mujoco_format.write(source, range(3), tmp_path / "out")[0]))
    assert (model.ntendon, model.nmocap) == (len(source.twin.topology.springs), 3)
    assert model.body_mass.sum() == pytest.approx(source.twin.body.mass.sum())
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, 20)
    assert np.isfinite(data.qpos).all()
    assert data.warning.number.sum() == 0


def test_arrays_are_described_and_the_format_says_that_it_is_a_rod(tmp_path):
    source = source_of(tmp_path)
    npz.write(source, [0, 1], tmp_path / "out")
    said, arrays, sizes = described(tmp_path / "out")
    assert (said["format"], said["version"]) == ("neuspring-rod", 1)
    assert {"stretching", "damping", "roll", "drag", "gravity"} <= said["settings"].keys()
    assert "mass" not in arrays
    for name in Rod.__dataclass_fields__:
        if f"rod_{name}" in arrays:
            assert np.array_equal(arrays[f"rod_{name}"], getattr(source.twin.body, name))
    assert sizes["V"] == 10 == sizes["E"] + 1


def test_a_viewer_sees_the_center_line_as_a_moving_curve(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (extra `export`)")
    from pxr import Usd, UsdGeom

    source = source_of(tmp_path, clamped=True)
    (path,) = usd.write(source, [0, 3, 5], tmp_path / "rod.usdc")
    stage = Usd.Stage.Open(str(path))
    line = UsdGeom.BasisCurves.Get(stage, "/Twin/Body")
    assert line.GetCurveVertexCountsAttr().Get() == [2] * 6
    assert line.GetPointsAttr().GetTimeSamples() == [0, 3, 5]
    points = np.array(line.GetPointsAttr().Get(5))
    np.testing.assert_allclose(points[4:9:2], source.positions[5], atol=1e-6)


def test_a_graph_file_has_the_line_and_its_mass(tmp_path):
    source = source_of(tmp_path)
    rod, edges, vertices = source.twin.body, ply.edges(source, 2), ply.vertices(source, 2)
    assert len(edges) == len(rod.lengths) + len(source.twin.topology.springs)
    np.testing.assert_allclose(vertices["mass"][-10:], rod.mass, rtol=1e-6)
    assert vertices["mass"].sum() == pytest.approx(rod.mass.sum(), rel=1e-6)
    assert np.abs(edges["strain"][: len(rod.lengths)]).max() < 0.05
