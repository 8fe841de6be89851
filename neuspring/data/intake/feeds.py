"""What one camera gave, in the order of time: folders of images, videos, RealSense files, PhysTwin's raw layout.

An image source has pictures of one kind (color or depth). A feed is one camera: color and depth in pairs, or color alone, with what
the files say about the camera. `ImageFolder` and `VideoFile` are sources, `Paired` and `Bag` feeds. All have

    path         for messages
    series       when every picture or pair was taken: see `moments`
    rate(places) of a feed: frames per second, where the files know
    read(places) the pictures or pairs at ascending places
    files(places) the files that hold them
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.data import phystwin
from neuspring.data.camera import Camera, Lens
from neuspring.data.images import read_npy, read_picture
from neuspring.data.intake.moments import Series, matched, spans

if TYPE_CHECKING:
    import av

T = TypeVar("T")
Kind = Literal["color", "depth"]
PICTURES = {"color": (".png", ".jpg", ".jpeg", ".bmp", ".npy"), "depth": (".png", ".npy", ".tif", ".tiff")}
VIDEOS = (".mkv", ".mp4", ".mov", ".avi", ".m4v", ".webm")
DEEP = ("gray16le", "gray16be")
"""Pixel formats of a video that holds depth. Those of 10 and 12 bits would be scaled when they are read."""
LOSSLESS = ("ffv1", "png", "rawvideo", "tiff", "apng")
STAMP = re.compile(r"(?<![0-9])([0-9]{10,19})(\.[0-9]+)?(?![0-9])")
SECOND = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}
"""s per count of a time since 1970 with so many digits before the point."""


def _picked(path: Path, pictures: Iterable[T], places: Sequence[int]) -> Iterator[T]:
    """Those at ascending places. Raises InputError where the file ends early."""
    wanted = list(places)
    for place, picture in enumerate(pictures):
        if not wanted:
            return
        if place == wanted[0]:
            wanted.pop(0)
            yield picture
    if wanted:
        raise InputError(path, f"a picture {wanted[0]} is required", "the file ends before it")


@dataclass(frozen=True)
class ImageFolder:
    """Images in one folder, in the order of their names, in which runs of digits count as numbers: 10 comes after 9."""

    path: Path
    kind: Kind

    @cached_property
    def paths(self) -> list[Path]:
        """Its images. Raises InputError where there are none, or of two formats."""
        found = [path for path in self.path.iterdir() if path.suffix.lower() in PICTURES[self.kind] and path.name[0] != "."]
        endings = sorted({path.suffix.lower() for path in found})
        if len(endings) != 1:
            rule = f"{self.kind} images of one format are required ({' '.join(PICTURES[self.kind])})"
            raise InputError(self.path, rule, " and ".join(endings) or "none", "Color and depth need a folder of their own each.")
        stamps = {path: _stamp(path) or 0.0 for path in found}
        # re.split with a group alternates text and digits.
        words = {path: [(p.isdigit(), int(p) if p.isdigit() else 0, p) for p in re.split(r"([0-9]+)", path.stem)] for path in found}
        return sorted(found, key=lambda path: (stamps[path] if all(stamps.values()) else 0.0, words[path]))

    @cached_property
    def series(self) -> Series:
        """Times since 1970 in the names, with places as numbers; else the only number in which names differ; else places."""
        stems = [path.stem for path in self.paths]
        times = np.array([_stamp(path) for path in self.paths], dtype=float)
        if np.isfinite(times).all() and (np.diff(times) > 0).all():
            return Series(list(range(len(stems))), times=times, clock="wall")
        words = [re.split(r"([0-9]+)", stem) for stem in stems]
        counts = list(zip(*(word[1::2] for word in words), strict=True)) if len({tuple(word[::2]) for word in words}) == 1 else []
        moving = [column for column in counts if len(set(column)) > 1]
        numbers = [int(digits) for digits in moving[0]] if len(moving) == 1 else []
        return Series(numbers, named=True) if len(set(numbers)) == len(stems) else Series(list(range(len(stems))))

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W] as stored. Raises InputError for a damaged image or one of the wrong kind."""
        for path in self.files(places):
            if path.suffix.lower() == ".npy":
                yield require_kind(path, self.kind, read_npy(path))
                continue
            image = read_picture(path, cv2.IMREAD_COLOR if self.kind == "color" else cv2.IMREAD_UNCHANGED)
            yield require_kind(path, self.kind, image[..., ::-1] if self.kind == "color" else image)

    def files(self, places: Sequence[int]) -> list[Path]:
        """One per picture."""
        return [self.paths[place] for place in places]


