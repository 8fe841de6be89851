"""PLY: read back by plyfile (graph) and by the reader of splat files, nothing is lost."""

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.artifacts import Twin
from neuspring.export.source import read_source
from neuspring.splats.model import Splats
from tests.support import exported

plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra `dev`)")


def test_plyfile_reads_the_graph_as_it_is_and_splats_are_those_that_pictures_show(tmp_path):
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
