"""The two-material study: equilibrium as in the simulator, derivatives as in finite differences, an even twist."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring.twin.rollout import roll_out
from results.published.two_materials import beams
from results.published.two_materials.make import regional


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    """A coarse beam whose surface is one triangle."""
    path = tmp_path_factory.mktemp("cad") / "beam.obj"
    path.write_text("v -7 1 1.5\nv 0 -1 1.5\nv 5 1 1.5\nf 1/1 2/2 3/3\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beams, "CELLS", 2)
        return beams.Beam(path)


def test_equilibrium_is_where_a_damped_rollout_ends(beam):
    held = beams.Held(beam, beam.clamps[0])
    stiffness = np.full(len(held.kept), 20.0)
    nodes = held.settle(stiffness)
    simulation = replace(held.twin.simulation, substeps=200)
    twin = replace(held.twin, material=replace(held.twin.material, stiffness=stiffness), simulation=simulation)
    end = roll_out(twin, np.repeat(twin.topology.controllers[None], 61, axis=0)).positions[-1]
    sag = np.abs(nodes[held.free] - held.rest).max()
    assert sag > 0.01
    # Single precision, and what motion is left.
    np.testing.assert_allclose(end, nodes[held.free], atol=2e-6)


def test_derivatives_by_stiffness_are_those_of_differences(beam):
    held = beams.Held(beam, beam.clamps[0])
    weights, law = torch.from_numpy(np.random.default_rng(0).normal(size=(len(beam.nodes), 3))), regional(held, None)
    p = torch.tensor([3.2, 2.5, 1.3], dtype=torch.float64, requires_grad=True)

    def value(q):
        return (weights * beams.Equilibrium.apply(law(q).exp(), held)).sum()

    value(p).backward()
    for k in range(3):
        step = 1e-4 * torch.eye(3, dtype=torch.float64)[k]
        slope = (value(p.detach() + step) - value(p.detach() - step)) / 2e-4
        assert float(p.grad[k]) == pytest.approx(float(slope), rel=1e-4)
