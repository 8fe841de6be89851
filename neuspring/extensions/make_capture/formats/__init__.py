"""Formats of images and recordings; each file recognizes and opens one format.

To add a format, write a file here with a `CaptureFormat` named capture_format, or declare an entry point of the group
`neuspring.capture_formats` in a package. A format sets one of

    pictures     opens color or depth of one camera (--color, --depth), like a folder or a video
    recording    opens the streams of all cameras (--recording), like a bag
    capture      writes the capture itself (--recording), like PhysTwin's raw layout
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import foreign
from neuspring.data.capture import Capture
from neuspring.extensions.make_capture.options import Intake
from neuspring.extensions.make_capture.streams import CameraStreams, ImageSource, Kind
from neuspring.registry import Registry, modules

ENDINGS = {"color": (".png", ".jpg", ".jpeg", ".bmp", ".npy"), "depth": (".png", ".npy", ".tif", ".tiff")}


@dataclass(frozen=True, kw_only=True)
class CaptureFormat:
    """One format of images or recordings."""

    about: str
    """Name for messages; {kind} and {endings} are replaced by the kind of images and the endings of their files."""
    recognizes: Callable[[Path], bool]
    """True for a path of this format."""
    pictures: Callable[[Path, Kind], ImageSource] | None = None
    """Opens images of one kind. Raises InputError."""
    recording: Callable[[Intake], list[CameraStreams]] | None = None
    """Opens the streams of --recording. Raises InputError."""
    capture: Callable[[Intake], Capture] | None = None
    """Writes --recording as a capture. Raises InputError."""


FORMATS: Registry[CaptureFormat] = Registry("capture_formats", modules(__name__, "capture_format"), CaptureFormat)


def open_images(path: Path, kind: Kind) -> ImageSource:
    """Open color or depth of one camera. Raises InputError for an unknown format."""
    for format_ in FORMATS.values():
        if format_.pictures is not None and format_.recognizes(path):
            return format_.pictures(path, kind)
    name, remedy = foreign(next(iter(sorted(path.iterdir())), path) if path.is_dir() else path)
    received = "a folder without any" if path.is_dir() else f"a {path.suffix or 'plain'} file" if path.exists() else "no such path"
    known = " or ".join(format_.about for format_ in FORMATS.values() if format_.pictures is not None)
    raise InputError(path, known.format(kind=kind, endings=" ".join(ENDINGS[kind])), name or received, remedy)


def open_recording(intake: Intake) -> list[CameraStreams] | Capture:
    """Open the streams of a recording, or return the capture that its format wrote. Raises InputError."""
    formats = {key: format_ for key, format_ in FORMATS.items() if format_.pictures is None}
    name = intake.format or next((key for key, format_ in formats.items() if format_.recognizes(intake.recording[0])), "")
    if name not in formats:
        raise InputError("--format", f"must be one of {', '.join(formats)}", name or f"none that reads {intake.recording[0]}")
    chosen = formats[name]
    if chosen.recording is not None:
        return chosen.recording(intake)
    assert chosen.capture is not None, "a format without pictures opens recordings or writes captures"
    return chosen.capture(intake)


def open_streams(intake: Intake) -> list[CameraStreams]:
    """Open the streams of --color and --depth, one of each per camera. Raises InputError."""
    if intake.depth and len(intake.color) != len(intake.depth):
        rule = "one folder or video of color and one of depth are required per camera"
        raise InputError("--color, --depth", rule, f"{len(intake.color)} of color, {len(intake.depth)} of depth")
    colors = [open_images(path, "color") for path in intake.color]
    depths: list[ImageSource | None] = [open_images(path, "depth") for path in intake.depth]
    return [CameraStreams(str(k), *pair) for k, pair in enumerate(zip(colors, depths or [None] * len(colors), strict=True))]


def require_kind(path: Path, kind: Kind, image: np.ndarray) -> np.ndarray:
    """Return 8-bit RGB, or depth with one channel of at least 16 bits or floating point. Raises InputError for other images."""
    received = f"{image.dtype} of shape {image.shape}"
    if kind == "color":
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(path, "color must be 8-bit RGB [H, W, 3]", received)
        return image
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        remedy = "Export raw depth as 16-bit PNG or npy; colored or 8-bit images lose it."
        raise InputError(path, "depth must have one channel [H, W] of at least 16 bits", received, remedy)
    return image
