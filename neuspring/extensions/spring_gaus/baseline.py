"""Spring-Gaus as a baseline. The workflow imports this module before any job exists, so it imports nothing heavy."""

from __future__ import annotations

from pathlib import Path

from neuspring.baselines import Baseline, OptionalWeights
from neuspring.core.weights import find_file, hub_folder
from neuspring.extensions.spring_gaus.settings import SpringGaus

VGG16, DIGEST = "vgg16-397923af.pth", "397923af"
"""Weights for a loss term, and the first digits of their SHA-256, which Torch Hub puts into the file name."""


def find_vgg16() -> Path | str:
    """The weight file in Torch Hub's cache, or one line with the reason why it is missing."""
    return find_file("VGG16 weights", None, [hub_folder() / VGG16], DIGEST, False)


def _reads(section: SpringGaus) -> tuple[str, ...]:
    if section.supervision == "masks":
        return ("simulation.gravity", "images.backend")
    return ("simulation.gravity", "losses")


SPRING_GAUS = Baseline(
    training="neuspring.extensions.spring_gaus.train:train",
    prediction="neuspring.extensions.spring_gaus.model:predict",
    model="neuspring.extensions.spring_gaus.model:SpringGausModel",
    section="spring_gaus",
    takes_pictures=lambda section: bool(section.supervision == "masks"),
    reads=_reads,
    own_splats=True,
    notes={
        # The note omits the reason, which names paths of this machine.
        "vgg16": (
            lambda fact: fact not in ("computed", "not asked for"),
            "without the loss of VGG16's features, whose weights are missing",
        ),
        "links": (lambda fact: fact == 0, "no anchor is near a controller in frame 0, so the hands move no anchor"),
    },
    weights=OptionalWeights(
        what="VGG16 (Spring-Gaus' features)", file=VGG16, address=f"https://download.pytorch.org/models/{VGG16}", find=find_vgg16
    ),
)
