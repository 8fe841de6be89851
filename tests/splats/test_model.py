"""Splat files: what is written is read back, other trainers' files are read, damaged ones are named."""

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.splats.model import Gaussians, Splats


def some(count=7, axes=1, coefficients=4):
    rng = np.random.default_rng(0)
    shapes = {
        "means": (count, 3),
        "quaternions": (count, 4),
        "log_scales": (count, axes),
        "opacity_logits": (count,),
        "harmonics": (count, coefficients, 3),
    }
    return Splats(**{name: rng.normal(size=shape) for name, shape in shapes.items()})


@pytest.mark.parametrize(("axes", "coefficients"), [(1, 1), (3, 16)])
def test_what_is_written_is_read_back(tmp_path, axes, coefficients):
    splats = some(axes=axes, coefficients=coefficients)
    splats.save(tmp_path / "splats.ply")
    again = Splats.load(tmp_path / "splats.ply")
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "harmonics"):
        assert np.array_equal(getattr(again, name), getattr(splats, name))
    assert np.array_equal(Gaussians.of(again).stored().harmonics, splats.harmonics)


def test_public_viewers_find_every_property_that_they_read(tmp_path):
    """The list of the original viewer, in its order; one scale is written three times."""
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra `dev`)")
    splats = some(coefficients=16)
    splats.save(tmp_path / "splats.ply")
    vertex = plyfile.PlyData.read(tmp_path / "splats.ply")["vertex"]
    wanted = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(45)), "opacity"]
    assert [one.name for one in vertex.properties] == [*wanted, *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    for k in range(3):
        assert np.array_equal(vertex[f"scale_{k}"], splats.log_scales[:, 0])
        assert np.array_equal(vertex[f"f_rest_{15 * k}"], splats.harmonics[:, 1, k])
    assert {one.val_dtype for one in vertex.properties} == {"f4"}


def test_the_layout_is_that_of_splat_viewers(tmp_path):
    """Bands above the first are stored channel by channel; written here by hand, with normals and another order."""
    splats = some(count=2)
    rest = {f"f_rest_{3 * channel + band}": splats.harmonics[:, 1 + band, channel] for channel in range(3) for band in range(3)}
    columns = {f"rot_{k}": splats.quaternions[:, k] for k in range(4)} | rest
    columns |= {axis: splats.means[:, k] for k, axis in enumerate("xyz")} | {f"n{axis}": np.zeros(2) for axis in "xyz"}
    columns |= {f"f_dc_{k}": splats.harmonics[:, 0, k] for k in range(3)}
    columns |= {"opacity": splats.opacity_logits, "scale_0": splats.log_scales[:, 0]}
    header = "\n".join(["ply", "format binary_little_endian 1.0", "comment by hand", "element vertex 2"])
    header += "".join(f"\nproperty float {name}" for name in columns) + "\nend_header\n"
    path = tmp_path / "hand.ply"
    path.write_bytes(header.encode() + np.stack(list(columns.values()), axis=1).astype("<f4").tobytes())
    again = Splats.load(path)
    assert np.array_equal(again.harmonics, splats.harmonics)
    assert np.array_equal(again.quaternions, splats.quaternions)


HEAD = b"ply\nformat binary_little_endian 1.0\nelement vertex "


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "must be a binary"),
        (HEAD + b"1\nproperty float x\nend_header\n\0\0\0\0", "no y, z, f_dc_0"),
        (HEAD + b"1\nproperty list uchar int x\nend_header\n", "float properties"),
        (HEAD + b"1\nelement face 2\nend_header\n", "only vertices"),
        (HEAD + b"0\nproperty float x\nend_header\n", "only vertices"),
        (HEAD + b"1\nproperty float x\nproperty float x\nend_header\n", "different"),
        (HEAD + b"1\nproperty float f_rest_0\nend_header\n\0\0\0\0", "f_rest_"),
    ],
)
def test_other_files_are_named(tmp_path, content, message):
    path = tmp_path / "other.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        Splats.load(path)


def test_a_file_that_is_truncated_or_has_values_that_are_not_finite_is_named(tmp_path):
    path = tmp_path / "splats.ply"
    some(count=50).save(path)
    content = path.read_bytes()
    path.write_bytes(content[:-1000])
    with pytest.raises(InputError, match=r"splats\.ply.*promises 50 splats.*truncated"):
        Splats.load(path)
    path.write_bytes(content[:-4] + np.float32(np.nan).tobytes())
    with pytest.raises(InputError, match=r"splats\.ply.*usable.*quaternions.*finite"):
        Splats.load(path)