@dataclass(frozen=True)
class VideoFile:
    """A video; depth needs a gray one of 16 bits."""

    path: Path
    kind: Kind
    track: int | None = None
    """Which of its video tracks, from 0; None: the first."""

    @cached_property
    def tracks(self) -> list[str]:
        """What its video tracks hold."""
        with self._opened() as (container, _):
            return [f"{s.name} {s.width} x {s.height} {s.pix_fmt}" for s in _films(container)]

    @cached_property
    def series(self) -> Series:
        """By the times of its pictures as they are decoded: a trimmed file holds more than it shows.

        Raises InputError for a file without video, or one that is stored turned.
        """
        with self._opened() as (container, stream):
            tracks = len(_films(container))
            if self.kind == "depth" and stream.codec_context.pix_fmt not in DEEP:
                remedy = "Color maps and 8 bits lose the depth: store gray16le in FFV1 (mkv), or a folder of 16-bit PNG."
                if tracks > 1 and self.track is None:
                    remedy = f"It has {tracks} video tracks: name that of depth, like {self.path}#1."
                raise InputError(self.path, "a depth video must be gray with 16 bits", stream.codec_context.pix_fmt, remedy)
            if self.kind == "depth" and stream.codec_context.name not in LOSSLESS:
                rule = f"a depth video must be lossless ({' '.join(LOSSLESS)})"
                raise InputError(self.path, rule, stream.codec_context.name, "Store gray16le in FFV1 (mkv).")
            base, stamps = float(stream.time_base or 1), list[float]()
            for frame in container.decode(stream):
                if not stamps and frame.rotation:
                    remedy = "Write it upright, as the intrinsics are: ffmpeg -i VIDEO -crf 12 upright.mp4"
                    raise InputError(self.path, "a video must be stored upright", f"turned by {frame.rotation} degrees", remedy)
                stamps.append(np.nan if frame.pts is None else frame.pts * base)
            if not stamps:
                raise InputError(self.path, "a video must have pictures", "none")
            numbers, times = list(range(len(stamps))), np.sort(stamps)
            if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
                return Series(numbers)
            # Tracks of one file have one clock; of a file alone the first picture is the start.
            return Series(numbers, times=times if tracks > 1 else times - times[:1], clock=str(self.path) if tracks > 1 else "")

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """As a folder. The video is decoded from its beginning. Raises InputError where it ends early."""
        form = "rgb24" if self.kind == "color" else "gray16le"
        with self._opened() as (container, stream):
            for frame in _picked(self.path, container.decode(stream), places):
                yield require_kind(self.path, self.kind, frame.to_ndarray(format=form))

    def files(self, places: Sequence[int]) -> list[Path]:
        """The video."""
        return [self.path]

    @contextmanager
    def _opened(self) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
        """The file with its track. Raises InputError for what is no video, or is damaged."""
        needed("av")
        import av

        try:
            with av.open(str(self.path)) as container:
                films, track = _films(container), self.track or 0
                if track >= len(films):
                    received = f"track {track}" if films else "none"
                    raise InputError(self.path, f"a video track is required; the file has {len(films)}, from 0", received)
                films[track].thread_type = "AUTO"
                yield container, films[track]
        except (av.error.FFmpegError, OSError) as error:
            raise InputError(self.path, "this file must be a readable video", str(error)) from error


def _films(container: av.container.InputContainer) -> list[av.VideoStream]:
    """Video tracks that are not the picture of a cover."""
    import av.stream

    return [s for s in container.streams.video if not s.disposition & av.stream.Disposition.attached_pic]


def _stamp(path: Path) -> float | None:
    """s since 1970 of a name with such a time, in s with a fraction, ms, us or ns."""
    found = STAMP.search(path.stem)
    if not found or len(found[1]) not in SECOND or not (found[2] or len(found[1]) > min(SECOND)):
        return None
    time = (int(found[1]) + float(found[2] or 0)) * SECOND[len(found[1])]
    return time if 1e9 < time < 2e9 else None  # From 2e9 on digits are a date: 20260131...


ImageSource: TypeAlias = ImageFolder | VideoFile


def open_images(path: Path, kind: Kind) -> ImageSource:
    """A folder or a video, FILE or FILE#TRACK. Raises InputError for anything else."""
    file, mark, track = str(path).rpartition("#")
    if mark and track.isdigit() and Path(file).is_file():
        return VideoFile(Path(file), kind, int(track))
    if path.is_dir():
        return ImageFolder(path, kind)
    if path.is_file() and path.suffix.lower() in VIDEOS:
        return VideoFile(path, kind)
    received = "nothing there" if not path.exists() else f"a {path.suffix or 'plain'} file"
    raise InputError(path, f"a folder of {kind} images ({' '.join(PICTURES[kind])}) or a video ({' '.join(VIDEOS)})", received)


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


