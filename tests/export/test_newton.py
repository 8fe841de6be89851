"""Newton: its rollout of the exported model against ours, for a body that swings freely, and what Newton leaves out."""

import importlib.util

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.export import newton
from neuspring.export.source import read_source
from tests.support import exported

ERROR = 2e-6
"""m, over six frames of 60 steps, float32 on both sides. Measured: 2.6e-7."""


def script_of(folder):
    """The exported script as a module."""
    spec = importlib.util.spec_from_file_location("newton_twin", folder / "newton_twin.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rollouts(tmp_path, *, drag=True, **options):
    twin = exported.stretched(exported.rope(ground=False, **options), 1.1)
    source = read_source(exported.run_folder(tmp_path, twin, with_splats=False))
    newton.write(source, range(exported.FRAMES), tmp_path / "out")
    return source.positions, script_of(tmp_path / "out").simulate(tmp_path / "out", exported.FRAMES - 1, drag)


@pytest.mark.parametrize("options", [{}, {"up": "-z"}, {"controller_velocity": True}], ids=["plain", "-z up", "hand velocity"])
def test_newton_swings_as_we_do(tmp_path, options):
    ours, theirs = rollouts(tmp_path, **options)
    assert np.abs(ours - theirs).max() < ERROR
    assert np.abs(ours[-1] - ours[0]).max() > 0.05


def test_without_drag_they_part(tmp_path):
    ours, theirs = rollouts(tmp_path, drag=False)
    assert np.abs(ours - theirs).max() > 1e-3


def test_the_hands_are_needed_from_the_start(tmp_path):
    source = read_source(exported.run_folder(tmp_path, with_splats=False))
    with pytest.raises(InputError, match="Take 0:STOP"):
        newton.write(source, [2, 3], tmp_path / "out")
