"""What one camera gave: pictures of one kind (color or depth) from a folder of images or a video, in the order of time; and color
and depth in pairs, or color alone, with what the files say about the camera.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed

if TYPE_CHECKING:
    import av

Kind = Literal["color", "depth"]
PICTURES = {"color": (".png", ".jpg", ".jpeg", ".bmp", ".npy"), "depth": (".png", ".npy", ".tif", ".tiff")}
VIDEOS = (".mkv", ".mp4", ".mov", ".avi", ".m4v", ".webm")
DEEP = ("gray16le", "gray16be")
"""Pixel formats of a video that holds depth. Those of 10 and 12 bits would be scaled when they are read."""
GAP = 1.5
"""Pictures this many times farther apart than usual have others missing between them."""
LOSSLESS = ("ffv1", "png", "rawvideo", "tiff", "apng")


class ImageSource(Protocol):
    """What one camera saw, of one kind."""

    @property
    def path(self) -> Path:
        """The folder, or the file."""

    @property
    def numbers(self) -> list[int]:
        """The number of every picture: that in its name, or its place, from 0."""

    @property
    def rate(self) -> float | None:
        """Frames per second, where the source knows."""

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """The pictures at ascending places: RGB [H, W, 3] uint8, or depth [H, W] as stored."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


def open_images(path: Path, kind: Kind) -> ImageSource:
    """A folder or a video. Raises InputError for anything else."""
    if path.is_dir():
        return ImageFolder(path, kind)
    if path.is_file() and path.suffix.lower() in VIDEOS:
        return VideoFile(path, kind)
    received = "nothing there" if not path.exists() else f"a {path.suffix or 'plain'} file"
    raise InputError(path, f"a folder of {kind} images ({' '.join(PICTURES[kind])}) or a video ({' '.join(VIDEOS)})", received)


def natural(path: Path) -> list[tuple[int, int, str]]:
    """The order of names: runs of digits count as numbers, so that 10 comes after 9."""
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"([0-9]+)", path.stem)]


@dataclass(frozen=True)
class ImageFolder:
    """Images in one folder, in the order of their names."""

    path: Path
    kind: Kind

    @cached_property
    def paths(self) -> list[Path]:
        """Its images. Raises InputError where there are none, or of two formats."""
        found = [path for path in self.path.iterdir() if path.suffix.lower() in PICTURES[self.kind] and path.name[0] != "."]
        endings = sorted({path.suffix.lower() for path in found})
        if not found or len(endings) > 1:
            rule = f"{self.kind} images of one format are required ({' '.join(PICTURES[self.kind])})"
            raise InputError(self.path, rule, " and ".join(endings) or "none", "Color and depth need a folder of their own each.")
        return sorted(found, key=natural)

    @cached_property
    def numbers(self) -> list[int]:
        """The numbers at the end of the names where they differ in nothing else, else places from 0."""
        matches = [re.fullmatch(r"(.*?)([0-9]{1,9})", path.stem) for path in self.paths]
        if all(matches) and len({match[1] for match in matches if match}) == 1:
            numbers = [int(match[2]) for match in matches if match]
            if len(set(numbers)) == len(numbers):
                return numbers
        return list(range(len(self.paths)))

    @property
    def rate(self) -> None:
        """Unknown."""
        return None

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """See `ImageSource`. Raises InputError for a damaged image or one of the wrong kind."""
        for place in places:
            yield self._picture(self.paths[place])

    def files(self, places: Sequence[int]) -> list[Path]:
        """One per picture."""
        return [self.paths[place] for place in places]

    def _picture(self, path: Path) -> np.ndarray:
        if path.suffix.lower() == ".npy":
            try:
                image = np.load(path, allow_pickle=False)
            except (OSError, ValueError, EOFError) as error:
                raise InputError(path, "this file must be a NumPy array without pickle", str(error)) from error
            return require_kind(path, self.kind, image)
        image = cv2.imread(str(path), cv2.IMREAD_COLOR if self.kind == "color" else cv2.IMREAD_UNCHANGED)
        if image is None:
            raise InputError(path, "this file must be a readable image", "a damaged file", "Copy it again from the camera.")
        return require_kind(path, self.kind, image[..., ::-1] if self.kind == "color" else image)


