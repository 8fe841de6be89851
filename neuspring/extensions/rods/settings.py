"""Settings of rods and of recordings of cables."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from neuspring.core.errors import InputError
from neuspring.core.section import Count, Name, Positive, SettingsSection
from neuspring.core.text import listed


@dataclass(frozen=True, kw_only=True)
class RodSettings(SettingsSection):
    """A long thin object as a rod (rods/made.py)."""

    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0. With `lay_out` it is the unloaded shape in the recording."""
    lay_out: Annotated[int, Field(ge=4)] | None = None
    """Number of vertices at equal distances along the unloaded shape, for a line with few observed points. A hand clamps the
    first edge with its pose, and in frame 0 the rod rests under gravity. null: the observed points are the vertices."""


@dataclass(frozen=True, kw_only=True)
class RodFit(SettingsSection):
    """Levenberg-Marquardt on whole recordings (rods/fit.py), for methods whose `fit` is rod."""

    stiffness: Literal["constant", "knots", "free"] = "constant"
    """EI and GJ along the arc. constant: one value each; knots: a smooth field, cubic between `knots`; free: per joint."""
    curvature: Literal["straight", "constant", "knots", "free"] = "free"
    """Unloaded curvature along the arc. straight: not fitted; constant: one value; knots: a smooth field; free: per joint."""
    slip: Annotated[int, Field(ge=0)] = 0
    """Number of fitted branches that slip in bending and twist: friction inside the rod. 0: none."""
    knots: Annotated[int, Field(ge=4)] = 5
    """Knots of a smooth field along the arc."""
    horizons: tuple[Annotated[int, Field(ge=0)], ...] = (60, 150, 0)
    """Training frames of each stage of the fit; 0: all. The search uses the first value."""
    every: Count = 4
    """Stride of the compared frames."""


@dataclass(frozen=True, kw_only=True)
class Mocap(SettingsSection):
    """Motion capture of cables. End markers are controllers, inner markers are observed, and the cable is sampled as rings."""

    unit: Positive = 1.0
    """Unit of a recording, m."""
    rate: Positive = 100.0
    """Sampling rate of a recording, Hz."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "+z"
    """Up axis of a recording, which is rotated so that +z is up. x stays x, except for +x and -x."""
    stride: Count = 2
    """Stride of the samples."""
    start: Annotated[int, Field(ge=0)] = 0
    """Samples omitted at the beginning. With 1 or more, the sample before frame 0 gives its velocity
    (`simulation.initial_velocity: before`)."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Number of first frames to keep, after the stride; shorter recordings are an error. null keeps all."""
    train_fraction: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Fraction of training frames. 1: all frames, if other recordings provide the future frames."""
    rings: Annotated[int, Field(ge=2)] = 40
    """Number of rings. It is the same for all recordings, so that a twin can predict another recording of the cable."""


@dataclass(frozen=True, kw_only=True)
class Posed(SettingsSection):
    """A table with one row per sample: the pose of a hand that holds a long thin object, and markers. Meters, seconds, z up."""

    position: tuple[str, str, str] = ("x", "y", "z")
    """Columns of the hand's position."""
    rotation: tuple[str, ...] = ("qx", "qy", "qz", "qw")
    """Columns of the hand's rotation to the world: a quaternion, scalar last, or three angles in the order of `angles`."""
    angles: Literal["", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] = ""
    """Order of the angles, rad, about the rotating axes of the hand: ZYX is R = Rz Ry Rx. Empty: a quaternion."""
    markers: tuple[tuple[str, str, str], ...] = ()
    """Columns of each marker's position, in the order from the hand. A marker without numbers is invisible in this sample."""
    unloaded: tuple[tuple[float, float, float], ...] = ()
    """Position of each marker in the frame of the hand without load. The unloaded object is straight between markers."""
    clamp: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the clamp on the object's line, in the frame of the hand."""
    radius: Positive = 0.01
    """Radius of the object."""
    stride: Count = 1
    """Stride of the samples."""


@dataclass(frozen=True, kw_only=True)
class Deform(SettingsSection):
    """DEFORM's benchmark. Each cable has a pool of training recordings, and its twin predicts all evaluation recordings."""

    cables: tuple[Name, ...] = ()
    """Folders of `data_root` with recordings `train/NUMBER.pkl` and `eval/NUMBER.pkl`. They extend `scenarios`, `pools` and
    `transfers`."""
    clips: Annotated[int, Field(ge=2)] = 8
    """Training recordings per cable, equally spaced by their numbers. The first names the pool's scenario."""

    def expand(self, config: Any) -> Any:
        """The configuration with the scenarios, pools and transfers of the cables. Raises InputError for missing files."""
        if self.cables and config.data_root is None:
            raise InputError(
                "configuration, deform", "DEFORM's data require data_root", "null", "Add --config data_root=/path/to/data."
            )
        pools, transfers, scenarios = dict(config.pools or {}), dict(config.transfers or {}), [*config.scenarios]
        for cable in self.cables:
            folder = Path(config.data_root or ".") / cable
            numbers = {part: sorted(int(file.stem) for file in folder.glob(f"{part}/[0-9]*.pkl")) for part in ("train", "eval")}
            train, targets = ([f"{cable}_{part}_{number}" for number in files] for part, files in numbers.items())
            if len(train) < self.clips or not targets:
                rule = f"at least {self.clips} recordings train/NUMBER.pkl (deform.clips) and one eval/NUMBER.pkl are required"
                known = listed(sorted({path.parent.parent.name for path in folder.parent.glob("*/eval/*.pkl")})) or "none"
                raise InputError(
                    folder, rule, f"{len(train)} and {len(targets)}", f"Correct data_root, deform.cables (found: {known}), clips."
                )
            picked = [train[i * (len(train) - 1) // (self.clips - 1)] for i in range(self.clips)]
            pools[cable], transfers[picked[0]] = tuple(picked), tuple(targets)
            scenarios += [picked[0]] if picked[0] not in scenarios else []
        return dataclasses.replace(config, scenarios=tuple(scenarios), pools=pools or None, transfers=transfers or None)
