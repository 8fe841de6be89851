"""The capture folder: RGBD video of one or more cameras, color video of one camera, or points in space without video.

    capture.json                       all settings, see `Description`
    color/<camera>/<frame>.png         8-bit RGB
    depth/<camera>/<frame>.png | .npy  uint16 in units of `depth_unit` m (png, npy) or float meters (npy); along the optical axis,
                                       0: no depth; absent with `depth: none`
    mask/<camera>/<frame>.png          optional: 8-bit, 0 nothing, 1 object, 2 hands, 3 person
    tracks.json                        optional: [K][T] of [x, y, z] m in the world, or null where not annotated; see `tracks`
    controllers.npz|csv                optional: controllers in all frames (points.py)
    nodes.npz|ply, rest.npz            optional: nodes of the object in frame 0, and points of its unloaded shape (points.py)
    points.json                        optional, only for scoring: {camera: [K][T] of [x, y] pixels, or null where not annotated}

Frames are numbered from 0 with five digits. Pixel centers have integer coordinates: x right, y down, z forward (OpenCV). The world
is right-handed, in meters, with the table at z = 0. Cameras may differ in size. The key `missing` of a camera lists frames without
files.
"""

from __future__ import annotations

import filecmp
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from PIL import Image
from pydantic import Field, TypeAdapter

from neuspring.config import parse
from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.findings import Finding, broken, refuse
from neuspring.core.records import digest_file
from neuspring.core.section import STRICT, Name, Positive
from neuspring.data.c3d import Markers, is_c3d
from neuspring.data.camera import Camera, CameraEntry
from neuspring.data.images import make_way, read_array, read_image, write_image

