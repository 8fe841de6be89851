"""USD, read back by pxr bit for bit, and by Newton."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.cli.main import main
from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.extensions.exports.formats import usd
from neuspring.extensions.exports.source import read_source
from tests.extensions.exports import exported

REASON = "usd-core is not installed (extra `export`)"
Gf, Usd, UsdGeom, UsdVol = (pytest.importorskip(f"pxr.{name}", reason=REASON) for name in ("Gf", "Usd", "UsdGeom", "UsdVol"))


@pytest.mark.parametrize("suffix", usd.SUFFIXES)
def test_pxr_reads_positions_as_they_are(tmp_path, suffix):
    folder = exported.run_folder(tmp_path)
    path = tmp_path / f"twin{suffix}"
    assert main(["export", str(folder), "--to", "usd", "--output", str(path)]) == 0
    stage, source, twin = Usd.Stage.Open(str(path)), read_source(folder), Twin.load(folder / "twin.npz")
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(30) and stage.GetEndTimeCode() == exported.FRAMES - 1
    assert stage.GetDefaultPrim().GetPath() == usd.ROOT_PRIM
    nodes, springs = UsdGeom.Points.Get(stage, "/Twin/Nodes"), UsdGeom.BasisCurves.Get(stage, "/Twin/Springs")
    splats = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/Twin/Splats")
    stand_in = UsdGeom.Points.Get(stage, "/Twin/SplatPoints")
    moved = dict(source.moved_splats(range(exported.FRAMES)))
    for frame in range(exported.FRAMES):
        assert np.array_equal(nodes.GetPointsAttr().Get(frame), source.positions[frame])
        both = np.concatenate([source.positions[frame], source.hands[frame]])
        assert np.array_equal(np.array(springs.GetPointsAttr().Get(frame)).reshape(-1, 2, 3), both[twin.topology.springs])
        assert np.array_equal(splats.GetPositionsAttr().Get(frame), moved[frame].means)
        assert np.array_equal(stand_in.GetPointsAttr().Get(frame), moved[frame].means)
        shades = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(frame)).reshape(moved[0].harmonics.shape)
        assert np.array_equal(shades, moved[frame].harmonics)
    ours = moved[3].quaternions / np.linalg.norm(moved[3].quaternions, axis=1, keepdims=True)
    theirs = np.array([[turn.GetReal(), *turn.GetImaginary()] for turn in splats.GetOrientationsAttr().Get(3)])
    assert np.abs(ours - theirs).max() < 1e-6
    assert np.allclose(splats.GetScalesAttr().Get(), np.exp(moved[0].log_scales), rtol=1e-6)
    coefficients = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(moved[0].harmonics.shape)
    assert np.array_equal(coefficients, moved[0].harmonics) and splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    primvars = UsdGeom.PrimvarsAPI(springs)
    assert np.array_equal(primvars.GetPrimvar("stiffness").Get(), twin.material.stiffness)
    assert primvars.GetPrimvar("stiffness").GetInterpolation() == "uniform"
    assert UsdGeom.Imageable(splats).GetPurposeAttr().Get() == "render" and len(splats.GetOpacitiesAttr().Get()) == len(ours)


@pytest.fixture
def stage(tmp_path):
    """All frames of the rope with its splats, and the source."""
    source = read_source(exported.run_folder(tmp_path))
    usd.write(source, range(exported.FRAMES), tmp_path / "twin.usdc")
    return Usd.Stage.Open(str(tmp_path / "twin.usdc")), source


def test_bounds_hold_what_is_drawn_in_every_frame_and_no_more(stage):
    """Down to 1 / 255 of an opaque splat, in many directions, and half a width around points."""
    layer, source = stage
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for frame, splats in source.moved_splats(range(exported.FRAMES)):
        bounds = UsdGeom.BBoxCache(frame, [UsdGeom.Tokens.default_, UsdGeom.Tokens.render])
        turns = Rotation.from_quat(splats.quaternions, scalar_first=True)
        scales = np.exp(splats.log_scales) * np.sqrt(2 * np.log(255))
        shells = [turn.apply(directions * size) for turn, size in zip(turns, scales, strict=True)] + splats.means[:, None]
        width = UsdGeom.Points.Get(layer, "/Twin/Nodes").GetWidthsAttr().Get()[0] / 2
        nodes = source.positions[frame]
        for name, points in {"Splats": shells.reshape(-1, 3), "Nodes": np.concatenate([nodes - width, nodes + width])}.items():
            box = bounds.ComputeWorldBound(layer.GetPrimAtPath(f"/Twin/{name}")).ComputeAlignedRange()
            np.testing.assert_allclose([box.GetMin(), box.GetMax()], [points.min(axis=0), points.max(axis=0)], atol=5e-4)


def test_newton_reads_the_splats_of_frame_0_where_no_time_is_asked_for(stage):
    newton = pytest.importorskip("newton", reason="newton is not installed (extra `synthetic`)")
    layer, source = stage
    first = dict(source.moved_splats([0]))[0]
    read = newton.Gaussian.create_from_usd(layer.GetPrimAtPath("/Twin/Splats"))
    assert np.array_equal(read.positions, first.means)
    np.testing.assert_allclose(read.scales, np.exp(first.log_scales), rtol=1e-6)
    for prim in layer.Traverse():
        sampled = [attribute for attribute in prim.GetAttributes() if attribute.GetNumTimeSamples()]
        assert all(attribute.Get() == attribute.Get(0) for attribute in sampled)


def test_up_is_up_and_another_suffix_is_refused(tmp_path):
    source = read_source(exported.run_folder(tmp_path, exported.rope(up="-z", ground=False), with_splats=False))
    usd.write(source, [0, 2], tmp_path / "twin.usda")
    stage = Usd.Stage.Open(str(tmp_path / "twin.usda"))
    assert stage.GetTimeCodesPerSecond() == pytest.approx(30) and stage.GetEndTimeCode() == pytest.approx(2)
    assert not stage.GetPrimAtPath("/Twin/Splats")
    matrix = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    assert Gf.IsClose(matrix.TransformDir(Gf.Vec3d(0, 0, -1)), Gf.Vec3d(0, 0, 1), 1e-6)
    with pytest.raises(InputError, match="--output: must end"):
        usd.write(source, [0], tmp_path / "twin.fbx")
