"""Tests of the interface of a body, also for bodies of packages."""

from dataclasses import fields

import numpy as np

from neuspring.core.artifacts import Artifact
from neuspring.twin.body import BODIES, body_of, lines_of


def require_answers(name, twin, seen):
    """Assert that the body of this name answers for its twin, which was made on these observations."""
    body = body_of(twin)
    assert body is BODIES[name] and body.name == name
    lines, nodes, hands = lines_of(twin), twin.topology.nodes, twin.topology.controllers
    assert len(lines.points(nodes, hands)) == len(lines.labels) == len(lines.masses) > lines.pairs.max()
    assert len(lines.pairs) == len(lines.stiffness) == len(lines.rest_lengths) >= lines.inner > 0
    assert body.node_stiffness(twin).shape == (len(nodes),)
    assert lines.masses.sum() > 0 and body.mass_at(twin, 0) > 0
    body.check(body.stable(twin, 0.8))
    np.testing.assert_array_equal(body.on_recording(twin, seen, "recording").topology.nodes, nodes)


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
