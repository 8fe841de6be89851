"""Files of viewers, read back: SPZ by a reader of its own, written from the format's description, within its quantization; PLY by
plyfile and USD by pxr, bit for bit."""

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.export import spz, usd
from neuspring.export.source import read_source
from neuspring.splats.model import Splats
from tests.support import exported

POSITION, SCALE, OPACITY, COLOR, HARMONIC, ANGLE = 2**-17, 1 / 32, 0.5 / 255, 0.5 / (255 * 0.15), 0.5 / 128, 0.35
"""Half steps of m, log m, opacity and coefficients; degrees of orientation. Coefficients of +1 do not fit and become 127 / 128."""


def decoded(content):
    """Splats of a file, in the axes that our PLY has. One splat and one value at a time, unlike the writer."""
    data = gzip.decompress(content)
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, flags, reserved) == (0x5053474E, 3, 0, 0)
    assert len(data) == 16 + count * (9 + 1 + 3 + 3 + 4 + 3 * ((degree + 1) ** 2 - 1))
    sizes = np.cumsum([16, 9 * count, count, 3 * count, 3 * count, 4 * count])
    at = dict(zip(("means", "opacity", "color", "scale", "turn", "rest"), map(int, sizes), strict=True))
    means = [int.from_bytes(data[at["means"] + 3 * k :][:3], "little", signed=True) / 2**bits for k in range(3 * count)]
    opacities = [data[at["opacity"] + k] / 255 for k in range(count)]
    colors = [(data[at["color"] + k] / 255 - 0.5) / 0.15 for k in range(3 * count)]
    scales = [data[at["scale"] + k] / 16 - 10 for k in range(3 * count)]
    rest = [data[at["rest"] + k] / 128 - 1 for k in range(3 * count * ((degree + 1) ** 2 - 1))]
    turns = []
    for k in range(count):
        (word,) = struct.unpack_from("<I", data, at["turn"] + 4 * k)
        largest, turn = word >> 30, [0.0] * 4
        for component in (3, 2, 1, 0):
            if component != largest:
                turn[component] = (word & 511) / 511 / 2**0.5 * (-1 if word >> 9 & 1 else 1)
                word >>= 10
        turn[largest] = (1 - sum(value**2 for value in turn)) ** 0.5
        x, y, z, w = turn
        turns.append([w, x, -y, -z])
    places = np.reshape(means, (count, 3)) * [1, -1, -1]
    colors, scales = np.reshape(colors, (-1, 3)), np.reshape(scales, (-1, 3))
    return places, opacities, colors, scales, np.array(turns), np.reshape(rest, (count, -1, 3))


@pytest.mark.parametrize(("degree", "axes"), [(0, 1), (1, 3), (2, 3), (3, 3)])
def test_every_attribute_is_within_its_quantization(degree, axes):
    splats = exported.splats(200, degree)
    splats = replace(splats, log_scales=splats.log_scales[:, :axes])
    means, opacities, colors, scales, turns, rest = decoded(spz.encoded(splats))
    assert np.abs(means - splats.means).max() <= POSITION * 1.01
    assert np.abs(opacities - 1 / (1 + np.exp(-splats.opacity_logits))).max() <= OPACITY * 1.01
    assert np.abs(colors - splats.harmonics[:, 0]).max() <= COLOR * 1.01
    assert np.abs(scales - splats.log_scales).max() <= SCALE * 1.01
    unit = splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    assert np.degrees(2 * np.arccos(np.abs((unit * turns).sum(axis=1)).clip(0, 1))).max() < ANGLE
    signs = spz.TURN_HARMONICS[: rest.shape[1], None]
    assert rest.shape[1] == (degree + 1) ** 2 - 1
    assert np.abs(rest * signs - splats.harmonics[:, 1:]).max(initial=0) <= HARMONIC * 1.01


def test_harmonics_turn_with_the_axes():
    """A color seen along d is, of turned coefficients, seen along the turned d."""
    import torch

    from neuspring.splats.view import basis

    directions = torch.nn.functional.normalize(torch.tensor(np.random.default_rng(0).normal(size=(50, 3))), dim=-1)
    turned = basis(directions * torch.tensor(spz.TURN), 3)[:, 1:]
    assert torch.allclose(turned, basis(directions, 3)[:, 1:] * torch.tensor(spz.TURN_HARMONICS))


