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
from typing import Literal, Protocol, TypeAlias, TypeVar

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import foreign
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.moments import Series
from neuspring.registry import Registry, modules

T = TypeVar("T")
Kind = Literal["color", "depth"]
ENDINGS = {"color": (".png", ".jpg", ".jpeg", ".bmp", ".npy"), "depth": (".png", ".npy", ".tif", ".tiff")}
Pair: TypeAlias = tuple[np.ndarray, np.ndarray | None]
"""RGB [H, W, 3] uint8, and depth [H, W] as stored; None: color alone."""


class ImageSource(Protocol):
    """Pictures of one kind, in the order of time."""

    @property
    def path(self) -> Path:
        """For messages."""

    @property
    def kind(self) -> Kind:
        """The kind of all of them."""

    @property
    def series(self) -> Series:
        """When every picture was taken."""

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W] as stored, at ascending places. Raises InputError."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


class CameraFeed(Protocol):
    """One camera: color and depth in pairs, or color alone, with what the files say about the camera."""

    @property
    def name(self) -> str:
        """The camera's."""

    @property
    def path(self) -> Path:
        """For messages."""

    @property
    def unit(self) -> float | None:
        """m per count of depth, where the source says it."""

    @property
    def lens(self) -> Lens | None:
        """Intrinsics, where the source says them."""

    @property
    def pose(self) -> np.ndarray | None:
        """Camera to world [4, 4], m, where the source says it."""

    @property
    def series(self) -> Series:
        """When every pair was taken."""

    def rate(self, places: Sequence[int]) -> float | None:
        """Frames per second, where the files know."""

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """The pairs at ascending places. Raises InputError."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """All that cameras gave, and what came along."""

    views: Sequence[CameraFeed]
    rate: float | None = None
    """Frames per second, where it is known apart from the views."""
    up: Literal["+z", "-z"] | None = None
    """Up of its poses; None: found by the table."""
    train_end: int | None = None
    """End of the training frames, of all its frames."""
    tracks: np.ndarray | None = None
    """[T, K, 3], m, in its world: annotated points."""
    labels: Callable[[str, int], np.ndarray] | None = None
    """Camera and number of a frame -> mask [H, W] uint8; None: no masks. Raises InputError."""
    require_masks: Callable[[dict[str, list[int]]], None] = lambda numbers: None
    """Raises InputError unless there are masks of the frames, by number, of each camera."""


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
