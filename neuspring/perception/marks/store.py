"""Masks of a capture: made from its marks, kept in its folder mask/, shown on a contact sheet, and compared with other masks.

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
from neuspring.config.parse import STRICT, Name
from neuspring.config.perception import MarksSegmentation
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_atomically, write_text
from neuspring.core.records import canonical, digest_file
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture, images_digest
from neuspring.perception.lift import heights_above_table
from neuspring.perception.marks.carry import Carried, carry
from neuspring.perception.marks.marks import Mark, marks_digest

MADE = "masks.json"
"""What the masks of a capture were made from, and how far each frame is doubted; in its folder."""
TINTS = {OBJECT: (40, 220, 60), HANDS: (70, 110, 255)}
"""RGB, as in the other pictures of masks."""
COLUMNS = 4
EVEN, DOUBTFUL = 8, 8
"""How many frames are shown evenly over the video, and in doubt."""
WIDTH = 424
"""Of a tile, pixels, at most."""


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
        view, up_sign = self.capture.cameras[self.camera], self.capture.description.up_sign
        return heights_above_table(view, depth, up_sign).astype(np.float32)


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


def overlay(image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """An RGB image [H, W, 3] with object tinted green and hands blue, their borders drawn."""
    result = image.copy()
    for label, tint in TINTS.items():
        own = (labels == label).astype(np.uint8)
        result[own > 0] = (0.6 * image[own > 0] + 0.4 * np.array(tint)).astype(np.uint8)
        outlines, _ = cv2.findContours(own, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(result, outlines, -1, tint, 1)
    return result


def sheet_of(capture: Capture, camera: str) -> Path:
    """Where the sheet of a camera lies: beside the masks."""
    return capture.folder / f"mask_{camera}.png"


def save_sheet(capture: Capture, camera: str, carried: Carried) -> Path:
    """Write `sheet_of` a camera: the most doubtful frames first, then frames evenly spaced."""
    path = sheet_of(capture, camera)
    frames = np.array([frame for frame in range(capture.frame_count) if capture.has(camera, frame)])
    doubtful = frames[np.argsort(-carried.doubt[frames], kind="stable")][:DOUBTFUL]
    even = frames[np.unique(np.linspace(0, len(frames) - 1, EVEN).astype(int))]
    tiles = [_tile(capture, camera, carried, int(frame), "doubt") for frame in doubtful]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    tiles += [_tile(capture, camera, carried, int(frame), "even") for frame in even]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[index : index + COLUMNS]) for index in range(0, len(tiles), COLUMNS)]
    ok, png = cv2.imencode(".png", np.vstack(rows)[..., ::-1])
    assert ok, "a PNG of tiles can be encoded"
    write_atomically(path, lambda temporary: temporary.write_bytes(png.tobytes()))
    return path


def _tile(capture: Capture, camera: str, carried: Carried, frame: int, why: str) -> np.ndarray:
    image = overlay(np.ascontiguousarray(capture.color(camera, frame)), carried.labels[frame])
    height, width = image.shape[:2]
    if width > WIDTH:
        image = cv2.resize(image, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    text = f"{frame}: doubt {carried.doubt[frame]:.2f}" if why == "doubt" else str(frame)
    for color, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(image, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, thick, cv2.LINE_AA)
    return image


@dataclass(frozen=True)
class Agreement:
    """Of one frame. NaN where neither mask shows the thing."""

    frame: int
    object: float
    """Intersection over union."""
    hands: float


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks [...] bool; NaN if both are empty."""
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else float("nan")


def compare(masks: Path, truth: Path) -> list[Agreement]:
    """Of all frames in `truth`, by their number. Raises InputError where masks lack one or differ in size."""
    there, known = (_numbered(folder) for folder in (masks, truth))
    rows = []
    for frame, path in known.items():
        if frame not in there:
            raise InputError(masks, f"a mask of frame {frame} is required: {truth} has one", sorted(there)[:5])
        one, other = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in (there[frame], path))
        if one is None or other is None or one.shape != other.shape or one.ndim != 2:
            sizes = [None if image is None else image.shape for image in (one, other)]
            raise InputError(there[frame], f"must be a gray image of the size of {path}", sizes)
        rows.append(Agreement(frame, *(overlap(one == label, other == label) for label in (OBJECT, HANDS))))
    return rows


def table(rows: list[Agreement]) -> str:
    """Text of a table: IoU per frame, and the mean."""
    lines = ["frame  object  hands"] + [f"{row.frame:5d}  {row.object:6.3f}  {row.hands:5.3f}" for row in rows]
    values = np.array([[row.object, row.hands] for row in rows])
    known = np.isfinite(values)
    means = np.where(known, values, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return "\n".join([*lines, f" mean  {means[0]:6.3f}  {means[1]:5.3f}"]) + "\n"


def _numbered(folder: Path) -> dict[int, Path]:
    found = {int(path.stem): path for path in sorted(Path(folder).glob("*.png")) if path.stem.isdigit()}
    if not found:
        raise InputError(folder, "a folder of masks named by their frame is required: 00000.png", "none")
    return found