@dataclass(frozen=True)
class VideoFile:
    """A video; depth needs a gray one of 16 bits."""

    path: Path
    kind: Kind

    @cached_property
    def _times(self) -> list[Fraction]:
        """s, of every picture, ascending. Raises InputError for a file without video, or one that is stored turned."""
        with _opened(self.path) as container:
            stream = container.streams.video[0]
            if self.kind == "depth" and stream.codec_context.pix_fmt not in DEEP:
                remedy = "Color maps and 8 bits lose the depth: store gray16le in FFV1 (mkv), or a folder of 16-bit PNG."
                raise InputError(self.path, "a depth video must be gray with 16 bits", stream.codec_context.pix_fmt, remedy)
            if self.kind == "depth" and stream.codec_context.name not in LOSSLESS:
                rule = f"a depth video must be lossless ({' '.join(LOSSLESS)})"
                raise InputError(self.path, rule, stream.codec_context.name, "Store gray16le in FFV1 (mkv).")
            first = next(container.decode(stream), None)
            if first is not None and first.rotation:
                remedy = "Write it upright, as the intrinsics are: ffmpeg -i VIDEO -crf 12 upright.mp4"
                raise InputError(self.path, "a video must be stored upright", f"turned by {first.rotation} degrees", remedy)
        with _opened(self.path) as container:
            stream = container.streams.video[0]
            base = stream.time_base or Fraction(1)
            return sorted(packet.pts * base for packet in container.demux(stream) if packet.pts is not None and packet.size)

    @property
    def numbers(self) -> list[int]:
        """Places from 0."""
        return list(range(len(self._times)))

    @property
    def rate(self) -> float | None:
        """The mean distance of pictures decides, as time stamps may be whole milliseconds; gaps of dropped ones do not count."""
        steps = np.diff([float(time) for time in self._times])
        return float(1 / steps[steps <= GAP * np.median(steps)].mean()) if len(steps) else None

    def dropped(self) -> int:
        """Pictures that are missing in between."""
        steps = np.diff([float(time) for time in self._times])
        return int(np.round(steps[steps > GAP * np.median(steps)] / np.median(steps) - 1).sum()) if len(steps) else 0

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """See `ImageSource`. The video is decoded from its beginning. Raises InputError where it ends early."""
        wanted = list(places)
        with _opened(self.path) as container:
            try:
                for place, frame in enumerate(container.decode(container.streams.video[0])):
                    if not wanted:
                        return
                    if place == wanted[0]:
                        wanted.pop(0)
                        image = frame.to_ndarray(format="rgb24" if self.kind == "color" else "gray16le")
                        yield require_kind(self.path, self.kind, image)
            except needed("av").error.FFmpegError as error:
                raise InputError(self.path, "this video must be readable", str(error)) from error
        if wanted:
            raise InputError(self.path, f"a picture {wanted[0]} is required", "the video ends before it")

    def files(self, places: Sequence[int]) -> list[Path]:
        """The video."""
        return [self.path]


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


def _opened(path: Path) -> av.container.InputContainer:
    needed("av")
    import av

    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(path, "this file must be a readable video", str(error)) from error
    if not container.streams.video:
        container.close()
        raise InputError(path, "this file must have a video stream", "none")
    return container


Pair: TypeAlias = tuple[np.ndarray, np.ndarray | None]
"""RGB [H, W, 3] uint8, and depth [H, W] as stored; None: color alone."""
COMMON = 0.5
"""Color and depth are paired by their numbers if this part of them is common, else by their order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """A camera's intrinsics."""

    matrix: np.ndarray
    """K [3, 3], pixels."""
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Coefficients of OpenCV's model (4, 5, 8, 12 or 14); none: no distortion."""
    size: tuple[int, int] | None = None
    """(width, height) for which it holds, where it is said."""


