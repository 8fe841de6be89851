"""Write a video that all browsers play: H.264 (libx264) in MP4, yuv420p, BT.709 colors, with PyAV."""

from __future__ import annotations

import tempfile
from fractions import Fraction
from pathlib import Path
from typing import Self

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.core.files import write_atomically

BT709 = 1
"""Code of BT.709 in ITU-T H.273, the same for matrix, primaries and transfer."""
LIMITED_RANGE = 1
"""Code of the limited range (16 to 235), which all players expect."""


class Video:
    """Writes images one at a time: `with Video(path, rate) as video: video.add(image)`.

    The file appears at `path` when the block ends, and not at all after an exception. `rate` is in frames per second. `quality`
    is x264's constant rate factor: 0 (best) to 51; 6 more halve the file. Raises InputError for an invalid image or a video
    without images.
    """

    def __init__(self, path: Path, rate: float, quality: int = 20) -> None:
        self._path, self._rate, self._quality = path, Fraction(rate).limit_denominator(1001), quality
        self._shape: tuple[int, ...] = ()
        self._count = 0
        self._av = needed("av")

    def __enter__(self) -> Self:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._folder = tempfile.TemporaryDirectory(prefix=f".{self._path.name}.", dir=self._path.parent)
        self._part = Path(self._folder.name) / self._path.name
        return self

    def add(self, picture: np.ndarray) -> None:
        """Append an image [H, W, 3] uint8 RGB; all images must have the same size.

        The edge is repeated to make an odd width or height even, because colors are stored at half resolution.
        """
        where, number = self._path, self._count
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
            rule = f"image {number} of this video must be [H, W, 3] uint8"
            raise InputError(where, rule, f"{picture.dtype.name} {picture.shape}")
        if not number:
            self._open(picture.shape)
        if picture.shape != self._shape:
            raise InputError(where, f"image {number} of this video must have the shape of the first, {self._shape}", picture.shape)
        height, width = self._shape[:2]
        padded = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        rgb = self._av.VideoFrame.from_ndarray(padded, format="rgb24")
        frame = rgb.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG", threads=1)
        self._container.mux(self._stream.encode(frame))
        self._count += 1

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if self._count:
                self._container.mux(self._stream.encode(None))
                self._container.close()
            if kind is None:
                if not self._count:
                    raise InputError(self._path, "a video needs at least one image")
                write_atomically(self._path, self._part.replace)
        finally:
            self._folder.cleanup()

    def _open(self, shape: tuple[int, ...]) -> None:
        # The index at the start of the file lets browsers play before the download is complete.
        self._container = self._av.open(self._part, "w", format="mp4", options={"movflags": "+faststart"})
        stream = self._container.add_stream("libx264", rate=self._rate, options={"crf": str(self._quality)})
        stream.height, stream.width = (side + side % 2 for side in shape[:2])
        stream.pix_fmt = "yuv420p"
        stream.colorspace = stream.color_primaries = stream.color_trc = BT709
        stream.color_range = LIMITED_RANGE
        # Jobs may use one thread.
        stream.codec_context.thread_count = 1
        self._stream, self._shape = stream, shape
