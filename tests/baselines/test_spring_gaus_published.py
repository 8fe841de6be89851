"""Spring-Gaus: published choices that are settings, each with what it does."""

import math

import numpy as np
import pytest
import torch

from neuspring.baselines.spring_gaus.graph import AnchorGraph
from neuspring.baselines.spring_gaus.model import SpringGausModel
from neuspring.baselines.spring_gaus.solver import AnchorParameters, AnchorSolver
from neuspring.config.spring_gaus import SpringGaus

REST, STRAIN, STEP = 0.1, 0.5, 1 / 30
HANDS = torch.full((1, 3), 9.0, dtype=torch.float64)


def pair(**settings) -> SpringGausModel:
    """Two anchors that feel each other, far from any hand and from the ground."""
    graph = AnchorGraph(
        anchors=np.array([[0, 0, 1], [REST, 0, 1]], dtype=np.float32),
        neighbors=np.array([[1], [0]], dtype=np.int32),
        lengths=np.full((2, 1), REST, dtype=np.float32),
        link_starts=np.zeros(3, dtype=np.int32),
        links=np.zeros(0, dtype=np.int32),
        link_lengths=np.zeros(0, dtype=np.float32),
    )
    chosen = SpringGaus(neighbors=1, full_neighbors=1, **settings)
    return SpringGausModel.start(graph, chosen, frame_time=STEP, up_sign=1.0, gravity=0.0, ground=False)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 2.0])
def test_a_stretched_spring_pulls_with_the_published_power_of_its_strain(exponent):
    """After one substep v = dt s e (1 + |e|)^p."""
    model = pair(exponent=exponent)
    x = torch.tensor([[0, 0, 1], [REST * (1 + STRAIN), 0, 1]], dtype=torch.float64)
    stiffness, undamped = torch.full((2,), 3.0, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    parameters = AnchorParameters(stiffness, torch.ones(1, dtype=torch.float64), undamped, torch.ones((), dtype=torch.float64))
    _, velocity = AnchorSolver(model, model, 1, dtype=torch.float64).frame(parameters, x, torch.zeros_like(x), HANDS, HANDS)
    expected = STEP * 3.0 * STRAIN * (1 + STRAIN) ** exponent
    # Rest lengths are stored in float32.
    assert velocity[:, 0].tolist() == pytest.approx([expected, -expected], rel=1e-6)


@pytest.mark.parametrize(("negative", "damping"), [(True, math.log(0.5)), (False, 0.0)])
def test_damping_becomes_negative_only_where_that_is_asked_for(negative, damping):
    model = pair(negative_damping=negative)
    trained = model.tensors("cpu") | {"theta": torch.tensor([0.5])}
    assert float(model.parameters(trained).damping) == pytest.approx(damping)
