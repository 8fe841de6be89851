"""The systems that the paper compares with, as models of their own, and two that learn nothing.

`BASELINES` declares them; a method row's `model` names one. PhysTwin is not here: it is a row of the method table, made of the
platform's own search and fit. Spring-Gaus and GS-Dynamics are extensions, and come through the door that is open to every package:
an entry point of the group `neuspring.baselines`, and one of `neuspring.settings` for what rows shall set.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from neuspring.config import Config, Method
from neuspring.registry import Registry

if TYPE_CHECKING:
    import numpy as np

    from neuspring.baselines.results import Prediction, Trained
    from neuspring.core.artifacts import Observations


@dataclass(frozen=True)
class Pictures:
    """Files that a model reads that is trained on silhouettes."""

    folder: Path
    """The capture's."""
    masks: Sequence[Path]
    """Records of the masks of every camera, in the capture's order."""
    splats: Path
    """Splats of frame 0."""


@dataclass(frozen=True, kw_only=True)
class TrainingRequest:
    """Everything that the training of a baseline is given."""

    observations: Observations
    settings: Config
    """The configuration, with the method's own settings in the model's section."""
    seed: int
    device: str
    partial: Path | None
    """Checkpoint, from which a killed training continues."""
    key: Callable[..., str]
    """The key of the checkpoint, from further facts that it depends on."""
    pictures: Pictures | None = None


@dataclass(frozen=True, kw_only=True)
class OptionalWeights:
    """A file that is used where it is there."""

    what: str
    """The weights, for people."""
    file: str
    """Its name in torch hub's cache."""
    address: str
    """The address that it can be had from."""
    find: Callable[[], Path | str]
    """The file, or one line that says why there is none."""


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Declaration of a baseline. Its functions are named as `module:name` and imported when they are called."""

    prediction: str
    """(model or None, observations, centers of splats or None, device) -> Prediction."""
    training: str = ""
    """TrainingRequest -> Trained; empty: it learns nothing."""
    model: str = ""
    """The artifact that is trained."""
    section: str = ""
    """Its settings: a field of `config.Baselines`; empty: it has none, and the functions below get None for them."""
    takes_pictures: Callable[[Any], bool] = lambda section: False
    """From its settings: True where it is trained on silhouettes."""
    reads: Callable[[Any], tuple[str, ...]] = lambda section: ()
    """Keys of the configuration, from its settings, that training reads beside its own section."""
    notes: Mapping[str, tuple[Callable[[Any], bool], str]] = field(default_factory=dict)
    """Facts of its training's record: when one is worth a note, and the note."""
    own_splats: bool = False
    """True where a method row may give it splats of its own to move (`appearance`)."""
    transfers: bool = False
    """True where what it learned can be moved to another recording."""
    weights: OptionalWeights | None = None
    """A file of trained weights that a term of its loss needs; without it the term is left out."""

    @property
    def trained(self) -> bool:
        """True for a model that learns something."""
        return bool(self.training)

    def settings(self, config: Config) -> Any:
        """Its section of a configuration; None where it has none."""
        return getattr(config.baselines, self.section) if self.section else None

    def features(self) -> str:
        """none, absent or found: its optional weights; training runs again when they come."""
        return "none" if not self.weights else "absent" if isinstance(self.weights.find(), str) else "found"

    def pictured(self, config: Config) -> bool:
        """True where it is trained on silhouettes."""
        return self.trained and self.takes_pictures(self.settings(config))

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules whose code its results depend on, with all that they import."""
        return tuple(sorted({name.partition(":")[0] for name in (self.training, self.prediction) if name}))

    def train(self, request: TrainingRequest) -> Trained[Any]:
        """Train. Raises NumericalFailure where there is nothing to train."""
        result: Trained[Any] = resolve_name(self.training)(request)
        return result

    def predict(self, observations: Observations, model: Path | None, splats: np.ndarray | None, device: str) -> Prediction:
        """Open-loop rollout over all frames; `splats` are the centers [G, 3], m, of the model's own splats in frame 0."""
        assert (model is None) != self.trained, "stage predict requires the record of a training"
        learned = resolve_name(self.model).load(model) if model else None
        result: Prediction = resolve_name(self.prediction)(learned, observations, splats, device)
        return result


def without_pictures(method: Method | None, config: Config) -> tuple[str, ...]:
    """The inputs of a stage that a method's model goes without: what is trained on points sees no pictures."""
    pictured = bool(method and method.model and BASELINES[method.model].pictured(config))
    return () if pictured else ("capture", "masks", "appearance")


REFERENCES = ("static", "controller_lbs")
"""Methods that learn nothing: what others must be better than."""
BASELINES = Registry(
    "baselines",
    {name: Baseline(prediction=f"neuspring.baselines.references:{name}", transfers=True) for name in REFERENCES},
    Baseline,
)
