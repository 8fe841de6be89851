"""GS-Dynamics as a baseline. The workflow imports this module before any job exists, so it imports nothing heavy."""

from neuspring.baselines import Baseline

GS_DYNAMICS = Baseline(
    training="neuspring.extensions.gs_dynamics.train:train",
    prediction="neuspring.extensions.gs_dynamics.model:predict",
    model="neuspring.extensions.gs_dynamics.model:GsDynamicsModel",
    section="gs_dynamics",
    transfers=True,
)
