"""JSON files of intrinsics and poses as other programs write them, read by their keys; see `LENS_KEYS` and `POSE_FORMS`.

Intrinsics: an object with fx, fy, cx, cy or K (3 x 3, 9 numbers or fx fy cx cy; by columns too, as Open3D and Record3D write it),
and optionally the size of its images, distortion, model. A key that may be of the lens and is not read is an error. One alone is
for all cameras. `depth_scale`, wherever it stands, is the unit of depth.

Poses: an object with the keys of one of `POSE_FORMS`, m: [4, 4], [3, 4] or the same numbers in one row.

For several cameras: a list in their order, or an object with their names as keys. Both may lie anywhere in the file.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.checks.rig import OFF_CENTER, OPENGL
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import Lens
from neuspring.data.capture import TEXT_TOLERANCE, pose_findings
from neuspring.extensions.make_capture.lenses import COEFFICIENT_COUNTS, MODELS, RATIONAL

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "taux", "tauy")
"""In OpenCV's order."""
SPELLINGS = (
    "fx fl_x / fy fl_y / cx ppx / cy ppy / K intrinsics intrinsic camera_matrix intrinsic_matrix cam_K / model / "
    "distortion_model / camera_model / distortion D dist disto coeffs dist_coeffs distortion_coeffs distortion_coefficients"
)
LENS_KEYS = {words.split()[0]: words.split() for words in (*SPELLINGS.split(" / "), *COEFFICIENTS)}
"""Keys that are read, and their spellings: ours, and those of OpenCV, ROS, librealsense, Open3D, nerfstudio and Kalibr."""
SIZE_KEYS = {"width": "width w cols", "height": "height h rows", "size": "size resolution shape dims dimensions wh hw"}
"""The same of the size of images; `IMAGE_WORDS` may stand around them."""
IMAGE_WORDS = re.compile(r"^(image|img|im|frame|picture|video|color|rgb|camera|cam|calibration|calib)+|(px|pixels)$")
DEPTH_KEYS = (
    "depth_scale depth_unit depth_units depth_factor depth_scale_factor depth_unit_scale_factor depth_to_meters depth_shift "
    "depth_map_factor png_depth_scale depth_scale_to_m"
)
"""The same of the unit of depth: meters per count, or counts per meter above 1."""
UNITS_IN_WORDS = {"m": 1.0, "meter": 1.0, "meters": 1.0, "mm": 0.001, "millimeter": 0.001, "millimeters": 0.001}
SILENT = (
    "R P rectification_matrix projection_matrix roi header frames poses initPose frameTimestamps applied_transform camera_name "
    "camera_angle_x camera_angle_y horizontal_aperture vertical_aperture T rvec tvec qvec camera_to_world world_to_camera "
    "transform_matrix rotation translation extrinsic extrinsics pose position orientation"
)
"""Keys beside them that say nothing about a lens, or the same once more."""
TELLING = re.compile(
    r"dist|coef|lens|model|skew|fish|radial|tang|focal|princip|camera|proj|^f+[xy_]|^c[xy_]|^[a-z]_?\d+$", re.IGNORECASE
)
"""A key like this may be of the lens, as may one with several numbers."""
BESIDE_THE_LENS = re.compile(r"(^|_)(errors?|rms|serial)(_|$)", re.IGNORECASE)
"""A key like this is not."""
CONVERSIONS = {
    "camera_angle_x": "An angle of view, with the width of the images: fx = fy = 0.5 width / tan(0.5 camera_angle_x). ",
    "focal_length": "In millimeters: fx = focal_length / horizontal_aperture * width, in pixels. ",
}
"""Keys that are not read, with what they say and how it becomes fx."""
REALSENSE_MODELS = ("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4")
"""By their numbers in librealsense."""
MAKERS = re.compile(
    r"\bzed|realsense|intel|kinect|k4a|azure|femto|orbbec|gemini|astra|\boak|luxonis|\b[dlt]\d{3}|iphone|ipad|basler|gopro"
)
"""Names of cameras, which some files give as their model."""
FARTHEST_CAMERA = 20.0
"""m. A camera farther from the world's origin has its position in another unit."""


