"""A form of pictures comes in through the registry."""

from importlib.metadata import EntryPoint

import cv2
import numpy as np
import pytest

from neuspring import registry
from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.make_capture import formats
from neuspring.extensions.make_capture.feeds import Paired, Recorded
from neuspring.extensions.make_capture.formats import CaptureFormat
from neuspring.extensions.make_capture.formats.folder import ImageFolder
from neuspring.extensions.make_capture.forms import read_lenses
from neuspring.intake.points import read_nodes
from tests.support.desk import write_folders


def _twin_folders(paths, cameras):
    names = cameras or tuple(map(str, range(len(paths))))
    pairs = zip(names, paths, strict=True)
    return Recorded(
        views=[Paired(one, ImageFolder(p / "color_0", "color"), ImageFolder(p / "depth_0", "depth")) for one, p in pairs]
    )


MINE = CaptureFormat(
    about="a folder of two",
    recognizes=lambda path: (path / "color_0").is_dir() and (path / "depth_0").is_dir(),
    recording=_twin_folders,
)


@pytest.mark.parametrize("named", [(), ("--format", "mine")])
def test_a_package_adds_a_capture_format(tmp_path, monkeypatch, named):
    point = EntryPoint(name="mine", value=f"{__name__}:MINE", group="neuspring.capture_formats")
    others = registry.entry_points
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == point.group else others(group=group))
    own = registry.modules(formats.__name__, "capture_format")
    monkeypatch.setattr(formats, "FORMATS", registry.Registry("capture_formats", own, CaptureFormat))
    root = write_folders(tmp_path)
    words = ["--recording", str(root), *named, "--intrinsics", str(root / "intrinsics.json"), "--rate", "30", "--category", "ball"]
    assert main(["make-capture", *words, "--output", str(tmp_path / "made")]) == 0
    made = Capture.load(tmp_path / "made")
    assert [*made.cameras] == ["0"] and made.frame_count > 4


def test_a_path_of_no_format_is_refused_with_the_names(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(InputError, match=r"--format: must be one of bag, phystwin_raw; received none that reads"):
        formats.open_recording([tmp_path])


EXR, GLB, C3D = b"\x76\x2f\x31\x01\x02\0\0\0", b"glTF\x02\0\0\0", b"\x02\x50" + bytes(510)


@pytest.mark.parametrize(
    ("name", "first", "read", "words"),
    [
        ("0.exr", EXR, lambda path: formats.open_images(path.parent, "depth"), ("an OpenEXR image", "pip install OpenEXR")),
        ("0.exr", EXR, lambda path: formats.open_images(path, "depth"), ("an OpenEXR image", "pip install OpenEXR")),
        ("body.glb", GLB, read_nodes, ("a binary glTF model", "trimesh.load('a.glb', force='mesh')")),
        ("body.npz", GLB, read_nodes, ("a binary glTF model", "trimesh.load('a.glb', force='mesh')")),
        ("k.json", C3D, lambda path: read_lenses(path, ["0"]), ("a C3D file", "Read it by ezc3d")),
    ],
)
def test_a_file_of_another_program_is_refused_with_what_it_is_and_its_conversion(tmp_path, name, first, read, words):
    (tmp_path / name).write_bytes(first)
    with pytest.raises(InputError) as caught:
        read(tmp_path / name)
    assert all(word in str(caught.value) for word in (str(tmp_path), *words))
