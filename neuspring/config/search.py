"""Settings of the zero-order search: its variables, their ranges and scales."""

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
    """A variable of the search, which normalizes [low, high] to [0, 1] on its scale."""

    __pydantic_config__ = STRICT
    low: Finite
    high: Finite
    start: Finite
    """Start of the search, where a fixed variable stays."""
    scale: Literal["linear", "log"] = "linear"

    def normalized(self, value: float) -> float:
        """The place of a value in [low, high]."""
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
    """Variables of the search: lowest and highest value, start, and scale (linear or log). A setting names what differs."""

    stiffness: Variable = Variable(10.0, 1e5, 3e3, "log")
    """Stiffness Y of the springs, N."""
    object_radius: Variable = Variable(1.2, 5.0, 2.5)
    """Radius within which object nodes are joined, in units of `lengths`."""
    object_neighbors: Variable = Variable(10.0, 50.0, 30.0)
    """Most neighbors of an object node, itself included."""
    controller_radius: Variable = Variable(0.5, 5.0, 2.0)
    """Radius within which a controller is joined to object nodes, m; with `lengths: spacing` how far it goes beyond the smallest
    distance between a controller and a node, in spacings."""
    controller_neighbors: Variable = Variable(10.0, 80.0, 50.0)
    """Most object nodes that a controller is joined to."""
    ground_elasticity: Variable = Variable(0.0, 1.0, 0.5)
    """Restitution on the ground."""
    ground_friction: Variable = Variable(0.0, 2.0, 0.3)
    """Friction on the ground."""
    contact_elasticity: Variable = Variable(0.0, 1.0, 0.7)
    """Restitution between nodes."""
    contact_friction: Variable = Variable(0.0, 2.0, 0.3)
    """Friction between nodes."""
    contact_distance: Variable = Variable(0.5, 3.0, 1.0)
    """Distance at which nodes collide, in units of `lengths`."""
    drag: Variable = Variable(0.05, 50.0, 3.0, "log")
    """Velocity decay, 1/s."""
    dashpot: Variable = Variable(0.1, 500.0, 20.0, "log")
    """Damping along springs, N s/m."""

    @model_validator(mode="before")
    @classmethod
    def _over_defaults(cls, given: Any) -> Any:
        """The given values on top of the defaults of each variable."""
        if not isinstance(given, dict):
            return given
        defaults = dataclasses.asdict(cls())
        return {name: defaults.get(name, {}) | own if isinstance(own, dict) else own for name, own in given.items()}

    def __post_init__(self) -> None:
        for name in (spec.name for spec in dataclasses.fields(self)):
            low, high = getattr(self, name).low, getattr(self, name).high
            if not 0 <= low < high:
                raise ValueError(f"{name}: 0 <= low < high is required, received [{low}, {high}]")
        # An object node counts itself among its neighbors.
        for name, least in (("object_neighbors", 2), ("controller_neighbors", 1)):
            if getattr(self, name).low < least:
                raise ValueError(f"{name}: at least {least} is required, received {getattr(self, name).low}")
        if self.contact_distance.low <= 0:
            raise ValueError(f"contact_distance: must be positive, received {self.contact_distance.low}")


VARIABLES = tuple(spec.name for spec in dataclasses.fields(SearchVariables))


@dataclass(frozen=True, kw_only=True)
class Search(SettingsSection):
    """Zero-order stage: CMA-ES over homogeneous material and topology."""

    rollouts: Count = 220
    """Budget in candidate rollouts, the same for every method that is compared. The last generation may be cut short."""
    tied_rollouts: Annotated[int, Field(ge=0)] = 0
    """Rollouts, out of the budget, in which all regions share their values; afterwards each region is free around the best
    candidate."""
    isolated_nodes: Literal["repair", "allow"] = "repair"
    """Treatment of nodes and parts that no spring joins to the rest: join them, a part along its seam (repair), or leave them, as
    released (allow)."""
    lengths: Literal["spacing", "meter"] = "spacing"
    """Unit of radii and of contact_distance in `variables`: the distance between neighboring nodes in the rest shape,
    or meters, as released."""
    fixed: tuple[str, ...] = ()
    """Variables that keep their start and are not searched; the start may then lie outside the range."""
    hands: Literal["hold", "push", "auto"] = "hold"
    """Action of hands: their springs pull and push (hold, as released), only push, or what costs less (auto). push: they act only
    while they are shorter than at rest, and rest at `contact_distance` or, where a node was nearer in frame 0, there. auto: the
    first generation is judged in both ways, out of the budget, and the way of its best candidate is kept; hands push only if that
    also costs less than 0.9 of a body that stays."""
    controller_rest: Literal["rest_shape", "first_frame"] = "rest_shape"
    """Shape in which springs of controllers have no force: the body's rest shape, or frame 0, as a hand takes hold of a body that
    is bent already."""
    variables: SearchVariables = field(default_factory=SearchVariables)

    def __post_init__(self) -> None:
        unknown = [name for name in self.fixed if name not in VARIABLES]
        if unknown or len(set(self.fixed)) != len(self.fixed) or len(VARIABLES) - len(self.fixed) < 2:
            rule = f"different ones of {', '.join(VARIABLES)} are required, two of which stay free"
            raise ValueError(f"fixed: {rule}, received {list(self.fixed)}")
        for name in VARIABLES:
            if name in self.fixed:
                continue
            it = getattr(self.variables, name)
            if not it.low <= it.start <= it.high:
                raise ValueError(f"variables.{name}: start = {it.start} lies outside [{it.low}, {it.high}]")
            if it.scale == "log" and it.low <= 0:
                raise ValueError(f"variables.{name}: scale log needs a positive low, received {it.low}")
        if self.tied_rollouts >= self.rollouts:
            raise ValueError(f"tied_rollouts must be below rollouts ({self.rollouts}), received {self.tied_rollouts}")
