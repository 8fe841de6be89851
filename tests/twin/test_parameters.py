"""Trained parameters become physics: gradients through field and simulator, bounds, clamps, warm start."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.core.artifacts import Twin
from neuspring.physics.parameters import pack, twin_tensors
from neuspring.physics.solver import FrameSolver, simulate_frame
from neuspring.twin.field import in_cube, midpoints
from neuspring.twin.parameters import TwinParameters, inward_clamp, movement
from tests.support import small
from tests.support.scenes import random_scene, twin_of

STEP = 1e-6
ROUNDING = 1e-9
"""Absolute error of central differences: a loss of 0.7 in float64 is known to 1e-16, and 1e-16 / STEP = 1e-10; measured that."""
TRUNCATION = 1e-7
"""The same, relative to the largest derivative: STEP^2 = 1e-12 times third derivatives, which networks and contact make large."""
SINGLE = 1e-6
"""Relative: a few operations in float32, whose rounding is 6e-8."""
ALL = {"damping": "homogeneous", "output_bound": 1.5}


def twin() -> Twin:
    """Ten nodes, two controllers, about 20 springs of 20 to 200 N, some of them controllers'."""
    scene, x, _, hands = random_scene(3)
    return twin_of(scene, x, hands[0])


def parameters(kind: str = "field", start: Twin | None = None, field: dict | None = None, **settings) -> TwinParameters:
    """Trained values of the small twin."""
    fit = config.Fit(field=config.SpringFieldSettings(**(field or {})), **settings)
    return TwinParameters(start or twin(), fit, kind, "cpu")