class CameraFeed(Protocol):
    """One camera's pairs of pictures, and what is known of it."""

    @property
    def name(self) -> str:
        """Its name in the capture."""

    @property
    def path(self) -> Path:
        """For messages."""

    @property
    def numbers(self) -> list[int]:
        """The number of every pair, ascending."""

    @property
    def rate(self) -> float | None:
        """Frames per second, where the source knows."""

    @property
    def unit(self) -> float | None:
        """Meters per count of depth, where the source knows."""

    @property
    def lens(self) -> Lens | None:
        """Intrinsics, where the source knows."""

    @property
    def pose(self) -> np.ndarray | None:
        """Camera to world [4, 4], m, where the source knows."""

    @property
    def remarks(self) -> list[str]:
        """What the user should know about the files."""

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """The pairs at ascending places: with depth all of them, or none."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


@dataclass(frozen=True, eq=False)
class Paired:
    """Color and depth of two folders or videos, or color alone."""

    name: str
    color: ImageSource
    depth: ImageSource | None
    unit: float | None = None
    lens: Lens | None = None
    pose: np.ndarray | None = None

    @property
    def path(self) -> Path:
        """That of color."""
        return self.color.path

    @cached_property
    def _pairs(self) -> list[tuple[int, int, int]]:
        """(number, place of color, place of depth). Raises InputError where they cannot be paired."""
        if self.depth is None:
            return [(number, place, place) for place, number in enumerate(self.color.numbers)]
        left, right = ({number: place for place, number in enumerate(images.numbers)} for images in (self.color, self.depth))
        common = sorted(left.keys() & right.keys())
        if len(common) >= COMMON * max(len(left), len(right)) and len(common):
            return [(number, left[number], right[number]) for number in common]
        if len(left) == len(right):
            return [(number, place, place) for place, number in enumerate(self.color.numbers)]
        rule = f"camera {self.name} needs as many depth images as color images, or the same numbers in their names"
        remedy = "Where both have time stamps for names, copy the nearest pairs to two folders first."
        raise InputError(self.depth.path, rule, f"{len(right)} for {len(left)}, {len(common)} numbers in common", remedy)

    @property
    def numbers(self) -> list[int]:
        """See `CameraFeed`."""
        return [number for number, *_ in self._pairs]

    @property
    def rate(self) -> float | None:
        """That of the color video."""
        return self.color.rate

    @cached_property
    def remarks(self) -> list[str]:
        """Images without a partner, dropped pictures of a video."""
        found, sources = [], [images for images in (self.color, self.depth) if images is not None]
        alone = max(len(images.numbers) for images in sources) - len(self._pairs)
        if alone:
            found.append(f"camera {self.name}: {alone} images without their partner are left out")
        for images in sources:
            if isinstance(images, VideoFile) and (dropped := images.dropped()):
                found.append(f"{images.path}: about {dropped} pictures were dropped when it was filmed; time jumps there")
        return found

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """See `CameraFeed`."""
        pairs = [self._pairs[place] for place in places]
        colors = self.color.read([left for _, left, _ in pairs])
        if self.depth is None:
            return zip(colors, [None] * len(pairs), strict=True)
        return zip(colors, self.depth.read([right for *_, right in pairs]), strict=True)

    def files(self, places: Sequence[int]) -> list[Path]:
        """See `CameraFeed`."""
        pairs = [self._pairs[place] for place in places]
        deep = [] if self.depth is None else self.depth.files([right for *_, right in pairs])
        return self.color.files([left for _, left, _ in pairs]) + deep


def pairs(colors: Sequence[Path], depths: Sequence[Path], names: Sequence[str] = ()) -> list[CameraFeed]:
    """The views of folders or videos, one of color and one of depth per camera; without depths color alone, of one camera.

    Raises InputError.
    """
    if len(colors) > 1 and not depths:
        rule = "without depth one camera is required: color alone is of one view"
        raise InputError("--color", rule, len(colors), "Give one folder or video, or --depth for each.")
    if not colors or (depths and len(colors) != len(depths)):
        rule = "as many folders or videos of depth as of color are required, one each per camera"
        raise InputError("--color, --depth", rule, f"{len(colors)} of color, {len(depths)} of depth")
    names = names or tuple(map(str, range(len(colors))))
    if len(names) != len(colors) or len(set(names)) < len(names):
        raise InputError("--cameras", f"{len(colors)} different names are required", " ".join(names))
    deep: list[ImageSource | None] = [open_images(depth, "depth") for depth in depths]
    views: list[CameraFeed] = [
        Paired(name, open_images(color, "color"), depth) for name, color, depth in zip(names, colors, deep or [None], strict=True)
    ]
    return views
