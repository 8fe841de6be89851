"""Settings of the training losses and of the first-order fit."""

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
"""Every term of the training loss, by the name of its weight: a function of a `FrameLoss` and a `FrameState` that returns the
loss, or None where it does not apply."""


def _with_terms(kind: type[T]) -> type[T]:
    """Decorate `Losses`, below its `dataclass`: a term of a package has a weight of its name, 0 where it is not set."""
    for name in TERMS:
        if name not in kind.__annotations__:
            kind.__annotations__[name] = NonNegative
            setattr(kind, name, 0.0)
    return kind


@dataclass(frozen=True, kw_only=True)
@_with_terms
class Losses(SettingsSection):
    """Weights of the training losses; the defaults are those of the released PhysTwin code."""

    chamfer: NonNegative = 1.0
    """Weight of the squared one-way Chamfer distance."""
    track: NonNegative = 1.0
    """Weight of the smooth-L1 error of tracked points."""
    acceleration: NonNegative = 0.01
    """Weight of the acceleration loss, which the search alone uses, as in the released method."""
    image_track: NonNegative = 1.0
    """Weight, for color alone, of the error of tracked points in the image, as a distance at the object."""
    silhouette: NonNegative = 1.0
    """Weight, for color alone, of the squared distance in the image between mask and nodes, both ways."""


@dataclass(frozen=True, kw_only=True)
class SpringFieldSettings(SettingsSection):
    """Neural spring field: S(e) = S0 + F(x_mid(e)), F a tri-plane and a small MLP over spring midpoints in the rest shape."""

    triplane: bool = True
    """Three feature planes (xy, yz, xz), bilinear, summed; false: F is an MLP on Fourier features of the coordinates."""
    resolution: Annotated[int, Field(ge=2)] | Literal["adaptive"] = "adaptive"
    """Texels N per side of a plane; adaptive: round(0.85 sqrt(springs)), at least 2."""
    plane_learning_rate: Positive | None = None
    """Learning rate of the texels; null: that of the MLP."""
    shuffled: bool = False
    """Midpoints dealt out among the springs at random, so that F does not know which springs lie side by side."""


@dataclass(frozen=True, kw_only=True)
@with_extensions("fit")
class Fit(SettingsSection):
    """First-order stage: Adam, with gradients through the simulation. A method's `fit` says what is free per spring."""

    epochs: Count = 200
    """Passes over the training frames."""
    learning_rate: Positive = 1e-3
    """Adam's learning rate of log stiffness per spring, or of the field's weights."""
    factor_learning_rate: Positive | None = None
    """Learning rate of drag and common factors; null: `learning_rate`."""
    decay_epochs: NonNegative = 0.0
    """Epochs tau of the decay of all learning rates, to rate / (1 + epoch / tau); 0: none."""
    epsilon: Positive = 1e-15
    """Adam's epsilon, in the loss unit; released: 1e-8 m^2. Gradients far below it are not followed."""
    loss_unit: Literal["spacing", "meter"] = "spacing"
    """Unit of the loss that is differentiated: squared node spacings, or m^2, as released. Losses are
    recorded in m^2 always."""
    horizon: Annotated[int, Field(ge=0)] = 1
    """Frames per optimizer step, with the gradient through all of them; 0: all training frames."""
    output_bound: NonNegative = 0.0
    """Bound b of the change per spring: stiffness stays within exp(+-b) of the searched value, by b tanh(x / b).
    Common factors come on top. 0: no bound."""
    global_stiffness: bool = False
    """Training of one common factor of all stiffnesses beside springs or field."""
    controller_factors: bool = False
    """Two common factors each of stiffness and dashpots: of object springs, and of controllers' springs."""
    stiffness_range: Range = (0.0, 1e5)
    """Clamp of the stiffness inside the simulation, N."""
    damping: Literal["fixed", "homogeneous"] = "fixed"
    """Training of the damping: none (fixed), or drag and one factor of all dashpots (homogeneous)."""
    plateau: NonNegative = 0.01
    """Fraction by which the loss of a twin's rollout must be lower than that of the result so far to replace it. A fit that has
    found no such twin in 40 epochs has converged and ends. 0: any decrease, all epochs."""
    selection: Literal["rollout", "tail", "training_loss"] = "rollout"
    """Loss that chooses the twin: of its rollout over the training frames, or over the last fifth of them, on which nothing is
    fitted then; the search's twin is a candidate. training_loss: the mean seen while training, as in the released code."""
    field: SpringFieldSettings = dataclasses.field(default_factory=SpringFieldSettings)

    def __post_init__(self) -> None:
        low, high = self.stiffness_range
        if not 0 <= low < high:
            raise ValueError(f"stiffness_range: 0 <= low < high is required, received [{low}, {high}]")
