"""Settings of the zero-order search: its variables, their ranges and scales, and the polish that follows."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import Count, NonNegative, Positive, Range, Section

Scale = Literal["linear", "log"]
LENGTHS = ("object_radius", "controller_radius", "contact_distance")
"""Variables in units of `search.lengths`."""
EXTRA = ("bending",)
"""Variables beyond the released ones."""
HANDS = ("hand_tilt", "hand_size", "hand_depth")
"""Variables of how far hands are from a camera without depth; of captures with depth there are none."""
TOPOLOGY = ("object_radius", "object_neighbors", "controller_radius", "controller_neighbors")
"""Variables that decide which springs there are, so that a twin changes in jumps with them."""


@dataclass(frozen=True, kw_only=True)
class SearchRanges(Section):
    """Bounds of the zero-order search."""

    stiffness: Range = (10.0, 1e5)
    """Stiffness Y of the springs, N."""
    object_radius: Range = (1.2, 5.0)
    """Radius within which object nodes are joined, in units of `lengths`."""
    object_neighbors: Range = (10, 50)
    """Most neighbors of an object node, itself included."""
    controller_radius: Range = (0.5, 5.0)
    """Radius within which a controller is joined to object nodes, m; with `lengths: spacing` how far it goes beyond the smallest
    distance between a controller and a node, in spacings."""
    controller_neighbors: Range = (10, 80)
    """Most object nodes that a controller is joined to."""
    ground_elasticity: Range = (0.0, 1.0)
    """Restitution on the ground."""
    ground_friction: Range = (0.0, 2.0)
    """Friction on the ground."""
    contact_elasticity: Range = (0.0, 1.0)
    """Restitution between nodes."""
    contact_friction: Range = (0.0, 2.0)
    """Friction between nodes."""
    contact_distance: Range = (0.5, 3.0)
    """Distance at which nodes collide, in units of `lengths`."""
    drag: Range = (0.05, 50.0)
    """Velocity decay, 1/s."""
    dashpot: Range = (0.1, 500.0)
    """Damping along springs, N s/m."""
    bending: Range = (0.001, 100.0)
    """Stiffness and dashpot of bending springs over those of the others; searched where `extra` names it."""
    hand_tilt: Range = (-15.0, 60.0)
    """Color alone: tilt of the plane through its grip in which a hand moves, degrees. 0: upright, facing the camera. 90: level."""
    hand_size: Range = (0.0, 1.0)
    """Color alone: how much of a hand's distance follows from its apparent size, the rest from that plane."""
    hand_depth: Range = (0.97, 1.03)
    """Color alone: factors on a hand's distance from the camera at its knots (`hand_knots`)."""

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            low, high = getattr(self, spec.name)
            if not (0 <= low < high or (spec.name == "hand_tilt" and -90 < low < high)):
                raise ValueError(f"{spec.name}: 0 <= low < high is required, received [{low}, {high}]")
        # An object node counts itself among its neighbors.
        for name, least in (("object_neighbors", 2), ("controller_neighbors", 1)):
            if getattr(self, name)[0] < least:
                raise ValueError(f"{name}: at least {least} is required, received {getattr(self, name)[0]}")
        if self.contact_distance[0] <= 0:
            raise ValueError(f"contact_distance: must be positive, received {self.contact_distance[0]}")


@dataclass(frozen=True, kw_only=True)
class SearchScales(Section):
    """Scale on which each variable is normalized; log needs a positive lower bound of its range."""

    stiffness: Scale = "log"
    """Stiffness Y of the springs."""
    object_radius: Scale = "linear"
    """Radius within which object nodes are joined."""
    object_neighbors: Scale = "linear"
    """Most neighbors of an object node."""
    controller_radius: Scale = "linear"
    """Radius within which a controller is joined to object nodes."""
    controller_neighbors: Scale = "linear"
    """Most object nodes that a controller is joined to."""
    ground_elasticity: Scale = "linear"
    """Restitution on the ground."""
    ground_friction: Scale = "linear"
    """Friction on the ground."""
    contact_elasticity: Scale = "linear"
    """Restitution between nodes."""
    contact_friction: Scale = "linear"
    """Friction between nodes."""
    contact_distance: Scale = "linear"
    """Distance at which nodes collide."""
    drag: Scale = "log"
    """Velocity decay."""
    dashpot: Scale = "log"
    """Damping along springs."""
    bending: Scale = "log"
    """Stiffness and dashpot of bending springs over those of the others."""
    hand_tilt: Scale = "linear"
    """Tilt of the plane in which a hand moves."""
    hand_size: Scale = "linear"
    """How much apparent size says of a hand's distance."""
    hand_depth: Scale = "log"
    """Factors on a hand's distance."""


