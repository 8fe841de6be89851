"""GS-Dynamics as a baseline: what the workflow asks before any job exists, so that nothing heavy is imported."""

from neuspring.baselines import Baseline

GS_DYNAMICS = Baseline(
    training="neuspring.extensions.gs_dynamics.train:train",
    prediction="neuspring.extensions.gs_dynamics.model:predict",
    model="neuspring.extensions.gs_dynamics.model:GsDynamicsModel",
    section="gs_dynamics",
    transfers=True,
)
