"""Files of trained weights: their location in torch hub's cache, their digests, their tensors. Nothing is downloaded.

torch is imported only when tensors are read, because the workflow looks for weights before any job exists.
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
    """Folder of torch hub's checkpoints, read from the environment because importing torch takes seconds."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    return Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser() / "hub" / "checkpoints"


def find_file(what: str, given: Path | None, places: Iterable[Path], digest: str, trusted: bool) -> Path | str:
    """The file of `what`: `given`, or the first of `places` whose SHA-256 starts with `digest`; otherwise the faults as text.

    `trusted` skips the digest. Raises InputError only if `given` is missing or has other content.
    """
    if given is not None:
        if fault := _fault(given, digest, trusted):
            raise InputError(given, f"must be the file of {what}", fault, "Name another file, or none to search the caches.")
        return given
    faults = []
    for path in places:
        if not (fault := _fault(path, digest, trusted)):
            return path
        faults.append(f"{path} {fault}")
    return f"no {what}: {', '.join(faults)}"


def _fault(path: Path, digest: str, trusted: bool) -> str:
    """The fault of a weight file; empty if it has none."""
    if not path.is_file():
        return "is not there"
    try:
        actual = digest if trusted else digest_file(path)
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return "" if actual.startswith(digest) else f"has SHA-256 {actual[:8]}..., not {digest[:8]}..."


def read_tensors(path: Path, shapes: Mapping[str, tuple[int, ...]], device: str) -> list[torch.Tensor]:
    """The named tensors of a state dict, float32. Raises InputError for a missing tensor, another shape or type."""
    import torch

    remedy = "Delete the file and download it again."
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler may raise any exception for a damaged file
        line = str(error).partition("\n")[0]
        raise InputError(path, "this file must contain weights", f"{type(error).__name__}: {line}", remedy) from error
    if not isinstance(stored, dict):
        raise InputError(path, "this file must contain a state dict", type(stored).__name__, remedy)
    tensors = []
    for name, shape in shapes.items():
        value = stored.get(name)
        if not (isinstance(value, torch.Tensor) and value.shape == shape and value.is_floating_point() and value.isfinite().all()):
            raise InputError(path, f"`{name}` must be a finite float tensor {list(shape)}", getattr(value, "shape", value), remedy)
        tensors.append(value.to(device, torch.float32))
    return tensors
