"""Settings of the training losses and of the fit."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from neuspring.config.extensions import with_extensions
from neuspring.core.section import Count, NonNegative, Positive, Range, SettingsSection
from neuspring.registry import Registry

T = TypeVar("T")


TERMS: Registry[Any] = Registry(
    "losses", {name: f"neuspring.twin.losses:{name}" for name in ("chamfer", "track", "acceleration", "image_track", "silhouette")}
)
"""Terms of the training loss by the name of their weight. A term is a function of a `FrameLoss` and a `FrameState` that returns
the loss, or None if it does not apply."""


def _with_terms(kind: type[T]) -> type[T]:
    """Decorator of `Losses`, below `dataclass`: add a weight, 0 by default, for each term of a package."""
    for name in TERMS:
        if name not in kind.__annotations__:
            kind.__annotations__[name] = NonNegative
            setattr(kind, name, 0.0)
    return kind


@dataclass(frozen=True, kw_only=True)
@_with_terms
class Losses(SettingsSection):
    """Weights of the training losses. Defaults: the released PhysTwin code."""

    chamfer: NonNegative = 1.0
    """Squared one-way Chamfer distance."""
    track: NonNegative = 1.0
    """Smooth-L1 error of tracked points."""
    acceleration: NonNegative = 0.01
    """Acceleration loss; only in the search, as released."""
    image_track: NonNegative = 1.0
    """Error of tracked points in the image, as a distance at the object; only without depth."""
    silhouette: NonNegative = 1.0
    """Squared two-way distance between mask and nodes in the image; only without depth."""


@dataclass(frozen=True, kw_only=True)
class SpringFieldSettings(SettingsSection):
    """Neural spring field: S(e) = S0 + F(x_mid(e)). F is a tri-plane with a small MLP; x_mid is a spring's midpoint at rest."""

    triplane: bool = True
    """Three feature planes (xy, yz, xz), bilinear, summed; false: an MLP on Fourier features of the coordinates."""
    resolution: Annotated[int, Field(ge=2)] | Literal["adaptive"] = "adaptive"
    """Texels N per side of a plane; adaptive: round(0.85 sqrt(springs)), at least 2."""
    plane_learning_rate: Positive | None = None
    """Learning rate of the texels; null: that of the MLP."""
    shuffled: bool = False
    """Permute midpoints among springs at random, as a control: neighboring springs then share nothing."""


@dataclass(frozen=True, kw_only=True)
@with_extensions("fit")
class Fit(SettingsSection):
    """Adam, with gradients through the simulation. A method's `fit` selects the unknowns."""

    epochs: Count = 200
    """Passes over the training frames."""
    learning_rate: Positive = 1e-3
    """Learning rate of log stiffness per spring, or of the field's weights."""
    factor_learning_rate: Positive | None = None
    """Learning rate of drag and common factors; null: `learning_rate`."""
    decay_epochs: NonNegative = 0.0
    """Time constant tau of the learning rates, epochs: rate / (1 + epoch / tau); 0: no decay."""
    epsilon: Positive = 1e-15
    """Adam's epsilon, in the loss unit; released: 1e-8 m^2. Gradients far below it have no effect."""
    loss_unit: Literal["spacing", "meter"] = "spacing"
    """Unit of the differentiated loss: squared node spacings, or m^2 (as released). Losses are always recorded in m^2."""
    horizon: Annotated[int, Field(ge=0)] = 1
    """Frames per optimizer step, all of which the gradient passes through; 0: all training frames."""
    output_bound: NonNegative = 0.0
    """Bound b of the log change per spring: stiffness stays within exp(+-b) of the searched value, by b tanh(x / b); 0: no bound.
    Common factors are not bounded by it."""
    global_stiffness: bool = False
    """Train a common factor of all stiffnesses, in addition to springs or field."""
    controller_factors: bool = False
    """Train separate common factors of stiffness and dashpots for object springs and controller springs."""
    stiffness_range: Range = (0.0, 1e5)
    """Clamp of the stiffness inside the simulation, N."""
    damping: Literal["fixed", "homogeneous"] = "fixed"
    """Training of damping: none (fixed), or drag and a common factor of all dashpots (homogeneous)."""
    plateau: NonNegative = 0.01
    """Relative decrease of the rollout loss that a new best twin requires. A fit without a new best twin in 40 epochs has
    converged and ends. 0: any decrease counts, and all epochs run."""
    selection: Literal["rollout", "tail", "training_loss"] = "rollout"
    """Loss that selects the epoch: of a rollout over all training frames (rollout) or the tail (tail), or the mean training loss
    (as released). The tail is the last fifth of the training frames; a fit does not use it. The search's twin is also a
    candidate."""
    field: SpringFieldSettings = dataclasses.field(default_factory=SpringFieldSettings)

    def __post_init__(self) -> None:
        low, high = self.stiffness_range
        if not 0 <= low < high:
            raise ValueError(f"stiffness_range: 0 <= low < high is required, received [{low}, {high}]")
