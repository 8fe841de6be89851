"""The figures that say whether a fit moved anything."""

import math

import pytest
import torch

from neuspring import config
from neuspring.twin.fit import TwinFit, fit
from neuspring.twin.parameters import TwinParameters, movement
from tests.support import small

FIELD = config.SpringField(channels=4, hidden=8, bands=2, texel_scale=0.02)


def parameters(kind: str, **settings: object) -> TwinParameters:
    return TwinParameters(small.fit_problem().twin, config.Fit(field=FIELD, **settings), kind, "cpu")


def test_shares_count_springs_at_the_bound_and_at_the_range():
    trained = parameters("springs", output_bound=1.0, stiffness_range=(0.0, 6100.0))
    assert movement(trained) == {"at_bound": 0.0, "at_stiffness_range": 0.0}
    count = len(trained.start["stiffness"])
    with torch.no_grad():
        trained.offsets[:10] = 3.0  # tanh 3 = 0.995: at the bound, and above the range
        trained.offsets[10:30] = -3.0  # at the bound, within the range
        trained.offsets[30:70] = 0.5  # above the range, not at the bound
    assert movement(trained) == pytest.approx({"at_bound": 30 / count, "at_stiffness_range": 50 / count})


def test_a_texel_has_moved_by_a_tenth_of_the_scale_at_the_start():
    trained = parameters("field")
    texels = trained.field.planes.texels
    assert texels.detach().std() == pytest.approx(0.02, rel=0.1), "the scale is a setting"
    assert movement(trained)["texels_moved"] == 0
    with torch.no_grad():
        texels[0] += 0.0021
        texels[1] += 0.0019
    assert movement(trained)["texels_moved"] == pytest.approx(1 / len(texels))
    assert "at_bound" not in movement(trained), "no bound"


def test_common_factors_and_strains_are_reported():
    trained = parameters("springs", global_stiffness=True, rest_length_bound=0.1)
    with torch.no_grad():
        trained.factors["stiffness"].fill_(math.log(3.0))
        trained.offsets[:, 1] = math.inf
    figures = movement(trained)
    assert figures["factors"] == pytest.approx({"stiffness": 3.0})
    assert figures["rest_strain"] == pytest.approx(math.exp(0.1) - 1, rel=1e-5)


def gradient_over_epsilon(kind: str, epsilon: float, rate: float) -> float:
    settings = config.Fit(epochs=1, epsilon=epsilon, learning_rate=rate, scalar_learning_rate=1e-12, field=FIELD)
    return fit(small.fit_problem(kind=kind, fit=settings)).figures["gradient_over_epsilon"]


def test_gradients_are_compared_with_epsilon():
    medians = {epsilon: gradient_over_epsilon("springs", epsilon, 1e-12) for epsilon in (1e-15, 1e-3)}
    assert medians[1e-15] == pytest.approx(1e12 * medians[1e-3], rel=1e-2)
    assert medians[1e-15] > 1
    run = TwinFit(small.fit_problem(kind="springs", fit=config.Fit(epochs=1, horizon=0)))
    run.gradients = []
    run.epoch()
    assert run.gradients == [float(run.parameters.offsets.grad.abs().median())]


def test_gradients_of_texels_go_with_the_last_layer():
    """It is zero at the first step and of the order of the rate after it. The epoch's median leaves the first step behind."""
    slow, fast = (gradient_over_epsilon("field", 1e-15, rate) for rate in (1e-12, 1e-9))
    assert slow > 0
    assert fast == pytest.approx(1e3 * slow, rel=1e-2)
