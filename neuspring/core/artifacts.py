"""The data types that stages exchange: frozen, validated dataclasses, each saved to one file.

Every array is declared with its shape, dtype and unit (`array(...)`). Symbolic dimensions (T frames, N nodes, S springs,
...) must agree within one artifact. Files are `.npz` without pickle: the arrays, and one JSON text under `meta` with
the kind, the format version and the plain fields. Writes are atomic, so a killed job leaves no partial file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Literal, Self, get_args, get_type_hints

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import DamagedFile, read_npz, write_npz
from neuspring.registry import Registry

FORMAT_VERSION = 2
"""Version of all artifact files; `load` rejects other versions."""
Up = Literal["+z", "-z"]
InitialVelocity = Literal["rest", "observed", "before"]
SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,79}")
"""Allowed names. They become folder names and command-line words, so separators, spaces and shell characters are excluded."""
OMITTED = {"empty": "omitted"}
"""Metadata of a field that is not written while it is empty."""
NO_REST_SHAPE = np.zeros((0, 3))
"""The empty rest shape: frame 0 is the rest shape."""


def up_sign(up: str) -> float:
    """+1 for `+z`, -1 for `-z`."""
    return 1.0 if up == "+z" else -1.0


def array(
    shape: str,
    dtype: type,
    unit: str,
    doc: str,
    *,
    sign: str = "",
    nan: bool = False,
    optional: bool = False,
    omitted: bool = False,
) -> Any:
    """Declare an array field: comma-separated dimensions (letters are symbols, digits are fixed), dtype, unit, meaning.

    `sign` restricts all entries: "positive" or "not negative". An `optional` array is empty by default. An `omitted` array is
    optional, and is not written while it is empty.
    """
    sizes = tuple(shape.split(","))
    metadata = {"shape": sizes, "dtype": np.dtype(dtype), "unit": unit, "doc": doc, "nan": nan, "omitted": omitted, "sign": sign}
    if not (optional or omitted):
        return field(metadata=metadata)
    empty = tuple(int(size) if size.isdigit() else 0 for size in sizes)
    return field(metadata=metadata, default_factory=lambda: np.zeros(empty, dtype))


def number(unit: str, doc: str, **default: float) -> Any:
    """Declare a number: unit, meaning, and a `default` if it is optional. A default of 0 is not written to files."""
    metadata = {"unit": unit, "doc": doc} | (OMITTED if default.get("default") == 0 else {})
    return field(metadata=metadata, **default)  # type: ignore[call-overload]


@dataclass(frozen=True, kw_only=True)
class Artifact:
    """Base of all artifacts: validation against the declaration, `save` and `load`."""

    kind: ClassVar[str] = "artifact"

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        for spec in dataclasses.fields(self):
            if "shape" not in spec.metadata:
                continue
            value = np.asarray(getattr(self, spec.name))
            value = self._validated(spec, value, sizes)
            value.setflags(write=False)
            object.__setattr__(self, spec.name, value)
        self.check()

    def _validated(self, spec: dataclasses.Field[Any], value: np.ndarray, sizes: dict[str, int]) -> np.ndarray:
        shape, dtype = spec.metadata["shape"], spec.metadata["dtype"]
        where = f"{self.kind}.{spec.name}"
        declared = f"[{', '.join(shape)}] {dtype.name}"
        if value.ndim != len(shape):
            raise InputError(where, f"the shape must be {declared}", f"{value.shape}")
        absent = spec.metadata["omitted"] and not value.size
        for axis, (symbol, size) in enumerate(() if absent else zip(shape, value.shape, strict=True)):
            wanted = int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size)
            if size != wanted:
                raise InputError(where, f"the shape must be {declared}, so axis {axis} must have {wanted} entries", value.shape)
        same_family = np.can_cast(value.dtype, dtype, casting="same_kind")
        if not same_family or (dtype.kind == "b") != (value.dtype.kind == "b"):
            raise InputError(where, f"the dtype must be {dtype.name}", value.dtype)
        if dtype.kind == "i" and value.size and not (value.min() >= np.iinfo(dtype).min and value.max() <= np.iinfo(dtype).max):
            raise InputError(where, f"every entry must fit {dtype.name}", f"[{value.min()}, {value.max()}]")
        value = np.array(value, dtype=dtype, order="C", copy=True)
        if dtype.kind == "f" and not spec.metadata["nan"] and not np.isfinite(value).all():
            first = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
            raise InputError(where, "every entry must be finite", f"{value[first]} at index {first}")
        sign = spec.metadata["sign"]
        if sign and ((value < 0) | ((value == 0) & (sign == "positive"))).any():
            raise InputError(where, f"must {'not be negative' if sign == 'not negative' else 'be positive'}", float(value.min()))
        return value

    def check(self) -> None:
        """Raise InputError if fields contradict each other."""

    @property
    def digest(self) -> str:
        """SHA-256 of everything that `save` writes."""
        arrays: dict[str, np.ndarray] = {}
        digest = hashlib.sha256(json.dumps(self._flatten(arrays, ""), sort_keys=True, default=dataclasses.asdict).encode())
        for name in sorted(arrays):
            digest.update(name.encode() + arrays[name].tobytes())
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Write this artifact to `path` (.npz) atomically."""
        arrays: dict[str, np.ndarray] = {}
        plain = self._flatten(arrays, "")
        meta = {"kind": self.kind, "format": FORMAT_VERSION, "fields": plain}
        text = json.dumps(meta, sort_keys=True, allow_nan=False, default=dataclasses.asdict)
        write_npz(Path(path), arrays, text, compress=True)

    def _flatten(self, arrays: dict[str, np.ndarray], prefix: str) -> dict[str, Any]:
        plain: dict[str, Any] = {}
        for spec in dataclasses.fields(self):
            value = getattr(self, spec.name)
            if "shape" in spec.metadata:
                if value.size or not spec.metadata["omitted"]:
                    arrays[prefix + spec.name] = value
            elif isinstance(value, Artifact):
                # A nested artifact's arrays go to the same file, with its field name as a prefix.
                part = value._flatten(arrays, f"{prefix}{spec.name}.")
                plain[spec.name] = part | {"kind": value.kind} if isinstance(value, BodyData) else part
            elif dataclasses.is_dataclass(value) and not isinstance(value, type):
                parts = dataclasses.fields(value)
                plain[spec.name] = {f.name: getattr(value, f.name) for f in parts if kept(f, getattr(value, f.name))}
            elif kept(spec, value):
                plain[spec.name] = value
        return plain

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read an artifact of this kind from `path`. Raises InputError if the file is missing, damaged or of another kind."""
        path = Path(path)
        if not path.is_file():
            raise InputError(path, f"this file must be of kind {cls.kind}", "no such file", "Run the step that writes it first.")
        try:
            arrays, meta = read_npz(path)
        except DamagedFile as error:
            raise InputError(
                path, f"this file must be readable and of kind {cls.kind}", str(error), "Delete it and rerun its step."
            ) from error
        if (received := (meta.get("kind"), meta.get("format"))) != (cls.kind, FORMAT_VERSION):
            rule = f"this file must be of kind {cls.kind}, format {FORMAT_VERSION}"
            raise InputError(path, rule, received, "Rerun the step that writes it.")
        try:
            return cls._build(arrays, meta["fields"], "")
        except (KeyError, TypeError) as error:
            raise InputError(
                path,
                f"this file must contain every field of kind {cls.kind} and no others",
                f"{type(error).__name__}: {error}",
                "It may be from another version: rerun the step that writes it.",
            ) from error

    @classmethod
    def _build(cls, arrays: dict[str, np.ndarray], plain: dict[str, Any], prefix: str) -> Self:
        hints = get_type_hints(cls)
        values: dict[str, Any] = {}
        if unknown := plain.keys() - hints.keys():
            raise TypeError(f"unknown fields {sorted(unknown)}")
        for spec in dataclasses.fields(cls):
            is_array = "shape" in spec.metadata
            stored: dict[str, Any] = arrays if is_array else plain
            name = prefix + spec.name if is_array else spec.name
            has_default = spec.default is not dataclasses.MISSING or spec.default_factory is not dataclasses.MISSING
            if name not in stored and has_default:
                continue  # empty fields are not written
            kind, value = hints[spec.name], stored[name]
            if isinstance(kind, UnionType):
                # `Artifact | None`: a field that is written is never None.
                kind = get_args(kind)[0]
            if kind is BodyData:
                kind, value = BODY_DATA[value["kind"]], {key: of for key, of in value.items() if key != "kind"}
            if isinstance(kind, type) and issubclass(kind, Artifact):
                value = kind._build(arrays, value, f"{prefix}{spec.name}.")
            elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
                value = kind(**value)
            elif isinstance(value, list):
                value = tuple(value)
            values[spec.name] = value
        return cls(**values)


def kept(spec: dataclasses.Field[Any], value: object) -> bool:
    """True if the field is written to files; an empty field with `OMITTED` is not."""
    return bool(value) or not OMITTED.items() <= spec.metadata.items()


@dataclass(frozen=True, kw_only=True)
class Scenario(Artifact):
    """A capture's source, frames, split and world (up direction, ground).

    Training frames are [0, train_end), future frames [train_end, frame_count).
    """

    kind: ClassVar[str] = "scenario"
    name: str
    source: str
    """The kind of data, a name of `SOURCES` (scenes/sources.py)."""
    category: str
    frame_count: int
    train_end: int
    frame_rate: float
    """Frames per second."""
    up: Up
    """Direction up along the world's z axis; the ground is the plane z = 0."""
    self_collision: bool = False
    ground: bool = True
    mass: float | None = field(default=None, metadata=OMITTED)
    """Mass of the object, kg, to which exports scale; None: unknown. Motion depends only on forces per mass."""
    provenance: dict[str, str] = field(default_factory=dict)
    """Input files with digests, and options of the reader, as text."""

    @property
    def up_sign(self) -> float:
        """+1 when +z is up, -1 when -z is up."""
        return up_sign(self.up)

    def check(self) -> None:
        if not SAFE_NAME.fullmatch(self.name):
            raise InputError("scenario.name", f"a name must match {SAFE_NAME.pattern}", repr(self.name))
        if not 1 < self.train_end <= self.frame_count:
            raise InputError(
                f"scenario {self.name}, split",
                f"1 < train_end <= frame_count = {self.frame_count} is required",
                f"train_end = {self.train_end}",
                "Correct the split: at least one frame after frame 0 must be a training frame.",
            )
        if not (np.isfinite(self.frame_rate) and self.frame_rate > 0):
            raise InputError(
                f"scenario {self.name}, frame_rate", "a positive number of frames per second is required", self.frame_rate
            )
        if self.up not in ("+z", "-z"):
            raise InputError(f"scenario {self.name}, up", "must be '+z' or '-z'", repr(self.up))
        if self.mass is not None and not 0 < self.mass < np.inf:
            raise InputError(f"scenario {self.name}, mass", "a positive number of kg is required", self.mass)