@dataclass(frozen=True)
class PoseForm:
    """One form of a pose."""

    keys: tuple[str, ...]
    """Key of its matrix, or those of its rotation and translation."""
    to_world: bool
    """True for camera to world."""
    told: str = ""
    """Meaning of its keys, where they do not say it themselves."""
    axes: np.ndarray = field(default_factory=lambda: np.eye(4))
    """[4, 4]: from our axes of the camera to those of the form."""


OPENCV_POSE = "taken as OpenCV's, world to camera"
POSE_FORMS = (
    *(PoseForm((key,), True) for key in ("camera_to_world", "cam2world", "cam_to_world", "c2w")),
    *(PoseForm((key,), False) for key in ("world_to_camera", "world2cam", "world_to_cam", "w2c")),
    PoseForm(("transform_matrix",), True, "camera to world with the axes of OpenGL, turned to ours", OPENGL),
    PoseForm(("R", "T"), False, f"R and T {OPENCV_POSE}"),
    PoseForm(("rvec", "tvec"), False, f"rvec and tvec {OPENCV_POSE}"),
    PoseForm(("qvec", "tvec"), False, "qvec (w x y z) and tvec taken as COLMAP's, world to camera"),
)
MATRIX_SHAPES = ((4, 4), (3, 4), (4, 3), (16,), (12,))
ROTATION_SHAPES = ((3, 3), (9,), (3,), (4,))
"""A matrix, OpenCV's vector, or a quaternion w x y z."""
POSE_LIKE = re.compile(r"pose|extrin|rot|quat|trans|posit|orient|camera|^[RT]$|vec$", re.IGNORECASE)
"""A key like this may be of a pose."""
POSE_REMEDY = (
    'Write {"camera_to_world": [[R, t], ...]} where t is the position of the camera, or {"world_to_camera": [[R, t], ...]} where R '
    "and t move points of the world into the camera, as OpenCV has them; z forward, y down."
)
Place: TypeAlias = tuple[str | int, ...]
"""Keys and numbers in lists that lead to a part of a file."""
IsPart: TypeAlias = Callable[[dict[str, Any]], object]


def read_lenses(path: Path, names: Sequence[str]) -> dict[str, Lens]:
    """Intrinsics of each camera. Raises InputError naming the file and the key."""
    content = load_json(path)
    unit, objects, lenses = _depth_unit(path, content), list(_objects(content, _describes)), {}
    for name, (place, entry) in _of_cameras(path, "intrinsics", content, names, _describes).items():
        around = [outer for above, outer in objects if len(above) < len(place) and above == place[: len(above)]]
        for outer in around:
            beside = [key for key in outer if key not in place and _bare(key) not in QUIET and TELLING.search(key)]
            if loose := [key for key in beside if isinstance(outer[key], (float, list))]:
                raise InputError(path, "what describes a lens belongs into its camera's object", f"{loose[0]!r} beside the cameras")
        sizes = {key: value for outer in around for key, value in outer.items() if _side(key)}
        lenses[name] = _lens(path, name, sizes | entry if isinstance(entry, dict) else entry, unit)
        if place and name not in place and isinstance(place[-1], str):
            lenses[name] = replace(lenses[name], told=(f"those of {'.'.join(map(str, place))}", *lenses[name].told))
    return lenses


