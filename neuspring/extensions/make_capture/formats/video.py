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
from neuspring.extensions.make_capture.formats import CaptureFormat, require_kind
from neuspring.extensions.make_capture.streams import Kind, Series

if TYPE_CHECKING:
    import av

VIDEO_ENDINGS = (".mkv", ".mp4", ".mov", ".avi", ".m4v", ".webm")
TONE_MAP = "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,tonemap=clip,zscale=t=bt709:m=bt709:r=tv,format=yuv420p"
SQUARE_PIXELS = "scale=WIDTH:HEIGHT,setsar=1"
"""ffmpeg applies marks by itself; WIDTH and HEIGHT are those of the intrinsics."""
LOSSLESS = ("ffv1", "png", "rawvideo", "tiff", "apng")


@dataclass(frozen=True)
class VideoFile:
    """A video; depth needs a gray one of 16 bits."""

    path: Path
    kind: Kind
    track: int | None = None
    """Which of its video tracks, from 0; None: the only one."""

    @cached_property
    def series(self) -> Series:
        """Times of the images as they are decoded: a trimmed file contains more than it shows.

        Raises InputError for a file without video, one whose container turns, flips or stretches it, and depth that is not exact.
        """
        with self._opened() as (container, stream):
            codec, tracks = stream.codec_context, len(_films(container))
            if self.track is None and tracks > 1:
                raise InputError(self.path, "one video track must be named", f"{tracks} tracks", f"Like {self.path}#1.")
            if self.kind == "depth" and (codec.pix_fmt not in ("gray16le", "gray16be") or codec.name not in LOSSLESS):
                rule = f"a depth video must be gray with 16 bits and lossless ({' '.join(LOSSLESS)})"
                raise InputError(
                    self.path, rule, f"{codec.pix_fmt}, {codec.name}", "Store gray16le in FFV1 (mkv), or PNG of 16 bits."
                )
            base, stamps = float(stream.time_base or 1), list[float]()
            for frame in container.decode(stream):
                if not stamps:
                    self._require_plain(frame, stream)
                stamps.append(np.nan if frame.pts is None else frame.pts * base)
        if not stamps:
            raise InputError(self.path, "a video must have images", "none")
        times = np.sort(stamps)
        if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
            return Series(list(range(len(times))), named=False)
        # Tracks of one file share a clock.
        return Series(list(range(len(times))), times, clock=str(self.path) if tracks > 1 else "")

    def _require_plain(self, frame: av.VideoFrame, stream: av.VideoStream) -> None:
        ratio, matrix = stream.sample_aspect_ratio, [one for one in frame.side_data if "DISPLAYMATRIX" in str(one)]
        codec = stream.codec_context
        for received, wrong, filters in (
            ("a mark by which players turn or flip it", matrix, SQUARE_PIXELS),
            (f"pixels of {ratio}", ratio not in (None, 0, 1), SQUARE_PIXELS),
            ("interlaced", frame.interlaced_frame, "bwdif=mode=send_frame"),
            ("HDR (PQ or HLG)", codec.color_trc in (16, 18), TONE_MAP),
            ("colors of BT.2020", codec.color_primaries == 9, "zscale=p=bt709:t=bt709:m=bt709,format=yuv420p"),
        ):
            if wrong:
                rule = "a video must be upright, of square pixels, whole frames, and 8-bit colors of BT.709 or BT.601"
                raise InputError(self.path, rule, received, f"Convert it: ffmpeg -i VIDEO -vf {filters} -crf 12 plain.mp4")

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """As a folder. The video is decoded from its beginning. Raises InputError where it ends early."""
        wanted = list(places)
        with self._opened() as (container, stream):
            for place, frame in enumerate(container.decode(stream)):
                if wanted and place == wanted[0]:
                    wanted.pop(0)
                    image = frame.to_ndarray(format="rgb24" if self.kind == "color" else "gray16le")
                    yield require_kind(self.path, self.kind, image)
                if not wanted:
                    return
        raise InputError(self.path, f"an image {wanted[0]} is required", "the file ends before it")

    def files(self, places: Sequence[int]) -> list[Path]:
        """The video."""
        return [self.path]

    @contextmanager
    def _opened(self) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
        """The file with its track. Raises InputError for a file that is no video, or is damaged."""
        needed("av")
        import av

        try:
            with av.open(str(self.path)) as container:
                films, track = _films(container), self.track or 0
                if track >= len(films):
                    raise InputError(self.path, f"a video track is required; the file has {len(films)}, from 0", f"track {track}")
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


def _recognized(path: Path) -> bool:
    file, track = _track(path)
    return track is not None or (file.is_file() and file.suffix.lower() in VIDEO_ENDINGS)


capture_format = CaptureFormat(
    about=f"a video ({' '.join(VIDEO_ENDINGS)})",
    recognizes=_recognized,
    pictures=lambda path, kind: VideoFile(_track(path)[0], kind, _track(path)[1]),
)