def test_the_command_writes_a_file_per_frame(tmp_path):
    folder = exported.run_folder(tmp_path)
    assert main(["export", str(folder), "--to", "spz", "--frames", "0:3:2", "--output", str(tmp_path / "out")]) == 0
    moved = dict(read_source(folder).moved_splats([0, 2]))
    for frame in (0, 2):
        means = decoded((tmp_path / "out" / f"splats_{frame:05d}.spz").read_bytes())[0]
        assert np.abs(means - moved[frame].means).max() <= POSITION * 1.01
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_splats_far_away_have_fewer_bits_and_must_fit():
    assert [spz.fractional_bits(np.array([[x, 0.0, 0.0]])) for x in (1.0, 300.0, 8e6)] == [16, 14, 0]
    with pytest.raises(InputError, match="must lie within"):
        spz.fractional_bits(np.array([[9e6, 0.0, 0.0]]))


def test_plyfile_reads_the_graph_as_it_is_and_splats_are_those_that_pictures_show(tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra `dev`)")
    folder, written = exported.run_folder(tmp_path), tmp_path / "out"
    assert main(["export", str(folder), "--to", "ply", "--frames", "0:4:3", "--output", str(written)]) == 0
    assert sorted(path.name for path in written.iterdir()) == [
        *("splats_00000.ply", "splats_00003.ply", "springs_00000.ply", "springs_00003.ply")
    ]
    source, twin = read_source(folder), Twin.load(folder / "twin.npz")
    read = plyfile.PlyData.read(written / "springs_00003.ply")
    vertex, edge = read["vertex"].data, read["edge"].data
    nodes = exported.NODES
    placed = np.stack([vertex[axis] for axis in "xyz"], axis=-1).reshape(-1, 3)
    assert np.array_equal(placed, np.concatenate([source.positions[3], source.hands[3]]))
    assert np.array_equal(np.ravel(vertex["mass"]), [*twin.material.mass, 0]) and np.ravel(vertex["controller"])[nodes] == 1
    assert np.ravel(vertex["region"]).tolist() == [0, 0, 0, 1, 1, 1, -1]
    assert np.array_equal(np.stack([np.ravel(edge["vertex1"]), np.ravel(edge["vertex2"])], axis=1), twin.topology.springs)
    for name, value in {"stiffness": twin.material.stiffness, "rest_length": twin.topology.rest_lengths}.items():
        assert np.array_equal(np.ravel(edge[name]), value)
    ends = placed[twin.topology.springs]
    strain = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / twin.topology.rest_lengths - 1
    assert np.abs(np.ravel(edge["strain"]) - strain).max() < 1e-6 and np.abs(strain).max() > 0.01
    splats, expected = Splats.load(written / "splats_00003.ply"), dict(source.moved_splats([3]))[3]
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "harmonics"):
        assert np.array_equal(getattr(splats, name), getattr(expected, name))


def opened(path):
    from pxr import Usd

    return Usd.Stage.Open(str(path))


@pytest.mark.parametrize("suffix", usd.SUFFIXES)
def test_pxr_reads_positions_as_they_are(tmp_path, suffix):
    pytest.importorskip("pxr", reason="usd-core is not installed (extra `export`)")
    from pxr import UsdGeom, UsdVol

    folder = exported.run_folder(tmp_path)
    path = tmp_path / f"twin{suffix}"
    assert main(["export", str(folder), "--to", "usd", "--output", str(path)]) == 0
    stage, source, twin = opened(path), read_source(folder), Twin.load(folder / "twin.npz")
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(30) and stage.GetEndTimeCode() == exported.FRAMES - 1
    assert stage.GetDefaultPrim().GetPath() == usd.ROOT
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


def test_a_rate_changes_codes_and_no_seconds_up_is_up_and_bad_names_and_rates_are_refused(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed (extra `export`)")
    from pxr import Gf, UsdGeom

    source = read_source(exported.run_folder(tmp_path, exported.rope(up="-z", ground=False), with_splats=False))
    usd.write(source, [0, 2], tmp_path / "twin.usda", rate=24.0)
    stage = opened(tmp_path / "twin.usda")
    assert stage.GetTimeCodesPerSecond() == 24 and stage.GetEndTimeCode() == pytest.approx(2 / 30 * 24)
    assert not stage.GetPrimAtPath("/Twin/Splats")
    matrix = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    assert Gf.IsClose(matrix.TransformDir(Gf.Vec3d(0, 0, -1)), Gf.Vec3d(0, 0, 1), 1e-6)
    for name, rate in (("twin.fbx", None), ("twin.usda", 0.0), ("twin.usda", float("nan"))):
        with pytest.raises(InputError, match=r"--output: must end|--rate: must be a positive"):
            usd.write(source, [0], tmp_path / name, rate)
