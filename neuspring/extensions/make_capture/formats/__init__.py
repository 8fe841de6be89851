"""Forms in which cameras leave their pictures: one file each, which says what it recognizes and how it opens it.

To add one: a file here with a `CaptureFormat` named capture_format; or a package's entry point of the group
`neuspring.capture_formats`. Pictures are taken by what a format recognizes, a recording by that or by its name (--format).

    pictures     color or depth of one camera (--color, --depth): a folder, a video
    recording    all that cameras gave (--recording): a bag, PhysTwin's raw layout
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import foreign
from neuspring.extensions.make_capture.feeds import ImageSource, Kind, Paired, Recorded, names_of
from neuspring.registry import Registry, modules

T = TypeVar("T")
ENDINGS = {"color": (".png", ".jpg", ".jpeg", ".bmp", ".npy"), "depth": (".png", ".npy", ".tif", ".tiff")}


@dataclass(frozen=True, kw_only=True)
class CaptureFormat:
    """One form of pictures."""

    about: str
    """Its name for messages; {kind} and {endings} stand for the kind of pictures and the endings of their files."""
    recognizes: Callable[[Path], bool]
    """True for a path of this form."""
    pictures: Callable[[Path, Kind], ImageSource] | None = None
    """Opens pictures of one kind. Raises InputError."""
    recording: Callable[[Sequence[Path], Sequence[str]], Recorded] | None = None
    """Opens files or folders, one per camera or one for all, with names of the cameras, if they are given. Raises InputError."""


FORMATS: Registry[CaptureFormat] = Registry("capture_formats", modules(__name__, "capture_format"), CaptureFormat)


def open_images(path: Path, kind: Kind) -> ImageSource:
    """Color or depth of one camera. Raises InputError for what is of no format."""
    for format_ in FORMATS.values():
        if format_.pictures is not None and format_.recognizes(path):
            return format_.pictures(path, kind)
    suffix = path.suffix or "plain"
    name, remedy = foreign(next(iter(sorted(path.iterdir())), path) if path.is_dir() else path)
    received = "a folder without any" if path.is_dir() else f"a {suffix} file" if path.exists() else "nothing there"
    known = " or ".join(format_.about for format_ in FORMATS.values() if format_.pictures is not None)
    raise InputError(path, known.format(kind=kind, endings=" ".join(ENDINGS[kind])), name or received, remedy)


def open_recording(paths: Sequence[Path], name: str | None = None, cameras: Sequence[str] = ()) -> Recorded:
    """All that cameras gave, by the format of this name, or the one that recognizes the first path. Raises InputError."""
    fitting = {key: one for key, one in FORMATS.items() if one.recording is not None}
    if name is None:
        name = next((key for key, one in fitting.items() if one.recognizes(paths[0])), "")
    if name not in fitting or (opened := fitting[name].recording) is None:
        raise InputError("--format", f"must be one of {', '.join(fitting)}", name or f"none that reads {paths[0]}")
    return opened(paths, cameras)


def picked(path: Path, pictures: Iterable[T], places: Sequence[int]) -> Iterator[T]:
    """Pictures at ascending places. Raises InputError where the file ends early."""
    wanted = list(places)
    for place, picture in enumerate(pictures):
        if not wanted:
            return
        if place == wanted[0]:
            wanted.pop(0)
            yield picture
    if wanted:
        raise InputError(path, f"a picture {wanted[0]} is required", "the file ends before it")


def require_kind(path: Path, kind: Kind, image: np.ndarray) -> np.ndarray:
    """The image, if it is RGB of 8 bits, or depth of one channel: 16 bits or more, or floating point. Raises InputError."""
    received = f"{image.dtype} of shape {image.shape}"
    if kind == "color":
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(path, "color must be 8-bit RGB [H, W, 3]", received)
        return image
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    if image.ndim != 2:
        remedy = "A picture of depth in colors is none: export the raw depth (16-bit PNG or npy)."
        raise InputError(path, "depth must have one channel [H, W]", received, remedy)
    if image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        remedy = "8 bits cannot hold it: export the raw depth (16-bit PNG or npy)."
        raise InputError(path, "depth must be integers of at least 16 bits, or floating point", received, remedy)
    return image


def pairs(colors: Sequence[Path], depths: Sequence[Path], names: Sequence[str] = ()) -> list[Paired]:
    """The views of folders or videos, one of color and one of depth per camera; without depths color alone, of one camera.

    Raises InputError.
    """
    if len(colors) > 1 and not depths:
        rule = "without depth one camera is required: color alone is of one view"
        raise InputError("--color", rule, len(colors), "Give one folder or video, or --depth for each.")
    if not colors or (depths and len(colors) != len(depths)):
        rule = "as many folders or videos of depth as of color are required, one each per camera"
        raise InputError("--color, --depth", rule, f"{len(colors)} of color, {len(depths)} of depth")
    names = names_of(len(colors), names)
    deep: list[ImageSource | None] = [open_images(depth, "depth") for depth in depths]
    return [
        Paired(name, open_images(path, "color"), depth) for name, path, depth in zip(names, colors, deep or [None], strict=True)
    ]
