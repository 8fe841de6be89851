"""Readers of what PhysTwin released beside its data: searched parameters, checkpoint, prediction, splats, cameras and raw files.

They are written to the described layout of the archives and tried on stand-ins only. Every reader raises InputError naming file and
key. None runs code that a file holds.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.checks.case import Case
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, broken, refuse, unusual
from neuspring.data.camera import Camera
from neuspring.data.images import read_array, read_image
from neuspring.data.unpickle import load_pickle

DEPTH_GATE = (0.2, 1.5)
"""Camera depths that the released lifting keeps, m."""
DEPTH_SCALE = 1000.0
"""Depth units per meter."""
HUMAN = "0"
"""The only detection that the released evaluation reads of a person's masks."""
LARGEST_VALUE = 1e30
"""Larger values are refused, like infinity and NaN."""
OPTIMAL_KEYS = (
    *("global_spring_Y", "object_radius", "object_max_neighbours", "controller_radius", "controller_max_neighbours"),
    *("collide_elas", "collide_fric", "collide_object_elas", "collide_object_fric", "collision_dist"),
    *("drag_damping", "dashpot_damping"),
)
CONTACT_KEYS = {
    "ground_elasticity": "collide_elas",
    "ground_friction": "collide_fric",
    "contact_elasticity": "collide_object_elas",
    "contact_friction": "collide_object_fric",
}
"""Our names of the scalars of a checkpoint, and its own."""
SPLATS_FILE = Path("point_cloud") / "iteration_10000" / "point_cloud.ply"


@dataclass(frozen=True, kw_only=True)
class Released(Case):
    """The place where the files of one case lie below the folder that the archives were unpacked in."""

    @property
    def parameters(self) -> Path:
        """The searched parameters."""
        return self.root / "experiments_optimization" / self.name / "optimal_params.pkl"

    @property
    def checkpoint(self) -> Path:
        """best_{epoch}.pth of the highest epoch; a pattern if there is none."""
        folder = self.root / "experiments" / self.name / "train"
        numbered = [path for path in folder.glob("best_*.pth") if path.stem.removeprefix("best_").isdecimal()]
        return max(numbered, key=_epoch, default=folder / "best_*.pth")

    @property
    def epoch(self) -> int:
        """The epoch of the checkpoint, which must be there."""
        return _epoch(self.checkpoint)

    @property
    def prediction(self) -> Path:
        """Node positions of all frames."""
        return self.root / "experiments" / self.name / "inference.pkl"

    @property
    def splats(self) -> Path:
        """The last splats; a pattern if there are none. Raises InputError if several trainings lie side by side."""
        folder = self.root / "gaussian_output" / self.name
        paths = sorted(folder.glob(f"*/{SPLATS_FILE}"))
        if len(paths) > 1:
            names = [path.relative_to(folder).parts[0] for path in paths]
            raise InputError(folder, "one training of splats is expected", names, "Move the others away.")
        return paths[0] if paths else folder / "*" / SPLATS_FILE

    @property
    def colors(self) -> Path:
        """Pictures of the first camera that the evaluation compares with: its own copy, or those that were copied."""
        copy = self.root / "data" / "render_eval_data" / self.name / "color" / "0"
        return copy if copy.is_dir() else self.folder / "color" / "0"

    @property
    def object_masks(self) -> Path:
        """Masks of the object for evaluation, first camera."""
        return self.root / "data" / "render_eval_data" / self.name / "mask" / "0"

    @property
    def human_masks(self) -> Path:
        """Masks of the whole person, first camera."""
        return self.root / "data" / "different_types_human_mask" / self.name / "mask" / "0" / HUMAN

    def pixel_tracks(self, camera: str) -> Path:
        """Tracked pixels."""
        return self.folder / "cotracker" / f"{camera}.npz"

    def first_depth(self, camera: str) -> Path:
        """Depth of frame 0."""
        return self.folder / "depth" / camera / "0.npy"


def _epoch(checkpoint: Path) -> int:
    return int(checkpoint.stem.removeprefix("best_"))


def parameter_findings(path: Path, parameters: Any) -> list[Finding]:
    """Keys and values of optimal_params.pkl."""
    if not isinstance(parameters, dict):
        return [broken(path, "", "a dict of 12 numbers is required", type(parameters).__name__)]
    findings = []
    for key in OPTIMAL_KEYS:
        value = parameters.get(key)
        if key not in parameters:
            findings.append(broken(path, key, "this key is missing"))
        elif not isinstance(value, (int, float, np.integer, np.floating)) or not -LARGEST_VALUE < value < LARGEST_VALUE:
            findings.append(broken(path, key, "a finite number is required", value))
        elif key.endswith("neighbours") and value != int(value):
            findings.append(broken(path, key, "a whole number is required", value))
        elif key.endswith(("neighbours", "radius")) and value <= 0:
            findings.append(broken(path, key, "a positive number is required", value))
    findings += [unusual(path, str(key), "unknown key, not read") for key in parameters if key not in OPTIMAL_KEYS]
    return findings


def read_parameters(path: Path) -> dict[str, float]:
    """The numbers of optimal_params.pkl under their own names (`OPTIMAL_KEYS`): m, N, N s/m, 1/s, counts."""
    parameters = load_pickle(path)
    refuse(parameter_findings(path, parameters))
    return {key: float(parameters[key]) for key in OPTIMAL_KEYS}


