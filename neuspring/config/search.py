"""Settings of the search: its variables with ranges and scales, and its budget."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from neuspring.core.section import STRICT, Count, Finite, SettingsSection

LENGTHS = ("object_radius", "controller_radius", "contact_distance")
"""Variables in units of `search.lengths`."""


@dataclass(frozen=True)
class Variable:
    """A variable of the search; its scale maps [low, high] to [0, 1]."""

    __pydantic_config__ = STRICT
    low: Finite
    high: Finite
    start: Finite
    """Start of the search; the value of a fixed variable."""
    scale: Literal["linear", "log"] = "linear"

    def normalized(self, value: float) -> float:
        """Map a value from [low, high] to [0, 1]."""
        if self.scale == "log":
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        return (value - self.low) / (self.high - self.low)

    def value(self, normalized: float) -> float:
        """The inverse of `normalized`."""
        if self.scale == "log":
            return float(self.low * (self.high / self.low) ** normalized)
        return self.low + normalized * (self.high - self.low)


@dataclass(frozen=True, kw_only=True)
class SearchVariables(SettingsSection):
    """Variables of the search: low, high, start, and scale (linear or log). Omitted entries keep their defaults."""

    stiffness: Variable = Variable(10.0, 1e5, 3e3, "log")
    """Stiffness Y of the springs, N."""
    object_radius: Variable = Variable(1.2, 5.0, 2.5)
    """Connection radius of nodes, in units of `lengths`."""
    object_neighbors: Variable = Variable(10.0, 50.0, 30.0)
    """Maximum number of neighbors of a node, including itself."""
    controller_radius: Variable = Variable(0.5, 5.0, 2.0)
    """Connection radius of controllers, m; with `lengths: spacing`, the excess over the smallest controller-node distance, in
    spacings."""
    controller_neighbors: Variable = Variable(10.0, 80.0, 50.0)
    """Maximum number of nodes connected to a controller."""
    ground_elasticity: Variable = Variable(0.0, 1.0, 0.5)
    """Restitution at the ground."""
    ground_friction: Variable = Variable(0.0, 2.0, 0.3)
    """Coefficient of friction at the ground."""
    contact_elasticity: Variable = Variable(0.0, 1.0, 0.7)
    """Restitution between nodes."""
    contact_friction: Variable = Variable(0.0, 2.0, 0.3)
    """Coefficient of friction between nodes."""
    contact_distance: Variable = Variable(0.5, 3.0, 1.0)
    """Distance at which nodes collide, in units of `lengths`."""
    drag: Variable = Variable(0.05, 50.0, 3.0, "log")
    """Exponential decay rate of velocity, 1/s."""
    dashpot: Variable = Variable(0.1, 500.0, 20.0, "log")
    """Damping along springs, N s/m."""

    @model_validator(mode="before")
    @classmethod
    def _over_defaults(cls, given: Any) -> Any:
        """Override the defaults of each variable with the given values."""
        if not isinstance(given, dict):
            return given
        defaults = dataclasses.asdict(cls())
        return {name: defaults.get(name, {}) | value if isinstance(value, dict) else value for name, value in given.items()}

    def __post_init__(self) -> None:
        for name in (spec.name for spec in dataclasses.fields(self)):
            low, high = getattr(self, name).low, getattr(self, name).high
            if not 0 <= low < high:
                raise ValueError(f"{name}: 0 <= low < high is required, received [{low}, {high}]")
        # A node counts itself as a neighbor.
        for name, least in (("object_neighbors", 2), ("controller_neighbors", 1)):
            if getattr(self, name).low < least:
                raise ValueError(f"{name}: at least {least} is required, received {getattr(self, name).low}")
        if self.contact_distance.low <= 0:
            raise ValueError(f"contact_distance: must be positive, received {self.contact_distance.low}")


VARIABLES = tuple(spec.name for spec in dataclasses.fields(SearchVariables))


@dataclass(frozen=True, kw_only=True)
class Search(SettingsSection):
    """CMA-ES over topology and homogeneous material."""

    rollouts: Count = 220
    """Budget in candidate rollouts, equal for all compared methods. The last generation may be incomplete."""
    tied_rollouts: Annotated[int, Field(ge=0)] = 0
    """Rollouts of the budget in which all regions share their values; afterwards each region varies around the best candidate."""
    isolated_nodes: Literal["repair", "allow"] = "repair"
    """Nodes and parts without a spring to the rest: connect them (repair), or leave them (allow, as released). A part is
    connected along its seam."""
    lengths: Literal["spacing", "meter"] = "spacing"
    """Unit of radii and contact_distance in `variables`: the node spacing of the rest shape, or meters (as released)."""
    fixed: tuple[str, ...] = ()
    """Variables that keep their start value, which may be outside the range."""
    hands: Literal["hold", "push", "auto"] = "hold"
    """Controller springs pull and push (hold, as released), only push, or take the cheaper mode (auto). push: springs act only
    while they are shorter than their rest length, which is `contact_distance`, or the distance in frame 0 if that is smaller.
    auto: the first generation is evaluated in both modes, within the budget, and the mode of its best candidate is kept; push
    also requires a cost below 0.9 of that of a static object."""
    controller_rest: Literal["rest_shape", "first_frame"] = "rest_shape"
    """Shape in which controller springs have no force: the rest shape, or frame 0. Use first_frame if the object is already bent
    when it is grasped."""
    variables: SearchVariables = field(default_factory=SearchVariables)

    def __post_init__(self) -> None:
        unknown = [name for name in self.fixed if name not in VARIABLES]
        if unknown or len(set(self.fixed)) != len(self.fixed) or len(VARIABLES) - len(self.fixed) < 2:
            rule = f"entries must be different variables ({', '.join(VARIABLES)}), and at least two must stay free"
            raise ValueError(f"fixed: {rule}, received {list(self.fixed)}")
        for name in VARIABLES:
            if name in self.fixed:
                continue
            spec = getattr(self.variables, name)
            if not spec.low <= spec.start <= spec.high:
                raise ValueError(f"variables.{name}: start must be in [{spec.low}, {spec.high}], received {spec.start}")
            if spec.scale == "log" and spec.low <= 0:
                raise ValueError(f"variables.{name}: scale log requires a positive low, received {spec.low}")
        if self.tied_rollouts >= self.rollouts:
            raise ValueError(f"tied_rollouts must be below rollouts ({self.rollouts}), received {self.tied_rollouts}")
