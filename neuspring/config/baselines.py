"""Settings of the baseline models, which learn or need no spring-mass twin: `model` of a method row names one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from neuspring.config.gs_dynamics import GsDynamics
from neuspring.config.spring_gaus import SpringGaus
from neuspring.config.types import Section

Model = Literal["spring_gaus", "gs_dynamics", "static", "controller_lbs"]
"""spring_gaus: anchors with directed springs. gs_dynamics: a graph network. static: frame 0 is frozen. controller_lbs: the object
is skinned to the controllers."""
TRAINING = {"spring_gaus": "neuspring.baselines.spring_gaus.setup", "gs_dynamics": "neuspring.baselines.gs_dynamics.train"}
"""Models that are trained, and the module from which all their code is reached."""


@dataclass(frozen=True, kw_only=True)
class Baselines(Section):
    """The models of the baselines; a method's own `settings` go on top."""

    spring_gaus: SpringGaus = field(default_factory=SpringGaus)
    gs_dynamics: GsDynamics = field(default_factory=GsDynamics)