def read_poses(path: Path, names: Sequence[str]) -> tuple[dict[str, np.ndarray], str]:
    """Camera to world [4, 4], m, of each camera, and what was assumed, to be written after the file's name.

    Raises InputError naming the file and the key.
    """
    content = _one_each(load_json(path))
    found = [forms for _, entry in _objects(content, _pose_forms) if (forms := _pose_forms(entry))]
    if not found or any(len(forms) > 1 for forms in found):
        rule = "exactly one of the keys camera_to_world and world_to_camera is required: it says what the matrices do"
        keys = dict.fromkeys(key for key, _ in _items(content) if POSE_LIKE.search(key))
        raise InputError(path, rule, " ".join(keys) or "neither", POSE_REMEDY)
    poses, told = {}, list[str]()
    for name, (_, entry) in _of_cameras(path, "poses", content, names, _pose_forms).items():
        forms = _pose_forms(entry) if isinstance(entry, dict) else []
        if not forms:
            raise InputError(path, f"pose of camera {name}: one of the forms is required", str(entry)[:80], POSE_REMEDY)
        key = f"{' and '.join(forms[0].keys)}, camera {name}"
        matrix = _pose_matrix(path, key, [_spelled(entry, word) for word in forms[0].keys])
        if np.array_equal(matrix[:, 3], [0, 0, 0, 1]) and matrix[3, :3].any():
            matrix = matrix.T
            told.append("transposed, because the file has them by columns")
        refuse(pose_findings(path, key, matrix, TEXT_TOLERANCE))
        distance = float(np.linalg.norm(matrix[:3, 3]))
        if distance > FARTHEST_CAMERA:
            remedy = "Divide the last columns by 1000 if they are millimeters, by 100 if they are centimeters."
            raise InputError(path, f"{key}: the position must be in meters", f"one {distance:.4g} m from the origin", remedy)
        poses[name] = (matrix if forms[0].to_world else rigid_inverse(matrix)) @ forms[0].axes
        told.append(forms[0].told)
    for key, value in _items(content):
        if _bare(key) == "appliedscale" and value != 1:
            raise InputError(path, "applied_scale must be 1: positions are in meters", value, "Divide all positions by it.")
        told += ["applied_transform is not undone"] if _bare(key) == "appliedtransform" else []
    return poses, "".join(f", {text}" for text in dict.fromkeys(told) if text)


def _bare(key: object) -> str:
    """A key without case and without what separates its words."""
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


READ_AS = {_bare(word): key for key, words in LENS_KEYS.items() for word in words}
SIDES = {word: side for side, words in SIZE_KEYS.items() for word in words.split()}
UNIT_WORDS, QUIET = ({_bare(word) for word in words.split()} for words in (DEPTH_KEYS, SILENT))


def _side(key: str) -> str | None:
    """The side of a size, or `size`, that a key means."""
    return SIDES.get(IMAGE_WORDS.sub("", _bare(key)))


def _spelled(entry: dict[str, Any], key: str) -> Any:
    """The value of a key in any of its spellings."""
    wanted = {_bare(word) for word in LENS_KEYS.get(key, [key])}
    return next((value for word, value in entry.items() if _bare(word) in wanted), None)


def _items(content: Any) -> list[tuple[str, Any]]:
    """All keys of a file, and their values."""
    return [pair for _, entry in _objects(content) for pair in entry.items()]


def _objects(content: Any, is_part: IsPart = lambda entry: False, place: Place = ()) -> Iterator[tuple[Place, dict[str, Any]]]:
    """All objects of a file and their places, outer ones first, and none inside of one that is a part."""
    if isinstance(content, dict):
        yield place, content
        if is_part(content):
            return
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in inner:
        yield from _objects(value, is_part, (*place, key))


def _of_cameras(path: Path, what: str, content: Any, names: Sequence[str], is_part: IsPart) -> dict[str, tuple[Place, Any]]:
    """Place and part of each camera: by its name, in the order of a list, or the only one. Raises InputError."""
    objects = list(_objects(content, is_part))
    parts = [(place, entry) for place, entry in objects if is_part(entry)]
    outer = [(place, entry) for place, entry in objects if not is_part(entry)]
    for place, around in outer:
        if all(name in around for name in names):
            named = {name: ((*place, name), around[name]) for name in names}
            inside = {name: [part for part in parts if part[0][: len(at)] == at] for name, (at, _) in named.items()}
            return {name: inside[name][0] if len(inside[name]) == 1 else named[name] for name in names}
    if not any(name in around for _, around in outer for name in names):
        if len(parts) == 1 and (len(names) == 1 or (what == "intrinsics" and not parts[0][0])):
            return dict.fromkeys(names, parts[0])
        if len(parts) == len(names) and all(isinstance(place[-1], int) for place, _ in parts if place):
            return dict(zip(names, parts, strict=True))
    keys = [".".join(map(str, place)) for place, _ in parts] or (sorted(content) if isinstance(content, dict) else [])
    received = f"list of {len(content)}" if isinstance(content, list) else keys[:9] or type(content).__name__
    remedy = "".join(text for key, text in CONVERSIONS.items() if key in keys)
    if chosen := [place[-1] for place, _ in parts if place and isinstance(place[-1], str)]:
        like = sorted(map(str, chosen), key=lambda key: not re.search("color|rgb", key, re.IGNORECASE))[: len(names)]
        remedy = f"Choose those of the color images by their keys, which then name the cameras: --cameras {' '.join(like)}"
    rule = f"{what}: a list for {len(names)} cameras in their order, or an object with the keys {' '.join(names)}"
    raise InputError(path, rule if parts else f"{what}: fx, fy, cx, cy are required, or K [3, 3]", received, remedy)


