"""Settings of the sources of data that this package makes or samples itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, Name, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class Toy(SettingsSection):
    """Analytic scenes simulated by the float64 reference, with known stiffness."""

    frames: Annotated[int, Field(ge=5)] = 60
    """Frames per scene; the first 70 % are for training."""


@dataclass(frozen=True, kw_only=True)
class Mocap(SettingsSection):
    """Motion capture of cables: end markers control, inner markers are observed, the body is sampled as rings."""

    unit: Positive = 1.0
    """m per count of a recording."""
    rate: Positive = 100.0
    """Samples per second of a recording."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "+z"
    """Up in a recording. It is turned so that +z is up; x stays x, but for +x and -x."""
    stride: Count = 2
    """Stride of samples of the record."""
    start: Annotated[int, Field(ge=0)] = 0
    """Samples left out at the beginning of the record. With at least one, the velocity in frame 0 is known from the sample before
    it (`simulation.initial_velocity: before`)."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Number of frames that are kept, the first ones, counted after the stride; shorter recordings are refused. null keeps all."""
    train_fraction: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Part of the frames that are for training, the first ones. 1: all, where future frames are those of other recordings."""
    rings: Annotated[int, Field(ge=2)] | None = None
    """Number of rings, whatever their spacing, so that a twin can move to another recording of the cable; null: one every 12 mm."""
    ring: Annotated[int, Field(ge=3)] = 4
    """Nodes per ring."""
    rest_shape: Literal["first_frame", "straight"] = "first_frame"
    """Shape without forces: frame 0, as in the paper, or a straight cable with the arc lengths of frame 0."""
    grip: Literal["markers", "clamp"] = "markers"
    """Hold of an end: its two markers, which leave its roll free, or a clamp. clamp: and a ring of `ring` points around each, which
    turns with the direction of the two without spinning, so that direction and roll are held. With a straight rest shape set
    `search.controller_rest: first_frame` too."""


@dataclass(frozen=True, kw_only=True)
class Posed(SettingsSection):
    """A table with a row per sample: the pose of a hand that holds a long thin body, and markers on it. Meters, seconds, z up."""

    time: str = "t"
    """Column of the time."""
    position: tuple[str, str, str] = ("x", "y", "z")
    """Columns of the hand's position."""
    rotation: tuple[str, ...] = ("qx", "qy", "qz", "qw")
    """Columns of its rotation to the world: a quaternion, scalar last, or the three angles that `angles` names."""
    angles: Literal["", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] = ""
    """Order of angles, rad, about the axes of the hand as it turns: R = Rz Ry Rx is ZYX. Empty: a quaternion."""
    markers: tuple[tuple[str, str, str], ...] = ()
    """Columns of each marker's position, in their order from the hand on. A marker without numbers is not seen in this sample."""
    unloaded: tuple[tuple[float, float, float], ...] = ()
    """Place of each marker in the frame of the hand if nothing loads the body, which then runs straight from one to the next."""
    clamp: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of the clamp on the body's line, in the frame of the hand."""
    radius: Positive = 0.01
    """Radius of the body."""
    rings: Annotated[int, Field(ge=2)] = 24
    """Number of rings of nodes along the body, which lattices are made of."""
    ring: Annotated[int, Field(ge=3)] = 3
    """Nodes per ring."""
    stride: Count = 1
    """Stride of samples of the table."""
    train_fraction: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Part of the frames that are for training, the first ones. 1: all, where future frames are those of other recordings."""


@dataclass(frozen=True, kw_only=True)
class Deform(SettingsSection):
    """DEFORM's benchmark. For each cable: a pool of training recordings, whose twins go to all evaluation recordings."""

    cables: tuple[Name, ...] = ()
    """Folders of `data_root`, each with recordings `train/NUMBER.pkl` and `eval/NUMBER.pkl`. They are added to `scenarios`, `pools`
    and `transfers`."""
    clips: Annotated[int, Field(ge=2)] = 8
    """Training recordings per cable, equally spaced in the order of their numbers. The first of them names the pool's scenario."""
    leave_out: tuple[Name, ...] = ()
    """Recordings that are not used, as DLO3_train_15. The place of one for training takes the nearest by number."""


@dataclass(frozen=True, kw_only=True)
class Synthetic(SettingsSection):
    """Synthetic captures: finite elements seen by a ray caster through a model of a depth sensor."""

    size: Literal["tiny", "small", "demo", "full"] = "demo"
    """Size of the images, with meshes to match: 120 x 68, 424 x 240 (small: with coarser bodies) or 848 x 480 pixels."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Number of frames that are kept, the first ones; null keeps all."""
    certified_frames: Count = 20
    """Number of first frames in which twice the substeps must not move the clip; more of them cost time and change no picture."""
    sensor: Literal["model", "clean"] = "model"
    """Depth sensor: with noise, dropouts and holes (model), or only quantized (clean)."""
