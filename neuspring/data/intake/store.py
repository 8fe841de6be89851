"""The folder that is written: never over another one, and from where it was interrupted."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, Literal

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.data.capture import CAPTURE, POINTS, TRACKS, Writer
from neuspring.data.json_file import load_json

RECIPE = ".make-capture.json"
"""What an unfinished folder is made of. It is removed at the end."""
PRECIOUS = ("mask", "marks.json", "annotations.json", TRACKS, POINTS)
"""Work of people and of hours, which --force does not remove."""


def prepare(folder: Path, recipe: dict[str, Any], force: bool) -> bool:
    """Make `folder` ready for a capture made by `recipe`; returns whether it holds a part of it already.

    Raises InputError for a folder with anything else in it, unless `force` replaces the images of a capture.
    """
    path = folder / RECIPE
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "--output must be a folder", "a file")
    if path.exists() and not (folder / CAPTURE).exists() and load_json(path) == recipe:
        return True
    if folder.is_dir() and any(folder.iterdir()):
        ours = (folder / CAPTURE).exists() or path.exists()
        what = "a capture" if (folder / CAPTURE).exists() else "an unfinished capture from other input" if ours else "other files"
        if not (force and ours):
            remedy = "Choose another folder" + (", or give --force, which replaces its images." if ours else ".")
            raise InputError(folder, "--output must be a new or empty folder", what, remedy)
        kept = [name for name in PRECIOUS if (folder / name).exists()]
        if kept:
            raise InputError(
                folder, "--force does not remove masks, marks, clicks or tracks", " and ".join(kept), "Move them away first."
            )
        (folder / CAPTURE).unlink(missing_ok=True)
        for kind in ("color", "depth"):
            if (folder / kind).is_dir():
                shutil.rmtree(folder / kind)
    write_text(path, json.dumps(recipe, indent=1) + "\n")
    return False


def written(writer: Writer, camera: str, frames: list[int]) -> set[int]:
    """The frames of an interrupted folder that are complete: all with their images, but the last, which may be half written."""
    capture = writer.capture
    kinds: tuple[Literal["color", "depth"], ...] = ("color", "depth") if capture.has_depth else ("color",)
    there = [f for f in frames if all(capture.path(kind, camera, f).is_file() for kind in kinds)]
    return set(there[:-1])


def close(folder: Path) -> None:
    """The capture is complete."""
    (folder / RECIPE).unlink(missing_ok=True)
