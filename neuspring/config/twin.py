"""Settings of the twin's two stages: the zero-order search and the first-order fit, with their losses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import Count, NonNegative, Positive, Range, Section

Beta = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class Losses(Section):
    """Weights of the training losses; the defaults are those of the released PhysTwin code."""

    chamfer: NonNegative = 1.0
    """Weight of the squared one-way Chamfer distance."""
    track: NonNegative = 1.0
    """Weight of the smooth-L1 error of tracked points."""
    acceleration: NonNegative = 0.01
    """Weight of the acceleration loss, which the search alone uses, as in the released method."""


@dataclass(frozen=True, kw_only=True)
class SearchRanges(Section):
    """Bounds of the zero-order search."""

    stiffness: Range = (0.0, 1e5)
    """Stiffness Y of the springs, N."""
    object_radius: Range = (0.01, 0.05)
    """Radius within which object nodes are joined, m."""
    object_neighbours: Range = (10, 50)
    """Most neighbors of an object node, itself included."""
    controller_radius: Range = (0.01, 0.08)
    """Radius within which a controller is joined to object nodes, m."""
    controller_neighbours: Range = (10, 80)
    """Most object nodes that a controller is joined to."""
    ground_elasticity: Range = (0.0, 1.0)
    """Restitution on the ground."""
    ground_friction: Range = (0.0, 2.0)
    """Friction on the ground."""
    contact_elasticity: Range = (0.0, 1.0)
    """Restitution between nodes."""
    contact_friction: Range = (0.0, 2.0)
    """Friction between nodes."""
    contact_distance: Range = (0.01, 0.05)
    """Distance at which nodes collide, m."""
    drag: Range = (0.0, 20.0)
    """Velocity decay, 1/s."""
    dashpot: Range = (0.0, 200.0)
    """Damping along springs, N s/m."""

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            low, high = getattr(self, spec.name)
            if not 0 <= low < high:
                raise ValueError(f"{spec.name}: 0 <= low < high is required, received [{low}, {high}]")
        # An object node counts itself among its neighbors.
        for name, least in (("object_neighbours", 2), ("controller_neighbours", 1)):
            if getattr(self, name)[0] < least:
                raise ValueError(f"{name}: at least {least} is required, received {getattr(self, name)[0]}")
        if self.contact_distance[0] <= 0:
            raise ValueError(f"contact_distance: must be positive, received {self.contact_distance[0]}")


@dataclass(frozen=True, kw_only=True)
class SearchStart(Section):
    """Where the search starts; the defaults are those of the released configuration."""

    stiffness: float = 3e4
    """Stiffness Y of the springs, N."""
    object_radius: float = 0.02
    """Radius within which object nodes are joined, m."""
    object_neighbours: float = 30
    """Most neighbors of an object node, itself included."""
    controller_radius: float = 0.04
    """Radius within which a controller is joined to object nodes, m."""
    controller_neighbours: float = 50
    """Most object nodes that a controller is joined to."""
    ground_elasticity: float = 0.5
    """Restitution on the ground."""
    ground_friction: float = 0.3
    """Friction on the ground."""
    contact_elasticity: float = 0.7
    """Restitution between nodes."""
    contact_friction: float = 0.3
    """Friction between nodes."""
    contact_distance: float = 0.02
    """Distance at which nodes collide, m."""
    drag: float = 3.0
    """Velocity decay, 1/s."""
    dashpot: float = 100.0
    """Damping along springs, N s/m."""


@dataclass(frozen=True, kw_only=True)
class Clusters(Section):
    """Regions of a piecewise topology: agglomerative clustering of the nodes in the rest shape; a search row says how many."""

    linkage: Literal["ward", "complete", "average", "single"] = "ward"
    """Distance between regions; the two nearest regions merge. ward: the growth of their variance."""
    connectivity: Annotated[int, Field(ge=0)] = 0
    """Number of nearest neighbors in a graph of the nodes; only regions that this graph joins may merge. 0: any two may merge."""


@dataclass(frozen=True, kw_only=True)
class Search(Section):
    """Zero-order stage: CMA-ES over homogeneous material and topology."""

    rollouts: Count = 220
    """Budget in candidate rollouts, the same for every method that is compared. The last generation may be cut short."""
    sigma: Positive = 1 / 6
    """Initial step in normalized variables."""
    tied_rollouts: Annotated[int, Field(ge=0)] = 0
    """Rollouts, out of the budget, in which all regions share their values; afterwards each region is free around the best
    candidate."""
    freed_sigma: Positive = 0.06
    """Step in normalized variables after `tied_rollouts`, when each region becomes free."""
    stiffness_scale: Literal["linear", "log"] = "linear"
    """Scale on which stiffness is normalized; log needs a positive lower bound."""
    isolated_nodes: Literal["repair", "penalise", "allow"] = "repair"
    """Nodes without any spring. repair: join them to their 3 nearest nodes. penalise: refuse the candidate. allow: leave them, as
    released."""
    controller_rest: Literal["rest_shape", "first_frame"] = "rest_shape"
    """Where springs of controllers have no force, if the rest shape is not frame 0. rest_shape: where the body's have none.
    first_frame: in frame 0, as a hand takes hold of a body that is bent already."""
    clusters: Clusters = field(default_factory=Clusters)
    ranges: SearchRanges = field(default_factory=SearchRanges)
    start: SearchStart = field(default_factory=SearchStart)

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self.start):
            low, high = getattr(self.ranges, spec.name)
            value = getattr(self.start, spec.name)
            if not low <= value <= high:
                raise ValueError(f"start.{spec.name} = {value} lies outside ranges.{spec.name} = [{low}, {high}]")
        if self.stiffness_scale == "log" and self.ranges.stiffness[0] <= 0:
            rule = "stiffness_scale: log needs a positive lower bound of ranges.stiffness"
            raise ValueError(f"{rule}, received {list(self.ranges.stiffness)}")
        if self.tied_rollouts >= self.rollouts:
            raise ValueError(f"tied_rollouts must be below rollouts ({self.rollouts}), received {self.tied_rollouts}")


@dataclass(frozen=True, kw_only=True)
class SpringField(Section):
    """Neural spring field: S(e) = S0 + F(x_mid(e)), F a tri-plane and a small MLP over spring midpoints in the rest shape."""

    triplane: bool = True
    """Use three feature planes (xy, yz, xz), bilinear, summed. false: F is an MLP on Fourier features of the coordinates."""
    resolution: Annotated[int, Field(ge=2)] | Literal["adaptive"] = "adaptive"
    """Texels N per side of a plane; adaptive: round(adaptive_factor sqrt(springs)), at least 2."""
    adaptive_factor: Positive = 0.85
    """Factor of the resolution where `resolution` is adaptive."""
    channels: Count = 32
    """Features per texel, C."""
    hidden: Count = 128
    """Units per hidden layer of the MLP, which has three layers."""
    fourier: Literal["feature", "coordinates", "both", "none"] = "both"
    """What the Fourier transform is applied to: the summed plane feature, the coordinates (concatenated), or both."""
    bands: Count = 4
    """Number of frequencies 1, 2, 4, ... (times pi) of the Fourier transform."""
    scale: Literal["log", "linear"] = "log"
    """log: Y = Y0 exp(F). linear: Y = Y0 (1 + F)."""
    controllers: bool = True
    """The field covers controller springs too; false: they keep S0."""
    plane_learning_rate: Positive | None = None
    """Learning rate of the texels; null: that of the MLP."""
    plane_smoothness: NonNegative = 0.0
    """Weight of the mean squared difference of neighboring texels, m^2."""
    weight_decay: NonNegative = 0.0
    """Decoupled weight decay of texels and MLP."""


@dataclass(frozen=True, kw_only=True)
class Fit(Section):
    """First-order stage: Adam, with gradients through the simulation. A method's `fit` says what is free per spring."""

    epochs: Count = 200
    """Passes over the training frames."""
    learning_rate: Positive = 1e-3
    """Adam's learning rate of log stiffness per spring, or of the field's weights."""
    scalar_learning_rate: Positive | None = None
    """Learning rate of contact scalars, drag and common factors; null: `learning_rate`."""
    rest_learning_rate: Positive | None = None
    """Learning rate of rest lengths that are free beside a field; null: `learning_rate`."""
    betas: tuple[Beta, Beta] = (0.9, 0.99)
    """Adam's decay rates of the first and the second moment."""
    schedule: Literal["constant", "cosine"] = "constant"
    """Learning rates over the epochs; cosine: they fall to a hundredth."""
    warmup_epochs: Annotated[int, Field(ge=0)] = 0
    """Epochs over which learning rates rise linearly."""
    homogeneous_epochs: Annotated[int, Field(ge=0)] = 0
    """First epochs, in which one common factor and the scalars are trained, not single springs: a warm start."""
    horizon: Annotated[int, Field(ge=0)] = 1
    """Frames per optimizer step, with the gradient through all of them; 0: all training frames."""
    clip_gradient_norm: NonNegative = 0.0
    """Largest norm of the gradient; 0 disables clipping."""
    output_bound: NonNegative = 0.0
    """Bound b of the change per spring: stiffness (and dashpot) stay within exp(+-b) of the searched value, by b tanh(x / b).
    Common factors come on top. 0: no bound."""
    stiffness_range: Range = (0.0, 1e5)
    """Clamp of the stiffness inside the simulation, N."""
    damping: Literal["fixed", "homogeneous", "springs"] = "fixed"
    """What is trained of the damping. homogeneous: drag and one factor of all dashpots. springs: a dashpot per spring, by the field
    where the method has one."""
    rest_length_bound: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Bound of trained rest lengths: within exp(+-bound) of the distances in the rest shape; 0: rest lengths are fixed."""
    rest_lengths_by: Literal["springs", "field"] = "springs"
    """Trained rest lengths are free per spring, or an output of the field (for methods that have one)."""
    selection: Literal["training_loss", "tail"] = "training_loss"
    """How the best epoch is chosen. training_loss: by the loss seen while training, as in the paper. tail: by the loss on the last
    training frames, on which nothing is fitted then; the start of the fit is a candidate too."""
    tail_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Fraction of the training frames on which nothing is fitted with `selection: tail`."""
    field: SpringField = dataclasses.field(default_factory=SpringField)
    checkpoint_every: Count = 5
    """Epochs between checkpoints from which a killed job continues."""

    def __post_init__(self) -> None:
        low, high = self.stiffness_range
        if not 0 <= low < high:
            raise ValueError(f"stiffness_range: 0 <= low < high is required, received [{low}, {high}]")
        if not self.field.triplane and self.field.fourier not in ("coordinates", "both"):
            raise ValueError(f"field.fourier: coordinates is required without the tri-plane, received {self.field.fourier}")