CAPTURE, TRACKS, POINTS = "capture.json", "tracks.json", "points.json"
CONTROLLERS, NODES, REST = ("controllers.npz", "controllers.csv"), ("nodes.npz", "nodes.ply"), "rest.npz"
RECIPE = ".make-capture.json"
"""Recipe of an unfinished folder; make-capture removes it at the end."""
NOTHING, OBJECT, HANDS, PERSON = 0, 1, 2, 3
"""Labels of masks."""
FEWEST_FRAMES = 5
"""Smallest number of frames of a capture."""
THIN = ("cloth", "package")
"""Categories without interior nodes; objects of all other categories are filled."""
LEFT_OUT = ("depth", "tracks", "pose", "mass")
"""Fields that capture.json omits at their default."""
TEXT_TOLERANCE = 1e-4
"""Allowed deviation from R^T R = 1 in JSON, whose matrices may have only five digits."""
FEW_DIGITS = 0.03
"""Deviation from R^T R = 1 that two decimals explain."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """capture.json."""

    __pydantic_config__ = STRICT
    format: Literal[1]
    name: Name
    category: str
    """Kind of object: cloth, rope, package, ..."""
    frame_count: Annotated[int, Field(ge=FEWEST_FRAMES)]
    frame_rate: Annotated[float, Field(ge=1, le=2000)]
    """Recorded frames per second."""
    cameras: tuple[CameraEntry, ...]
    """Empty: points in space without video, with `depth: none` and `tracks: train` (points.py)."""
    depth: Literal["measured", "none"] = "measured"
    """The lifter of the capture (`LIFTERS` of neuspring/perception/backends.py). none: color of one camera, or no camera."""
    tracks: Literal["score", "train"] = "score"
    """score: annotated points are only for scoring. train: the fit also uses them in training frames."""
    depth_unit: Positive = 0.001
    """Meters per count of an integer depth image."""
    depth_format: Literal["png", "npy"] = "png"
    pose: Literal["lying", "standing"] | None = None
    """Pose of the object in frame 0 if `depth` is none and it is neither a sheet nor a rope. null: unknown; parts that would be too
    far from the camera are raised."""
    up: Literal["+z", "-z"] = "+z"
    """Direction of up along the world's z axis."""
    train_end: Annotated[int, Field(ge=2)] | None = None
    """Training frames are [0, train_end); null: the first 70 %."""
    masks: bool = False
    """True if the capture has masks."""
    self_collision: bool | None = None
    """True if the object may touch itself, for scenarios without a line in the table. null: true for the category cloth."""
    ground: bool = True
    """True if there is a table, for scenarios without a line in the scenario table."""
    mass: Positive | None = None
    """Mass of the object, kg, for exports; without it, each node weighs 1 kg."""
    provenance: dict[str, str] = field(default_factory=dict)

    @property
    def up_sign(self) -> float:
        """+1 when +z is up, -1 when -z is up."""
        return up_sign(self.up)


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture folder; images are read on demand."""

    folder: Path
    description: Description

    @classmethod
    def load(cls, folder: Path) -> Capture:
        """Read capture.json and check the calibration. Raises InputError with file and field."""
        folder = Path(folder)
        path = folder / CAPTURE
        description = read_description(path)
        refuse(description_findings(path, description))
        return cls(folder, description)

    @staticmethod
    def begun(folder: Path) -> bool:
        """True if a folder contains a capture, finished or not."""
        return (folder / CAPTURE).exists() or (folder / RECIPE).exists()

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """Cameras by name, in the order of capture.json."""
        return {entry.name: entry.camera() for entry in self.description.cameras}

    @property
    def frame_count(self) -> int:
        """Number of frames, including missing ones."""
        return self.description.frame_count

    @property
    def train_end(self) -> int:
        """Training frames are [0, train_end)."""
        return self.description.train_end or int(0.7 * self.frame_count)

    @cached_property
    def streams(self) -> frozenset[str]:
        """The kinds of images in the capture: color, depth, mask."""
        stored = {"color": bool(self.cameras), "depth": self.description.depth == "measured", "mask": self.description.masks}
        return frozenset(name for name, there in stored.items() if there)

    def require_camera(self, name: str) -> None:
        """Raise InputError unless the capture has this camera."""
        if name not in self.cameras:
            raise InputError(self.folder / CAPTURE, f"must have a camera {name}", sorted(self.cameras))

    def has(self, camera: str, frame: int) -> bool:
        """True if the camera has this frame."""
        return frame not in self._missing[camera]

    @cached_property
    def _missing(self) -> dict[str, frozenset[int]]:
        return {c.name: frozenset(c.missing) for c in self.description.cameras}

    @cached_property
    def repeats(self) -> dict[str, dict[str, list[int]]]:
        """Camera -> stream -> frames whose image equals the previous one bit by bit; sensor noise rules this out for new images."""
        return {
            name: {
                kind: [int(there.stem) for here, there in pairwise(files) if filecmp.cmp(here, there, shallow=False)]
                for kind in sorted(self.streams - {"mask"})
                if (files := sorted((self.folder / kind / name).glob(5 * "[0-9]" + ".*")))
            }
            for name in self.cameras
        }

    def shows(self, camera: str, frame: int) -> bool:
        """True if the camera has this frame and none of its images repeats the previous one."""
        return self.has(camera, frame) and frame not in chain(*self.repeats[camera].values())

    def path(self, what: Literal["color", "depth", "mask"], camera: str, frame: int) -> Path:
        """The file of one image."""
        ending = self.description.depth_format if what == "depth" else "png"
        return self.folder / what / camera / f"{frame:05d}.{ending}"

    def color(self, camera: str, frame: int) -> np.ndarray:
        """RGB [H, W, 3] uint8. Raises InputError."""
        return self._image("color", camera, frame, cv2.IMREAD_COLOR)[..., ::-1]

    def depth(self, camera: str, frame: int) -> np.ndarray:
        """Depth [H, W], m; 0 where nothing was measured, and everywhere with `depth: none`. Raises InputError."""
        if "depth" not in self.streams:
            return np.zeros((self.cameras[camera].height, self.cameras[camera].width))
        path = self.path("depth", camera, frame)
        if path.suffix == ".png":
            values = self._image("depth", camera, frame, cv2.IMREAD_UNCHANGED)
        else:
            values = read_array(path, self.cameras[camera])
        if values.dtype.kind == "f":
            return np.where(np.isfinite(values), values, 0.0)
        if values.dtype != np.uint16:
            raise InputError(path, "depth must be 16-bit integers, or floating-point meters (npy)", values.dtype)
        return values * self.description.depth_unit

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Labels [H, W] uint8: 0 nothing, 1 object, 2 hands, 3 person. Raises InputError."""
        return read_labels(self.path("mask", camera, frame), self.cameras[camera], self._absent(camera))

    def _image(self, what: Literal["color", "depth"], camera: str, frame: int, flag: int) -> np.ndarray:
        return read_image(self.path(what, camera, frame), self.cameras[camera], flag, self._absent(camera))

    def _absent(self, camera: str) -> str:
        return f"If the camera does not have this frame, list it in cameras.{camera}.missing of {CAPTURE}."

    def tracks(self, path: Path | None = None) -> np.ndarray:
        """Annotated tracks [T, K, 3], m, NaN where not annotated; K = 0 without tracks.json. Raises InputError.

        `path` selects another file, JSON or C3D.
        """
        path = path or self.folder / TRACKS
        if is_c3d(path):
            points = Markers.read(path).points
            if len(points) != self.frame_count:
                raise InputError(path, f"every track needs {self.frame_count} entries", len(points))
            return points
        return _read_tracks(path, load_json(path) if path.exists() else [], self.frame_count, 3)

    def points(self, camera: str) -> np.ndarray:
        """Annotated points in the images of a camera [T, K, 2], pixels, NaN where not annotated; K = 0: none. Raises InputError."""
        path = self.folder / POINTS
        listed = load_json(path) if path.exists() else {}
        if not isinstance(listed, dict):
            raise InputError(path, "a JSON object {camera: tracks} is required", type(listed).__name__)
        return _read_tracks(path, listed.get(camera, []), self.frame_count, 2)


