"""Where the weights of VGG16 are. Imports nothing heavy, because the workflow asks before it starts jobs."""

from __future__ import annotations

from pathlib import Path

from neuspring.core.weights import find_file, hub_folder

FILE = "vgg16-397923af.pth"
DIGEST = "397923af"
"""First digits of the SHA-256; by torch hub's convention they are in the file's name."""


def find(path: str | None) -> Path | str:
    """The weight file that the configuration names or that is in torch hub's cache, else one line that says why there is none.

    Raises InputError only for a named file that is missing or has another content.
    """
    return find_file("VGG16 weights", Path(path) if path else None, [hub_folder() / FILE], DIGEST, False)
