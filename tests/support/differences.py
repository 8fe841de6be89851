"""Central differences, against which adjoints are tested in float64."""

import numpy as np
import torch

from neuspring.physics import reference
from tests.support.scenes import tensors, with_values

# Central differences with step h of a smooth function: truncation h^2 f''' / 6 plus rounding 1e-16 f / h. With h = 1e-6 of
# values of order 1, both stay below 1e-9 of the largest derivative; third derivatives grow with 1 / length^2 = 1e3..1e4.
STEP = 1e-6
EXACT = 1e-12
"""Two ways to compute the same adjoint: rounding only."""
Arrays = dict[str, np.ndarray]


def differences(function, at, **steps):
    """Central differences of a scalar function of named arrays, entry by entry; `steps` by name, else STEP."""
    result = {}
    for name, values in at.items():
        gradient = np.zeros(values.shape)
        for index in np.ndindex(values.shape):
            shift = np.zeros(values.shape)
            shift[index] = steps.get(name, STEP) * max(1.0, abs(values[index]))
            up, down = (function(at | {name: values + s * shift}) for s in (1, -1))
            gradient[index] = (up - down) / (2 * shift[index])
        result[name] = gradient
    return result


def compared(name, body, state, hands, simulated, valid=None, **steps):
    """Gradients of a weighted sum of the last positions by one parameter or by x or v of `state`: the solver's, and differences.

    `simulated` gives the last positions for the parameters by name, x and v; differences are those of the reference.
    """
    weights, values = np.random.default_rng(0).normal(size=state["x"].shape), tensors(body)
    every = values | {key: torch.tensor(value) for key, value in state.items()}
    every[name] = every[name].clone().requires_grad_()
    (simulated({key: every[key] for key in values}, every["x"], every["v"]) * torch.tensor(weights)).sum().backward()

    def loss(changed):
        other = with_values(body, {name: changed[name]}) if name in values else body
        start = (state | changed)["x"], (state | changed)["v"]
        return float((reference.rollout(other, *start, hands, valid)[0][-1] * weights).sum())

    return {name: every[name].grad.numpy()}, differences(loss, {name: every[name].detach().numpy()}, **steps)


def assert_gradients(got, wanted, tolerance):
    """Each gradient agrees to `tolerance` of its largest entry."""
    assert got.keys() >= wanted.keys()
    for name, expected in wanted.items():
        scale = np.abs(expected).max(initial=0) or 1.0
        np.testing.assert_allclose(got[name] / scale, expected / scale, atol=tolerance, rtol=0, err_msg=name)
