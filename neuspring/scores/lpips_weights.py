"""Where the weights of LPIPS lie: in torch hub's cache, the heads also inside an installed `lpips` or `torchmetrics`, or where the
configuration says. Files are known by their SHA-256. Nothing is downloaded, and what is absent is said.

Imports nothing heavy, because the workflow asks before any job exists.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

from neuspring.config.images import LpipsWeights
from neuspring.core.weights import find_file, hub_folder

BACKBONE = "alexnet-owt-7be5be79.pth"
BACKBONE_DIGEST = "7be5be79"
"""First digits of the SHA-256, by torch hub's convention those in the name."""
BACKBONE_ADDRESS = f"https://download.pytorch.org/models/{BACKBONE}"
HEADS = "lpips_alex_v0.1.pth"
HEADS_DIGEST = "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
PACKAGED_HEADS = {"lpips": "weights/v0.1/alex.pth", "torchmetrics": "functional/image/lpips_models/alex.pth"}
"""Where packages keep the heads, below their folder."""


@dataclass(frozen=True)
class Weights:
    """Checked weight files."""

    backbone: Path
    heads: Path


def find_weights(backbone: Path | None = None, heads: Path | None = None, *, trusted: bool = False) -> Weights | str:
    """The weight files, or one line that says which are absent. None: look in the usual caches.

    Checks SHA-256 unless `trusted`. Raises InputError only for a given path that is missing or has another content.
    """
    hub = hub_folder()
    found = (
        find_file("AlexNet weights", backbone, [hub / BACKBONE], BACKBONE_DIGEST, trusted),
        find_file("LPIPS heads", heads, [hub / HEADS, *_packaged()], HEADS_DIGEST, trusted),
    )
    first, second = found
    if isinstance(first, Path) and isinstance(second, Path):
        return Weights(first, second)
    return "; ".join(reason for reason in found if isinstance(reason, str))


def configured(settings: LpipsWeights) -> Weights | str:
    """As `find_weights`, for what the configuration names."""
    return find_weights(*(Path(path) if path else None for path in (settings.backbone, settings.heads)))


def _packaged() -> list[Path]:
    """Where the installed packages that carry the heads have them. The packages are not imported."""
    places = []
    for package, inside in PACKAGED_HEADS.items():
        spec = importlib.util.find_spec(package)
        places += [Path(folder) / inside for folder in (spec.submodule_search_locations or [] if spec else [])]
    return places