def _read_tracks(path: Path, listed: object, frames: int, size: int) -> np.ndarray:
    """Tracks [T, K, size] from [K][T] lists, with NaN for null. Raises InputError."""
    if listed == []:
        return np.zeros((frames, 0, size))
    if not isinstance(listed, list):
        raise InputError(path, "a list of tracks is required", type(listed).__name__)
    try:
        rows = [[[np.nan] * size if point is None else point for point in track] for track in listed]
        tracks = np.array(rows, dtype=float).reshape(len(rows), -1, size)
    except (TypeError, ValueError) as error:
        form = "[x, y, z]" if size == 3 else "[x, y]"
        raise InputError(path, f"a list of tracks of {form} or null is required", str(error)) from error
    if tracks.shape[1] != frames:
        raise InputError(path, f"every track needs {frames} entries", tracks.shape[1])
    unseen = np.array([[point is None for point in track] for track in listed], dtype=bool)
    if (odd := np.argwhere(~np.isfinite(tracks).all(axis=2) & ~unseen)).size:
        rule = "coordinates must be finite; write null where a point is not seen"
        raise InputError(path, rule, f"point {odd[0, 0]}, frame {odd[0, 1]}: {tracks[tuple(odd[0])].tolist()}")
    return np.swapaxes(tracks, 0, 1)


