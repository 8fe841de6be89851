"""Settings of the baseline models, which learn or need no spring-mass twin: `model` of a method row names one."""

from __future__ import annotations

from dataclasses import dataclass, field

from neuspring.config.gs_dynamics import GsDynamics
from neuspring.config.spring_gaus import SpringGaus
from neuspring.config.types import Section


@dataclass(frozen=True, kw_only=True)
class Baselines(Section):
    """The models of the baselines; a method's own `settings` go on top."""

    spring_gaus: SpringGaus = field(default_factory=SpringGaus)
    gs_dynamics: GsDynamics = field(default_factory=GsDynamics)