@dataclass(frozen=True, kw_only=True)
class SearchStart(Section):
    """Where the search starts, in the units of `ranges`."""

    stiffness: float = 3e3
    """Stiffness Y of the springs, N."""
    object_radius: float = 2.5
    """Radius within which object nodes are joined."""
    object_neighbors: float = 30
    """Most neighbors of an object node, itself included."""
    controller_radius: float = 2.0
    """Radius within which a controller is joined to object nodes."""
    controller_neighbors: float = 50
    """Most object nodes that a controller is joined to."""
    ground_elasticity: float = 0.5
    """Restitution on the ground."""
    ground_friction: float = 0.3
    """Friction on the ground."""
    contact_elasticity: float = 0.7
    """Restitution between nodes."""
    contact_friction: float = 0.3
    """Friction between nodes."""
    contact_distance: float = 1.0
    """Distance at which nodes collide."""
    drag: float = 3.0
    """Velocity decay, 1/s."""
    dashpot: float = 20.0
    """Damping along springs, N s/m."""
    bending: float = 0.1
    """Stiffness and dashpot of bending springs over those of the others."""
    hand_tilt: float = 0.0
    """Tilt of the plane in which a hand moves, degrees."""
    hand_size: float = 0.0
    """How much apparent size says of a hand's distance."""
    hand_depth: float = 1.0
    """Factors on a hand's distance."""


@dataclass(frozen=True, kw_only=True)
class Clusters(Section):
    """Regions of a piecewise topology: agglomerative clustering of the nodes in the rest shape; a search row says how many."""

    linkage: Literal["ward", "complete", "average", "single"] = "ward"
    """Distance between regions; the two nearest regions merge. ward: the growth of their variance."""
    connectivity: Annotated[int, Field(ge=0)] = 0
    """Number of nearest neighbors in a graph of the nodes; only regions that this graph joins may merge. 0: any two may merge."""


@dataclass(frozen=True, kw_only=True)
class Polish(Section):
    """Levenberg-Marquardt after CMA-ES: from its best candidate, in few variables, on the residuals of all training frames."""

    rounds: Annotated[int, Field(ge=0)] = 6
    """Most rounds; 0: no polish. A round takes a rollout, one more per variable for the slopes, and four for the damped steps."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Largest part of the budget `rollouts` that its rounds may take: a search of few rollouts has fewer rounds, or none."""
    variables: tuple[str, ...] = ("stiffness", "dashpot", "drag")
    """What is polished: variables of `ranges` that decide nothing of which springs and pairs there are; fixed ones are left out."""
    step: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    """Step of the finite differences, in normalized variables."""
    tolerance: NonNegative = 1e-3
    """A round whose step lowers the cost by less than this fraction of it is the last."""

    def __post_init__(self) -> None:
        allowed = [s.name for s in dataclasses.fields(SearchRanges) if s.name not in (*TOPOLOGY, "contact_distance")]
        unknown = [name for name in self.variables if name not in allowed]
        if unknown or len(set(self.variables)) != len(self.variables) or not self.variables:
            raise ValueError(f"variables: different ones of {', '.join(allowed)} are required, received {list(self.variables)}")