@dataclass(frozen=True, kw_only=True)
class ImageObservations(Artifact):
    """Observations of one calibrated camera without depth: the object in training frames, the hands in all frames.

    If the capture contains controllers in 3D (intake/points.py), H = 0 and `hand_of` is empty.

    Pixel centers are at integer coordinates, x right, y down (data/capture.py).
    """

    kind: ClassVar[str] = "image_observations"
    width: int
    height: int
    intrinsics: np.ndarray = array("3,3", np.float64, "px", "K")
    camera_to_world: np.ndarray = array("4,4", np.float64, "m", "pose")
    pixel_size: float
    """Width of a pixel at the object in frame 0, m."""
    pixels: np.ndarray = array("T,No,2", np.float32, "px", "image positions of tracked object points; zeros where not visible")
    visible: np.ndarray = array("T,No", np.bool_, "1", "whether each tracked point is visible; false in future frames")
    inside: np.ndarray = array("E,P,2", np.float32, "px", "points on the object, training frames; padded with NaN", nan=True)
    outside: np.ndarray = array("E,h,w", np.float32, "px", "distance of each image cell from object and hands; 0 inside them")
    cell: int
    """Side of a cell, px; the center of cell (row i, column j) is ((j + 1/2) cell - 1/2, (i + 1/2) cell - 1/2)."""
    hand_of: np.ndarray = array("C", np.int32, "1", "index of the hand of each controller")
    hand_centers: np.ndarray = array("T,H,2", np.float32, "px", "image position of each hand's grasp")
    hand_angles: np.ndarray = array("T,H", np.float32, "rad", "rotation of each hand in the image since frame 0, from x to y")
    hand_sizes: np.ndarray = array("T,H", np.float32, "1", "apparent size of each hand, relative to frame 0")
    marked: np.ndarray = array("T,K,2", np.float32, "px", "annotated points, for scoring only; NaN: not annotated", nan=True)

    @property
    def hands(self) -> int:
        """Number of hands, H."""
        return self.hand_centers.shape[1]  # type: ignore[no-any-return]