def _depth_unit(path: Path, content: Any) -> float | None:
    """m per count of depth, where a file says it, for all cameras. Raises InputError."""
    found: dict[float, str] = {}
    for key, value in _items(content):
        if _bare(key) not in UNIT_WORDS:
            continue
        try:
            number = UNITS_IN_WORDS.get(str(value).lower()) or float(value)
        except (TypeError, ValueError):
            number = np.nan
        if not 0 < number < np.inf:
            raise InputError(path, f"{key}: meters per count of depth, or counts per meter, are required", str(value)[:80])
        found[number if number <= 1 else 1 / number] = key
    if len(found) > 1:
        received = " and ".join(f"{key} {unit:g} m per count" for unit, key in found.items())
        raise InputError(path, "one unit of depth for all cameras is required", received)
    return next(iter(found), None)


def _describes(entry: dict[str, Any]) -> bool:
    """True for an object with the intrinsics of a camera."""
    k = _spelled(entry, "K")
    inner = isinstance(k, dict) and ("data" in k or _spelled(k, "fx") is not None)
    return _spelled(entry, "fx") is not None or isinstance(k, list) or inner


def _lens(path: Path, name: str, entry: Any, unit: float | None) -> Lens:
    where = f"intrinsics of camera {name}"
    if not isinstance(entry, dict) or not _describes(entry):
        rule = f"{where}: fx, fy, cx, cy are required, or K [3, 3]"
        raise InputError(path, rule, sorted(entry) if isinstance(entry, dict) else type(entry).__name__)
    inner = _spelled(entry, "K")
    if isinstance(inner, dict) and "data" not in inner:
        entry = {key: value for key, value in entry.items() if READ_AS.get(_bare(key)) != "K"} | inner
    spelled = {key: [word for word in entry if READ_AS.get(_bare(word)) == key] for key in LENS_KEYS}
    if twice := next((words for words in spelled.values() if len(words) > 1), None):
        raise InputError(path, f"{where}: one spelling of a key is required", " and ".join(twice), "Remove the others.")
    said = {key: entry[words[0]] for key, words in spelled.items() if words}
    # Of a focal length in millimeters, K is the same in pixels.
    quiet = {*READ_AS, *UNIT_WORDS, *QUIET, *(() if _spelled(entry, "horizontal_aperture") is None else ["focallength"])}
    unread = [word for word in entry if _bare(word) not in quiet and not _side(word)]
    several = [key for key in unread if isinstance(entry[key], (list, dict))]
    if telling := [key for key in unread if (TELLING.search(key) or key in several) and not BESIDE_THE_LENS.search(key)]:
        read = [word for words in LENS_KEYS.values() for word in words]
        close = difflib.get_close_matches(telling[0], read, n=1)
        remedy = CONVERSIONS.get(telling[0], f"Is {close[0]} meant? " if close else "")
        remedy += "Remove it if it says nothing about the lens."
        raise InputError(path, f"{where}: the keys that are read are {' '.join(read)}", repr(telling[0]), remedy)
    told, matrices = [f"not read: {' '.join(unread)}"] if unread else [], []
    if "fx" in said:
        values = [said.get(key) for key in ("fx", "fy", "cx", "cy")]
        matrices.append(_numbers(path, f"{where}: fx, fy, cx, cy", values, ((4,),)))
    if "K" in said:
        matrices.append(_numbers(path, f"{where}: K", _plain(said["K"]), ((3, 3), (9,), (4,))))
    for number, k in enumerate(matrices):
        k = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1.0]]) if k.size == 4 else k.reshape(3, 3)
        by_columns = np.array_equal(k[:, 2], [0, 0, 1]) and not np.array_equal(k[2], [0, 0, 1])
        matrices[number] = k.T if by_columns else k
        told += ["K by columns"] if by_columns else []
    if not np.allclose(matrices[0], matrices[-1], rtol=1e-3):
        raise InputError(path, f"{where}: fx, fy, cx, cy and K must agree", f"{matrices[-1].tolist()}", "Remove the wrong one.")
    model = _model(path, where, said, told)
    distortion = _coefficients(path, where, said, model)
    size = _size(path, where, entry, matrices[0][:2, 2])
    return Lens(matrix=matrices[0], distortion=distortion, model=model, size=size, unit=unit, told=tuple(told))