Pair: TypeAlias = tuple[np.ndarray, np.ndarray | None]
"""RGB [H, W, 3] uint8, and depth [H, W] as stored; None: color alone."""


@dataclass(frozen=True, eq=False)
class Paired:
    """Color and depth of two folders or videos, or color alone."""

    name: str
    color: ImageSource
    depth: ImageSource | None
    unit: float | None = None
    lens: Lens | None = None
    pose: np.ndarray | None = None
    numbered: bool = False
    """Whether numbers in names are known to count the same moments everywhere."""

    @property
    def path(self) -> Path:
        """That of color."""
        return self.color.path

    @cached_property
    def match(self) -> tuple[dict[int, int], str]:
        """Number of color -> place of depth, and what decided; nothing of color alone. Raises InputError; see `moments`."""
        if self.depth is None:
            return {}, ""
        names = (f"camera {self.name}: color", "depth")
        return matched(self.depth.path, names, self.color.series, self.depth.series, self.numbered)

    @cached_property
    def _pairs(self) -> list[tuple[int, int]]:
        """(place of color, place of depth)."""
        numbers, of = self.color.series.numbers, self.match[0]
        if self.depth is None:
            return [(place, place) for place in range(len(numbers))]
        return [(place, of[number]) for place, number in enumerate(numbers) if number in of]

    @cached_property
    def series(self) -> Series:
        """Of the pairs."""
        return self.color.series.part([left for left, _ in self._pairs])

    def rate(self, places: Sequence[int]) -> float | None:
        """Frames per second around some pairs, by their time stamps."""
        return self.series.part(range(min(places), max(places) + 1)).rate

    @property
    def sources(self) -> list[ImageSource]:
        """Color, and depth where there is any."""
        return [self.color] if self.depth is None else [self.color, self.depth]

    @property
    def alone(self) -> dict[str, list[int]]:
        """Numbers of images without a partner, by kind."""
        used = zip(*self._pairs, strict=True) if self._pairs else ((), ())
        return {
            images.kind: [number for place, number in enumerate(images.series.numbers) if place not in taken]
            for images, taken in zip(self.sources, map(set, used), strict=False)
        }

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """With depth all of them, or none."""
        pairs = [self._pairs[place] for place in places]
        colors = self.color.read([left for left, _ in pairs])
        if self.depth is None:
            return zip(colors, [None] * len(pairs), strict=True)
        return zip(colors, self.depth.read([right for _, right in pairs]), strict=True)

    def files(self, places: Sequence[int]) -> list[Path]:
        """Those of color, then those of depth."""
        pairs = [self._pairs[place] for place in places]
        deep = [] if self.depth is None else self.depth.files([right for _, right in pairs])
        return self.color.files([left for left, _ in pairs]) + deep


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
    return [
        Paired(name, open_images(color, "color"), depth) for name, color, depth in zip(names, colors, deep or [None], strict=True)
    ]


MODULE = "pyrealsense2"
PATIENCE = 5000
"""ms until the next frames of a file; none within it: the file ends."""


