"""Pictures and videos inside the page: made smaller, and only as many as fit; the others are linked."""

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
"""Of WebP."""
CHUNK = 32
"""Pictures that are made smaller at once."""
NO_ROOM = "not embedded, to keep this page small"


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A picture or video that a section would like to show; of all, those of the lowest rank come first."""

    path: Path
    rank: tuple[int, ...]
    width: int = 0
    """Pixels that it is made as wide as, at most; 0: a video."""


@dataclass(frozen=True, kw_only=True)
class Embedded:
    """A file as a data URI, and its size in pixels."""

    uri: str
    size: tuple[int, int] = (0, 0)


class Media:
    """What is embedded of all that is wanted."""

    def __init__(self, output: Path, wanted: Iterable[Wanted], room: int, video_room: int) -> None:
        """`room` characters for pictures, of which videos may take what is left, up to `video_room`."""
        self._folder = output.resolve().parent
        self._found: dict[Path, Embedded] = {}
        self.damaged: dict[Path, str] = {}
        ordered = sorted(wanted, key=lambda one: (one.rank, one.path))
        room = self._pictures([one for one in ordered if one.width], room)
        self._videos([one for one in ordered if not one.width], min(room, video_room))

    @property
    def count(self) -> int:
        """Files that were embedded."""
        return len(self._found)

    def picture(self, path: Path, caption: str, alt: str, *, wide: bool = False, paper: bool = False) -> Picture:
        """A picture, or a link where it had no place."""
        found = self._found.get(path)
        if found:
            return Picture(caption=caption, alt=alt, data=found.uri, size=found.size, wide=wide, paper=paper)
        return Picture(caption=caption, alt=alt, link=self.link(path), reason=self.damaged.get(path, NO_ROOM))

    def video(self, path: Path, caption: str, *, wide: bool = False) -> Video:
        """A video, or a link where it had no place."""
        found = self._found.get(path)
        if found:
            return Video(caption=caption, data=found.uri, wide=wide)
        return Video(caption=caption, link=self.link(path), reason=self.damaged.get(path, NO_ROOM))

    def link(self, path: Path) -> str:
        """The path from the page."""
        return link(path, self._folder)

    def _pictures(self, wanted: Sequence[Wanted], room: int) -> int:
        """Embed in order until there is no room; returns what is left."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for start in range(0, len(wanted), CHUNK):
                for one, made in zip(part := wanted[start : start + CHUNK], pool.map(_smaller, part), strict=True):
                    if isinstance(made, str):
                        self.damaged[one.path] = made
                    elif len(made.uri) <= room:
                        self._found[one.path] = made
                        room -= len(made.uri)
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
            self._found[one.path] = Embedded(uri=uri)
            room -= len(uri)


def link(path: Path, folder: Path) -> str:
    """A relative link from a page in `folder`."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def embedded_png(path: Path) -> Embedded | None:
    """A drawing as it is, as PNG; None if it is not there."""
    if not path.is_file():
        return None
    data = path.read_bytes()
    shape = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return None if shape is None else Embedded(uri=_uri("image/png", data), size=(shape.shape[1], shape.shape[0]))


def _smaller(one: Wanted) -> Embedded | str:
    """The picture, not wider than wanted, as WebP; in words why not, if it cannot be read."""
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
    ok, made = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    assert ok, "a picture can be encoded"
    return Embedded(uri=_uri("image/webp", made.tobytes()), size=(picture.shape[1], picture.shape[0]))


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
