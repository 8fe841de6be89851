"""A video, of one or several tracks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.extensions.make_capture.feeds import Kind
from neuspring.extensions.make_capture.formats import CaptureFormat, picked, require_kind
from neuspring.extensions.make_capture.moments import Series

if TYPE_CHECKING:
    import av

VIDEO_ENDINGS = (".mkv", ".mp4", ".mov", ".avi", ".m4v", ".webm")
DEEP = ("gray16le", "gray16be")
"""Pixel formats of a video that holds depth. Those of 10 and 12 bits would be scaled when they are read."""
LOSSLESS = ("ffv1", "png", "rawvideo", "tiff", "apng")


@dataclass(frozen=True)
class VideoFile:
    """A video; depth needs a gray one of 16 bits."""

    path: Path
    kind: Kind
    track: int | None = None
    """Which of its video tracks, from 0; None: the first."""

    @cached_property
    def tracks(self) -> list[str]:
        """Content of its video tracks."""
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
            for frame in picked(self.path, container.decode(stream), places):
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


def _track(path: Path) -> tuple[Path, int | None]:
    """The file and the track of FILE or FILE#TRACK."""
    file, mark, track = str(path).rpartition("#")
    return (Path(file), int(track)) if mark and track.isdigit() and Path(file).is_file() else (path, None)


def _opened(path: Path, kind: Kind) -> VideoFile:
    file, track = _track(path)
    return VideoFile(file, kind, track)


def _recognized(path: Path) -> bool:
    file, track = _track(path)
    return track is not None or (file.is_file() and file.suffix.lower() in VIDEO_ENDINGS)


capture_format = CaptureFormat(about=f"a video ({' '.join(VIDEO_ENDINGS)})", recognizes=_recognized, pictures=_opened)
