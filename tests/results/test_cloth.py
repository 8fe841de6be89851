"""A leaning sheet is rotated to hang straight, and the error of a sheet counts its free nodes."""

import numpy as np
import pytest

from results.published.cloth.make import capture, error, read
from results.published.stand_ins import of_cloth


def test_a_leaning_sheet_becomes_a_plumb_capture_whose_error_counts_free_nodes(tmp_path):
    of_cloth(tmp_path)
    mesh = read(path := tmp_path / "SOMtraj8_1_10ms.mat")
    assert np.ptp(mesh[..., 1]) == pytest.approx(0, abs=1e-9)
    assert capture(path, tmp_path, corners=False) == "cloth_8_1"
    nodes = mesh[:, :6].reshape(10, 42, 3)
    assert error(mesh, nodes + 0.001 * np.eye(3)[0]) == pytest.approx(12 / 16)
