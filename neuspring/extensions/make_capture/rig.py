"""rig.json, the user's description of the cameras. No value is guessed: the error for a missing key contains an example.

frame_rate   frames per second, or "stamps": the rate from the stamps of a video, a bag or stamps.csv
depth_unit   m per count of depth; 1 for meters
poses        camera_to_world, world_to_camera (both with `pose` of each camera), board, or table (one camera)
axes         camera axes of the given poses: opencv (x right, y down, z forward) or opengl (x right, y up, z backward)
up           axis of the given world that points up: +z, -z, +y, ...; or table: the world is moved so that the table is z = 0
table_at     optional: [x, y], a pixel of the table, if another plane is larger
board        {"squares": [5, 7], "square": 0.04, "marker": 0.03, "dictionary": "DICT_5X5_100"}: a ChArUco board, m
cameras      for each camera, in the order of --color: name (optional), width, height, fx, fy, cx, cy (pixels), distortion_model
             (none, opencv, fisheye), distortion (coefficients of OpenCV), pose (4 x 4, m), board_images (optional: a folder)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field

from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.core.section import STRICT, Count, Finite, Name, Positive
from neuspring.data.camera import Lens, Row4
from neuspring.data.capture import intrinsics_findings

KEYS = (
    ("nerfstudio transforms.json", "fl_x fl_y w h, transform_matrix", "fx fy width height, pose with axes opengl"),
    ("RealSense (librealsense)", "ppx ppy, coeffs, depth_scale", "cx cy, distortion (opencv), depth_unit"),
    ("Record3D metadata.json", "K (by columns), w h", "fx=K[0] fy=K[4] cx=K[6] cy=K[7], width height, depth_unit 1"),
    (
        "OpenCV",
        "camera_matrix (_3x3), dist_coeffs (_array), rvec tvec",
        "fx fy cx cy, distortion, pose [Rodrigues(rvec) tvec] with world_to_camera",
    ),
    (
        "ROS camera_info",
        "K D, plumb_bob or equidistant",
        "fx fy cx cy, distortion with opencv or fisheye; rectified: P, none",
    ),
    (
        "Kalibr",
        "intrinsics, radtan or equidistant, T_cn_cnm1",
        "fx fy cx cy, opencv or fisheye, chained poses with world_to_camera",
    ),
    ("ARKit", "intrinsics, transform (both by columns)", "transposed: fx fy cx cy, pose with axes opengl, up +y"),
    ("COLMAP", "params, qvec (w x y z), tvec", "fx fy cx cy, pose [R tvec] with world_to_camera, tvec times m per unit"),
    ("Open3D", "intrinsic_matrix (by columns), extrinsic", "fx fy cx cy, pose with world_to_camera"),
    ("Azure Kinect", "fx fy cx cy k1..k6 p1 p2", "distortion [k1 k2 p1 p2 k3 k4 k5 k6] with opencv, depth_unit 0.001"),
    ("TUM RGB-D", "depth factor 5000, qx qy qz qw", "depth_unit 0.0002, pose with camera_to_world and axes opencv"),
)
"""Program, its keys, and the keys of rig.json."""
EXAMPLES = {
    "frame_rate": '30, or "stamps"',
    "depth_unit": "0.001 (m per count: millimeters)",
    "poses": '"table" (one camera with depth), "camera_to_world", "world_to_camera" or "board"',
    "axes": '"opencv" (x right, y down, z forward) or "opengl"',
    "up": '"+z", the axis of the world that points up, or "table"',
    "board": '{"squares": [5, 7], "square": 0.04, "marker": 0.03, "dictionary": "DICT_5X5_100"}',
    "pose": "[[1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, -1, 0.9], [0, 0, 0, 1]]",
    "distortion_model": '"none", "opencv" or "fisheye"',
    "distortion": "[k1, k2, p1, p2, k3] of opencv, [k1, k2, k3, k4] of fisheye",
}
COEFFICIENTS = {"opencv": (4, 5, 8, 12, 14), "fisheye": (4,), "none": (0,)}
VIEW_DEGREES = (10.0, 150.0)
"""Range of the field of view, degrees; focal lengths outside it are not in pixels of the images."""


@dataclass(frozen=True, kw_only=True)
class RigCamera:
    """One camera of rig.json."""

    __pydantic_config__ = STRICT
    name: Name | None = None
    width: Count | None = None
    height: Count | None = None
    fx: Positive | None = None
    fy: Positive | None = None
    cx: Finite | None = None
    cy: Finite | None = None
    distortion_model: Literal["none", "opencv", "fisheye"] | None = None
    distortion: tuple[Finite, ...] | None = None
    pose: tuple[Row4, Row4, Row4, Row4] | None = None
    board_images: str | None = None


@dataclass(frozen=True, kw_only=True)
class BoardEntry:
    """A ChArUco board: squares across and down, and the sides of squares and markers, m."""

    __pydantic_config__ = STRICT
    squares: tuple[Annotated[int, Field(ge=3)], Annotated[int, Field(ge=3)]]
    square: Positive
    marker: Positive
    dictionary: str


@dataclass(frozen=True, kw_only=True)
class StatedRig:
    """rig.json; keys that are not stated are None."""

    __pydantic_config__ = STRICT
    frame_rate: Positive | Literal["stamps"] | None = None
    depth_unit: Positive | None = None
    poses: Literal["camera_to_world", "world_to_camera", "table", "board"] | None = None
    axes: Literal["opencv", "opengl"] | None = None
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z", "table"] | None = None
    table_at: tuple[Finite, Finite] | None = None
    board: BoardEntry | None = None
    cameras: tuple[RigCamera, ...] = ()


def read_rig(path: Path | None) -> StatedRig:
    """Read rig.json; without a file all keys are None. Raises InputError with the table of other programs' keys."""
    if path is None:
        return StatedRig()
    values = load_json(path)
    try:
        if not isinstance(values, dict):
            raise InputError(path, "a JSON object is required", type(values).__name__)
        return parse(StatedRig, values, str(path))
    except InputError as error:
        rows = "".join(f"\n  {program}: {keys} -> {rig_keys}" for program, keys, rig_keys in KEYS)
        cause = str(error).partition(". \nSee config")[0]
        raise InputError(cause, f"rig.json has its own keys ({__name__}). Keys of other programs become{rows}") from error