def _model(path: Path, where: str, said: dict[str, Any], told: list[str]) -> str:
    """The name of the distortion's model; opencv where there is none. Raises InputError for two."""
    models = set()
    for key in ("model", "distortion_model", "camera_model"):
        word = str(said.get(key, "")).lower().removesuffix(".0")
        if word in [str(number) for number in range(len(REALSENSE_MODELS))]:
            word = REALSENSE_MODELS[int(word)]
            told.append(f"{key} {said[key]} is {word}, by librealsense's numbers")
        if MAKERS.search(word):
            told.append(f"{key} {said[key]} is a camera and no model of distortion, not read")
        elif word:
            models.add(word.rpartition(".")[2].removeprefix("rs2_distortion_"))
    models -= {"pinhole"} if len(models) > 1 else set()
    if len(models) > 1:
        raise InputError(path, f"{where}: one model is required", " and ".join(sorted(models)))
    return models.pop() if models else "opencv"


def _size(path: Path, where: str, entry: dict[str, Any], center: np.ndarray) -> tuple[int, int] | None:
    """(width, height) of the images that intrinsics are for, by all keys that say it; `center` is (cx, cy). Raises InputError."""
    sides, sizes = dict[str, int](), set()
    for word, value in entry.items():
        if (side := _side(word)) is None:
            continue
        found = [int(float(digits)) for digits in re.findall(r"\d+\.?\d*", str(value))]
        if len(found) < 1 + (side == "size") or (side == "size" and len(found) > 3):
            raise InputError(path, f"{where}: {word}: the size of the images in pixels is required", str(value)[:80])
        if side != "size":
            sides[side] = found[0]
            continue
        # Lists are width, height or, as shapes of arrays, height, width: the center of the image decides.
        orders = [(found[0], found[1]), (found[1], found[0])]
        off = [float(np.abs(center / order - 0.5).max()) for order in orders]
        sizes.add(orders[1] if off[1] < OFF_CENTER < off[0] else orders[0])
    if len(sides) == 1:
        raise InputError(path, f"{where}: width and height are required, or none of them", f"{next(iter(sides))} alone")
    sizes |= {(sides["width"], sides["height"])} if sides else set()
    if len(sizes) > 1:
        raise InputError(path, f"{where}: one size of the images is required", " and ".join(f"{w} x {h}" for w, h in sizes))
    return sizes.pop() if sizes else None


def _coefficients(path: Path, where: str, said: dict[str, Any], model: str) -> np.ndarray:
    """Coefficients of a list in OpenCV's order, or by name; none without any."""
    named = {key: said[key] for key in COEFFICIENTS if key in said}
    listed = _plain(said.get("distortion", []))
    if isinstance(listed, dict):
        if unknown := sorted(listed.keys() - set(COEFFICIENTS)):
            raise InputError(path, f"{where}: distortion: names {' '.join(COEFFICIENTS)} are required", unknown[0])
        named, listed = named | listed, []
    if not named:
        return _numbers(path, f"{where}: distortion", listed, ((0,), *((count,) for count in COEFFICIENT_COUNTS["opencv"])))
    if np.size(listed):
        rule = f"{where}: coefficients are required in a list or by name, not both"
        raise InputError(path, rule, f"distortion and {next(iter(named))}")
    if MODELS.get(model) == "fisheye":
        order: tuple[str, ...] = ("k1", "k2", "k3", "k4")
    else:
        order = COEFFICIENTS[: next(count for count in COEFFICIENT_COUNTS["opencv"] if named.keys() <= set(COEFFICIENTS[:count]))]
        if any(named.get(key) for key in ("k4", "k5", "k6")) and model not in RATIONAL:
            rule = f"{where}: k4 to k6 differ between programs: the model must be {' or '.join(RATIONAL)}, OpenCV's, or fisheye"
            raise InputError(path, rule, model, "Or give OpenCV's coefficients as the list distortion.")
    return _numbers(path, f"{where}: {' '.join(order)}", [named.get(key, 0.0) for key in order], ((len(order),),))


