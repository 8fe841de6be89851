"""Errors of rods: the exception and the field that it names."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.extensions.rods import mocap
from neuspring.extensions.rods.center_line import center_line
from neuspring.extensions.rods.fit import search_rod
from neuspring.extensions.rods.made import rod_twin
from neuspring.extensions.rods.nodes import RodFrames, hanging
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move
from tests.extensions.rods import make, ropes
from tests.support import colored

NOTHING = config.SearchVariables(controller_radius=config.Variable(0.0, 1.0, 0.0))
CABLE = ropes.cable(frames=3)
DOUBLE = replace(CABLE, object_points=2 * CABLE.object_points, controller_points=2 * CABLE.controller_points)
BALL = np.random.default_rng(0).normal(size=(300, 3))


def crossed():
    """A rope in a scene in which bodies meet themselves."""
    twin = ropes.twin()
    roll_out(replace(twin, simulation=replace(twin.simulation, self_collision=True)), ropes.rope().controller_points)


def continued():
    """A rod that is to begin in another state than that of frame 0."""
    twin = ropes.twin()
    hand = torch.tensor(twin.topology.controllers)
    nodes = torch.tensor(twin.topology.nodes) + 0.1
    RodFrames(twin).forward(nodes, 0 * nodes, hand, hand)


def along():
    """A cable whose axis lies along a clamp."""
    twin = ropes.twin(CABLE)
    axis = np.diff(twin.body.vertices[:2], axis=0)[0]
    roll_out(replace(twin, body=replace(twin.body, axis=axis)), CABLE.controller_points)


@pytest.mark.parametrize(
    ("call", "error", "field"),
    [
        (lambda: center_line(BALL, 12), InputError, "observations, nodes of frame 0: .*one line without branches.*lattice"),
        (
            lambda: rod_twin(ropes.rope(), replace(ropes.SETTINGS, search=config.Search(variables=NOTHING)), ropes.AXIS),
            InputError,
            r".*a controller must hold the rod.*controller_radius",
        ),
        (lambda: ropes.twin(colored.observed()), InputError, ".*tracked in 3D.*without depth"),
        (
            lambda: search_rod(ropes.rope(), [ropes.rope()], ropes.SETTINGS),
            InputError,
            "pool of .*markers along the line.*rod_single",
        ),
        (lambda: move(ropes.twin(CABLE), DOUBLE), InputError, "transfer to .*as long as the twin's"),
        (lambda: move(ropes.twin(CABLE), ropes.rope()), InputError, "transfer to .*line of 7 vertices.*no line"),
        (crossed, InputError, r"twin\.body: .*must not collide"),
        (continued, InputError, r"twin\.body: .*must start in frame 0"),
        (along, InputError, r"rod\.axis: .*cosine below"),
        (lambda: make.rod(make.straight(4), (0, 1), slip=np.array([[-0.1, 0.3]])), InputError, r"rod\.slip"),
        (lambda: make.rod(make.straight(4), (0, 1), slip=np.array([[0.1, 0.2, 0.3]])), InputError, r"rod\.slip"),
        (lambda: mocap.clamps(np.zeros((9, 4, 3)), np.eye(3)[:2], 0.006, 3, "cable"), InputError, "cable: .*two held markers"),
        (
            lambda: hanging([make.clamped(9, curvature=np.full((9, 2), 40.0))], make.JAWS[None], make.simulation(gravity=9.8)),
            NumericalFailure,
            ".*does not come to rest",
        ),
    ],
)
def test_what_is_refused_is_named(call, error, field):
    with pytest.raises(error, match=f"^{field}"):
        call()
