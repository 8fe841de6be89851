"""Baselines: the systems that the paper compares with, and two reference points that learn nothing.

`BASELINES` declares them; the `model` of a method names one. PhysTwin is not a baseline here, because the method `baseline` uses
this project's search and fit. Spring-Gaus and GS-Dynamics are extensions. Any package can add a baseline with an entry point of
the group `neuspring.baselines`, and its settings with one of the group `neuspring.settings`.
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
    """Files for a model that is trained on silhouettes."""

    folder: Path
    """Folder of the capture."""
    masks: Sequence[Path]
    """Records of the masks of every camera, in the order of the capture."""
    splats: Path
    """Splats of frame 0."""


@dataclass(frozen=True, kw_only=True)
class TrainingRequest:
    """The inputs of the training of a baseline."""

    observations: Observations
    settings: Config
    """The configuration, including the settings of the method in the model's section."""
    seed: int
    device: str
    partial: Path | None
    """File of the checkpoint, from which a killed training resumes."""
    key: Callable[..., str]
    """Function from further facts that the checkpoint depends on to its key."""
    pictures: Pictures | None = None


@dataclass(frozen=True, kw_only=True)
class OptionalWeights:
    """A file of trained weights that is used if it exists."""

    what: str
    """Name of the weights in messages."""
    file: str
    """Name of the file in torch hub's cache."""
    address: str
    """URL of the file."""
    find: Callable[[], Path | str]
    """Returns the file, or one line with the reason why it is missing."""


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Declaration of a baseline. Functions are named as `module:name` and imported when they are called."""

    prediction: str
    """(model or None, observations, centers of splats or None, device) -> Prediction."""
    training: str = ""
    """TrainingRequest -> Trained; empty: the baseline learns nothing."""
    model: str = ""
    """Class of the trained artifact."""
    section: str = ""
    """Field of `config.Baselines` with its settings; empty: no settings, and the functions below receive None."""
    takes_pictures: Callable[[Any], bool] = lambda section: False
    """From its settings: True if it is trained on silhouettes."""
    reads: Callable[[Any], tuple[str, ...]] = lambda section: ()
    """From its settings: keys of the configuration that training reads in addition to its own section."""
    notes: Mapping[str, tuple[Callable[[Any], bool], str]] = field(default_factory=dict)
    """By fact of the training record: the condition for a note, and the note."""
    own_splats: bool = False
    """True if a method may give it its own splats to move (`appearance`)."""
    transfers: bool = False
    """True if the trained model can be moved to another recording."""
    weights: OptionalWeights | None = None
    """File of trained weights that a loss term requires; if it is missing, training omits the term."""

    @property
    def trained(self) -> bool:
        """True if the baseline has a training."""
        return bool(self.training)

    def settings(self, config: Config) -> Any:
        """Return its section of a configuration; None without settings."""
        return getattr(config.baselines, self.section) if self.section else None

    def features(self) -> str:
        """Return none, absent or found, by its optional weights. Training runs again when they appear."""
        return "none" if not self.weights else "absent" if isinstance(self.weights.find(), str) else "found"

    def pictured(self, config: Config) -> bool:
        """Return True if it is trained on silhouettes."""
        return self.trained and self.takes_pictures(self.settings(config))

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules whose code, imports included, determines its results."""
        return tuple(sorted({name.partition(":")[0] for name in (self.training, self.prediction) if name}))

    def train(self, request: TrainingRequest) -> Trained[Any]:
        """Train the model. Raises NumericalFailure if there is nothing to train."""
        result: Trained[Any] = resolve_name(self.training)(request)
        return result

    def predict(self, observations: Observations, model: Path | None, splats: np.ndarray | None, device: str) -> Prediction:
        """Predict all frames, open-loop. `splats` are the centers [G, 3], m, of the model's own splats in frame 0."""
        assert (model is None) != self.trained, "the stage predict requires the record of a training"
        learned = resolve_name(self.model).load(model) if model else None
        result: Prediction = resolve_name(self.prediction)(learned, observations, splats, device)
        return result


def without_pictures(method: Method | None, config: Config) -> tuple[str, ...]:
    """Inputs of a stage that the model of a method does not use: a model trained on points reads no images."""
    pictured = bool(method and method.model and BASELINES[method.model].pictured(config))
    return () if pictured else ("capture", "masks", "appearance")


REFERENCES = ("static", "controller_lbs")
"""Methods that learn nothing, as reference points for all methods."""
BASELINES = Registry(
    "baselines",
    {name: Baseline(prediction=f"neuspring.baselines.references:{name}", transfers=True) for name in REFERENCES},
    Baseline,
)
