"""The interface of bodies: the lattice, and a body of a package; no code checks for a kind of body."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.artifacts import Twin
from neuspring.physics.solver import FrameSolver
from neuspring.twin import body as module
from neuspring.twin.bodies.lattice import Lattice
from neuspring.twin.body import BODIES, body_of, lines_of, with_mass
from neuspring.twin.rollout import roll_out
from tests.support import small
from tests.support.bodies import differing, require_answers


@pytest.fixture(scope="module")
def twin():
    return small.fit_problem().twin


def test_a_lattice_answers_for_its_twin(twin):
    require_answers("lattice", twin, small.observations())
    assert isinstance(body_of(twin).solver(twin), FrameSolver)
    assert body_of(twin).load(twin) > 0.0


def test_a_mass_scales_forces_and_masses_and_nothing_else(twin):
    weighed = with_mass(twin, 0.35)
    assert lines_of(weighed).masses.sum(dtype=float) == pytest.approx(0.35, rel=1e-6)
    assert differing(twin, weighed) == {"material.stiffness", "material.dashpot", "material.mass"}


def crowded() -> tuple[Twin, np.ndarray]:
    """A rope on the ground, its nodes nearer than their contacts, and its hand [F, C, 3]."""
    problem = small.fit_problem()
    twin = problem.twin
    material = replace(twin.material, contact_distance=1.2 * twin.material.contact_distance)
    crowd = replace(twin, material=material, simulation=replace(twin.simulation, self_collision=True))
    return crowd, problem.observations.controller_points


def apart(twin: Twin) -> Twin:
    return replace(twin, simulation=replace(twin.simulation, self_collision=False))


def test_a_mass_changes_no_motion():
    """By a power of two not a bit: springs, drag, ground, collisions, hands. Contacts amplify any rounding."""
    twin, hands = crowded()
    total = float(lines_of(twin).masses.sum(dtype=float))
    here = roll_out(twin, hands).positions
    assert np.abs(here[-1] - here[0]).max() > 0.02
    assert np.abs(roll_out(apart(twin), hands).positions - here).max() > 0.001, "collisions matter"
    assert here[..., 2].min() < 1e-4, "it lies on the ground"
    assert np.array_equal(roll_out(with_mass(twin, total / 1024), hands).positions, here)
    near = [roll_out(one, hands).positions for one in (apart(twin), with_mass(apart(twin), 0.035))]
    assert np.abs(near[1] - near[0]).max() < 1e-6


class Marked(Lattice):
    """A body of another package: a lattice whose nodes have masses."""

    name = "marked"

    def describes(self, twin: Twin) -> bool:
        return len(twin.material.mass) > 0


def test_a_further_body_is_one_entry_point(twin, monkeypatch):
    body = Marked()
    monkeypatch.setattr(module, "BODIES", {**BODIES, "marked": body})
    heavy = replace(twin, material=replace(twin.material, mass=np.ones(len(twin.topology.nodes), np.float32)))
    assert body_of(heavy) is body
    assert body_of(twin).name == "lattice"
