"""Masks of a capture: made from its marks, and kept in its folder mask/.

marks = Marks.load(folder / MARKS)
capture = Capture.load(folder)
carried = carry_camera(capture, "0", marks.of("0"), MarksSegmentation())
save_masks(capture, "0", carried.labels)
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from neuspring.config import parse, plain
from neuspring.config.perception import MarksSegmentation
from neuspring.config.types import STRICT, Name
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_atomically, write_text
from neuspring.core.records import canonical, digest_file
from neuspring.data.capture import CAPTURE, HANDS, Capture, images_digest
from neuspring.perception.marks.carry import Carried, carry
from neuspring.perception.marks.marks import Mark, marks_digest
from neuspring.perception.marks.sheet import save_sheet

MADE = "masks.json"
"""What the masks of a capture were made from, and how far each frame is doubted; in its folder."""


@dataclass(frozen=True, eq=False)
class Film:
    """The frames that a camera of a capture has, in their order. Implements `carry.Images`."""

    capture: Capture
    camera: str
    frames: tuple[int, ...]
    """Their numbers in the capture."""

    @property
    def count(self) -> int:
        """Number of frames, missing ones left out."""
        return len(self.frames)

    def color(self, frame: int, /) -> np.ndarray:
        """RGB [H, W, 3] uint8."""
        return self.capture.color(self.camera, self.frames[frame])

    def depth(self, frame: int, /) -> np.ndarray | None:
        """Depth [H, W] float32, m, 0 where nothing was measured; None: the camera has no depth."""
        if not self.capture.has_depth or not self.capture.path("depth", self.camera, self.frames[frame]).exists():
            return None
        return self.capture.depth(self.camera, self.frames[frame]).astype(np.float32)

    def height(self, frame: int, /) -> np.ndarray | None:
        """Height above the table [H, W], m, NaN where nothing was measured; None: the camera has no depth."""
        depth = self.depth(frame)
        if depth is None:
            return None
        view, sign = self.capture.cameras[self.camera], 1.0 if self.capture.description.up == "+z" else -1.0
        pixels = np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), axis=-1).astype(float)
        return np.where(depth > 0, sign * view.lift(pixels, depth)[..., 2], np.nan).astype(np.float32)


def film_of(capture: Capture, camera: str) -> Film:
    """The frames that a camera has. Raises InputError for an unknown camera."""
    capture.require_camera(camera)
    return Film(capture, camera, tuple(frame for frame in range(capture.frame_count) if capture.has(camera, frame)))


def carry_camera(
    capture: Capture,
    camera: str,
    marks: Sequence[Mark],
    settings: MarksSegmentation,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Carried:
    """As `carry`, for a camera of a capture: labels [T, H, W] and doubt [T] of all its frames, 0 where the camera has none.

    Raises InputError where marks do not fit the capture.
    """
    film = film_of(capture, camera)
    place = {number: index for index, number in enumerate(film.frames)}
    absent = [mark.frame for mark in marks if mark.frame not in place]
    if absent:
        raise InputError(f"marks of camera {camera}", "must lie on frames that the camera has", absent[0])
    carried = carry(film, [replace(mark, frame=place[mark.frame]) for mark in marks], settings, progress=progress)
    view = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, view.height, view.width), np.uint8)
    doubt = np.zeros(capture.frame_count)
    labels[list(film.frames)], doubt[list(film.frames)] = carried.labels, carried.doubt
    return Carried(labels, doubt)


def save_masks(capture: Capture, camera: str, labels: np.ndarray) -> Path:
    """Write mask/<camera>/<frame>.png of labels [T, H, W] uint8, and `masks: true` once every camera has masks.

    Frames that the camera lacks are skipped. Returns the folder. Raises InputError where the shape or a label is wrong.
    """
    view = capture.cameras[camera]
    shape = (capture.frame_count, view.height, view.width)
    if labels.shape != shape or labels.dtype != np.uint8:
        raise InputError(f"masks of camera {camera}", f"labels must be uint8 of shape {shape}", f"{labels.dtype} {labels.shape}")
    if labels.max(initial=0) > HANDS:
        raise InputError(f"masks of camera {camera}", "labels must be 0 (nothing), 1 (object) or 2 (hands)", int(labels.max()))
    # From here on the masks are no longer what masks.json says, also if this is interrupted.
    Made.of(capture).forget(capture, camera)
    for frame in range(capture.frame_count):
        if capture.has(camera, frame):
            # A renamed file replaces a link to the original of an imported capture, and leaves the original alone.
            write_atomically(capture.path("mask", camera, frame), partial(_write, labels[frame]))
    if has_masks(capture):
        path = capture.folder / CAPTURE
        values = load_json(path) | {"masks": True}
        if "images" in values.get("provenance", {}):
            values["provenance"]["images"] = images_digest(capture.folder)
        write_text(path, json.dumps(values, indent=1) + "\n")
    return capture.folder / "mask" / camera


def _write(labels: np.ndarray, path: Path) -> None:
    ok, png = cv2.imencode(".png", labels)
    assert ok, "a mask can be encoded"
    path.write_bytes(png.tobytes())


def has_masks(capture: Capture, cameras: Sequence[str] = ()) -> bool:
    """Whether there is a mask of every frame of these cameras, all by default."""
    frames = range(capture.frame_count)
    return all(
        capture.path("mask", name, frame).is_file()
        for name in cameras or capture.cameras
        for frame in frames
        if capture.has(name, frame)
    )


@dataclass(frozen=True, kw_only=True)
class MadeCamera:
    """What the masks of one camera were made from."""

    __pydantic_config__ = STRICT
    source: str
    """SHA-256 over backend, settings, marks and images."""
    backend: str
    doubt: tuple[float, ...]
    """Per frame, 0 (sure) to 1."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """masks.json of a capture."""

    __pydantic_config__ = STRICT
    format: Literal[1] = 1
    cameras: dict[Name, MadeCamera] = field(default_factory=dict)

    @classmethod
    def of(cls, capture: Capture) -> Made:
        """Of a capture; empty without the file. Raises InputError for a damaged one."""
        path = capture.folder / MADE
        if not path.exists():
            return cls()
        values = load_json(path)
        if not isinstance(values, dict):
            raise InputError(path, "a JSON object is required", type(values).__name__, "Delete it; the masks are made again.")
        return parse(cls, values, str(path))

    def save(self, capture: Capture, camera: str, made: MadeCamera) -> Made:
        """The record with this camera, written."""
        result = replace(self, cameras={**self.cameras, camera: made})
        write_text(capture.folder / MADE, json.dumps(asdict(result)) + "\n")
        return result

    def forget(self, capture: Capture, camera: str) -> None:
        """Remove this camera from the file."""
        if camera in self.cameras:
            kept = replace(self, cameras={name: made for name, made in self.cameras.items() if name != camera})
            write_text(capture.folder / MADE, json.dumps(asdict(kept)) + "\n")

    def holds(self, capture: Capture, camera: str, source: str) -> bool:
        """Whether the camera's masks are there and were made from this source."""
        return camera in self.cameras and self.cameras[camera].source == source and has_masks(capture, [camera])


def save_carried(capture: Capture, camera: str, carried: Carried, source: str, backend: str) -> MadeCamera:
    """Write mask/<camera>/, the sheet to look at, and what the masks were made from: `source_digest`. Raises InputError."""
    save_masks(capture, camera, carried.labels)
    save_sheet(capture, camera, carried)
    made = MadeCamera(source=source, backend=backend, doubt=tuple(round(float(value), 4) for value in carried.doubt))
    Made.of(capture).save(capture, camera, made)
    return made


def source_digest(capture: Capture, camera: str, marks: Sequence[Mark], backend: str, settings: Any) -> str:
    """SHA-256 over the backend, its settings, the marks and the contents of the camera's images."""
    digest = hashlib.sha256(canonical([backend, plain(settings), marks_digest(tuple(marks))]).encode())
    for kind in ("color", "depth"):
        for path in sorted((capture.folder / kind / camera).glob("*")):
            digest.update(f"{kind}/{path.name} {digest_file(path)}".encode())
    return f"sha256:{digest.hexdigest()}"
