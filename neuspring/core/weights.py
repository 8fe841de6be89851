"""Files of trained weights: where torch hub keeps them, whether they are what they should be, their tensors. Nothing is downloaded.

Imports nothing heavy before tensors are read, because the workflow asks before any job exists.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.errors import InputError
from neuspring.core.records import digest_file

if TYPE_CHECKING:
    import torch


def hub_folder() -> Path:
    """Folder in which torch hub keeps checkpoints; read from the environment, since torch itself takes seconds to import."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    return Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser() / "hub" / "checkpoints"


def find_file(what: str, given: Path | None, places: Iterable[Path], digest: str, trusted: bool) -> Path | str:
    """The file of `what`: `given`, or the first of `places` whose SHA-256 begins with `digest`; else what is wrong, in one line.

    `trusted`: the digest is not looked at. Raises InputError only for a given path that is missing or has another content.
    """
    if given is not None:
        if fault := _fault(given, digest, trusted):
            raise InputError(given, f"must be the file of {what}", fault, "Name another file, or none to search the caches.")
        return given
    faults = []
    for place in places:
        if not (fault := _fault(place, digest, trusted)):
            return place
        faults.append(f"{place} {fault}")
    return f"no {what}: {', '.join(faults)}"


def _fault(path: Path, digest: str, trusted: bool) -> str:
    """Fault of a weight file in words; empty where it has none."""
    if not path.is_file():
        return "is not there"
    try:
        found = digest if trusted else digest_file(path)
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return "" if found.startswith(digest) else f"has SHA-256 {found[:8]}..., not {digest[:8]}..."


def read_tensors(path: Path, shapes: Mapping[str, tuple[int, ...]], device: str) -> list[torch.Tensor]:
    """The named tensors of a state dict, float32. Raises InputError if one is absent, or has another shape or kind."""
    import torch

    remedy = "Delete the file and get it again."
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # A damaged file fails in any way: there is no list of what the unpickler raises.
        line = str(error).partition("\n")[0]
        raise InputError(path, "this file must hold weights", f"{type(error).__name__}: {line}", remedy) from error
    if not isinstance(stored, dict):
        raise InputError(path, "this file must hold a state dict", type(stored).__name__, remedy)
    tensors = []
    for name, shape in shapes.items():
        value = stored.get(name)
        if not (isinstance(value, torch.Tensor) and value.shape == shape and value.is_floating_point() and value.isfinite().all()):
            raise InputError(path, f"`{name}` must be a finite float tensor {list(shape)}", getattr(value, "shape", value), remedy)
        tensors.append(value.to(device, torch.float32))
    return tensors
