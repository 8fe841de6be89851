"""Masks of a capture: the folder mask/, the record of their source, a contact sheet, and comparison with other masks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.records import canonical, digest_file
from neuspring.core.section import STRICT, Name
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, PERSON, Capture, images_digest, read_labels
from neuspring.data.frames import Color, frames_of, overlap, overlay, spread, tints_of, write_png
from neuspring.perception.film import Carried
from neuspring.perception.marks import Mark, marks_digest

MADE = "masks.json"
"""File in a capture with the source of its masks and the doubt of each frame."""
SHEET_COLUMNS = 4
EVEN, DOUBTFUL = 8, 8
"""Numbers of evenly spaced and of most doubtful frames on the contact sheet."""
TILE_WIDTH = 424
"""Largest width of a tile, pixels."""


def save_masks(capture: Capture, camera: str, labels: np.ndarray) -> Path:
    """Write mask/<camera>/<frame>.png of labels [T, H, W] uint8; set `masks: true` once every camera has masks.

    Missing frames are skipped. Returns the folder. Raises InputError if the shape or a label is wrong.
    """
    view = capture.cameras[camera]
    shape = (capture.frame_count, view.height, view.width)
    if labels.shape != shape or labels.dtype != np.uint8:
        raise InputError(f"masks of camera {camera}", f"labels must be uint8 of shape {shape}", f"{labels.dtype} {labels.shape}")
    if labels.max(initial=0) > PERSON:
        raise InputError(
            f"masks of camera {camera}", "labels must be 0 (nothing), 1 (object), 2 (hands) or 3 (person)", int(labels.max())
        )
    # Remove the record first: after an interruption, masks.json must not describe other masks.
    _write_made(capture, {name: made for name, made in MasksFile.of(capture).cameras.items() if name != camera})
    for frame in frames_of(capture, camera):
        # Replaces a link of an imported capture, and leaves its original unchanged.
        write_png(capture.path("mask", camera, frame), labels[frame])
    if has_masks(capture):
        path = capture.folder / CAPTURE
        values = load_json(path) | {"masks": True}
        if "images" in values.get("provenance", {}):
            values["provenance"]["images"] = images_digest(capture.folder)
        write_text(path, json.dumps(values, indent=1) + "\n")
    return capture.folder / "mask" / camera


def import_masks(capture: Capture, camera: str, masks: Path, hands: Path | None = None) -> Path:
    """Save masks of another tool as those of a camera: a folder of <frame>.png, read by `capture.read_labels`.

    With `hands`, each nonzero pixel counts: as the object in `masks`, as hands in `hands`, which occlude the object. Returns the
    folder. Raises InputError.
    """
    view = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, view.height, view.width), np.uint8)
    for folder, label in ((masks, OBJECT), (hands, HANDS)):
        files = {} if folder is None else _numbered(folder)
        for frame in frames_of(capture, camera) if files else ():
            if frame not in files:
                rule = f"a mask of frame {frame} of camera {camera} is required, named by its frame number: {frame:05d}.png"
                raise InputError(str(folder), rule, f"frames {min(files)} to {max(files)}, {len(files)} in all")
            values = read_labels(files[frame], view, binary=hands is not None)
            labels[frame] = np.where(values > 0, label if hands is not None else values, labels[frame])
    return save_masks(capture, camera, labels)


def has_masks(capture: Capture, cameras: Sequence[str] = ()) -> bool:
    """True if every recorded frame of these cameras, by default all, has a mask."""
    names = cameras or capture.cameras
    return all(capture.path("mask", name, frame).is_file() for name in names for frame in frames_of(capture, name))


@dataclass(frozen=True, kw_only=True)
class MadeMasks:
    """Source of the masks of one camera."""

    __pydantic_config__ = STRICT
    source: str
    """SHA-256 over backend, settings, annotations and images."""
    backend: str
    doubt: tuple[float, ...]
    """Doubt of each frame, 0 (certain) to 1."""


@dataclass(frozen=True, kw_only=True)
class MasksFile:
    """masks.json of a capture."""

    __pydantic_config__ = STRICT
    format: Literal[1] = 1
    cameras: dict[Name, MadeMasks] = field(default_factory=dict)

    @classmethod
    def of(cls, capture: Capture) -> MasksFile:
        """Read masks.json of a capture; empty if the file is missing. Raises InputError for a damaged file."""
        path = capture.folder / MADE
        if not path.exists():
            return cls()
        values = load_json(path)
        if not isinstance(values, dict):
            raise InputError(path, "a JSON object is required", type(values).__name__, "Delete this file; masks are made again.")
        return parse(cls, values, str(path))

    def holds(self, capture: Capture, camera: str, source: str) -> bool:
        """True if the camera has masks that were made from this source."""
        return camera in self.cameras and self.cameras[camera].source == source and has_masks(capture, [camera])


def _write_made(capture: Capture, cameras: dict[str, MadeMasks]) -> None:
    if cameras or (capture.folder / MADE).exists():
        write_text(capture.folder / MADE, json.dumps(asdict(MasksFile(cameras=cameras))) + "\n")


def save_carried(capture: Capture, camera: str, carried: Carried, source: str, backend: str) -> MadeMasks:
    """Write mask/<camera>/, the contact sheet, and the record of their source (`source_digest`). Raises InputError."""
    save_masks(capture, camera, carried.labels)
    save_sheet(capture, camera, carried)
    made = MadeMasks(source=source, backend=backend, doubt=tuple(round(float(value), 4) for value in carried.doubt))
    _write_made(capture, MasksFile.of(capture).cameras | {camera: made})
    return made


def source_digest(capture: Capture, camera: str, marks: Sequence[Mark], backend: str) -> str:
    """SHA-256 over the backend, the annotations and the contents of the camera's images."""
    digest = hashlib.sha256(canonical([backend, marks_digest(tuple(marks))]).encode())
    for kind in ("color", "depth"):
        for path in sorted((capture.folder / kind / camera).glob("*")):
            digest.update(f"{kind}/{path.name} {digest_file(path)}".encode())
    return f"sha256:{digest.hexdigest()}"