class Writer:
    """Writes a capture folder image by image, and capture.json last: without it a folder is not a capture."""

    def __init__(self, folder: Path, description: Description) -> None:
        self.capture = Capture(Path(folder), description)
        for name in (CAPTURE, TRACKS, POINTS, *CONTROLLERS, *NODES):
            (self.capture.folder / name).unlink(missing_ok=True)

    def frame(self, camera: str, frame: int, color: np.ndarray, depth: np.ndarray | None, mask: np.ndarray | None = None) -> None:
        """Write RGB uint8 [H, W, 3], depth as stored [H, W] (None with `depth: none`), and labels uint8 [H, W]."""
        write_image(self.capture.path("color", camera, frame), color[..., ::-1])
        path = self.capture.path("depth", camera, frame)
        if depth is not None and path.suffix == ".png":
            write_image(path, depth)
        elif depth is not None:
            make_way(path)
            np.save(path, depth, allow_pickle=False)
        if mask is not None:
            self.mask(camera, frame, mask)

    def link(self, kind: Literal["color", "depth"], camera: str, frame: int, source: Path) -> None:
        """Add an image that already has the capture's format: linked if the file system allows it, else copied."""
        make_way(path := self.capture.path(kind, camera, frame))
        try:
            os.link(source, path)
        except OSError:
            shutil.copyfile(source, path)

    def mask(self, camera: str, frame: int, labels: np.ndarray) -> None:
        """Write labels uint8 [H, W]: 0 nothing, 1 object, 2 hands, 3 person."""
        write_image(self.capture.path("mask", camera, frame), labels)

    def finish(
        self, tracks: np.ndarray | None = None, points: Mapping[str, np.ndarray] | None = None, **provenance: str
    ) -> Capture:
        """Write tracks [T, K, 3], m, and points [T, K, 2], pixels, by camera (NaN where not annotated), then capture.json.

        The provenance contains a digest of all images.
        """
        folder, before = self.capture.folder, self.capture.description
        description = replace(before, provenance={**before.provenance, "images": images_digest(folder), **provenance})
        if tracks is not None:
            write_tracks(folder, tracks)
        if points is not None:
            write_text(folder / POINTS, json.dumps({name: _listed(one) for name, one in points.items()}) + "\n")
        plain = TypeAdapter(Description).dump_python(description, mode="json")
        for name in LEFT_OUT:
            if getattr(description, name) == getattr(Description, name):
                del plain[name]
        write_text(folder / CAPTURE, json.dumps(plain, indent=1) + "\n")
        return Capture(folder, description)


def write_tracks(folder: Path, tracks: np.ndarray) -> None:
    """Write tracks [T, K, 3], m, NaN where not annotated, to tracks.json of a capture's folder."""
    write_text(folder / TRACKS, json.dumps(_listed(tracks)) + "\n")


def _listed(tracks: np.ndarray) -> list[list[list[float] | None]]:
    """Tracks [T, K, n] in the form of the JSON file: [K][T], null where not annotated."""
    return [
        [None if np.isnan(point).any() else [round(float(v), 6) for v in point] for point in track]
        for track in np.swapaxes(tracks, 0, 1)
    ]


def images_digest(folder: Path) -> str:
    """SHA-256 of the names and contents of all images of a capture's folder."""
    digest = hashlib.sha256()
    for path in sorted(path for kind in ("color", "depth", "mask") for path in (folder / kind).rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(folder)} {digest_file(path)}\n".encode())
    return f"sha256:{digest.hexdigest()}"


def read_description(path: Path) -> Description:
    """Read capture.json and check every key and type. Raises InputError that lists all problems."""
    require_finished(path.parent)
    values = load_json(path)
    if not isinstance(values, dict):
        raise InputError(path, "a JSON object is required", type(values).__name__)
    return parse(Description, values, str(path))


def require_finished(folder: Path) -> None:
    """Raise InputError for a folder that make-capture has not finished."""
    if (folder / RECIPE).exists() and not (folder / CAPTURE).exists():
        remedy = "Rerun the same make-capture command to resume."
        raise InputError(folder, "a complete capture is required", "one that make-capture has not finished", remedy)


def description_findings(path: Path, description: Description) -> list[Finding]:
    """Findings about rules that types cannot express: calibration, frame numbers, the split."""
    findings = []
    names = [camera.name for camera in description.cameras]
    if len(set(names)) < len(names):
        findings.append(broken(path, "cameras", "names must differ", names))
    if description.train_end is not None and description.train_end > description.frame_count:
        rule = f"must be at most frame_count = {description.frame_count}"
        findings.append(broken(path, "train_end", rule, description.train_end))
    if not names and (description.depth, description.tracks) != ("none", "train"):
        rule = "at least one is required, unless depth is none and tracks is train (points in space)"
        findings.append(broken(path, "cameras", rule, f"none, depth: {description.depth} and tracks: {description.tracks}"))
    if description.depth == "none" and len(names) > 1:
        findings.append(broken(path, "depth", "none allows only one camera", f"{len(names)} cameras"))
    for camera in description.cameras:
        where = f"cameras.{camera.name}"
        size = (camera.width, camera.height)
        findings += intrinsics_findings(path, f"{where}.intrinsics", np.array(camera.intrinsics), size)
        findings += pose_findings(path, f"{where}.camera_to_world", np.array(camera.camera_to_world), TEXT_TOLERANCE)
        beyond = [frame for frame in camera.missing if frame >= description.frame_count]
        if beyond:
            findings.append(broken(path, f"{where}.missing", f"frames must be below {description.frame_count}", beyond[0]))
        if 0 in camera.missing:
            findings.append(broken(path, f"{where}.missing", "frame 0, in which every twin starts, must not be missing"))
    return findings


