"""The systems that the paper compares with, as models of their own: Spring-Gaus, GS-Dynamics, and two that learn nothing.

`BASELINES` declares them; a method row's `model` names one. PhysTwin is not here: it is a row of the method table, made of the
platform's own search and fit.

To add a baseline: its package with a module `entry`, its settings in neuspring/config (a field of `Baselines`), its line here, and
its row in config/methods.yaml.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config import Config

if TYPE_CHECKING:
    import numpy as np

    from neuspring.baselines.results import Prediction, Trained
    from neuspring.core.artifacts import Observations


@dataclass(frozen=True)
class Pictures:
    """What a model that is trained on silhouettes reads."""

    folder: Path
    """Of the capture."""
    masks: Sequence[Path]
    """Records of the masks of every camera, in the capture's order."""
    splats: Path
    """Splats of frame 0."""


@dataclass(frozen=True, kw_only=True)
class TrainingRequest:
    """Everything that `entry.train` of a baseline is given."""

    observations: Observations
    settings: Config
    """With the method's own settings in the model's section."""
    seed: int
    device: str
    partial: Path
    """Checkpoint, from which a killed training continues."""
    key: Callable[..., str]
    """The key of the checkpoint, from further facts that it depends on."""
    pictures: Pictures | None = None


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """What is known of a baseline before it runs. Its modules are imported when they are used."""

    module: str
    """Has `predict(observations, model, splats, device)`, and `train(request)` where the model is trained."""
    trained: bool = True
    section: str = ""
    """Its settings: a field of `config.Baselines`."""
    takes_pictures: Callable[[Any], bool] = lambda section: False
    """From its settings: whether it is trained on silhouettes."""
    reads: Callable[[Any], tuple[str, ...]] = lambda section: ()
    """From its settings: keys of the configuration that training reads beside its own section."""
    own_splats: bool = False
    """Whether a method row may give it splats of its own to move (`appearance`)."""
    transfers: bool = False
    """Whether what it learned can be moved to another recording."""
    features: Callable[[Any], str] = lambda section: "none"
    """Whether optional weights are there, so that training runs again when they come. Raises InputError for wrong ones."""

    def train(self, request: TrainingRequest) -> Trained[Any]:
        """Train. Raises NumericalFailure where there is nothing to train."""
        result: Trained[Any] = importlib.import_module(self.module).train(request)
        return result

    def predict(self, observations: Observations, model: Path | None, splats: np.ndarray | None, device: str) -> Prediction:
        """Open-loop rollout over all frames; `splats` are the centers [G, 3], m, of the model's own splats in frame 0."""
        result: Prediction = importlib.import_module(self.module).predict(observations, model, splats, device)
        return result


def _spring_gaus_reads(section: Any) -> tuple[str, ...]:
    if section.supervision == "masks":
        return ("simulation.gravity", "images.backend", "images.released_quirks.corner_pixels")
    return ("simulation.gravity", "losses")


def _vgg16(section: Any) -> str:
    from neuspring.baselines.spring_gaus.vgg16_weights import find

    return "absent" if isinstance(find(section.vgg16), str) else "found"


REFERENCES = ("static", "controller_lbs")
"""Methods that learn nothing: what others must be better than."""
BASELINES = {
    "spring_gaus": Baseline(
        module="neuspring.baselines.spring_gaus.entry",
        section="spring_gaus",
        takes_pictures=lambda section: bool(section.supervision == "masks"),
        reads=_spring_gaus_reads,
        own_splats=True,
        features=_vgg16,
    ),
    "gs_dynamics": Baseline(
        module="neuspring.baselines.gs_dynamics.entry",
        section="gs_dynamics",
        transfers=True,
    ),
    "static": Baseline(module="neuspring.baselines.static", trained=False),
    "controller_lbs": Baseline(module="neuspring.baselines.controller_lbs", trained=False),
}