def _plain(value: Any) -> Any:
    """The numbers of a matrix that OpenCV or ROS wrote with rows, cols and data; the inside of a list of one row or one column."""
    value = value["data"] if isinstance(value, dict) and "data" in value else value
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        return value[0] if len(value) == 1 else [row[0] for row in value] if {len(row) for row in value} == {1} else value
    return value


def _numbers(path: Path, key: str, listed: Any, shapes: Sequence[tuple[int, ...]]) -> np.ndarray:
    try:
        array = np.array(listed, dtype=float)
    except (TypeError, ValueError):
        array = np.full(99, np.nan)
    if array.shape not in shapes or not np.isfinite(array).all():
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise InputError(path, f"{key}: {wanted} finite numbers are required", str(listed)[:80])
    return array


def _pose_forms(entry: dict[str, Any]) -> list[PoseForm]:
    """The forms of which an object has the keys."""
    words = {_bare(key) for key in entry}
    return [form for form in POSE_FORMS if {_bare(key) for key in form.keys} <= words]


def _one_each(content: Any) -> Any:
    """Content in which an object with a pose is that of one camera: of lists, or objects, of matrices one each is made.

    Of a list of one and the same pose, for the frames of a film, one is left.
    """
    if isinstance(content, list):
        each = [_one_each(inner) for inner in content]
        forms = [_pose_forms(inner) if isinstance(inner, dict) else [] for inner in each]
        poses = [[_spelled(one, key) for key in form[0].keys] for one, form in zip(each, forms, strict=True) if form]
        return each[:1] if len(poses) == len(each) and all(pose == poses[0] for pose in poses) else each
    if not isinstance(content, dict):
        return content
    if len(own := _pose_forms(content)) != 1:
        return {key: _one_each(inner) for key, inner in content.items()}
    keys = own[0].keys
    values = [_spelled(content, key) for key in keys]
    if all(isinstance(value, dict) for value in values):
        return {name: dict(zip(keys, (value.get(name) for value in values), strict=True)) for name in values[0]}
    if all(isinstance(value, list) for value in values) and not _is_pose(values[0]):
        return [dict(zip(keys, each, strict=True)) for each in zip(*values, strict=False)]
    return content


def _is_pose(value: list[Any]) -> bool:
    """True for numbers of one camera."""
    try:
        return np.shape(value) in (*MATRIX_SHAPES, *ROTATION_SHAPES)
    except ValueError:
        return False


def _pose_matrix(path: Path, key: str, values: Sequence[Any]) -> np.ndarray:
    """[4, 4] of a matrix, or of a rotation and a translation. Raises InputError."""
    made = np.eye(4)
    if len(values) == 1:
        matrix = _numbers(path, key, values[0], MATRIX_SHAPES)
        matrix = matrix.reshape(-1, 4) if matrix.ndim == 1 else matrix
        made[: len(matrix), : matrix.shape[1]] = matrix
        return made
    turn = _numbers(path, key, _plain(values[0]), ROTATION_SHAPES)
    if turn.size == 4:
        made[:3, :3] = Rotation.from_quat(np.roll(turn, -1)).as_matrix()
    else:
        made[:3, :3] = cv2.Rodrigues(turn)[0] if turn.size == 3 else turn.reshape(3, 3)
    made[:3, 3] = _numbers(path, key, _plain(values[1]), ((3,),))
    return made