def sheet_of(capture: Capture, camera: str) -> Path:
    """Path of the contact sheet of a camera."""
    return capture.folder / f"mask_{camera}.png"


def save_sheet(capture: Capture, camera: str, carried: Carried) -> Path:
    """Write the contact sheet of a camera: the most doubtful frames first, then evenly spaced frames."""
    frames = frames_of(capture, camera)
    tints = tints_of(capture.color(camera, frames[0]), carried.labels[frames[0]])
    doubtful = sorted(frames, key=lambda frame: -carried.doubt[frame])[:DOUBTFUL]
    tiles = [_tile(capture, camera, carried, tints, frame, f"{frame}: doubt {carried.doubt[frame]:.2f}") for frame in doubtful]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % SHEET_COLUMNS)
    tiles += [_tile(capture, camera, carried, tints, frame, str(frame)) for frame in spread(frames, EVEN)]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % SHEET_COLUMNS)
    rows = [np.hstack(tiles[index : index + SHEET_COLUMNS]) for index in range(0, len(tiles), SHEET_COLUMNS)]
    return write_png(sheet_of(capture, camera), np.vstack(rows))


def _tile(capture: Capture, camera: str, carried: Carried, tints: Mapping[int, Color], frame: int, text: str) -> np.ndarray:
    image = overlay(capture.color(camera, frame), carried.labels[frame], tints)
    height, width = image.shape[:2]
    if width > TILE_WIDTH:
        image = cv2.resize(image, (TILE_WIDTH, round(height * TILE_WIDTH / width)), interpolation=cv2.INTER_AREA)
    for color, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(image, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, thick, cv2.LINE_AA)
    return image


def compare(masks: Path, truth: Path) -> dict[int, tuple[float, float]]:
    """IoU of object and of hands for each frame in `truth`; NaN if neither mask shows them.

    Raises InputError if a frame is missing in `masks`, or if sizes differ.
    """
    compared, known = (_numbered(folder) for folder in (masks, truth))
    rows = {}
    for frame, path in known.items():
        if frame not in compared:
            raise InputError(masks, f"a mask of frame {frame} is required: {truth} has one", sorted(compared)[:5])
        labels, true = (read_labels(file) for file in (compared[frame], path))
        if labels.shape != true.shape:
            raise InputError(compared[frame], f"must have the size of {path}", [image.shape for image in (labels, true)])
        rows[frame] = (overlap(labels == OBJECT, true == OBJECT), overlap(labels == HANDS, true == HANDS))
    return rows


def table(rows: dict[int, tuple[float, float]]) -> str:
    """Table of the IoU per frame and its mean, as text."""
    lines = ["frame  object  hands"] + [f"{frame:5d}  {toy:6.3f}  {hands:5.3f}" for frame, (toy, hands) in rows.items()]
    values = np.array(list(rows.values()))
    known = np.isfinite(values)
    means = np.where(known, values, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return "\n".join([*lines, f" mean  {means[0]:6.3f}  {means[1]:5.3f}"]) + "\n"


def _numbered(folder: Path) -> dict[int, Path]:
    files = {int(path.stem): path for path in sorted(Path(folder).glob("*.png")) if path.stem.isdigit()}
    if not files:
        raise InputError(folder, "must contain masks named by their frame number, such as 00000.png", "no such file")
    return files
