"""Errors of twins, searches, fits and topologies: the exception and the field that it names."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring import config
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.physics import topology as graphs
from neuspring.twin.body import BODIES
from neuspring.twin.fit import fit
from neuspring.twin.search import search
from tests.support import small

NODES = np.array([[0.0, 0, 0], [0.2, 0, 0]])
SHORT = replace(small.observations(), scenario=replace(small.observations().scenario, train_end=2))
FEWER = replace(small.observations(), surface_points=small.observations().surface_points[1:])
TAIL = config.Fit(epochs=1, selection="tail")


def on_a_node():
    """A search whose first controller is where a node is."""
    seen = small.observations()
    hands = seen.controller_points.copy()
    hands[:, 0] += seen.object_points[0, 0] - hands[0, 0]
    return search(small.search_problem(replace(seen, controller_points=hands)), seed=0)


@pytest.mark.parametrize(
    ("call", "error", "field"),
    [
        (lambda: BODIES["jelly"], InputError, ".*jelly.*lattice"),
        (lambda: small.fit_problem(pool=[FEWER]), InputError, "pool of small: .*124, 3.*123, 3.*in small"),
        (lambda: small.fit_problem(kind="rod"), InputError, "fit, kind"),
        (lambda: small.fit_problem(oracle=True, fit=TAIL), InputError, r"fit\.selection: an oracle"),
        (lambda: fit(small.fit_problem(SHORT, fit=TAIL)), InputError, r"fit\.selection.*two training frames"),
        (
            lambda: search(small.search_problem(simulation=config.SimulationSettings(substeps=1)), seed=0),
            InputError,
            r"simulation\.substeps: .*22 candidates.*received 1.*Use at least \d+ substeps",
        ),
        (
            lambda: search(small.search_problem(simulation=config.SimulationSettings(safety=1e-6)), seed=0),
            NumericalFailure,
            r"none of 22 candidates.*requires \d+ substeps",
        ),
        (on_a_node, InputError, "topology: a controller may not coincide"),
        (lambda: graphs.uniform_topology(NODES, NODES[1:], 0.5, 5, 0.5, 5), InputError, r"topology: .*spring \[2, 1\]"),
        (lambda: graphs.regions(NODES, 5), InputError, "clusters: .*received 2 nodes"),
        (lambda: graphs.regions(NODES, 0), InputError, "clusters"),
        (lambda: graphs.node_spacing(np.ones((3, 3))), InputError, ".*two nodes at different positions"),
    ],
)
def test_what_is_refused_is_named(call, error, field):
    with pytest.raises(error, match=f"^{field}"):
        call()