def intrinsics_findings(file: Path, key: str, matrix: np.ndarray, size: tuple[int, int] | None) -> list[Finding]:
    """Findings about K [3, 3], pixels: its form, and (cx, cy) within an image of `size` (width, height), if known."""
    fixed = matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.array_equal(fixed, [0, 0, 0, 0, 1])):
        return [broken(file, key, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 is required", matrix.tolist())]
    if size is not None and not (0 <= matrix[0, 2] < size[0] and 0 <= matrix[1, 2] < size[1]):
        return [broken(file, key, f"(cx, cy) must lie in the {size[0]} x {size[1]} image", matrix.tolist())]
    return []


def pose_findings(file: Path, key: str, pose: np.ndarray, tolerance: float) -> list[Finding]:
    """Findings about a camera-to-world pose [4, 4], m, which must be a rotation and a translation."""
    findings = []
    rotation = pose[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    mirrored = np.linalg.det(rotation) < 0
    if not error <= tolerance or mirrored or not np.isfinite(pose).all():
        rule = f"the upper left 3 x 3 block must be a rotation (rigid: orthonormal, right-handed) within {tolerance:g}"
        hint = ", with too few digits: write six decimals" if error < FEW_DIGITS else ""
        hint = ", and a mirror image" if mirrored else hint
        findings.append(broken(file, key, rule, f"a deviation of {error:.3g} from R^T R = 1{hint}"))
    if not np.array_equal(pose[3], [0, 0, 0, 1]):
        hint = ": stored by columns, transpose it" if np.array_equal(pose[:, 3], [0, 0, 0, 1]) else ""
        findings.append(broken(file, key, "the last row must be [0, 0, 0, 1]", f"{pose[3].tolist()}{hint}"))
    return findings


def read_labels(path: Path, camera: Camera | None = None, remedy: str = "", *, binary: bool = False) -> np.ndarray:
    """Read the labels [H, W] uint8 of a mask: a gray, one-bit or palette image; the indices of a palette are the labels.

    If all values are 0 or 255, or with `binary`, every value except 0 becomes 1. Raises InputError, also for another size than that
    of `camera`, and with `remedy` for a missing file.
    """
    if not path.is_file():
        raise InputError(path, "this image must exist", "no such file", remedy)
    try:
        # OpenCV would replace the indices of a palette by its colors.
        with Image.open(path) as image:
            labels = np.asarray(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(path, "this file must be a readable PNG", "a damaged file") from error
    if camera is not None and labels.shape[:2] != (camera.height, camera.width):
        next_move = "Make masks of these images, or resize the masks with nearest-neighbor interpolation."
        rule = f"masks must have the size of the images of camera {camera.name}, {camera.width} x {camera.height}"
        raise InputError(path, rule, f"{labels.shape[1]} x {labels.shape[0]}", next_move)
    if labels.ndim != 2:
        next_move = "Write the label of each pixel as its gray value, or a palette image whose indices are the labels."
        raise InputError(path, "masks must be gray, palette or one-bit images", f"{labels.shape[2]} color channels", next_move)
    values = set(np.unique(labels).tolist())
    if values <= {0, 255} or binary:
        labels = labels > 0
    elif max(values) > PERSON:
        next_move = "For separate folders of object and hands, run `neuspring mask --masks FOLDER --hands FOLDER`."
        raise InputError(path, "labels must be 0 (nothing), 1 (object), 2 (hands) or 3 (person)", f"label {max(values)}", next_move)
    return labels.astype(np.uint8)
