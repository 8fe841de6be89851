"""Where the weights of LPIPS lie: in torch hub's cache, the heads also inside an installed `lpips` or `torchmetrics`, or where the
configuration says. Files are known by their SHA-256. Nothing is downloaded, and what is absent is said.

Imports nothing heavy, because the workflow asks before any job exists.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from neuspring.config_images import LpipsWeights
from neuspring.errors import InputError
from neuspring.records import digest_file

BACKBONE = "alexnet-owt-7be5be79.pth"
BACKBONE_DIGEST = "7be5be79"
"""First digits of the SHA-256, by torch hub's convention those in the name."""
BACKBONE_ADDRESS = f"https://download.pytorch.org/models/{BACKBONE}"
HEADS = "lpips_alex_v0.1.pth"
HEADS_DIGEST = "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
PACKAGED_HEADS = {"lpips": "weights/v0.1/alex.pth", "torchmetrics": "functional/image/lpips_models/alex.pth"}
"""Where packages keep the heads, below their folder."""
SHOWN_DIGITS = 8


@dataclass(frozen=True)
class Weights:
    """Checked weight files."""

    backbone: Path
    heads: Path


def find_weights(backbone: Path | None = None, heads: Path | None = None, *, trusted: bool = False) -> Weights | str:
    """The weight files, or one line that says which are absent. None: look in the usual caches.

    Checks SHA-256 unless `trusted`. Raises InputError only for a given path that is missing or has another content.
    """
    hub = _hub()
    found = (
        _find("AlexNet weights", backbone, [hub / BACKBONE], BACKBONE_DIGEST, trusted),
        _find("LPIPS heads", heads, [hub / HEADS, *_packaged()], HEADS_DIGEST, trusted),
    )
    first, second = found
    if isinstance(first, Path) and isinstance(second, Path):
        return Weights(first, second)
    return "; ".join(reason for reason in found if isinstance(reason, str))


def configured(settings: LpipsWeights) -> Weights | str:
    """As `find_weights`, for what the configuration names."""
    return find_weights(*(Path(path) if path else None for path in (settings.backbone, settings.heads)))


def _hub() -> Path:
    """Where torch hub keeps checkpoints; asked of the environment, since torch itself takes seconds to import."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    return Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser() / "hub" / "checkpoints"


def _find(what: str, given: Path | None, places: Iterable[Path], digest: str, trusted: bool) -> Path | str:
    if given is not None:
        if fault := _fault(given, digest, trusted):
            raise InputError(given, f"must be the file of {what}", fault, "Name another file, or none to search the caches.")
        return given
    faults = []
    for place in places:
        fault = _fault(place, digest, trusted)
        if not fault:
            return place
        faults.append(f"{_short(place)} {fault}")
    return f"no {what}: {', '.join(faults)}"


def _short(path: Path) -> str:
    """A path as users write it."""
    home = Path.home()
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def _fault(path: Path, digest: str, trusted: bool) -> str:
    """What is wrong with a weight file; empty if nothing is."""
    try:
        if not path.is_file():
            return "is not there"
        found = digest if trusted else digest_file(path)
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if found.startswith(digest):
        return ""
    return f"has SHA-256 {found[:SHOWN_DIGITS]}..., not {digest[:SHOWN_DIGITS]}..."


def _packaged() -> list[Path]:
    """Where the installed packages that carry the heads have them. The packages are not imported."""
    places = []
    for package, inside in PACKAGED_HEADS.items():
        spec = importlib.util.find_spec(package)
        places += [Path(folder) / inside for folder in (spec.submodule_search_locations or [] if spec else [])]
    return places
