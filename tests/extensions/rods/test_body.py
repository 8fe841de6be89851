"""A rod implements the interface of bodies, and loads from files."""

import numpy as np
import pytest

from neuspring.core.artifacts import Twin
from neuspring.extensions.rods.nodes import RodFrames
from neuspring.twin.body import BODIES, body_of, lines_of, with_mass
from neuspring.twin.rollout import roll_out
from tests.extensions.rods import ropes
from tests.support.bodies import differing, require_answers


def test_a_rod_answers_for_its_twin():
    assert "rod" in BODIES
    twin = ropes.twin()
    require_answers("rod", twin, ropes.rope())
    assert isinstance(body_of(twin).solver(twin), RodFrames)
    assert body_of(twin).load(twin) == 0.0


def test_a_rod_is_read_from_a_file_as_it_was_written(tmp_path):
    twin = ropes.twin(ropes.cable())
    twin.save(tmp_path / "twin.npz")
    read = Twin.load(tmp_path / "twin.npz")
    assert type(read.body) is type(twin.body) and differing(twin, read) == set()


def test_a_mass_scales_forces_and_masses_and_nothing_else():
    twin = ropes.twin()
    weighed = with_mass(twin, 0.35)
    assert lines_of(weighed).masses.sum(dtype=float) == pytest.approx(0.35, rel=1e-6)
    scaled = {f"body.{name}" for name in ("mass", "bending", "twisting", "stretching")}
    assert differing(twin, weighed) == {"material.stiffness", "material.dashpot"} | scaled


@pytest.mark.parametrize("make", [lambda **k: ropes.rope(height=0.02, **k), ropes.cable], ids=["rope", "cable"])
def test_a_mass_changes_no_motion(make):
    """By a power of two not a bit: stiffness, drag, ground, hands, clamps."""
    seen = make(frames=8, move=(0, 0.002, 0.004))
    twin, hands = ropes.twin(seen), seen.controller_points
    total = float(lines_of(twin).masses.sum(dtype=float))
    here = roll_out(twin, hands).positions
    assert np.abs(here[-1] - here[0]).max() > 0.02
    assert np.array_equal(roll_out(with_mass(twin, total / 1024), hands).positions, here)
    assert np.abs(roll_out(with_mass(twin, 0.035), hands).positions - here).max() < 1e-6
