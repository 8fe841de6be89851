"""Pictures and videos inside the page, made smaller. Those that do not fit are linked."""

from __future__ import annotations

import base64
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np

from neuspring.report.blocks import Picture, Video

QUALITY = 75
"""Quality of WebP pictures, of 100."""
CHUNK = 32
"""How many pictures are made smaller at once."""
NO_ROOM = "not embedded, to keep this page small"


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A picture or video that a section would show. Those of the lowest rank are embedded first."""

    path: Path
    rank: tuple[int, ...]
    width: int = 0
    """Largest width of a picture in pixels; 0: a video."""


@dataclass(frozen=True, kw_only=True)
class Embedded:
    """A file as a data URI, and its size in pixels."""

    uri: str
    size: tuple[int, int] = (0, 0)


class Media:
    """The files that are embedded, of all that are wanted."""

    def __init__(self, output: Path, wanted: Iterable[Wanted], room: int, video_room: int) -> None:
        """Pictures may take `room` characters, and videos what they leave, up to `video_room`."""
        self._folder = output.resolve().parent
        self._embedded: dict[Path, Embedded] = {}
        self.damaged: dict[Path, str] = {}
        ordered = sorted(wanted, key=lambda one: (one.rank, one.path))
        room = self._pictures([one for one in ordered if one.width], room)
        self._videos([one for one in ordered if not one.width], min(room, video_room))

    @property
    def count(self) -> int:
        """Files that were embedded."""
        return len(self._embedded)

    def picture(
        self,
        path: Path,
        caption: str,
        alt: str,
        *,
        wide: bool = False,
        paper: bool = False,
        frames: Sequence[tuple[str, str]] = (),
    ) -> Picture:
        """A picture, or a link if it did not fit."""
        file = self._embedded.get(path)
        if file:
            return Picture(caption=caption, alt=alt, data=file.uri, size=file.size, wide=wide, paper=paper, frames=frames)
        return Picture(caption=caption, alt=alt, link=self.link(path), reason=self.damaged.get(path, NO_ROOM), frames=frames)

    def video(self, path: Path, caption: str, *, wide: bool = False) -> Video:
        """A video, or a link if it did not fit."""
        file = self._embedded.get(path)
        if file:
            return Video(caption=caption, data=file.uri, wide=wide)
        return Video(caption=caption, link=self.link(path), reason=self.damaged.get(path, NO_ROOM))

    def link(self, path: Path) -> str:
        """A link from the page to a file."""
        return link(path, self._folder)

    def _pictures(self, wanted: Sequence[Wanted], room: int) -> int:
        """Embed in order until there is no room; returns what is left."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for start in range(0, len(wanted), CHUNK):
                part = wanted[start : start + CHUNK]
                for one, smaller in zip(part, pool.map(_smaller, part), strict=True):
                    if isinstance(smaller, str):
                        self.damaged[one.path] = smaller
                    elif len(smaller.uri) <= room:
                        self._embedded[one.path] = smaller
                        room -= len(smaller.uri)
                if room < 20_000:
                    break
        return room

    def _videos(self, wanted: Sequence[Wanted], room: int) -> None:
        for one in wanted:
            try:
                if 4 * one.path.stat().st_size / 3 > room:
                    continue
                uri = _uri("video/mp4", one.path.read_bytes())
            except OSError as error:
                self.damaged[one.path] = str(error.strerror)
                continue
            self._embedded[one.path] = Embedded(uri=uri)
            room -= len(uri)


def link(path: Path, folder: Path) -> str:
    """A relative link from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def embedded_png(path: Path) -> Embedded | None:
    """A PNG file as it is; None if it is not there."""
    if not path.is_file():
        return None
    data = path.read_bytes()
    shape = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return None if shape is None else Embedded(uri=_uri("image/png", data), size=(shape.shape[1], shape.shape[0]))


def _smaller(one: Wanted) -> Embedded | str:
    """The picture, not wider than wanted, as WebP; or the reason why it cannot be read."""
    try:
        data = np.frombuffer(one.path.read_bytes(), np.uint8)
    except OSError as error:
        return str(error.strerror)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        return "damaged: not a picture"
    if picture.shape[1] > one.width:
        height = max(1, round(picture.shape[0] * one.width / picture.shape[1]))
        picture = cv2.resize(picture, (one.width, height), interpolation=cv2.INTER_AREA)
    ok, webp = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    assert ok, "a picture can be encoded"
    return Embedded(uri=_uri("image/webp", webp.tobytes()), size=(picture.shape[1], picture.shape[0]))


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
