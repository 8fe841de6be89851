"""Finds the weights of LPIPS: in torch hub's cache, for the heads also inside an installed `lpips` or `torchmetrics`, or where the
configuration says. Files are recognized by their SHA-256. Nothing is downloaded; missing files are named.

Imports nothing heavy, because the workflow asks before it plans any job.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

from neuspring.config.images import LpipsWeights
from neuspring.core.weights import find_file, hub_folder

BACKBONE = "alexnet-owt-7be5be79.pth"
BACKBONE_DIGEST = "7be5be79"
"""First digits of the SHA-256. By torch hub's convention they are part of the name."""
BACKBONE_ADDRESS = f"https://download.pytorch.org/models/{BACKBONE}"
HEADS = "lpips_alex_v0.1.pth"
HEADS_DIGEST = "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
PACKAGED_HEADS = {"lpips": "weights/v0.1/alex.pth", "torchmetrics": "functional/image/lpips_models/alex.pth"}
"""Path of the heads inside each package that has them."""


@dataclass(frozen=True)
class Weights:
    """Checked weight files."""

    backbone: Path
    heads: Path


def find_weights(backbone: Path | None = None, heads: Path | None = None, *, trusted: bool = False) -> Weights | str:
    """The weight files, or one line that says which are missing. None: look in the usual caches.

    Checks SHA-256 unless `trusted`. Raises InputError only if a path that was given is missing or has another content.
    """
    hub = hub_folder()
    files = (
        find_file("AlexNet weights", backbone, [hub / BACKBONE], BACKBONE_DIGEST, trusted),
        find_file("LPIPS heads", heads, [hub / HEADS, *_packaged()], HEADS_DIGEST, trusted),
    )
    first, second = files
    if isinstance(first, Path) and isinstance(second, Path):
        return Weights(first, second)
    return "; ".join(reason for reason in files if isinstance(reason, str))


def configured(settings: LpipsWeights) -> Weights | str:
    """As `find_weights`, with the paths of the configuration."""
    return find_weights(*(Path(path) if path else None for path in (settings.backbone, settings.heads)))


def _packaged() -> list[Path]:
    """Paths of the heads in installed packages, which are not imported."""
    places = []
    for package, inside in PACKAGED_HEADS.items():
        spec = importlib.util.find_spec(package)
        places += [Path(folder) / inside for folder in (spec.submodule_search_locations or [] if spec else [])]
    return places
