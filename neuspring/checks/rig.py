"""Cameras of one scene as a whole: what is wrong with them, and the one change of lens, unit, depth or poses that makes it right.

A right rig has its table level at z = 0, flat to the sensor's noise over what it covers, cameras that see the same surfaces in the
same place, and principal points near the centers of images. Where it has not, every hypothesis of the table here is applied, to all
cameras and to those that are wrong, and the one that makes all of it right is named. Nothing is proposed that was not tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.checks.cameras import MOST_FLOATING, pairs
from neuspring.checks.table import FAR_OFF, POSE, SMALLEST_PLANE, TABLE_OFF, TILT, TILTED, Stand, on_table, other_side, stand
from neuspring.core.artifacts import up_sign
from neuspring.core.checks import Check
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import FAR, NEAR, ROLL, Camera, Plane
from neuspring.data.planes import cloud, planes

HIGHEST_CAMERA = 3.0
"""m. Cameras higher above the table have too coarse a picture of what lies on it, or another unit of depth."""
STRAIGHT_ABOVE = 20.0
"""Degrees from straight above, within which a camera has no upper side."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to OpenGL's, where y is up and z points backward."""
ROS_BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From OpenCV's axes of a camera to those of ROS's camera_link: x forward, y to the left, z up."""
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From a world with y up to one with z up."""
OFF_CENTER = 0.12
"""Part of the image by which a principal point may be off its center. Cameras have up to 0.05, or cut a part of an image out."""
SAME_SIZE = 0.06
"""Part by which the sizes of an image, as a principal point tells them, may differ from the true proportion."""
FLATTER, FLAT_SHARE = 1.15, 0.05
"""A table is flat where it was bent before if it covers so many times as many pixels, and this part of all more."""
FLAT_POINTS = 5000
"""Points of a camera by which that is told."""
MOST_ORDERED = 4
"""Cameras of which every order of poses is tried."""
FACTORS = (0.1, 10.0, 0.25, 4.0, 0.2, 5.0, 0.001, 1000.0)
"""Wrong units of depth make the scene so many times as large."""


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One way in which data of a camera can mean something else than they say."""

    name: str
    """For `make-capture --take`; empty: another option applies it."""
    looks: str
    """The thing that the data look like, with the next move."""
    lens: Callable[[np.ndarray, tuple[int, int]], np.ndarray | None] | None = None
    """K [3, 3] and (width, height) of the images -> the K that is meant; None: this cannot be."""
    depth: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    """Depth [H, W] and K -> depth along the optical axis."""
    pose: Callable[[np.ndarray], np.ndarray] | None = None
    """A pose [4, 4] -> camera to world, m."""
    model: str = ""
    """The model of the distortion, if it is another."""

    def camera(self, camera: Camera) -> Camera | None:
        """The camera that is meant."""
        matrix = camera.intrinsics if self.lens is None else self.lens(camera.intrinsics, (camera.width, camera.height))
        pose = camera.camera_to_world if self.pose is None else self.pose(camera.camera_to_world)
        return None if matrix is None else replace(camera, intrinsics=matrix, camera_to_world=pose)


def along_axis(distance: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Depth z [H, W] along the optical axis of a distance r to the camera's center: z = r / |K^-1 [x, y, 1]|."""
    y, x = np.mgrid[: distance.shape[0], : distance.shape[1]]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(intrinsics).T
    return np.asarray(distance / np.linalg.norm(rays, axis=-1))