def stated(path: Path | None, key: str, value: Any, camera: str = "") -> Any:
    """The value of a required key. Raises InputError with an example if it is None."""
    if value is None:
        where = f"cameras.{camera}.{key}" if camera else key
        example = f"State it, for example {EXAMPLES[key]}." if key in EXAMPLES else "State it in pixels of these images."
        raise InputError(path or "--rig rig.json", f"{where}: is required", "none", example)
    return value


def lens_of(path: Path | None, name: str, entry: RigCamera, source: Lens | None, size: tuple[int, int]) -> Lens:
    """The lens of a camera with images of `size` (width, height): from rig.json if stated there, else from the recording.

    Raises InputError if a key is missing or the lens does not fit the images.
    """
    where: object = path or name
    if source is None or entry.fx is not None:
        keys = ("width", "height", "fx", "fy", "cx", "cy", "distortion_model")
        width, height, fx, fy, cx, cy, model = (stated(path, key, getattr(entry, key), name) for key in keys)
        distortion = np.array(entry.distortion or ())
        if model != "none" or len(distortion):
            distortion = np.array(stated(path, "distortion", entry.distortion, name))
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        lens = Lens(matrix=matrix, distortion=distortion, model=model, size=(width, height))
    else:
        lens = source
    if lens.size != size and lens.size is not None:
        remedy = "State the intrinsics of these images; resizing scales fx, fy, cx and cy."
        rule = f"camera {name}: width and height must be those of its images, {size[0]} x {size[1]}"
        raise InputError(where, rule, f"{lens.size[0]} x {lens.size[1]}", remedy)
    refuse(intrinsics_findings(Path(str(where)), f"intrinsics of camera {name}", lens.matrix, size))
    if lens.model not in COEFFICIENTS or len(lens.distortion) not in COEFFICIENTS[lens.model]:
        rule = f"camera {name}: distortion_model must be none, opencv (4, 5, 8, 12 or 14 coefficients) or fisheye (4)"
        remedy = "Undistort other models with the camera's software, and state the new intrinsics with distortion_model none."
        raise InputError(where, rule, f"{lens.model} with {len(lens.distortion)}", remedy)
    views = np.degrees(2 * np.arctan(0.5 * np.array(size) / np.diag(lens.matrix)[:2]))
    if not (VIEW_DEGREES[0] < views.min() and views.max() < VIEW_DEGREES[1]):
        rule = f"camera {name}: a field of view between {VIEW_DEGREES[0]:g} and {VIEW_DEGREES[1]:g} degrees is required"
        received = f"{views[0]:.1f} x {views[1]:.1f} degrees"
        raise InputError(where, rule, received, "State focal lengths in pixels of these images, not in millimeters.")
    return lens


class Straightener:
    """Removes the distortion of one camera's images; K does not change."""

    def __init__(self, lens: Lens, size: tuple[int, int]) -> None:
        self.maps: Any = None
        k, coefficients = lens.matrix, lens.distortion
        if coefficients.any():
            module = cv2.fisheye if lens.model == "fisheye" else cv2
            self.maps = module.initUndistortRectifyMap(k, coefficients, np.eye(3), k, size, cv2.CV_32FC1)

    def color(self, image: np.ndarray) -> np.ndarray:
        """Undistort color by bilinear interpolation."""
        return self._moved(image, cv2.INTER_LINEAR)

    def depth(self, image: np.ndarray) -> np.ndarray:
        """Undistort depth by the nearest value; a mean of two depths would be on neither surface."""
        return self._moved(image, cv2.INTER_NEAREST)

    def _moved(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        return image if self.maps is None else cv2.remap(np.ascontiguousarray(image), self.maps[0], self.maps[1], interpolation)
