"""Spring-Gaus: anchors with directed springs move splats; their parameters are trained on silhouettes, or on points.

physics: anchors and their motion. model: what is learned, and the rollout. train: the problem, its losses and epochs.
What differs from the public code, and what was measured: `neuspring/baselines/README.md`.
"""

from pathlib import Path

from neuspring.core.weights import find_file, hub_folder

VGG16, DIGEST = "vgg16-397923af.pth", "397923af"
"""Weights for a term of the loss, and the first digits of their SHA-256, which by torch hub's convention are in the file's name."""


def find_vgg16() -> Path | str:
    """The weight file in torch hub's cache, else one line that says why there is none."""
    return find_file("VGG16 weights", None, [hub_folder() / VGG16], DIGEST, False)
