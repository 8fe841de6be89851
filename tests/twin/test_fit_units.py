"""A fit does not depend on the unit of length; the released unit can be selected."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.twin.fit import FitProblem, TwinFit
from neuspring.twin.parameters import topology_spacing
from tests.support import small

SINGLE = 1e-5
"""Relative: sums of gradients in float32."""
FIELD = config.SpringFieldSettings()
SETTINGS = {"springs": {}, "field": {"output_bound": 1.5, "horizon": 2}}


def in_unit(factor: float, kind: str, losses: config.Losses, **settings: object) -> FitProblem:
    """The default scene without ground, all lengths multiplied by `factor`: positions, gravity, forces of unit mass."""
    seen = small.observations()
    lengths = ("object_points", "controller_points", "surface_points", "interior_points", "tracks")
    seen = replace(seen, **{name: getattr(seen, name) * np.float32(factor) for name in lengths})
    fit = config.Fit(
        epochs=3,
        learning_rate=1e-2,
        global_stiffness=True,
        damping="homogeneous",
        field=FIELD,
        stiffness_range=(0.0, 1e5 * factor),
        **(SETTINGS[kind] | settings),
    )
    problem = small.fit_problem(kind=kind, fit=fit, losses=losses)
    topology, material, simulation = problem.twin.topology, problem.twin.material, problem.twin.simulation
    scaled = {name: getattr(topology, name) * np.float32(factor) for name in ("nodes", "controllers", "rest_lengths")}
    stiffness = material.stiffness * np.float32(factor)
    twin = replace(
        problem.twin,
        topology=replace(topology, **scaled),
        material=replace(material, stiffness=stiffness, contact_distance=material.contact_distance * factor),
        simulation=replace(simulation, gravity=simulation.gravity * factor, ground=False),
    )
    return replace(problem, observations=seen, twin=twin)


# Smooth L1 has its corner at 1 m, so errors may not grow beyond it.
UNITS = [(2.0**-10, config.Losses()), (2.0**10, config.Losses(track=0.0))]


@pytest.mark.parametrize(("factor", "losses"), UNITS, ids=["small", "large"])
@pytest.mark.parametrize("kind", ["springs", "field"])
def test_another_unit_of_length_gives_the_same_fit(kind, factor, losses):
    """Bit for bit where the factor is a power of two, so that no number is rounded otherwise."""
    here, there = TwinFit(in_unit(1.0, kind, losses)), TwinFit(in_unit(factor, kind, losses))
    for _ in range(3):
        rows = []
        for run in (here, there):
            run.set_rate(1.0)
            rows.append(small.done(run.epoch()))
        assert rows[1]["loss"] == rows[0]["loss"] * factor**2
        assert rows[1]["gradient_norm"] == rows[0]["gradient_norm"] > 0
    start = here.parameters.first
    for name, values in here.parameters.copy().items():
        np.testing.assert_array_equal(there.parameters.copy()[name], values, err_msg=name)
        if not name.startswith("scalars"):
            assert not np.array_equal(values, start[name]), name


def test_gradients_are_those_of_the_loss_in_its_unit():
    first = {}
    for unit in ("meter", "spacing"):
        run = TwinFit(small.fit_problem(fit=config.Fit(epochs=1, loss_unit=unit, horizon=0)))
        row = small.done(run.epoch())
        first[unit] = (run.parameters.offsets.grad.numpy(), row["loss"])
    spacing = topology_spacing(small.fit_problem().twin.topology)
    atol = SINGLE * np.abs(first["spacing"][0]).max()
    np.testing.assert_allclose(first["spacing"][0], first["meter"][0] / spacing**2, rtol=SINGLE, atol=atol)
    assert first["spacing"][1] == first["meter"][1], "recorded in m^2"


def test_epsilon_shortens_steps_of_small_gradients():
    """The first step of Adam is rate g / (|g| + epsilon)."""
    epsilon = 1e-6
    run = TwinFit(small.fit_problem(fit=config.Fit(epochs=1, epsilon=epsilon, loss_unit="meter", horizon=0, learning_rate=0.1)))
    small.done(run.epoch())
    gradient = run.parameters.offsets.grad
    expected = -0.1 * gradient / (gradient.abs() + epsilon)
    torch.testing.assert_close(run.parameters.offsets.detach(), expected, rtol=SINGLE, atol=1e-9)
    assert expected.abs().median() < 0.09
