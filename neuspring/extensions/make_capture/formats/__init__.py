"""Formats of images and recordings: one file each, which recognizes a path and opens it.

To add one: a file here with a `CaptureFormat` named capture_format, or a package's entry point of the group
`neuspring.capture_formats`. A format has one of

    pictures     color or depth of one camera (--color, --depth): a folder, a video
    recording    streams of all cameras (--recording): a bag
    capture      writes the capture itself (--recording): PhysTwin's raw layout
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
    """Its name for messages; {kind} and {endings} stand for the kind of images and the endings of their files."""
    recognizes: Callable[[Path], bool]
    """True for a path of this format."""
    pictures: Callable[[Path, Kind], ImageSource] | None = None
    """Opens images of one kind. Raises InputError."""
    recording: Callable[[Intake], list[CameraStreams]] | None = None
    """Opens --recording. Raises InputError."""
    capture: Callable[[Intake], Capture] | None = None
    """Writes --recording as a capture. Raises InputError."""


FORMATS: Registry[CaptureFormat] = Registry("capture_formats", modules(__name__, "capture_format"), CaptureFormat)


def open_images(path: Path, kind: Kind) -> ImageSource:
    """Color or depth of one camera. Raises InputError for a path of no format."""
    for format_ in FORMATS.values():
        if format_.pictures is not None and format_.recognizes(path):
            return format_.pictures(path, kind)
    name, remedy = foreign(next(iter(sorted(path.iterdir())), path) if path.is_dir() else path)
    received = "a folder without any" if path.is_dir() else f"a {path.suffix or 'plain'} file" if path.exists() else "nothing there"
    known = " or ".join(format_.about for format_ in FORMATS.values() if format_.pictures is not None)
    raise InputError(path, known.format(kind=kind, endings=" ".join(ENDINGS[kind])), name or received, remedy)


def open_recording(intake: Intake) -> list[CameraStreams] | Capture:
    """The streams of a recording, or the capture that its format wrote. Raises InputError."""
    fitting = {key: one for key, one in FORMATS.items() if one.pictures is None}
    name = intake.format or next((key for key, one in fitting.items() if one.recognizes(intake.recording[0])), "")
    if name not in fitting:
        raise InputError("--format", f"must be one of {', '.join(fitting)}", name or f"none that reads {intake.recording[0]}")
    one = fitting[name]
    if one.recording is not None:
        return one.recording(intake)
    assert one.capture is not None, "a format without pictures opens recordings or writes captures"
    return one.capture(intake)


def open_streams(intake: Intake) -> list[CameraStreams]:
    """The streams of --color and --depth, one of each per camera. Raises InputError."""
    if intake.depth and len(intake.color) != len(intake.depth):
        rule = "as many folders or videos of depth as of color are required, one each per camera"
        raise InputError("--color, --depth", rule, f"{len(intake.color)} of color, {len(intake.depth)} of depth")
    colors = [open_images(path, "color") for path in intake.color]
    depths: list[ImageSource | None] = [open_images(path, "depth") for path in intake.depth]
    return [CameraStreams(str(k), *pair) for k, pair in enumerate(zip(colors, depths or [None] * len(colors), strict=True))]


def require_kind(path: Path, kind: Kind, image: np.ndarray) -> np.ndarray:
    """The image, if it is RGB of 8 bits, or depth of one channel: 16 bits or more, or floating point. Raises InputError."""
    received = f"{image.dtype} of shape {image.shape}"
    if kind == "color":
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(path, "color must be 8-bit RGB [H, W, 3]", received)
        return image
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        remedy = "Export the raw depth (16-bit PNG or npy): colors and 8 bits lose it."
        raise InputError(path, "depth must have one channel [H, W] of at least 16 bits", received, remedy)
    return image
