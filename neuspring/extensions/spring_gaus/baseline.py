"""Spring-Gaus as a baseline: what the workflow asks before any job exists, so that nothing heavy is imported."""

from __future__ import annotations

from pathlib import Path

from neuspring.baselines import Baseline, OptionalWeights
from neuspring.core.weights import find_file, hub_folder
from neuspring.extensions.spring_gaus.settings import SpringGaus

VGG16, DIGEST = "vgg16-397923af.pth", "397923af"
"""Weights for a term of the loss, and the first digits of their SHA-256, which by torch hub's convention are in the file's name."""


def find_vgg16() -> Path | str:
    """The weight file in torch hub's cache, else one line that says why there is none."""
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
        # Not why the weights are not there: that names places on this machine.
        "vgg16": (
            lambda fact: fact not in ("computed", "not asked for"),
            "without the loss of VGG16's features, whose weights are not there",
        ),
        "links": (lambda fact: fact == 0, "no anchor lies near a controller in frame 0, so the hands move nothing"),
    },
    weights=OptionalWeights(
        what="VGG16 (Spring-Gaus' features)", file=VGG16, address=f"https://download.pytorch.org/models/{VGG16}", find=find_vgg16
    ),
)
