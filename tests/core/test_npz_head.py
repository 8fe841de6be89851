"""Shapes and meta data of a file of arrays, without its arrays."""

import os

import numpy as np
import pytest

from neuspring.core.artifacts import Observations
from neuspring.core.files import DamagedFile, read_head
from tests.support.scenarios import observations


def test_the_head_of_a_file_is_what_loading_it_says(tmp_path):
    path = tmp_path / "observations.npz"
    seen = observations(frames=6, points=4)
    seen.save(path)
    shapes, meta = read_head(path)
    for name in ("object_points", "surface_points", "interior_points", "controller_points"):
        assert shapes[name] == getattr(seen, name).shape
    assert meta["fields"]["scenario"]["train_end"] == Observations.load(path).scenario.train_end
    for damage in (b"", path.read_bytes()[: path.stat().st_size // 2], os.urandom(100)):
        path.write_bytes(damage)
        with pytest.raises(DamagedFile):
            read_head(path)
    with path.open("wb") as stream:
        np.savez(stream, a=np.zeros(2))
    with pytest.raises(DamagedFile, match="no mapping"):
        read_head(path)
    with pytest.raises(FileNotFoundError):
        read_head(tmp_path / "none.npz")
