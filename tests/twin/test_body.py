"""The body of a twin is asked, never told apart: lattice, rod, and what a package brings."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import neuspring
from neuspring.core.artifacts import Artifact, Observations, Twin
from neuspring.core.errors import InputError
from neuspring.physics.solver import FrameSolver
from neuspring.rods.made import rod_twin
from neuspring.rods.nodes import RodFrames
from neuspring.twin import body as module
from neuspring.twin.bodies.lattice import Lattice
from neuspring.twin.body import BODIES, body_of, lines_of, with_mass
from neuspring.twin.rollout import roll_out
from tests.support import ropes, small

PACKAGE = Path(neuspring.__file__).parent
TOLD_APART = re.compile(r"\.rod is (not )?None|\b(body|kind|fit)\b *[!=]= *\"(rod|lattice)\"|isinstance\([^)]*Rod")


@pytest.fixture(scope="module")
def twins() -> dict[str, Twin]:
    """A twin of each body."""
    return {"lattice": small.fit_problem().twin, "rod": rod_twin(ropes.rope(), ropes.SETTINGS)}


def test_no_room_above_tells_a_rod_from_a_lattice():
    """Outside physics and twin; the pattern finds what it looks for."""
    assert all(TOLD_APART.search(text) for text in ("if twin.rod is None", 'if body == "rod":', "isinstance(solver, RodFrames)"))
    places = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] not in ("physics", "rods", "twin")]
    lines = [(path.relative_to(PACKAGE), line) for path in places for line in path.read_text().splitlines()]
    found = [f"{path}: {line.strip()}" for path, line in lines if TOLD_APART.search(line)]
    assert not found, "\n".join(found)


def test_every_body_answers_for_its_twin(twins):
    assert list(BODIES) == list(twins)
    for name, twin in twins.items():
        body = body_of(twin)
        assert body is BODIES[name] and body.name == name
        lines, nodes, hands = lines_of(twin), twin.topology.nodes, twin.topology.controllers
        assert len(lines.points(nodes, hands)) == len(lines.labels) == len(lines.masses) > lines.pairs.max()
        assert len(lines.pairs) == len(lines.stiffness) == len(lines.rest_lengths) >= lines.inner > 0
        assert body.node_stiffness(twin).shape == (len(nodes),)
        assert lines.masses.sum() > 0 and body.mass_at(twin, 0) > 0
        body.check(body.stable(twin, 0.8))
        seen = {"lattice": small.observations(), "rod": ropes.rope()}[name]
        np.testing.assert_array_equal(body.on_recording(twin, seen)[0].topology.nodes, nodes)
    assert isinstance(body_of(twins["lattice"]).solver(twins["lattice"]), FrameSolver)
    assert isinstance(body_of(twins["rod"]).solver(twins["rod"]), RodFrames)
    assert body_of(twins["rod"]).load(twins["rod"]) == 0.0 < body_of(twins["lattice"]).load(twins["lattice"])


HEAVY = {
    "lattice": {"material.stiffness", "material.dashpot", "material.mass"},
    "rod": {"material.stiffness", "material.dashpot", "rod.mass", "rod.bending", "rod.twisting", "rod.stretching"},
}
"""Fields that a mass scales."""


def differing(before, after, prefix=""):
    """Fields whose values differ, by name."""
    found = set()
    for spec in fields(before):
        old, new = getattr(before, spec.name), getattr(after, spec.name)
        if isinstance(old, Artifact):
            found |= differing(old, new, f"{prefix}{spec.name}.")
        elif not np.array_equal(old, new):
            found.add(prefix + spec.name)
    return found


@pytest.mark.parametrize("name", HEAVY)
def test_a_mass_scales_forces_and_masses_and_nothing_else(twins, name):
    weighed = with_mass(twins[name], 0.35)
    assert lines_of(weighed).masses.sum(dtype=float) == pytest.approx(0.35, rel=1e-6)
    assert differing(twins[name], weighed) == HEAVY[name]


def crowded() -> tuple[Twin, np.ndarray]:
    """A rope on the ground, its nodes nearer than their contacts, and its hand [F, C, 3]."""
    problem = small.fit_problem()
    twin = problem.twin
    material = replace(twin.material, contact_distance=1.2 * twin.material.contact_distance)
    crowd = replace(twin, material=material, simulation=replace(twin.simulation, self_collision=True))
    return crowd, problem.observations.controller_points


def apart(twin: Twin) -> Twin:
    return replace(twin, simulation=replace(twin.simulation, self_collision=False))


def led(seen: Observations) -> tuple[Twin, np.ndarray]:
    return ropes.twin(seen), seen.controller_points


MOVING = {
    "lattice": crowded,
    "rope": lambda: led(ropes.rope(frames=8, move=(0, 0.002, 0.004), height=0.02)),
    "cable": lambda: led(ropes.cable(frames=8, move=(0, 0.002, 0.004))),
}


@pytest.mark.parametrize("name", MOVING)
def test_a_mass_changes_no_motion(name):
    """By a power of two not a bit: springs, drag, ground, collisions, hands, clamps. Contacts amplify any rounding."""
    twin, hands = MOVING[name]()
    total = float(lines_of(twin).masses.sum(dtype=float))
    here = roll_out(twin, hands).positions
    assert np.abs(here[-1] - here[0]).max() > 0.02
    if name == "lattice":
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


def test_a_further_body_is_one_entry_point(twins, monkeypatch):
    twin, body = twins["lattice"], Marked()
    monkeypatch.setattr(module, "BODIES", {**BODIES, "marked": body})
    heavy = replace(twin, material=replace(twin.material, mass=np.ones(len(twin.topology.nodes), np.float32)))
    assert body_of(heavy) is body
    assert [body_of(each).name for each in twins.values()] == list(twins)


def test_an_unknown_body_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"must be a registered name; received jelly.*lattice, rod"):
        BODIES["jelly"]
