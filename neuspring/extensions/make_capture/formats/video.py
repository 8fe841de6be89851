"""Video files with one or more tracks."""

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
"""ffmpeg applies rotation marks by itself; WIDTH and HEIGHT are those of the intrinsics."""
LOSSLESS = ("ffv1", "png", "rawvideo", "tiff", "apng")


@dataclass(frozen=True)
class VideoFile:
    """A video; depth requires 16-bit gray."""

    path: Path
    kind: Kind
    track: int | None = None
    """Index of the video track, from 0; None: the only one."""

    @cached_property
    def series(self) -> Series:
        """Times of the decoded images; a trimmed file contains more images than players show.

        Raises InputError for a file without video, a container that rotates, flips or stretches the video, and lossy depth.
        """
        with self._opened() as (container, stream):
            codec, tracks = stream.codec_context, len(_video_tracks(container))
            if self.track is None and tracks > 1:
                raise InputError(
                    self.path, "one video track must be chosen", f"{tracks} tracks", f"Append its number: {self.path}#1"
                )
            if self.kind == "depth" and (codec.pix_fmt not in ("gray16le", "gray16be") or codec.name not in LOSSLESS):
                rule = f"a depth video must be gray with 16 bits and lossless ({' '.join(LOSSLESS)})"
                raise InputError(
                    self.path, rule, f"{codec.pix_fmt}, {codec.name}", "Store gray16le in FFV1 (mkv), or write 16-bit PNG images."
                )
            base, stamps = float(stream.time_base or 1), list[float]()
            for frame in container.decode(stream):
                if not stamps:
                    self._require_plain(frame, stream)
                stamps.append(np.nan if frame.pts is None else frame.pts * base)
        if not stamps:
            raise InputError(self.path, "a video must contain images", "none")
        times = np.sort(stamps)
        if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
            return Series(list(range(len(times))), named=False)
        # Tracks of one file share a clock.
        return Series(list(range(len(times))), times, clock=str(self.path) if tracks > 1 else "")

    def _require_plain(self, frame: av.VideoFrame, stream: av.VideoStream) -> None:
        ratio, matrix = stream.sample_aspect_ratio, [one for one in frame.side_data if "DISPLAYMATRIX" in str(one)]
        codec = stream.codec_context
        for received, wrong, filters in (
            ("a mark that makes players rotate or flip it", matrix, SQUARE_PIXELS),
            (f"pixels of {ratio}", ratio not in (None, 0, 1), SQUARE_PIXELS),
            ("interlaced", frame.interlaced_frame, "bwdif=mode=send_frame"),
            ("HDR (PQ or HLG)", codec.color_trc in (16, 18), TONE_MAP),
            ("colors of BT.2020", codec.color_primaries == 9, "zscale=p=bt709:t=bt709:m=bt709,format=yuv420p"),
        ):
            if wrong:
                rule = "a video must be upright and progressive, with square pixels and 8-bit colors of BT.709 or BT.601"
                raise InputError(self.path, rule, received, f"Convert it: ffmpeg -i VIDEO -vf {filters} -crf 12 plain.mp4")

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """See `ImageSource.read`. Decodes the video from its beginning. Raises InputError if it ends early."""
        wanted = list(places)
        with self._opened() as (container, stream):
            for place, frame in enumerate(container.decode(stream)):
                if wanted and place == wanted[0]:
                    wanted.pop(0)
                    image = frame.to_ndarray(format="rgb24" if self.kind == "color" else "gray16le")
                    yield require_kind(self.path, self.kind, image)
                if not wanted:
                    return
        raise InputError(self.path, f"image {wanted[0]} is required", "a file that ends before it")

    def files(self, places: Sequence[int]) -> list[Path]:
        """The video."""
        return [self.path]

    @contextmanager
    def _opened(self) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
        """Open the file and its track. Raises InputError for a file that is damaged or not a video."""
        needed("av")
        import av

        try:
            with av.open(str(self.path)) as container:
                videos, track = _video_tracks(container), self.track or 0
                if track >= len(videos):
                    raise InputError(self.path, f"a video track below {len(videos)} is required", f"track {track}")
                videos[track].thread_type = "AUTO"
                yield container, videos[track]
        except (av.error.FFmpegError, OSError) as error:
            raise InputError(self.path, "this file must be a readable video", str(error)) from error


def _video_tracks(container: av.container.InputContainer) -> list[av.VideoStream]:
    """Video tracks without cover images."""
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