@dataclass(frozen=True, kw_only=True)
class ReleasedCheckpoint:
    """Result of a training. The springs themselves are not stored: they follow from the parameters."""

    object_springs: int
    """Springs between object nodes; they come first."""
    stiffness: np.ndarray
    """Stiffness of every spring [S], N, as stored; the simulator clamps it."""
    contact: dict[str, float] | None
    """The scalars of `CONTACT_KEYS` under our names, as stored: the simulator clamps them. None where they are not all there."""


def read_checkpoint(path: Path) -> ReleasedCheckpoint:
    """Read best_{epoch}.pth: tensors and plain values only."""
    import torch  # slow to import, and needed for this file alone

    rule = "a checkpoint with spring_Y and num_object_springs is required (read with weights_only)"
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        stiffness = stored["spring_Y"].detach().numpy()
        springs = int(stored["num_object_springs"])
        complete = all(key in stored for key in CONTACT_KEYS.values())
        contact = {name: float(stored[key]) for name, key in CONTACT_KEYS.items()} if complete else None
    except Exception as error:  # torch names no closed set of exceptions for damaged or refused files
        reason = str(error).partition("\n")[0]
        raise InputError(path, rule, f"{type(error).__name__}: {reason}") from error
    if stiffness.ndim != 1 or stiffness.dtype.kind != "f" or not 0 <= springs <= len(stiffness):
        received = f"{stiffness.shape} {stiffness.dtype} and {springs}"
        raise InputError(path, "spring_Y [S] of floating point numbers and 0 <= num_object_springs <= S are required", received)
    if not (np.isfinite(stiffness).all() and np.isfinite(list((contact or {}).values())).all()):
        raise InputError(path, "every number must be finite")
    return ReleasedCheckpoint(object_springs=springs, stiffness=stiffness, contact=contact)


def prediction_findings(path: Path, positions: Any, frames: int, nodes: int) -> list[Finding]:
    """Shape, dtype and finiteness of inference.pkl."""
    shape = (frames, nodes, 3)
    if not isinstance(positions, np.ndarray) or positions.dtype.kind != "f" or positions.shape != shape:
        received = f"{positions.shape} {positions.dtype}" if isinstance(positions, np.ndarray) else type(positions).__name__
        return [broken(path, "", f"floating point positions of shape {shape} are required", received)]
    findings = []
    if positions.dtype != np.float32:
        findings.append(unusual(path, "", "the released dtype is float32", positions.dtype))
    if not np.isfinite(positions).all():
        findings.append(broken(path, "", "every coordinate must be finite"))
    return findings


def read_prediction(path: Path, frames: int, nodes: int) -> np.ndarray:
    """Node positions [T, N, 3], m, float32, of inference.pkl."""
    positions = load_pickle(path)
    refuse(prediction_findings(path, positions, frames, nodes))
    return np.asarray(positions, dtype=np.float32)


def visible_pixels(path: Path) -> np.ndarray:
    """Frame-0 pixels [Q, 2] (row, column) of the visible tracks of cotracker/{camera}.npz."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            tracks, visible = stored["tracks"], stored["visibility"]
    except KeyError as error:
        raise InputError(path, "arrays `tracks` and `visibility` are required", str(error)) from error
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(path, "this file must be a NumPy file (npz) without pickle", f"{type(error).__name__}: {error}") from error
    has_pixels = tracks.ndim == 3 and tracks.shape[2] == 2 and len(tracks) > 0
    if not has_pixels or visible.shape != tracks.shape[:2] or visible.dtype != np.bool_:
        received = f"{tracks.shape} and {visible.shape} {visible.dtype}"
        raise InputError(path, "tracks [T, Q, 2] and bool visibility [T, Q] are required", received)
    pixels: np.ndarray = tracks[0][visible[0]].astype(np.float64)
    if not np.isfinite(pixels).all():
        raise InputError(path, "track pixels of frame 0 must be finite")
    return pixels


def depth_image(path: Path, camera: Camera) -> np.ndarray:
    """Depth of one frame [H, W], uint16, of depth/{camera}/{frame}.npy."""
    depth = read_array(path, camera)
    if depth.dtype != np.uint16:
        raise InputError(path, "a uint16 image [H, W] is required", depth.dtype)
    return depth


def gated_lift(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """World points [P, 3], m, of those pixels [Q, 2] (row, column) whose depth [H, W] lies within the gate.

    As released: whole pixels, never below the table (z > 0).
    """
    row, column = np.rint(pixels).astype(np.int64).T
    inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    row, column = row[inside], column[inside]
    z = depth[row, column] / DEPTH_SCALE
    gate = (z > DEPTH_GATE[0]) & (z < DEPTH_GATE[1])
    world = camera.lift(np.stack([column, row], axis=1)[gate].astype(np.float64), z[gate])
    world[:, 2] = np.minimum(world[:, 2], 0.0)
    return world


def mirrored(camera: Camera) -> Camera:
    """The camera with principal point W - c_x, as the released points were lifted at first."""
    intrinsics = camera.intrinsics.copy()
    intrinsics[0, 2] = camera.width - intrinsics[0, 2]
    return replace(camera, intrinsics=intrinsics)


def read_picture(path: Path, camera: Camera, *, gray: bool = False) -> np.ndarray:
    """RGB [H, W, 3] or gray [H, W], uint8."""
    if gray:
        return read_image(path, camera, cv2.IMREAD_GRAYSCALE)
    return read_image(path, camera, cv2.IMREAD_COLOR)[..., ::-1]