@dataclass(frozen=True, kw_only=True)
class Observations(Artifact):
    """Observations of a capture: tracked object points, controllers, and the object's nodes in frame 0.

    The canonical node order is [object_points[0] | surface_points | interior_points]; the first No + Ns are surface nodes.
    """

    kind: ClassVar[str] = "observations"
    scenario: Scenario
    object_points: np.ndarray = array("T,No,3", np.float32, "m", "tracked points; zeros where not visible")
    object_visibility: np.ndarray = array("T,No", np.bool_, "1", "whether each tracked point is visible in each frame")
    object_motion_valid: np.ndarray = array("T,No", np.bool_, "1", "row t: whether the motion from frame t to t+1 is reliable")
    controller_points: np.ndarray = array("T,C,3", np.float32, "m", "points that move the object (hands, grippers)")
    """A controller that grasps later starts at its future contact point, because its springs are built in frame 0."""
    controller_valid: np.ndarray = array(
        "T,C", np.bool_, "1", "whether each controller holds the object in each frame; empty: always", omitted=True
    )
    controller_hand: np.ndarray = array("C", np.int32, "1", "index of the hand of each controller; empty: unknown", omitted=True)
    surface_points: np.ndarray = array("Ns,3", np.float32, "m", "further surface nodes of frame 0")
    interior_points: np.ndarray = array("Ni,3", np.float32, "m", "interior nodes of frame 0")
    tracks: np.ndarray = array("T,K,3", np.float32, "m", "annotated tracks for scoring only; NaN where not annotated", nan=True)
    rest_shape: np.ndarray = array(
        "R,3", np.float32, "m", "unloaded positions of nodes, then controllers; empty: frame 0 is the rest shape", optional=True
    )
    line: np.ndarray = array(
        "V",
        np.int32,
        "1",
        "center line of a long thin object: node indices, or N + c for controller c, in order; empty: unknown",
        omitted=True,
    )
    velocity_before: np.ndarray = array(
        "P,3",
        np.float32,
        "m/s",
        "velocity of tracked points, then controllers, in frame 0, from the sample before it; empty: unknown",
        omitted=True,
    )
    image: ImageObservations | None = field(default=None, metadata=OMITTED)
    """Observations of a camera without depth. With them, object points are known only in frame 0, and hands seen by the camera
    move in a plane (extensions/color_alone/hands.py)."""

    def check(self) -> None:
        name = f"observations of {self.scenario.name}"
        frames, points = self.object_visibility.shape
        if frames != self.scenario.frame_count:
            raise InputError(name, f"the scenario declares {self.scenario.frame_count} frames", f"arrays of {frames} frames")
        if points == 0:
            raise InputError(name, "at least one tracked object point is required", "none")
        if self.controller_points.shape[1] == 0:
            raise InputError(name, "at least one controller point is required", "none", "Without controllers, nothing moves.")
        if not self.object_visibility[0].all():
            count = int((~self.object_visibility[0]).sum())
            raise InputError(
                name, "every tracked point must be visible in frame 0, where rollouts start", f"{count} of {points} are not"
            )
        hands = self.controller_points.shape[1]
        _require_rest_shape(name, self.rest_shape, len(self.nodes) + hands)
        total = len(self.nodes) + hands
        if self.line.size and not (
            len(set(self.line.tolist())) == len(self.line) > 2 and 0 <= self.line.min() <= self.line.max() < total
        ):
            rule = f"must contain at least 3 different indices in [0, {total})"
            raise InputError(f"{name}.line", rule, self.line.tolist())
        if len(self.velocity_before) not in (0, points + hands):
            rule = f"must contain one velocity per tracked point and controller ({points + hands}), or none"
            raise InputError(f"{name}.velocity_before", rule, len(self.velocity_before))
        if self.image is not None:
            sizes = (*self.image.visible.shape, len(self.image.hand_of) if self.image.hands else hands)
            wanted = (frames, points, self.controller_points.shape[1])
            if sizes != wanted:
                raise InputError(f"{name}.image", f"frames, tracked points and controllers must be {wanted}", sizes)

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of frame 0 [N, 3], m."""
        return np.concatenate([self.object_points[0], self.surface_points, self.interior_points])

    @property
    def canonical(self) -> np.ndarray:
        """Nodes, then controllers [N + C, 3], m, in the shape in which topology, regions and field are defined."""
        return canonical_shape(self.nodes, self.controller_points[0], self.rest_shape)

    def on_line(self, positions: np.ndarray) -> np.ndarray:
        """The center line [F, V, 3], m, for node positions [F, N, 3] and the controllers of the first F frames."""
        joined: np.ndarray = np.concatenate([positions, self.controller_points[: len(positions)]], axis=1)[:, self.line]
        return joined

    @property
    def surface_count(self) -> int:
        """Number of surface nodes, which come first: No + Ns."""
        return len(self.object_points[0]) + len(self.surface_points)


def canonical_shape(nodes: np.ndarray, controllers: np.ndarray, rest_shape: np.ndarray) -> np.ndarray:
    """The rest shape [N + C, 3], m; if it is empty, nodes [N, 3] and controllers [C, 3] of frame 0."""
    return rest_shape if len(rest_shape) else np.concatenate([nodes, controllers])


def _require_rest_shape(name: str, rest_shape: np.ndarray, points: int) -> None:
    if len(rest_shape) not in (0, points):
        raise InputError(
            f"{name}.rest_shape", f"must contain one position per node and controller ({points}), or none", len(rest_shape)
        )


@dataclass(frozen=True, kw_only=True)
class Topology(Artifact):
    """The spring graph. Spring end points are node indices; an index i >= N means controller i - N."""

    kind: ClassVar[str] = "topology"
    nodes: np.ndarray = array("N,3", np.float32, "m", "positions of frame 0")
    controllers: np.ndarray = array("C,3", np.float32, "m", "controller positions of frame 0")
    springs: np.ndarray = array("S,2", np.int32, "1", "end points; object springs first, then controller springs")
    rest_lengths: np.ndarray = array("S", np.float32, "m", "lengths without force")
    labels: np.ndarray = array("N", np.int32, "1", "region of each node; all zero in a uniform topology")
    rest_shape: np.ndarray = array(
        "R,3", np.float32, "m", "unloaded positions of nodes, then controllers; empty: frame 0 is the rest shape", optional=True
    )
    pushes: np.ndarray = array(
        "S", np.bool_, "1", "controller springs that act only while shorter than their rest length; empty: none", omitted=True
    )
    controller_rest: str = "rest_shape"
    """Shape in which controller springs have no force: rest_shape or first_frame."""

    def check(self) -> None:
        nodes, total = len(self.nodes), len(self.nodes) + len(self.controllers)
        _require_rest_shape("topology", self.rest_shape, total)
        if len(self.springs) and (self.springs.min() < 0 or self.springs.max() >= total):
            raise InputError(
                "topology.springs", f"indices must be in [0, {total})", f"[{self.springs.min()}, {self.springs.max()}]"
            )
        of_controller = (self.springs >= nodes).any(axis=1)
        if (np.diff(of_controller.astype(np.int8)) < 0).any():
            raise InputError("topology.springs", "object springs must come before controller springs")
        if (self.springs >= nodes).all(axis=1).any():
            raise InputError("topology.springs", "a spring must not connect two controllers")
        if self.pushes.size and (self.pushes & ~of_controller).any():
            raise InputError("topology.pushes", "only controller springs may be push-only", "an object spring")
        if self.controller_rest not in ("rest_shape", "first_frame"):
            raise InputError("topology.controller_rest", "must be 'rest_shape' or 'first_frame'", repr(self.controller_rest))
        short = np.flatnonzero(~(self.rest_lengths > 0))
        if len(short):
            raise InputError(
                "topology.rest_lengths",
                "every spring must have a positive rest length",
                f"{self.rest_lengths[short[0]]} m for spring {short[0]} between {self.springs[short[0]].tolist()}",
                "Remove duplicate points before building the springs.",
            )

    @property
    def canonical(self) -> np.ndarray:
        """Nodes, then controllers [N + C, 3], m, in the shape in which rest lengths and field are defined."""
        return canonical_shape(self.nodes, self.controllers, self.rest_shape)

    @property
    def object_spring_count(self) -> int:
        """Number of springs that connect two nodes; they come first."""
        return int(np.count_nonzero((self.springs < len(self.nodes)).all(axis=1)))


@dataclass(frozen=True, kw_only=True)
class Material(Artifact):
    """Physical parameters. Each node has 1 kg, as in the released simulator, or its value of `mass`; forces scale with mass."""

    kind: ClassVar[str] = "material"
    stiffness: np.ndarray = array("S", np.float32, "N", "Y in f = Y (l / l0 - 1): force per unit strain", sign="not negative")
    dashpot: np.ndarray = array("S", np.float32, "N s/m", "damping along the spring", sign="not negative")
    drag: float = number("1/s", "exponential decay of velocity")
    ground_elasticity: float = number("1", "restitution: fraction of the normal speed after contact with the ground")
    ground_friction: float = number("1", "Coulomb's coefficient")
    contact_elasticity: float = number("1", "as ground_elasticity, between nodes")
    contact_friction: float = number("1", "as ground_friction, between nodes")
    contact_distance: float = number("m", "distance below which approaching nodes collide")
    mass: np.ndarray = array("N", np.float32, "kg", "mass of each node; empty: 1 kg each", sign="positive", optional=True)

    def check(self) -> None:
        for name in SCALARS:
            value = getattr(self, name)
            if not np.isfinite(value):
                raise InputError(f"material.{name}", "must be finite", value)
        if self.drag < 0 or self.contact_distance <= 0:
            raise InputError("material", "drag >= 0 and contact_distance > 0 are required", (self.drag, self.contact_distance))


SCALARS = tuple(spec.name for spec in dataclasses.fields(Material) if "shape" not in spec.metadata)
"""Scalar fields of the material."""


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Integration settings of a twin: what a rollout needs besides topology, material and controller motion."""

    frame_time: float
    """Simulated time per frame, s. The substep is frame_time / substeps."""
    substeps: int
    up: Up = "+z"
    gravity: float = 9.8
    """m/s^2, towards -up."""
    ground: bool = True
    self_collision: bool = False
    collision_capacity: int = 500
    """Collision candidates kept per node and frame; a rollout counts the others as overflow."""
    controller_velocity: bool = False
    """Whether dashpots use the finite-difference velocity of controllers. The released simulator uses zero."""
    initial_velocity: InitialVelocity = "rest"
    """Velocity in frame 0: zero (rest), as in the released simulator; from the first frames (observed); from the sample before
    frame 0 (before)."""

    def __post_init__(self) -> None:
        if not (0 < self.frame_time < np.inf and self.substeps >= 1 and self.collision_capacity >= 1 and np.isfinite(self.gravity)):
            rule = "finite frame_time > 0, substeps >= 1, collision_capacity >= 1, finite gravity are required"
            raise InputError("simulation", rule, self)
        if self.up not in ("+z", "-z"):
            raise InputError("simulation.up", "must be '+z' or '-z'", repr(self.up))

    @property
    def substep(self) -> float:
        """Integration step, s."""
        return self.frame_time / self.substeps

    @property
    def up_sign(self) -> float:
        """+1 when +z is up, -1 when -z is up."""
        return up_sign(self.up)