def disturb(trained: TwinParameters, scale: float = 0.3, seed: int = 0) -> TwinParameters:
    """Every trained value moved away from its start, at random, but contact scalars hardly, so that they stay in range."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in trained.named_parameters():
            step = 0.01 if name.startswith("scalars") else scale
            tensor += step * torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
    return trained


def offsets(trained: TwinParameters, values: torch.Tensor | float) -> TwinParameters:
    """Offsets of single springs [S, channels] set to `values`."""
    with torch.no_grad():
        trained.offsets.copy_(torch.as_tensor(values).expand_as(trained.offsets))
    return trained


# Gradients ------------------------------------------------------------------------------------------------------------

TRAINED = {
    "field": ("field", {}, ALL | {"global_stiffness": True, "controller_factors": True}),
    "field of coordinates": ("field", {"triplane": False}, ALL),
    "springs": ("springs", {}, ALL | {"global_stiffness": True}),
}


@pytest.mark.parametrize("name", TRAINED)
def test_gradients_through_simulated_frames_match_differences(name):
    """A loss over three frames, through simulator, physical values and network, down to single weights and texels.

    The seed is one of a scene that touches the ground, so that every trained value has a gradient, and in which no stiffness
    lies beyond its clamp, where the gradient is not meant to be the derivative.
    """
    kind, field, settings = TRAINED[name]
    scene, x, v, hands = random_scene(9, substeps=10)
    start = twin_of(scene, x, hands[0])
    trained = parameters(kind, start, field, **settings).double()
    trained.start = {key: value.double() for key, value in trained.start.items()}
    disturb(trained, seed=0)
    topology, motion = start.topology, torch.tensor(hands)
    solver = FrameSolver(topology.springs, len(x), hands.shape[1], start.simulation, dtype=torch.float64)
    target = torch.tensor(np.random.default_rng(1).normal(size=(4, *x.shape)) * 0.1)

    def loss() -> torch.Tensor:
        packed, state = trained.pack(start.simulation.substep), (torch.tensor(x), torch.tensor(v))
        total = torch.zeros((), dtype=torch.float64)
        for frame in (1, 2, 3):
            state = simulate_frame(solver, packed, *state, motion[frame - 1], motion[frame])
            total = total + (state[0] - target[frame]).square().sum()
        return total

    loss().backward()
    for parameter_name, tensor in trained.named_parameters():
        if parameter_name.startswith("scalars.contact"):
            continue  # nodes do not collide in this scene
        flat, gradient = tensor.detach().view(-1), tensor.grad.view(-1)
        largest = gradient.abs().topk(min(3, len(flat))).indices.tolist()
        checked = sorted({*largest, 0, len(flat) // 2})
        measured = []
        for index in checked:
            value = float(flat[index])
            sides = []
            for sign in (1, -1):
                flat[index] = value + sign * STEP
                with torch.no_grad():
                    sides.append(float(loss()))
            flat[index] = value
            measured.append((sides[0] - sides[1]) / (2 * STEP))
        scale = float(gradient.abs().max())
        assert scale > 1e4 * ROUNDING, f"{parameter_name}: too small to be told from rounding"
        tolerance = ROUNDING + TRUNCATION * scale
        np.testing.assert_allclose(gradient[checked].numpy(), measured, rtol=0, atol=tolerance, err_msg=parameter_name)


@pytest.mark.parametrize(("value", "felt"), [(0.5, {1.0, -1.0}), (1.0, {1.0}), (2.0, {1.0}), (0.0, {-1.0}), (-2.0, {-1.0})])
def test_the_inward_clamp_feels_only_what_pulls_back(value, felt):
    """Above and at the upper limit, a positive gradient: a descent step leads back."""
    for gradient in (1.0, -1.0):
        at = torch.tensor([value], requires_grad=True)
        clamped = inward_clamp(at, 0.0, 1.0)
        assert clamped.item() == min(max(value, 0.0), 1.0)
        clamped.backward(torch.tensor([gradient]))
        assert at.grad.item() == (gradient if gradient in felt else 0.0)


def test_a_spring_beyond_a_limit_stays_there_as_released_and_a_field_finds_back():
    """The springs of a field move together, so those beyond the limit must say that they would be better off inside."""
    limit = (0.0, 100.0)
    single, field = parameters("springs", stiffness_range=limit), parameters("field", stiffness_range=limit)
    stiffness = single.start["stiffness"]
    beyond = stiffness > limit[1]
    assert 0 < beyond.sum() < len(beyond)
    for trained in (single, field):
        stiffness_used = trained.physical()["stiffness"]
        assert torch.equal(stiffness_used.detach(), stiffness.clamp(*limit))
        stiffness_used.sum().backward()  # as if lower stiffness were better
    assert torch.equal(single.offsets.grad[:, 0], stiffness.masked_fill(beyond, 0.0))
    torch.testing.assert_close(field.field.layers[-1].bias.grad[0], stiffness.sum(), rtol=SINGLE, atol=0)


# Values ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["springs", "field"])
def test_the_start_is_the_twin_whatever_is_trained(kind):
    """Bit for bit, in single precision."""
    start = twin()
    values = parameters(kind, start, **ALL, global_stiffness=True).physical()
    for name, value in twin_tensors(start, "cpu").items():
        assert torch.equal(values[name].detach().expand_as(value), value), name


def test_the_bound_of_stiffness():
    """However far the offsets go; and within its growth over the search."""
    for sign, growth, most in ((-1.0, 1e3, np.exp(-1.5)), (1.0, 1e3, np.exp(1.5)), (1.0, 4.0, 4.0)):
        trained = offsets(parameters("springs", **ALL), sign * 50.0)
        trained.stiffness_growth = growth
        torch.testing.assert_close(trained.physical()["stiffness"], trained.start["stiffness"] * most, rtol=SINGLE, atol=0)


def test_controllers_springs_may_have_factors_of_their_own():
    """Everything that is common to springs is then common to those of one kind; drag belongs to no spring."""
    settings = {"global_stiffness": True, "damping": "homogeneous", "controller_factors": True}
    trained, inner = parameters("springs", **settings), twin().topology.object_spring_count
    assert set(trained.factors) == {"stiffness", "drag", "dashpot", "controller_stiffness", "controller_dashpot"}
    with torch.no_grad():
        for name, value in (("stiffness", 2.0), ("controller_stiffness", 0.25), ("dashpot", 3.0), ("controller_dashpot", 0.5)):
            trained.factors[name].fill_(math.log(value))
    physical, start = trained.physical(), trained.start
    for name, inside, outside in (("stiffness", 2.0, 0.25), ("dashpot", 3.0, 0.5)):
        factor = torch.cat([torch.full((inner,), inside), torch.full((len(start[name]) - inner,), outside)])
        torch.testing.assert_close(physical[name].detach(), start[name] * factor, rtol=SINGLE, atol=0)
    assert 0 < inner < len(start["stiffness"])


def test_the_field_lives_on_the_rest_shape():
    start = twin()
    points = len(start.topology.nodes) + len(start.topology.controllers)
    shape = np.random.default_rng(0).uniform(0, 1, (points, 3)).astype(np.float32)
    trained = parameters(start=replace(start, topology=replace(start.topology, rest_shape=shape)))
    np.testing.assert_allclose(trained.field.coordinates, in_cube(midpoints(shape, start.topology.springs)), atol=SINGLE)


# Training -------------------------------------------------------------------------------------------------------------


def test_learning_rates_of_each_group():
    rates = {"learning_rate": 0.1, "factor_learning_rate": 0.4}
    trained = parameters(field={"plane_learning_rate": 0.3}, damping="homogeneous", **rates)
    expected = {"field.layers": 0.1, "field.planes": 0.3, "factors": 0.4}
    names = {tensor: name for name, tensor in trained.named_parameters()}
    for group in trained.groups():
        assert group["lr"] == group["base_rate"]
        for tensor in group["params"]:
            name = names.pop(tensor)
            wanted = next((values for start, values in expected.items() if name.startswith(start)), 0.1)
            assert group["lr"] == wanted, name
    assert not names, "every trained value belongs to one group"


@pytest.mark.parametrize("kind", ["springs", "field"])
def test_the_twin_is_what_is_simulated(kind):
    """The packed parameters of the twin that comes out are those of the training, bit for bit, clamps included."""
    start = twin()
    trained = disturb(parameters(kind, start, **ALL, stiffness_range=(0.0, 100.0)), 1.0)
    with torch.no_grad():
        trained.scalars["ground_elasticity"].fill_(1.2)  # beyond its clamp
    result, substep = trained.as_twin(start), start.simulation.substep
    again = pack(**twin_tensors(result, "cpu"), substep=substep)
    for name, expected in trained.pack(substep).items():
        assert torch.equal(again[name], expected.detach()), name
    assert result.material.stiffness.max() == 100
    np.testing.assert_array_equal(result.topology.springs, start.topology.springs)
    assert result.simulation == start.simulation


# What moved -----------------------------------------------------------------------------------------------------------


def of_scene(kind: str, **settings: object) -> TwinParameters:
    return TwinParameters(small.fit_problem().twin, config.Fit(**settings), kind, "cpu")


def test_shares_count_springs_at_the_bound_and_at_the_range():
    trained = of_scene("springs", output_bound=1.0, stiffness_range=(0.0, 6100.0))
    assert movement(trained) == {"at_bound": 0.0, "at_stiffness_range": 0.0}
    count = len(trained.start["stiffness"])
    with torch.no_grad():
        trained.offsets[:10] = 3.0  # tanh 3 = 0.995: at the bound, and above the range
        trained.offsets[10:30] = -3.0  # at the bound, within the range
        trained.offsets[30:70] = 0.5  # above the range, not at the bound
    figures = movement(trained)
    assert figures == pytest.approx({"at_bound": 30 / count, "at_stiffness_range": 50 / count})
