"""Plain files: npz and JSON, simulated without us by the script on the page, and PLY, read back by plyfile bit for bit."""

import re
from dataclasses import replace

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.artifacts import Twin
from neuspring.extensions.exports.formats import npz
from neuspring.extensions.exports.source import read_source
from neuspring.splats.model import Splats
from tests.extensions.exports import exported

ERROR = 2e-7
"""m, of the script on the page to our rollout in float32. Measured: 2.4e-8."""


@pytest.mark.parametrize(
    "options",
    [{}, {"up": "-z", "ground": False}, {"controller_velocity": True}, {"gravity": 200.0}],
    ids=["plain", "-z up", "hand velocity", "bounces"],
)
def test_the_script_on_the_page_simulates_the_first_frame(tmp_path, options):
    folder = exported.run_folder(tmp_path, exported.stretched(exported.rope(**options), 1.1))
    assert main(["export", str(folder), "--to", "npz", "--output", str(tmp_path / "out")]) == 0
    assert float(exported.run_page_script(0, tmp_path / "out").split()[-1]) < ERROR
    arrays = np.load(tmp_path / "out" / npz.ARRAYS_FILE)
    assert np.abs(arrays["positions"][1] - arrays["positions"][0]).max() > 100 * ERROR, "the body moves"
    if "gravity" in options:
        heights = arrays["positions"][:2, :, 2]
        assert (heights >= 0).all() and heights[0].max() < 0.4 * options["gravity"] / 900, "it hits the ground in the first frame"


def test_every_array_is_described_as_it_is(tmp_path):
    folder = exported.run_folder(tmp_path)
    npz.write(read_source(folder), [0, 2, 4], tmp_path / "out")
    said, arrays, sizes = exported.described(tmp_path / "out")
    assert set(arrays) == set(said["arrays"])
    for name, entry in said["arrays"].items():
        assert arrays[name].dtype.name == entry["dtype"] and entry["unit"] and entry["about"]
    assert sizes["F"] == 3 and arrays["time"].tolist() == pytest.approx([0, 2 / 30, 4 / 30])
    twin = Twin.load(folder / "twin.npz")
    for name in ("springs", "rest_lengths", "nodes"):
        assert np.array_equal(arrays[name], getattr(twin.topology, name))
    for name in ("stiffness", "dashpot", "mass"):
        assert np.array_equal(arrays[name], getattr(twin.material, name))
    assert all({"value", "unit", "about"} == set(entry) for entry in said["settings"].values())


def test_masses_of_one_kilogram_are_written_out_and_said_to_be_a_convention(tmp_path, capsys):
    twin = exported.rope()
    replace(twin, material=replace(twin.material, mass=np.zeros(0))).save(tmp_path / "twin.npz")
    assert main(["export", str(tmp_path / "twin.npz"), "--to", "npz", "--output", str(tmp_path / "out")]) == 0
    said, arrays, _ = exported.described(tmp_path / "out")
    assert arrays["mass"].tolist() == [1.0] * exported.NODES and arrays["positions"].shape[0] == 1
    assert said["mass"]["value"] == exported.NODES
    for text in (capsys.readouterr().out, said["mass"]["about"]):
        assert re.search("6 kg in all, by convention .1 kg per node.*--mass KG", text)


def test_plyfile_reads_the_graph_as_it_is_and_splats_are_those_that_pictures_show(tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra `dev`)")
    folder, written = exported.run_folder(tmp_path), tmp_path / "out"
    assert main(["export", str(folder), "--to", "ply", "--frames", "0:4:3", "--output", str(written)]) == 0
    names = [f"{kind}_0000{frame}.ply" for kind in ("splats", "springs") for frame in (0, 3)]
    assert sorted(path.name for path in written.iterdir()) == names
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
    for name in ("means", "log_scales", "opacity_logits", "harmonics"):
        assert np.array_equal(getattr(splats, name), getattr(expected, name))
    lengths = np.linalg.norm(expected.quaternions, axis=1, keepdims=True)
    assert np.ptp(lengths) > 1, "not all readers bring them to norm 1"
    np.testing.assert_allclose(np.linalg.norm(splats.quaternions, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(splats.quaternions * lengths, expected.quaternions, atol=1e-6)