class Bag:
    """One camera's recording in a RealSense file. Every pass plays the file once; the first, here, counts its frames."""

    pose = None

    def __init__(self, name: str, path: Path) -> None:
        """Raises InputError."""
        self.name, self.path = name, path
        count = 0
        for profile, _, _ in self._play(True):
            if not count:
                stream = profile.get_stream(_library().stream.color)
                self._rate = float(stream.fps())
                self.unit = float(profile.get_device().first_depth_sensor().get_depth_scale())
                about = stream.as_video_stream_profile().get_intrinsics()
                coefficients, model = np.array(about.coeffs, dtype=float), str(about.model).rpartition(".")[2]
                matrix = np.array([[about.fx, 0, about.ppx], [0, about.fy, about.ppy], [0, 0, 1.0]])
                self.lens = Lens(matrix=matrix, distortion=coefficients, model=model, size=(int(about.width), int(about.height)))
            count += 1
        if not count:
            raise InputError(path, "pairs of color and depth are required", "none", "Record both streams.")
        self.series = Series(list(range(count)))

    def rate(self, places: Sequence[int]) -> float:
        """Frames per second that were set."""
        return self._rate

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """Color with depth that is aligned to it. Raises InputError where the file ends early."""
        return _picked(self.path, ((color, depth) for _, color, depth in self._play(False)), places)

    def files(self, places: Sequence[int]) -> list[Path]:
        """The recording."""
        return [self.path]

    def _play(self, only_count: bool) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
        """Profile, RGB and aligned depth of every pair whose color is new; empty images where they are only counted."""
        library = _library()
        if not self.path.is_file():
            raise InputError(self.path, "a RealSense .bag file is required", "nothing there")
        pipeline, settings = library.pipeline(), library.config()
        settings.enable_device_from_file(str(self.path), repeat_playback=False)
        try:
            profile = pipeline.start(settings)
        except RuntimeError as error:
            raise InputError(self.path, "this file must be a RealSense recording", str(error)) from error
        try:
            profile.get_device().as_playback().set_real_time(False)
            align, last = library.align(library.stream.color), -1
            while True:
                there, frames = pipeline.try_wait_for_frames(PATIENCE)
                if not there:
                    return
                color, depth = frames.get_color_frame(), frames.get_depth_frame()
                if not color or not depth or color.get_frame_number() == last:
                    continue
                last = color.get_frame_number()
                if only_count:
                    yield profile, np.zeros(0), np.zeros(0)
                    continue
                frames = align.process(frames)
                color, depth = frames.get_color_frame(), frames.get_depth_frame()
                image, kind = np.array(color.get_data()), str(color.get_profile().format()).rpartition(".")[2]
                if kind == "bgr8":
                    image = image[..., ::-1]
                elif kind == "yuyv":
                    image = cv2.cvtColor(image.view(np.uint8).reshape(*image.shape[:2], 2), cv2.COLOR_YUV2RGB_YUYV)
                elif kind != "rgb8":
                    raise InputError(self.path, "color must be rgb8, bgr8 or yuyv", kind)
                yield profile, image, np.array(depth.get_data())
        finally:
            pipeline.stop()


def _library() -> Any:
    try:
        return importlib.import_module(MODULE)
    except ImportError as error:
        remedy = f"Run `pip install {MODULE}`, or export the recording to folders (rs-convert) and use --color and --depth."
        raise InputError("--bag", f"the package {MODULE} is required to read a .bag file", "not installed", remedy) from error


CameraFeed: TypeAlias = Paired | Bag


@dataclass(frozen=True, eq=False)
class Raw:
    """A case in PhysTwin's raw layout."""

    case: Path
    views: list[Paired]
    cameras: dict[str, Camera]
    rate: float
    train_end: int | None
    """Of all its frames."""
    tracks: np.ndarray | None
    """[T, K, 3], m, in its world."""
    ids: dict[str, dict[int, list[str]]]
    """Detections of each label, by camera; empty without masks."""

    @classmethod
    def open(cls, case: Path) -> Raw:
        """Read its calibration. Raises InputError."""
        metadata, listed = phystwin.read_calibration(case)
        cameras = {camera.name: camera for camera in listed}
        views = [
            Paired(
                name,
                open_images(case / "color" / name, "color"),
                open_images(case / "depth" / name, "depth"),
                unit=0.001,
                lens=Lens(matrix=camera.intrinsics, size=(camera.width, camera.height)),
                pose=camera.camera_to_world,
                numbered=True,
            )
            for name, camera in cameras.items()
        ]
        frames = int(metadata["frame_num"])
        for images in (images for view in views for images in view.sources):
            series = images.series
            if not series.named or series.numbers[-1] >= frames:
                rule = f"names must be frame numbers below frame_num of {phystwin.METADATA}, {frames}"
                raise InputError(images.path, rule, spans(series.numbers) if series.named else images.files([0])[0].name)
        return cls(
            case,
            views,
            cameras,
            float(metadata.get("fps", phystwin.RELEASED_FRAME_RATE)),
            phystwin.train_end_of(case, frames),
            phystwin.annotated(case, frames),
            {name: phystwin.detections(case, name) for name in cameras} if (case / "mask").is_dir() else {},
        )

    def require_masks(self, numbers: Mapping[str, Sequence[int]]) -> None:
        """Raise InputError unless every detection of a camera has masks of its frames with these numbers."""
        for name, one in ((name, one) for name, ids in self.ids.items() for listed in ids.values() for one in listed):
            folder = self.case / "mask" / name / one
            if lacking := [number for number in numbers[name] if not (folder / f"{number}.png").is_file()]:
                remedy = "Make them, take images of these frames away, or choose others with --frames."
                raise InputError(folder, "a mask of every frame with color is required", f"none of {spans(lacking)}", remedy)

    def labels(self, camera: str, number: int) -> np.ndarray:
        """Mask [H, W] uint8 of a camera's frame with this number in its name. Raises InputError."""
        return phystwin.labels_of(self.case, self.cameras[camera], number, self.ids[camera])