@dataclass(frozen=True, kw_only=True)
class Search(Section):
    """Zero-order stage: CMA-ES over homogeneous material and topology, then a polish of few variables."""

    rollouts: Count = 220
    """Budget in candidate rollouts, those of the polish included, the same for every method that is compared. The last generation
    of CMA-ES may be cut short."""
    sigma: Positive = 1 / 6
    """Initial step in normalized variables."""
    tied_rollouts: Annotated[int, Field(ge=0)] = 0
    """Rollouts, out of the budget, in which all regions share their values; afterwards each region is free around the best
    candidate."""
    freed_sigma: Positive = 0.06
    """Step in normalized variables after `tied_rollouts`, when each region becomes free."""
    isolated_nodes: Literal["repair", "penalize", "allow"] = "repair"
    """Nodes without any spring. repair: join them to their 3 nearest nodes. penalize: refuse the candidate. allow: leave them, as
    released."""
    lengths: Literal["spacing", "meter"] = "spacing"
    """Unit of object_radius, controller_radius and contact_distance in `ranges` and `start`. spacing: the distance between
    neighboring nodes in the rest shape, measured on each object (neuspring/twin/README.md). meter: as released."""
    extra: tuple[Literal["bending"], ...] = ()
    """Variables beyond the released ones that are searched too; without them what they describe is absent."""
    bending_reach: Range = (1.6, 2.6)
    """Lengths of bending springs, from and to, in node spacings of the rest shape; two spacings lie across one node between."""
    hand_knots: Annotated[int, Field(ge=0)] = 3
    """Color alone: knots of each hand's distance, spread evenly over the training frames after frame 0; between them the factor is
    a smooth curve, and it stays as it is after the last one."""
    fixed: tuple[str, ...] = ()
    """Variables that keep their start and are not searched; the start may then lie outside the range."""
    controller_rest: Literal["rest_shape", "first_frame"] = "rest_shape"
    """Where springs of controllers have no force, if the rest shape is not frame 0. rest_shape: where the body's have none.
    first_frame: in frame 0, as a hand takes hold of a body that is bent already."""
    clusters: Clusters = field(default_factory=Clusters)
    ranges: SearchRanges = field(default_factory=SearchRanges)
    scales: SearchScales = field(default_factory=SearchScales)
    start: SearchStart = field(default_factory=SearchStart)
    polish: Polish = field(default_factory=Polish)

    def __post_init__(self) -> None:
        if len(set(self.extra)) != len(self.extra):
            raise ValueError(f"extra: different ones are required, received {list(self.extra)}")
        if not 0 < self.bending_reach[0] < self.bending_reach[1]:
            raise ValueError(f"bending_reach: 0 < from < to is required, received {list(self.bending_reach)}")
        names = [spec.name for spec in dataclasses.fields(self.start)]
        unknown = [name for name in self.fixed if name not in names]
        if unknown or len(set(self.fixed)) != len(self.fixed) or len(names) - len(self.fixed) < 2:
            rule = f"different ones of {', '.join(names)} are required, two of which stay free"
            raise ValueError(f"fixed: {rule}, received {list(self.fixed)}")
        for name in names:
            if name in self.fixed:
                continue
            low, high = getattr(self.ranges, name)
            value = getattr(self.start, name)
            if not low <= value <= high:
                raise ValueError(f"start.{name} = {value} lies outside ranges.{name} = [{low}, {high}]")
            if getattr(self.scales, name) == "log" and low <= 0:
                raise ValueError(f"scales.{name}: log needs a positive lower bound of ranges.{name}, received {[low, high]}")
        if self.tied_rollouts >= self.cma_rollouts:
            rule = f"tied_rollouts must be below rollouts, without those of the polish ({self.cma_rollouts})"
            raise ValueError(f"{rule}, received {self.tied_rollouts}")

    @property
    def absent(self) -> tuple[str, ...]:
        """Variables beyond the released ones that are not asked for."""
        return tuple(name for name in EXTRA if name not in self.extra)

    @property
    def polished(self) -> tuple[str, ...]:
        """Variables of the polish; those of hands count only where there are any."""
        left_out = (*self.fixed, *self.absent, *HANDS)
        return tuple(name for name in self.polish.variables if name not in left_out)

    @property
    def polish_rounds(self) -> int:
        """Most rounds of the polish that its share of the budget holds."""
        return self.rounds_of(len(self.polished))

    def rounds_of(self, polished: int) -> int:
        """As `polish_rounds`, for a number of polished variables."""
        if not polished:
            return 0
        return min(self.polish.rounds, int(self.polish.share * self.rollouts) // round_rollouts(polished))

    @property
    def cma_rollouts(self) -> int:
        """Rollouts of CMA-ES: the budget without what the polish may take."""
        return self.cma_rollouts_of(len(self.polished))

    def cma_rollouts_of(self, polished: int) -> int:
        """As `cma_rollouts`, for a number of polished variables."""
        return self.rollouts - self.rounds_of(polished) * round_rollouts(polished)


def round_rollouts(polished: int) -> int:
    """Rollouts of a round of the polish of so many variables."""
    return 1 + polished + TRIALS


TRIALS = 4
"""Damped steps that a round of the polish tries."""
