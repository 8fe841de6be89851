"""The unloaded shape: what its displacement can do, what leaves lengths alone, and that a fit finds one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.core.artifacts import Topology
from neuspring.twin.fit import TwinFit, fit
from neuspring.twin.rest_shape import UnloadedShape, blending, topology_spacing
from neuspring.twin.topology import distances
from tests.support import small

EXACT = 1e-9
"""Relative: a least-squares solution in float64."""
SINGLE = 2e-6
"""Relative: differences of positions in float32, some ten times longer than a spring."""


def topology() -> Topology:
    return small.fit_problem().twin.topology


@pytest.mark.parametrize("handles", [2, 5, 1000])
def test_every_affine_map_is_met_exactly(handles):
    """The blend of one affine map at all handles is that map, wherever the handles are."""
    points = np.random.default_rng(0).normal(size=(40, 3)) * (1.0, 0.3, 0.01)
    matrix = blending(points, handles)
    assert matrix.shape == (40, 4 * min(handles, 40))
    wanted = points @ np.array([[0.1, 2.0, 0.0], [-0.4, 0.0, 1.0], [3.0, 0.0, 0.2]]) + [1.0, -2.0, 0.5]
    solution = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    np.testing.assert_allclose(matrix @ solution, wanted, atol=EXACT * np.abs(wanted).max())
    same = np.zeros((matrix.shape[1], 3))
    same[::4] = (1.0, 2.0, 3.0)
    np.testing.assert_allclose(matrix @ same, np.broadcast_to((1.0, 2.0, 3.0), (40, 3)), rtol=EXACT, err_msg="partition of unity")


def test_a_point_far_from_every_handle_still_belongs_to_some():
    points = np.concatenate([np.random.default_rng(0).normal(size=(30, 3)) * 0.01, [[100.0, 0.0, 0.0]]])
    assert np.isfinite(blending(points, 3)).all()
    np.testing.assert_allclose(blending(points, 3)[:, ::4].sum(axis=1), 1.0, rtol=EXACT)


def test_the_start_changes_no_length_and_a_rotation_none_either():
    shape = UnloadedShape(topology(), 6)
    assert torch.equal(shape(), torch.ones(len(topology().springs)))
    points = topology().canonical.astype(np.float64)
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = points @ quarter + 0.1 - points
    handles = np.linalg.lstsq(shape.matrix.double().numpy(), turned, rcond=None)[0]
    with torch.no_grad():
        shape.handles.copy_(torch.from_numpy(handles))
    torch.testing.assert_close(shape(), torch.ones_like(shape()), rtol=0, atol=1e-4)
    np.testing.assert_allclose(shape.displacement().detach().numpy(), turned, atol=1e-4 * np.abs(turned).max())


def test_lengths_are_those_of_the_displaced_shape():
    start = small.fit_problem().twin
    run = TwinFit(small.fit_problem(fit=config.Fit(epochs=1, rest_shape=config.RestShape(handles=5))))
    with torch.no_grad():
        run.parameters.unloaded.handles.normal_(0.0, 0.3, generator=torch.Generator().manual_seed(0))
    twin = run.parameters.as_twin(start)
    assert not np.allclose(twin.topology.rest_lengths, start.topology.rest_lengths, rtol=1e-2)
    expected = distances(twin.topology.canonical, start.topology.springs)
    np.testing.assert_allclose(twin.topology.rest_lengths, expected, rtol=1e-5)
    # Springs that were strained in the rest shape keep their ratio.
    strained = replace(start, topology=replace(start.topology, rest_lengths=start.topology.rest_lengths * np.float32(0.9)))
    other = TwinFit(small.fit_problem(twin=strained, fit=run.problem.fit))
    other.parameters.restore(run.parameters.copy())
    np.testing.assert_allclose(other.parameters.as_twin(strained).topology.rest_lengths, 0.9 * expected, rtol=1e-5)


@pytest.mark.parametrize("kind", ["springs", "field"])
def test_a_bent_unloaded_shape_is_found(kind):
    """What is filmed is a body that is unloaded in another shape; the stiffness is the true one."""
    start = small.fit_problem().twin
    field = config.SpringField(channels=4, hidden=8, bands=2)
    still = {"learning_rate": 1e-9, "scalar_learning_rate": 1e-9, "field": field}
    shape = config.RestShape(handles=4, prior=0.0, learning_rate=0.02)
    settings = config.Fit(epochs=15, horizon=2, rest_shape=shape, **still)
    bent = TwinFit(small.fit_problem(fit=settings))
    with torch.no_grad():
        bent.parameters.unloaded.handles.normal_(0.0, 0.2, generator=torch.Generator().manual_seed(1))
    truth = bent.parameters.as_twin(start)
    from neuspring.twin.rollout import roll_out

    seen = small.observations()
    filmed = replace(seen, object_points=roll_out(truth, seen.controller_points).positions[:, : seen.object_points.shape[1]])
    free = fit(small.fit_problem(filmed, fit=settings, kind=kind))
    fixed = fit(small.fit_problem(filmed, fit=replace(settings, rest_shape=config.RestShape()), kind=kind))
    assert free.best_loss < 0.3 * fixed.best_loss
    # The prior holds it back.
    held = fit(small.fit_problem(filmed, fit=replace(settings, rest_shape=replace(shape, prior=1e4)), kind=kind))
    assert held.figures["rest_strain"] < 0.2 * free.figures["rest_strain"]
    assert held.best_loss > 2 * free.best_loss


def test_the_topology_spacing_is_that_of_a_lattice_and_follows_the_unit():
    lattice = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3) * 0.02
    pairs = np.array([[0, 1]], np.int32)
    made = Topology(
        nodes=lattice.astype(np.float32),
        controllers=np.full((1, 3), 9.0, np.float32),
        springs=pairs,
        rest_lengths=np.full(1, 0.05, np.float32),
        labels=np.zeros(27, np.int32),
    )
    assert topology_spacing(made) == pytest.approx(0.02, rel=SINGLE)
    alone = replace(made, nodes=made.nodes[:1], labels=made.labels[:1], springs=np.array([[0, 1]], np.int32))
    assert topology_spacing(alone) == pytest.approx(0.05, rel=SINGLE), "one node: its springs"


def test_a_single_handle_is_refused():
    with pytest.raises(ValueError, match="at least 2"):
        config.RestShape(handles=1)