@dataclass(frozen=True, kw_only=True)
class BodyData(Artifact):
    """Data that a body other than the lattice stores in a twin; packages register subclasses in `BODY_DATA`."""

    def check_with(self, topology: Topology) -> None:
        """Raise InputError if this contradicts the nodes, controllers and springs of the twin."""

    @property
    def counts(self) -> dict[str, int]:
        """Sizes for the record of a stage."""
        return {}


BODY_DATA: Registry[type[BodyData]] = Registry("body_data", {}, type)
"""Kind -> class, from entry points of the group `neuspring.body_data`."""


@dataclass(frozen=True, kw_only=True)
class Twin(Artifact):
    """Topology, material and simulation settings: everything that a rollout needs except the controllers' motion."""

    kind: ClassVar[str] = "twin"
    topology: Topology
    material: Material
    simulation: Simulation
    body: BodyData | None = field(default=None, metadata=OMITTED)
    """Data of a body other than the lattice; None: a lattice. With such data, all springs may be controller springs."""

    def check(self) -> None:
        springs, values = len(self.topology.springs), len(self.material.stiffness)
        if springs != values:
            raise InputError("twin", f"the material must have one stiffness per spring ({springs})", values)
        nodes, masses = len(self.topology.nodes), len(self.material.mass)
        if masses not in (0, nodes):
            raise InputError("twin", f"the material must have one mass per node ({nodes}), or none", masses)
        if self.body is not None:
            self.body.check_with(self.topology)

    @property
    def counts(self) -> dict[str, int]:
        """Sizes for the record of a stage."""
        return (self.body.counts if self.body else {}) | {
            "nodes": len(self.topology.nodes),
            "springs": len(self.topology.springs),
            "object_springs": self.topology.object_spring_count,
            "substeps": self.simulation.substeps,
        }


@dataclass(frozen=True, kw_only=True)
class Trajectory(Artifact):
    """Predicted node positions. If the rollout diverges, the trajectory contains the frames before `diverged_frame`."""

    kind: ClassVar[str] = "trajectory"
    positions: np.ndarray = array("F,N,3", np.float32, "m", "positions at the end of each frame; frame 0 is the rest state")
    frame_count: int
    """Number of requested frames; F is smaller only if the rollout diverged."""
    diverged_frame: int | None = None
    reason: str = ""
    collision_overflow: int = 0
    """Number of collision candidates beyond the list's capacity, summed over frames."""

    def check(self) -> None:
        frames = len(self.positions)
        expected = self.frame_count if self.diverged_frame is None else self.diverged_frame
        if frames != expected:
            raise InputError("trajectory.positions", f"{expected} frames are expected", frames)


@dataclass(frozen=True, kw_only=True)
class SplatCenters(Artifact):
    """Splat centers predicted by a method's own model; all other splat properties are those of frame 0."""

    kind: ClassVar[str] = "splat_centers"
    positions: np.ndarray = array("F,G,3", np.float32, "m", "center of each splat at the end of each frame")