def lens_of(intrinsics: np.ndarray, size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of images whose center is the principal point."""
    return round(2 * intrinsics[0, 2] + 1), round(2 * intrinsics[1, 2] + 1)


def resized(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """K of images of another size, for the same images at `size`; None where these have another proportion."""
    scale = np.divide(size, lens_of(intrinsics, size))
    alike = scale.min() > 0 and scale.max() < (1 + SAME_SIZE) * scale.min()
    return np.diag([scale[0], scale[1], 1.0]) @ intrinsics if alike else None


def turned(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """K of an upright image, for the image that was turned by a quarter."""
    return np.asarray(intrinsics[[1, 0, 2]][:, [1, 0, 2]])


def cropped(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """K of a larger image, for the part of it around its center; None where the image is not smaller."""
    middle = intrinsics.copy()
    middle[:2, 2] = (np.array(size) - 1) / 2
    return middle if (np.array(lens_of(intrinsics, size)) >= size).all() else None


LENS_MEANINGS = (
    Hypothesis(name="lens_resized", looks="intrinsics of images of another size, which were only resized", lens=resized),
    Hypothesis(name="lens_turned", looks="intrinsics of an image that was turned by a quarter since", lens=turned),
    Hypothesis(name="lens_cropped", looks="intrinsics of a larger image, of which this is the middle", lens=cropped),
)
DISTANCE = Hypothesis(name="distance", looks="the distance to the camera instead of depth along its axis", depth=along_axis)
INVERSE, OPENGL_NAME, Y_UPWARD = "inverse", "opengl", "y_up"
SIGNS = "Change the signs of its second and third column"
TURN = f"ultiply it from the left by {Y_UP.astype(int).tolist()}"
POSE_MEANINGS = (
    Hypothesis(name=INVERSE, looks="a world-to-camera matrix. Invert it", pose=rigid_inverse),
    Hypothesis(name=OPENGL_NAME, looks=f"a matrix for OpenGL's axes (y up, z backward). {SIGNS}", pose=lambda pose: pose @ OPENGL),
    Hypothesis(
        name="ros_body",
        looks="a pose of ROS's camera_link (x forward, y left, z up). Take the optical frame, or multiply it from the right by "
        f"{ROS_BODY.astype(int).tolist()}",
        pose=lambda pose: pose @ ROS_BODY,
    ),
    Hypothesis(
        name=f"{INVERSE}+{OPENGL_NAME}",
        looks=f"a world-to-camera matrix for OpenGL's axes (y up, z backward). Invert it, then c{SIGNS[1:]}",
        pose=lambda pose: rigid_inverse(pose) @ OPENGL,
    ),
    Hypothesis(name=Y_UPWARD, looks=f"a pose in a world with y up. M{TURN}", pose=lambda pose: Y_UP @ pose),
    Hypothesis(
        name=f"{Y_UPWARD}+{OPENGL_NAME}",
        looks=f"a pose in a world with y up, for OpenGL's axes. {SIGNS}, then m{TURN}",
        pose=lambda pose: Y_UP @ pose @ OPENGL,
    ),
    Hypothesis(
        name=f"{INVERSE}+{Y_UPWARD}",
        looks=f"a world-to-camera matrix of a world with y up. Invert it, then m{TURN}",
        pose=lambda pose: Y_UP @ rigid_inverse(pose),
    ),
)
MODEL_MEANINGS = tuple(
    Hypothesis(name=f"model={model}", looks=f"distortion by {model}", model=model)
    for model in ("opencv", "distorted_to_ideal", "fisheye")
)
MEANINGS = {one.name: one for one in (*LENS_MEANINGS, *MODEL_MEANINGS, DISTANCE, *POSE_MEANINGS)}
"""The hypotheses that --take applies, by name."""


def flat_share(depths: Sequence[np.ndarray], intrinsics: np.ndarray) -> float:
    """Share of the pixels of depth images [H, W], m, that lie on the largest plane; 0 without any."""
    return max((plane.share for plane in planes(cloud(depths, intrinsics, FLAT_POINTS), 1)), default=0.0)


def flatter(share: float, before: float) -> bool:
    """True where a table is flat by one meaning of the data, and was bent by the one before."""
    return share > max(FLATTER * before, before + FLAT_SHARE)


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras, and what they measured in a few frames."""

    cameras: Mapping[str, Camera]
    depths: Mapping[str, Sequence[np.ndarray]]
    """[H, W], m, of what may be the table; none with color alone."""
    first: Mapping[str, np.ndarray] = field(default_factory=dict)
    """[H, W], m: all of one moment."""
    up: str = "+z"
    posed: bool = True
    """False where the table gives the pose."""

    @cached_property
    def planes(self) -> dict[str, list[Plane]]:
        """Planes that are large enough for a table, by camera."""
        clouds = {name: cloud(depths, self.cameras[name].intrinsics) for name, depths in self.depths.items()}
        return {name: [plane for plane in planes(points) if plane.share >= SMALLEST_PLANE] for name, points in clouds.items()}

    @cached_property
    def stands(self) -> dict[str, tuple[Plane, Stand]]:
        """The plane that stands best, and how, by camera."""
        sign = up_sign(self.up)
        found = {
            name: [(plane, stand(plane, self.cameras[name].camera_to_world, sign)) for plane in listed]
            for name, listed in self.planes.items()
            if listed and self.posed
        }
        return {name: min(each, key=lambda one: one[1].tilt / TILT + abs(one[1].off) / TABLE_OFF) for name, each in found.items()}

    @cached_property
    def standing(self) -> dict[str, float]:
        """Distance of each camera's table from level at z = 0, 1: as far as a change that explains a finding may leave it."""
        found = {}
        for name, camera in self.cameras.items():
            if name in self.stands:
                found[name] = self.stands[name][1].away(abs(camera.camera_to_world[2, 3]))
        return found

    def exact(self, name: str) -> bool:
        """True where a camera's table is level and at z = 0."""
        return self.stands[name][1].tilt < TILT and abs(self.stands[name][1].off) < TABLE_OFF

    @cached_property
    def views(self) -> list[dict[str, Any]]:
        """Share of points that one camera saw and another looked through, of every two cameras; see `cameras.pairs`."""
        return list(pairs(self.cameras, self.first, self.up)) if self.posed else []

    @property
    def disagreement(self) -> float:
        """The greatest of these shares, 1: as much as right cameras may have."""
        return max((one["value"] for one in self.views if one["value"] is not None), default=0.0) / MOST_FLOATING

    @property
    def off_center(self) -> dict[str, float]:
        """Distance of principal points from the centers of images, 1: as cameras have them; 0 where cameras agree."""
        compared = any(one["value"] is not None for one in self.views) and self.disagreement <= 1
        if compared and max(self.standing.values(), default=2.0) <= 1:
            return dict.fromkeys(self.cameras, 0.0)
        return {
            name: float(np.abs(camera.intrinsics[:2, 2] / (camera.width - 1, camera.height - 1) - 0.5).max() / OFF_CENTER)
            for name, camera in self.cameras.items()
        }

    @property
    def right(self) -> bool:
        """True where nothing is wrong with it, as far as a change that explains a finding may leave it."""
        alike = max(self.standing.values(), default=0.0) <= 1 and max(self.off_center.values()) <= 1
        return alike and self.disagreement <= 1

    def cost(self) -> float:
        """The less, the better it is."""
        return sum(self.standing.values()) + sum(self.off_center.values()) + self.disagreement

    def flat(self) -> float:
        """Share of the pixels on the largest plane, mean over the cameras; 0 without any."""
        return float(np.mean([flat_share(depths, self.cameras[name].intrinsics) for name, depths in self.depths.items()] or [0.0]))

    def taken(self, hypothesis: Hypothesis, names: Sequence[str] | None = None) -> Rig | None:
        """The rig if cameras `names`, all by default, are as the hypothesis says; None where that cannot be."""
        names = list(self.cameras) if names is None else names
        meant = {name: hypothesis.camera(camera) if name in names else camera for name, camera in self.cameras.items()}
        cameras = {name: camera for name, camera in meant.items() if camera is not None}
        if len(cameras) < len(meant):
            return None
        depths, first, change = self.depths, self.first, hypothesis.depth
        if change is not None:
            depths = {
                name: [change(depth, cameras[name].intrinsics) for depth in listed] if name in names else listed
                for name, listed in depths.items()
            }
            first = {name: change(depth, cameras[name].intrinsics) if name in names else depth for name, depth in first.items()}
        changed: dict[str, Any] = {"cameras": cameras, "depths": depths, "first": first}
        return replace(self, **changed) if change or hypothesis.lens else self.elsewhere(**changed)

    def elsewhere(self, **changes: Any) -> Rig:
        """The rig with changes that leave its planes, which are in the coordinates of the cameras, as they are."""
        rig = replace(self, **changes)
        rig.__dict__["planes"] = self.planes
        return rig

    def scaled(self, factor: float, names: Sequence[str]) -> Rig:
        """The rig if the unit of depth makes the scene of cameras `names` so many times as large."""
        part = {name: factor if name in names else 1.0 for name in self.cameras}
        depths = {name: [depth / part[name] for depth in listed] for name, listed in self.depths.items()}
        rig = replace(self, depths=depths, first={name: depth / part[name] for name, depth in self.first.items()})
        rig.__dict__["planes"] = {name: [plane.scaled(1 / part[name]) for plane in listed] for name, listed in self.planes.items()}
        return rig

    def with_poses(self, poses: Mapping[str, np.ndarray]) -> Rig:
        """The same with other poses, camera to world [4, 4], m."""
        cameras = {name: replace(one, camera_to_world=poses[name]) for name, one in self.cameras.items()}
        return self.elsewhere(cameras=cameras)


@dataclass(frozen=True)
class Explained:
    """The change that makes a rig right."""

    what: str
    """unit, pose, lens, distance, order, up, level."""
    names: tuple[str, ...]
    """Cameras that it changes."""
    looks: str
    option: str
    """An option of make-capture; empty where there is none."""
    factor: float = 1.0
    up: str = ""
    """Up with it, where that is another."""
    rivals: tuple[str, ...] = ()
    """Options of changes of the same kind that are as good."""


def explain(rig: Rig, sides: Sequence[str] | None = None) -> Explained | None:
    """The one change that makes a rig right; None where it is right, or nothing does. `sides` that may be up, both by default."""
    along = rig.taken(DISTANCE)
    before, share = rig.flat(), along.flat() if along else 0.0
    if flatter(share, before):
        looks = f"{DISTANCE.looks}: turned into that, one plane has {share:.0%} of the pixels, and {before:.0%} without"
        return Explained("distance", tuple(rig.cameras), looks, f"--take {DISTANCE.name}")
    found = [
        (round(other.cost(), 1), number, replace(one, up="" if side == rig.up else side))
        for number, (one, changed) in enumerate(() if rig.right else _candidates(rig))
        for side in (sides or (rig.up, other_side(rig.up)))
        if one.what != "lens" or side == rig.up
        for other in [changed.elsewhere(up=side)]
        if other.right
    ]
    if found:
        best, _, one = min(found, key=lambda each: each[:2])
        alike = [other.option for cost, _, other in found if cost == best and other.what == one.what and other.option != one.option]
        return replace(one, rivals=tuple(dict.fromkeys(alike)))
    leveled = None if all(map(rig.exact, rig.stands)) else _leveled(rig)
    if leveled is not None and leveled.right:
        return Explained("level", tuple(rig.cameras), "a world that is elsewhere", "--level")
    return None


def _candidates(rig: Rig) -> Iterator[tuple[Explained, Rig]]:
    """Every change, and the rig with it."""
    every = tuple(rig.cameras)
    yield Explained("up", every, "the other side", ""), rig
    wrong = tuple(name for name in every if rig.standing.get(name, 0.0) > 1 or rig.off_center[name] > 1)
    for names in dict.fromkeys((wrong or every, every)):
        some = "" if names == every else ":" + ",".join(names)
        if rig.posed and any(rig.depths.values()):
            for factor in FACTORS:
                yield Explained("unit", names, f"{factor:g} times", "--depth-unit", factor), rig.scaled(factor, names)
        for hypothesis in (*LENS_MEANINGS, *(POSE_MEANINGS if rig.posed else ())):
            off = hypothesis.lens is None or any(rig.off_center[name] > 1 for name in names)
            if off and (other := rig.taken(hypothesis, names)):
                what = "pose" if hypothesis.lens is None else "lens"
                yield Explained(what, names, hypothesis.looks, f"--take {hypothesis.name}{some}"), other
    if not rig.posed or not 1 < len(every) <= MOST_ORDERED:
        return
    for also, turned_so in ((None, rig), *((one, rig.taken(one)) for one in POSE_MEANINGS)):
        poses = [] if turned_so is None else [turned_so.cameras[name].camera_to_world for name in every]
        for order in permutations(range(len(poses))):
            moved = [name for k, name in enumerate(every) if order[k] != k]
            if moved:
                fit = f"the poses of cameras {' and '.join(moved)} exchanged fit" if len(moved) == 2 else ""
                fit = fit or f"the poses fit in the order {' '.join(every[k] for k in order)}"
                fit += f", each as {also.looks}" if also else ""
                option = f"--take {also.name + ' ' if also else ''}order={','.join(every[k] for k in order)}"
                other = rig.with_poses({name: poses[k] for name, k in zip(every, order, strict=True)})
                yield Explained("order", tuple(moved), fit, option), other


def _leveled(rig: Rig) -> Rig | None:
    """The rig in a world whose z = 0 is the table, the plane of each camera that stands best; None without one for every camera."""
    if len(rig.stands) < len(rig.cameras):
        return None
    poses = {name: camera.camera_to_world for name, camera in rig.cameras.items()}
    normal, point, _ = common_plane({name: plane for name, (plane, _) in rig.stands.items()}, poses)
    motion = levelling(normal, point, up_sign(rig.up))
    return rig.with_poses({name: motion @ pose for name, pose in poses.items()})


def common_plane(tables: Mapping[str, Plane], poses: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal [3], towards the cameras, a point [3] and rms, m, of the plane through the table's points that all cameras
    see, in the world."""
    points = np.concatenate([plane.points @ poses[name][:3, :3].T + poses[name][:3, 3] for name, plane in tables.items()])
    center = points.mean(axis=0)
    normal = np.linalg.svd((points - center).T @ (points - center))[0][:, -1]
    eyes = np.mean([poses[name][:3, 3] for name in tables], axis=0)
    normal = normal if normal @ (eyes - center) > 0 else -normal
    return normal, center, float(np.sqrt(np.mean(((points - center) @ normal) ** 2)))


def levelling(normal: np.ndarray, point: np.ndarray, up: float) -> np.ndarray:
    """The motion [4, 4] of the world that puts a plane at z = 0, its normal along `up` z: the least turn, about a level axis."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.align_vectors([[0.0, 0.0, up]], [normal])[0].as_matrix()
    motion[2, 3] = -(motion[:3, :3] @ point)[2]
    return motion


@dataclass(frozen=True, eq=False)
class Judged:
    """A rig, and what explains it."""

    rig: Rig
    units: Mapping[str, float | None]
    """m per count of each camera; None where depth is in meters by its type."""
    of_file: bool = True
    """False where a side that is up is found, and not said."""
    taken: Callable[[str], str] | None = None
    """An option, as it is after others that are given already."""

    @cached_property
    def explained(self) -> Explained | None:
        """The change that makes it right, if there is one."""
        return (None if self.of_file else explain(self.rig, (self.rig.up,))) or explain(self.rig)

    def text(self, name: str) -> str:
        """The place of a camera's table, in words."""
        table, standing = self.rig.stands[name]
        side = "above" if standing.off > 0 else "below"
        return f"{1e3 * abs(standing.off):.0f} mm {side} z = 0 and tilted by {standing.tilt:.1f} degrees; plane: {table.text()}"


def no_table(judged: Judged) -> list[dict[str, Any]]:
    """Cameras that see no plane."""
    return [{"camera": name} for name, listed in judged.rig.planes.items() if not listed]


def tables(judged: Judged) -> list[dict[str, Any]]:
    """Height above z = 0 of each camera's table that is right, m."""
    rig = judged.rig
    return [{"camera": n, "value": rig.stands[n][1].off, "text": judged.text(n)} for n in rig.stands if rig.exact(n)]


def heights(judged: Judged) -> list[dict[str, Any]]:
    """Height of each camera above its table that is right, m."""
    return [{"camera": name, "value": plane.height} for name, (plane, _) in judged.rig.stands.items() if judged.rig.exact(name)]


def explanation(judged: Judged) -> list[dict[str, Any]]:
    """The change that makes the rig right."""
    rig, one = judged.rig, judged.explained
    if one is None or one.what == "level":
        return []
    names, level = [name for name in one.names if name in rig.cameras], "error"
    told: list[tuple[str, str, str]]
    if one.what == "up":
        rule = f"must be the side of the table on which the cameras are: {one.up}"
        told = [("up", rule, f"{rig.up}, by which camera {names[0]} is below the table")]
    elif one.what == "unit":
        unit, rule = judged.units.get(names[0]), f"the table must be as far from camera {names[0]} as its pose says"
        told = [(f"depth of camera {' and '.join(names)}", rule, one.looks)]
        if unit is not None:
            plausible = f"Plausible would be {unit / one.factor:g}"
            told = [("depth_unit", rule, f"{unit:g}, which makes it {one.factor:g} times as far. {plausible}")]
    elif one.what == "order":
        told = [("cameras", "each camera must have its own pose, in the order of the cameras", f"others; {one.looks}")]
    elif one.what == "distance":
        told = [("depth", "depth along the optical axis is required", one.looks)]
    elif one.what == "lens":
        level, told = "warning" if max(rig.standing.values(), default=0.0) <= 1 and rig.disagreement <= 1 else "error", []
        for name in names:
            matrix, size = rig.cameras[name].intrinsics, (rig.cameras[name].width, rig.cameras[name].height)
            rule = f"the principal point should lie near the center of its images, {size[0]} x {size[1]}"
            other = " x ".join(map(str, lens_of(matrix, size)))
            received = f"({matrix[0, 2]:.0f}, {matrix[1, 2]:.0f}), the center of images of {other}: {one.looks}"
            told.append((f"intrinsics of camera {name}", rule, received))
    else:
        rule = "camera-to-world is required (x right, y down, z forward): with it the table is z = 0"
        received = f"what looks like {one.looks}" + (f", and set up to {one.up}" if one.up and judged.of_file else "")
        told = [(f"cameras.{name}.camera_to_world", rule, received) for name in names]
    options = map(judged.taken or str, (one.option, *one.rivals))
    words = {"value": one.what, "level": level, "next": ""}
    words |= {"next": f"make-capture {' or '.join(options)} takes it so."} if one.option.startswith("--take") else {}
    return [words | dict(zip(("key", "rule", "received"), each, strict=True)) for each in told]


def bent(name: str, model: str, shares: Mapping[str, float]) -> dict[str, Any] | None:
    """Share of the pixels on one plane with the distortion removed by its `model`, where another one makes more of it flat."""
    best = max(shares, key=lambda other: shares[other])
    told = {"value": shares[model], "model": model, "best": best, "share": shares[best]}
    return told if flatter(shares[best], shares[model]) else None


TRIED = "units of depth, distances in its place, inverse poses, other axes, y up, exchanged cameras, other lenses, a turn"


def elsewhere(judged: Judged) -> list[dict[str, Any]]:
    """Height of each table that is elsewhere, m, where nothing but another world explains it."""
    rig, one = judged.rig, judged.explained
    if one is not None and one.what != "level":
        return []
    told = []
    for name, (_, standing) in rig.stands.items():
        if rig.exact(name):
            continue
        far = standing.tilt > TILTED or abs(standing.off) > FAR_OFF
        next_move = "`neuspring make-capture --level` puts the table at z = 0" if one else f"None of these explains it: {TRIED}"
        words = {
            "camera": name,
            "value": standing.off,
            "text": judged.text(name),
            "must": "must" if far else "should",
            "next": next_move,
        }
        told.append(words | ({"level": "error"} if far else {}))
    return told


def off_center(judged: Judged) -> list[dict[str, Any]]:
    """Principal points far from the centers of images that nothing explains, as a part of the image."""
    if judged.explained is not None and judged.explained.what == "lens":
        return []
    return [{"camera": name, "value": OFF_CENTER * value} for name, value in judged.rig.off_center.items() if value > 1]


@dataclass(frozen=True, eq=False)
class CameraAlone:
    """A camera without depth; the table is z = 0."""

    camera: Camera
    up: str
    source: str = ""
    """The source of its pose."""

    @property
    def key(self) -> str:
        """The key of its pose."""
        return f"cameras.{self.camera.name}.camera_to_world{f' ({self.source})' if self.source else ''}"

    @property
    def height(self) -> float:
        """Height of the camera above z = 0, m."""
        return abs(float(self.camera.camera_to_world[2, 3]))

    @cached_property
    def away(self) -> float:
        """Distance, m, of the table in the center of the image; NaN where it is not there."""
        center = np.array([[(self.camera.width - 1) / 2, (self.camera.height - 1) / 2]])
        return float(np.linalg.norm(on_table(self.camera, center)[0] - self.camera.camera_to_world[:3, 3]))

    @cached_property
    def wrong(self) -> tuple[str, str, bool] | None:
        """The fault of the view of the table, the value, and whether a camera may be so all the same; None: nothing."""
        sign, height = up_sign(self.up), float(self.camera.camera_to_world[2, 3])
        if height * sign <= 0:
            rule = "the camera must be above the table z = 0, on the side of it that is up"
            return rule, f"its center at z = {height:.3f} m, and up {self.up}", False
        if not NEAR <= self.away <= FAR:
            rule = f"the table z = 0 must be {NEAR:g} to {FAR:g} m away in the center of the image"
            return rule, f"{self.away:.3g} m" if np.isfinite(self.away) else "a view past it", False
        x, y, _ = sign * self.camera.camera_to_world[2, :3]
        roll = float(np.degrees(np.arctan2(abs(x), -y)))
        if roll > ROLL and np.hypot(x, y) > np.sin(np.radians(STRAIGHT_ABOVE)):
            return "up should point up in the image", f"a camera that is turned by {roll:.0f} degrees about its axis", True
        return None


def wrong_view(view: CameraAlone) -> dict[str, Any] | None:
    """The fault of the view of the table, and the poses that would be right."""
    if view.wrong is None:
        return None
    rule, received, possible = view.wrong
    alike = [
        f"{one.looks}{'' if up == view.up else ', and set up to ' + up}"
        for one in POSE_MEANINGS
        for up in (view.up, other_side(view.up))
        for meant in [one.camera(view.camera)]
        if meant and not replace(view, camera=meant, up=up).wrong
    ]
    meant = f"This looks like {'. Or like '.join(alike)}" if alike else POSE.rstrip(".")
    told = {"rule": rule, "received": f"{received}. {meant}"}
    return told | {"level": "warning", "also": ". If the camera is mounted so, go on"} if possible else told | {"also": ""}


# fmt: off
checks = (
    Check("no table seen", "rig", no_table, None, "note",
          "camera {camera} sees no plane in depth: z = 0 and up are not checked against the table", title=""),
    Check("table", "rig", tables, None, "note", "camera {camera}: the table is {text}", title=""),
    Check("high camera", "rig", heights, (0, HIGHEST_CAMERA), "warning",
          "cameras.{camera}.camera_to_world: a camera should be at most {high:g} m above the table; received {value:.2f} m. "
          "Check depth_unit: ten times too large makes all of the scene so", title=""),
    Check("explained", "rig", explanation, None, "error", "{rule}; received {received}.", "{next}", title="{key}"),
    Check("lens model", "models", bent, None, "warning",
          "by the model {model} of the distortion one plane has {value:.0%} of the pixels, by {best} {share:.0%}.",
          "make-capture --take model={best} takes it so.", title="intrinsics of camera {0}"),
    Check("table elsewhere", "rig", elsewhere, None, "warning",
          "the table that the camera sees {must} be z = 0; received {text}. {next}", title="cameras.{camera}.camera_to_world"),
    Check("principal point", "rig", off_center, (0, OFF_CENTER), "warning",
          "the principal point should lie near the center of the images; received {value:.0%} of the image beside it. Are these "
          "intrinsics of these images?", title="intrinsics of camera {camera}"),
    Check("view of the table", "camera alone", wrong_view, None, "error", "{0.key}: {rule}; received {received}{also}", title=""),
    Check("distance of the table", "camera alone", lambda view: None if view.wrong else view.away, None, "note",
          "camera {0.camera.name}: color alone: the table is z = 0 as given, {value:.2f} m away in the center of the image, "
          "{0.height:.2f} m below the camera", title=""),
    Check("high camera", "camera alone", lambda view: None if view.wrong else view.height, (0, HIGHEST_CAMERA), "warning",
          "{0.key}: a camera should be at most {high:g} m above the table; received {value:.2f} m. Is camera_to_world in meters?",
          title=""),
)
